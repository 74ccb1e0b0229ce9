"""`lightkiln doctor`: what this machine can do, as coordinator and as worker, and how to mend what it lacks.

The worker's checks run in the worker's own process (renderer and network may abort one); the database is really
started, with a coordinator, in a temporary folder.
"""

import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Final, Literal

from pydantic import TypeAdapter, ValidationError

from kiln_schemas.base import Contract
from kiln_schemas.errors import KilnError
from kiln_service.cli.farm import HOST, LocalFarm

GIB: Final = 1 << 30
DISK_WANTED: Final = 5 * GIB
WORKER_TIMEOUT_S: Final = 600


class Check(Contract):
    """One finding; the worker prints the same fields."""

    name: str
    status: Literal["ok", "warn", "fail"]
    detail: str
    remedy: str | None = None


def examine(folder: Path) -> list[Check]:
    """All checks; `folder` is where a bake's data would go."""
    return [*_worker_checks(), *_store(folder), _database()]


def _worker_checks() -> list[Check]:
    done = subprocess.run(
        [sys.executable, "-m", "kiln_workers", "doctor", "--json"],
        capture_output=True,
        text=True,
        timeout=WORKER_TIMEOUT_S,
    )
    try:
        return TypeAdapter(list[Check]).validate_json(done.stdout)
    except ValidationError:
        words = done.stderr.strip().splitlines()
        detail = words[-1] if words else f"its check ended with status {done.returncode}"
        return [Check(name="worker", status="fail", detail=detail, remedy="Run: pip install 'lightkiln[worker]'.")]


def _store(folder: Path) -> list[Check]:
    """Whether a file can be written there, and how much room there is."""
    existing = next(parent for parent in (folder, *folder.parents) if parent.exists())
    try:
        with tempfile.TemporaryDirectory(prefix=".lightkiln-doctor-", dir=existing) as probe:
            (Path(probe) / "shard").write_bytes(bytes(4096))
    except OSError as error:
        return [
            Check(
                name="store",
                status="fail",
                detail=f"{existing} cannot be written: {error.strerror}",
                remedy="Name a folder that can be with --data.",
            )
        ]
    free = shutil.disk_usage(existing).free
    room = Check(name="disk", status="ok", detail=f"{free / GIB:.1f} GiB free")
    if free < DISK_WANTED:
        remedy = "A draft needs 1 GiB, a preview 5, a production bake tens: free space, or name a disk with --data."
        room = room.model_copy(update={"status": "warn", "remedy": remedy})
    return [Check(name="store", status="ok", detail=f"{existing} can be written"), room]


def _database() -> Check:
    """Start a coordinator on an empty folder, with its embedded database, and ask whether it is ready."""
    with tempfile.TemporaryDirectory(prefix="lightkiln-doctor-", ignore_cleanup_errors=True) as folder:
        try:
            with LocalFarm(Path(folder), workers=0, threads=1, memory=GIB, say=lambda message: None) as farm:
                farm.start()
        except KilnError as error:
            return Check(name="database", status="fail", detail=error.detail, remedy=error.remedy)
    return Check(name="database", status="ok", detail=f"the embedded PostgreSQL starts, and the coordinator on {HOST}")
