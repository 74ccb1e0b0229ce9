"""This worker's share of the machine: sizes as people write them, memory and cores as the container grants them."""

import fcntl
import os
import re
import stat
import tempfile
from pathlib import Path
from typing import IO, Final

from kiln_schemas.errors import InputError, MachineLacks

UNITS: Final = {"": 1, "B": 1}
for _power, _letter in enumerate("KMGT", start=1):
    UNITS[f"{_letter}iB"] = 1024**_power
    UNITS[f"{_letter}B"] = 1000**_power
    UNITS[_letter] = 1024**_power

MEMORY_SHARE: Final = 0.6
"""Of the machine's memory, what a worker takes unless told otherwise; the rest is for libraries and the page cache."""
CGROUP: Final = Path("/sys/fs/cgroup")
SLOTS: Final = 1024


def parse_size(text: str) -> int:
    """`4GiB`, `500 MB` or plain bytes, in bytes."""
    match = re.fullmatch(r"\s*(\d+(?:\.\d+)?)\s*([A-Za-z]*)\s*", text)
    if match is None or match[2] not in UNITS or not 0 < float(match[1]) * UNITS[match[2]] < 2**63:
        raise InputError(f"'{text}' is not a size", where="--memory", remedy="Write it as 4GiB or 500MB.")
    return int(float(match[1]) * UNITS[match[2]])


def memory_bytes() -> int:
    """Main memory of the machine, or of the container where that has less."""
    physical = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    limit = _cgroup_value("memory.max")
    return min(physical, int(limit)) if limit and limit.isdecimal() else physical


def default_memory_bytes() -> int:
    """What a worker takes when `--memory` is not given."""
    return int(MEMORY_SHARE * memory_bytes())


def cores() -> int:
    """Cores that this process may use: its affinity, and the container's quota where that is less."""
    allowed = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    quota, _, period = (_cgroup_value("cpu.max") or "").partition(" ")
    if quota.isdecimal() and period.isdecimal():
        allowed = min(allowed, max(1, int(quota) // int(period)))
    return allowed


def claim_folder(base: Path | None = None) -> tuple[Path, IO[bytes]]:
    """A folder that no other running worker uses, and the open lock that keeps it so.

    The folders of workers that were killed are used again, so what they left is bounded and their blob caches
    stay of use. Made under `base`, or under the system's temporary folder, where others may have made a folder of this
    name before us: MachineLacks where it, or a worker's folder in it, is a link or is not ours alone.
    """
    temporary = base is None
    base = base or Path(tempfile.gettempdir()) / f"lightkiln-worker-{os.getuid()}"
    try:
        base.mkdir(parents=True, exist_ok=True, mode=0o700)
        if temporary:
            own(base)
        for slot in range(SLOTS):
            opened = os.open(base / f"{slot}.lock", os.O_WRONLY | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC, 0o600)
            lock = os.fdopen(opened, "wb")
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                lock.close()
                continue
            folder = base / str(slot)
            try:
                folder.mkdir(exist_ok=True, mode=0o700)
                own(folder)
            except BaseException:
                lock.close()
                raise
            return folder, lock
    except OSError as error:
        raise MachineLacks(
            f"the worker's folder cannot be made: {error.strerror}",
            where=str(base),
            remedy="Free disk space, or name another folder with --scratch.",
        ) from None
    raise MachineLacks(f"{SLOTS} workers already use this folder", where=str(base), remedy="Pass another --scratch.")


def own(folder: Path) -> None:
    """Make a folder of ours private, mode 0700; MachineLacks where it is a link, no folder, or another user's."""
    found = folder.lstat()
    kind = "a link" if stat.S_ISLNK(found.st_mode) else None if stat.S_ISDIR(found.st_mode) else "no folder"
    if kind is None and found.st_uid != os.geteuid():
        kind = f"owned by user {found.st_uid}, not by {os.geteuid()}"
    if kind is not None:
        raise MachineLacks(
            f"the worker's folder is {kind}, so others could read and change what is in it",
            where=str(folder),
            remedy="Remove it, or name another folder with --scratch.",
        )
    if stat.S_IMODE(found.st_mode) != 0o700:
        folder.chmod(0o700)


def _cgroup_value(name: str) -> str | None:
    """A limit of our control group (version 2, as a container sees its own); None where there is none."""
    try:
        return (CGROUP / name).read_text().strip()
    except OSError:
        return None
