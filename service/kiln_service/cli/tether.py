"""`python -m kiln_service.cli.tether PARENT_PID COMMAND...`: run a command that ends when its parent does.

Linux sends the signal asked for with PR_SET_PDEATHSIG (prctl(2)) when the parent thread that forked us ends; the
setting survives execve. The signal is SIGTERM, so that a coordinator stops its database and a worker gives its task
back even where `lightkiln bake` was killed with -9. The parent may have died before the call, hence the look at its
pid. Elsewhere than on Linux the command simply runs.
"""

import ctypes
import os
import signal
import sys
from typing import Final

PR_SET_PDEATHSIG: Final = 1


def main() -> None:
    """Ask for the signal, look for the parent, become the command."""
    parent_pid, command = int(sys.argv[1]), sys.argv[2:]
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGTERM)
        if os.getppid() != parent_pid:
            sys.exit(0)
    os.execv(command[0], command)


if __name__ == "__main__":
    main()
