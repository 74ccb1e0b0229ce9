"""The wall clock of a farm's processes, which is set back and forth while they run (libfaketime).

Only CLOCK_REALTIME is set: setting a machine's clock does not touch its monotonic clock. The processes are those that
are started with `environment`: the coordinator, and the database server, which the coordinator starts.
"""

import os
import tempfile
from pathlib import Path
from typing import Final

LIBRARY: Final = "*/faketime/libfaketimeMT.so.1"
SLEEP: Final = Path(__file__).with_name("set_clock")


class FarmClock:
    """A clock that starts right. Its file lies where every user may read it: the database server has one of its own."""

    def __init__(self) -> None:
        self._folder = tempfile.TemporaryDirectory(prefix="lightkiln-clock-")
        Path(self._folder.name).chmod(0o755)
        self._file, self.offset_s = Path(self._folder.name) / "clock", 0
        self._library = next(iter(sorted(Path("/usr/lib").glob(LIBRARY))), None)
        self._file.write_bytes(self._line())
        self._file.chmod(0o644)

    @property
    def works(self) -> bool:
        """Whether libfaketime is installed here."""
        return self._library is not None

    def environment(self) -> dict[str, str]:
        """What processes need to have this clock; nothing without the library."""
        if self._library is None:
            return {}
        paths = [str(SLEEP), *filter(None, [os.environ.get("PYTHONPATH")])]
        return {
            "LD_PRELOAD": str(self._library),
            "FAKETIME_TIMESTAMP_FILE": str(self._file),
            "FAKETIME_NO_CACHE": "1",
            "DONT_FAKE_MONOTONIC": "1",
            "FAKETIME_DONT_FAKE_MONOTONIC": "1",
            "PYTHONPATH": os.pathsep.join(paths),
        }

    def close(self) -> None:
        """Remove the file; no process may have this clock any more."""
        self._folder.cleanup()

    def set(self, offset_s: int) -> None:
        """Set the clock to so many seconds after the true time, for all processes at once."""
        self.offset_s = offset_s
        # One write of the same length: nobody may read half a line.
        descriptor = os.open(self._file, os.O_WRONLY)
        try:
            os.pwrite(descriptor, self._line(), 0)
        finally:
            os.close(descriptor)

    def _line(self) -> bytes:
        return f"{self.offset_s:+08d}\n".encode()
