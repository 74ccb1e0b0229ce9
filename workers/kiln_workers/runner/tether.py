"""Tie a process to its parent's life, so that a killed worker leaves no renderer behind.

Linux sends PR_SET_PDEATHSIG when the parent *thread* that forked us ends (prctl(2)), so parents start children from
their main thread. The parent may have died before the call, which the kernel does not report; hence the look at the
parent's pid after it.
"""

import ctypes
import os
import signal
import sys
from typing import Final

PR_SET_PDEATHSIG: Final = 1


def die_with_parent(parent_pid: int, sig: signal.Signals = signal.SIGKILL) -> None:
    """Have the kernel send `sig` to this process when its parent ends; exit at once where that happened already.

    Does nothing on systems other than Linux, where the end of standard input has to do.
    """
    if sys.platform != "linux":
        return
    if ctypes.CDLL(None, use_errno=True).prctl(PR_SET_PDEATHSIG, sig) != 0:
        raise OSError(ctypes.get_errno(), "prctl(PR_SET_PDEATHSIG)")
    if os.getppid() != parent_pid:
        os._exit(0)
