"""A bounded cache of blobs on the worker's disk, so that the scene is fetched once and not once a tile.

Files are named by their sha256 and checked against it whenever they are read, so a damaged disk or a truncated file
costs a download and never a wrong picture. The least recently used files go first when the bound is met.
"""

import hashlib
import os
import shutil
from collections.abc import Callable
from pathlib import Path

from kiln_workers.runner.client import CHUNK
from kiln_workers.runner.machine import own

Fetch = Callable[[str, Path], None]
"""Downloads the blob of a hash to a path."""


class BlobCache:
    """Blobs under `folder`, `limit_bytes` in all (one larger blob may stand alone), filled by `fetch`."""

    def __init__(self, folder: Path, limit_bytes: int, fetch: Fetch) -> None:
        self.folder, self.limit_bytes, self._fetch = folder, limit_bytes, fetch
        folder.mkdir(parents=True, exist_ok=True, mode=0o700)
        own(folder)

    def get(self, sha256: str) -> Path:
        """A file with the blob's bytes; read it at once, or `link` it: a later `get` may evict it."""
        path = self.folder / sha256
        if _is_file(path) and file_sha256(path) == sha256:
            os.utime(path)
            return path
        _remove(path)
        self._fetch(sha256, path)
        self._evict(keep=path)
        return path

    def link(self, sha256: str, target: Path) -> Path:
        """The blob at `target`, independent of the cache: a hard link, or a copy where there are none."""
        source = self.get(sha256)
        target.unlink(missing_ok=True)
        try:
            target.hardlink_to(source)
        except OSError:
            shutil.copyfile(source, target)
        return target

    def _evict(self, keep: Path) -> None:
        entries = sorted((p for p in self.folder.iterdir() if _is_file(p)), key=lambda p: p.stat().st_mtime_ns)
        total = sum(p.stat().st_size for p in entries)
        for path in entries:
            if total <= self.limit_bytes:
                return
            if path != keep:
                total -= path.stat().st_size
                path.unlink()


def _is_file(path: Path) -> bool:
    """Whether it is a file itself: a link is none, wherever it leads."""
    return path.is_file() and not path.is_symlink()


def _remove(path: Path) -> None:
    """Remove what has a blob's name: a damaged file, a link, or a folder."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


def file_sha256(path: Path) -> str:
    """Hash of a file's bytes, read in pieces."""
    digest = hashlib.sha256()
    with path.open("rb") as file:
        while chunk := file.read(CHUNK):
            digest.update(chunk)
    return digest.hexdigest()
