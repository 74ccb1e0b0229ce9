"""Handing the process over to another of the package's programs."""

import os
import signal
import sys
from typing import NoReturn


def become(module: str, arguments: list[str]) -> NoReturn:
    """Turn into `python -m module`: signals, exit code and output are then that process's own."""
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    sys.stdout.flush()
    os.execv(sys.executable, [sys.executable, "-m", module, *arguments])
