"""What anybody does in a folder, told by the kernel (inotify): libraries in C are seen as well as Python."""

import ctypes
import os
import struct
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

IN_ALL_EVENTS = 0xFFF
EVENT = struct.Struct("iIII")
_libc = ctypes.CDLL(None, use_errno=True)


class WatchedFolder:
    """The acts in a folder since the last time that was asked."""

    def __init__(self, folder: Path) -> None:
        self._handle = _libc.inotify_init1(os.O_NONBLOCK | os.O_CLOEXEC)
        if self._handle < 0 or _libc.inotify_add_watch(self._handle, os.fsencode(folder), IN_ALL_EVENTS) < 0:
            raise OSError(ctypes.get_errno(), "inotify", str(folder))

    def acts(self) -> list[str]:
        """Mask and name of each act."""
        found = []
        with suppress(BlockingIOError):
            while data := os.read(self._handle, 65536):
                offset = 0
                while offset < len(data):
                    _, mask, _, length = EVENT.unpack_from(data, offset)
                    name = data[offset + EVENT.size : offset + EVENT.size + length].rstrip(b"\0")
                    found.append(f"{mask:#x} {os.fsdecode(name)}")
                    offset += EVENT.size + length
        return found

    def close(self) -> None:
        os.close(self._handle)


@contextmanager
def watched(folder: Path) -> Iterator[WatchedFolder]:
    """The folder, watched for the block."""
    watch = WatchedFolder(folder)
    try:
        yield watch
    finally:
        watch.close()
