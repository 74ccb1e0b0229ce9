"""The real prepare task, watched from inside its process: what it opens, makes, moves, starts, and how much it takes.

Python tells every such act to an audit hook (PEP 578). What lies where it may lie is passed over; the rest, the growth
of the memory's peak and the seconds go into the task's log as one line of JSON.
"""

import contextlib
import json
import os
import site
import sys
import sysconfig
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from kiln_schemas import files
from kiln_schemas.tasks import PreparePayload, PrepareResult
from kiln_workers.runner.context import Context
from kiln_workers.stages import prepare

FILES = {"open", "os.listdir", "os.scandir", "os.mkdir", "os.remove", "os.rename", "os.link", "os.symlink", "os.rmdir"}
OTHERS = {"subprocess.Popen", "os.exec", "os.posix_spawn", "os.system", "socket.getaddrinfo", "socket.connect"}
LIBRARIES = (
    *{sys.prefix, sys.base_prefix, *sysconfig.get_paths().values(), *site.getsitepackages()},
    *(str(Path(prepare.__file__).parents[1]), str(Path(__file__).parent)),
    *("/usr/lib", "/lib", "/etc/ld.so"),
)
COORDINATOR = ("'127.0.0.1'", "('127.0.0.1', ", "b'127.0.0.1'")
"""What it may connect to."""
FBX = repr([sys.executable, "-m", "kiln_workers.scene.fbx_native"])
"""What it may start."""

_seen: list[str] | None = None


def _hook(event: str, arguments: tuple[Any, ...]) -> None:
    if _seen is None or event not in FILES | OTHERS:
        return
    if event in FILES:
        folder = _walked() if event == "open" else Path.cwd()
        if event in ("os.remove", "os.rmdir") and arguments[1] >= 0:  # relative to an open folder
            folder = Path(f"/proc/self/fd/{arguments[1]}").readlink()
        for path in arguments[: 2 if event in ("os.rename", "os.link", "os.symlink") else 1]:
            if isinstance(path, str | bytes | os.PathLike):
                _seen.append(f"{event} {folder / os.fsdecode(path)}")
    else:
        which = {"socket.connect": -1, "subprocess.Popen": 1}.get(event, 0)
        _seen.append(f"{event} {arguments[which]!r}")


def _walked() -> Path:
    """Where a relative name is opened: below the folder that `kiln_schemas.files` has open, which no event tells."""
    frame = sys._getframe(2)
    if frame.f_code.co_filename != files.__file__:
        return Path.cwd()
    walk = frame.f_locals.get("walk") or [frame.f_locals.get("handle")]
    return Path.cwd() if walk[-1] is None else Path(f"/proc/self/fd/{walk[-1]}").readlink()


sys.addaudithook(_hook)


def run(payload: PreparePayload, context: Context) -> PrepareResult:
    global _seen
    allowed = (*LIBRARIES, str(context.scratch), str(context.scratch.with_name("blobs")))
    with contextlib.suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")  # the peak begins anew
    before, began = _memory("VmRSS"), time.perf_counter()
    _seen = []
    try:
        return prepare.run(payload, context)
    finally:
        seen, _seen = _seen, None
        strays = sorted({act for act in seen if not act.partition(" ")[2].startswith((*allowed, *COORDINATOR, FBX))})
        report = {
            "acts": len(seen),
            "strays": strays[:20],
            "grown": _memory("VmHWM") - before,
            "seconds": time.perf_counter() - began,
        }
        context.log("WATCHED " + json.dumps(report))


def _memory(key: str) -> int:
    """Bytes of this process by its name in /proc/self/status."""
    return next(value for name, value in _status() if name == key)


def _status() -> Iterator[tuple[str, int]]:
    for line in Path("/proc/self/status").read_text().splitlines():
        name, _, rest = line.partition(":")
        if rest.endswith("kB"):
            yield name, int(rest.split()[0]) << 10
