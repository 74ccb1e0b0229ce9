"""How every program of lightkiln begins and ends: standard streams that can be used, and no traceback for users.

`begin` is the first thing that a `main` does. `explained` turns whatever ended it into an error with a sentence and an
exit code: what the operating system refused (a full disk, a folder that is read-only, a path that is a file) is the
machine's lack, and what nobody foresaw is a defect, whose traceback goes into a file without secrets. `end` is the last
thing: output that cannot be written any more is an exit code too.
"""

import errno
import os
import secrets
import sys
import tempfile
import traceback
from contextlib import suppress
from datetime import datetime
from io import TextIOWrapper
from typing import Final, NoReturn

from kiln_schemas.errors import DISK_FULL, InternalError, KilnError, MachineLacks
from kiln_schemas.proxies import spare_loopback
from kiln_schemas.redact import command_of, redacted

BROKEN_PIPE: Final = 141
"""Exit code where the reader of standard output has gone: what a shell has for SIGPIPE."""


def begin() -> None:
    """Make the standard streams safe to use, and spare the loopback any proxy."""
    for number, mode in enumerate(("r", "w", "w")):
        try:
            os.fstat(number)
        except OSError:
            # Closed by whoever started us: the next file or socket would get its number, and be written to.
            os.open(os.devnull, os.O_RDWR)
        name = ("stdin", "stdout", "stderr")[number]
        if getattr(sys, name) is None:
            setattr(sys, name, open(number, mode, closefd=False))  # noqa: SIM115
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, TextIOWrapper):
            # A name that is not UTF-8, or a terminal that has fewer characters, is shown escaped.
            stream.reconfigure(errors="backslashreplace")
    spare_loopback()


def explained(error: Exception) -> KilnError:
    """The error with a sentence and an exit code that `error` stands for."""
    if isinstance(error, KilnError):
        return error
    if isinstance(error, OSError) and error.errno is not None:
        return refused(error)
    if isinstance(error, MemoryError):
        return MachineLacks("there is not enough memory", remedy="Close other programs, or use a larger machine.")
    return defect(error)


def refused(error: OSError) -> MachineLacks:
    """What the operating system did not let us do."""
    where = os.fsdecode(error.filename) if isinstance(error.filename, str | bytes) else None
    if error.errno in DISK_FULL:
        return MachineLacks("the disk is full", where=where, remedy="Free space and try again.")
    if error.errno in (errno.EMFILE, errno.ENFILE):
        return MachineLacks("too many files are open", where=where, remedy="Raise the limit (`ulimit -n`).")
    return MachineLacks(
        f"the operating system refuses: {error.strerror}",
        where=where,
        remedy="Check that it is there, what it is, and that this user may use it.",
    )


def defect(error: BaseException) -> InternalError:
    """Write the traceback to a file, without secrets, and name that to the user."""
    text = "".join(traceback.format_exception(error))
    detail = f"a defect in lightkiln: {type(error).__name__}"
    try:
        with tempfile.NamedTemporaryFile(
            "w",
            prefix=f"lightkiln-defect-{secrets.token_hex(4)}-",
            suffix=".log",
            delete=False,
            errors="backslashreplace",
        ) as file:
            file.write(f"{datetime.now().isoformat()} {command_of(sys.argv)}\n{redacted(text)}")
    except OSError:
        place = traceback.extract_tb(error.__traceback__)[-1:]
        at = "".join(f" at {frame.name}, line {frame.lineno}" for frame in place)
        return InternalError(detail + at, remedy="Please report it; no log could be written to the temporary folder.")
    return InternalError(detail, remedy=f"Please report it with {file.name}.")


def end(code: int) -> NoReturn:
    """Exit, with another code where standard output takes no more."""
    try:
        sys.stdout.flush()
    except OSError as error:
        code = output_lost(error)
    sys.exit(code)


def output_lost(error: OSError) -> int:
    """The exit code where standard output takes no more, which is shut so that nothing more is tried."""
    with suppress(OSError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
    if error.errno == errno.EPIPE:
        return BROKEN_PIPE
    with suppress(OSError):
        print(f"standard output cannot be written: {error.strerror}", file=sys.stderr)
    return MachineLacks.exit_code
