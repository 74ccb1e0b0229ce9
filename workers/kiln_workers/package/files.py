"""Files that are either whole or absent: written beside their final name, flushed to disk, then renamed.

A package is downloaded by its manifest, and the manifest is written last; so that a crash between leaves
nothing that could be mistaken for a result, every file of a package passes through `whole_file`.
"""

import hashlib
import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO, Final

from kiln_schemas.errors import MachineLacks
from kiln_schemas.tasks import Artifact

MEDIA_TYPES: Final = {
    ".ktx2": "image/ktx2",
    ".exr": "image/x-exr",
    ".glb": "model/gltf-binary",
    ".json": "application/json",
    ".html": "text/html; charset=utf-8",
    ".xml": "application/xml",
    ".png": "image/png",
    ".glsl": "text/plain; charset=utf-8",
    ".hlsl": "text/plain; charset=utf-8",
    ".wgsl": "text/plain; charset=utf-8",
}


def write_bytes(path: Path, data: bytes) -> None:
    """Write `data` to `path` atomically and durably; MachineLacks where the disk is full or not writable."""
    with whole_file(path) as file:
        file.write(data)


@contextmanager
def whole_file(path: Path) -> Iterator[BinaryIO]:
    """A file to write and read; it gets its name, atomically and durably, when the block ends without an error.

    MachineLacks where the disk is full or not writable.
    """
    temporary: Path | None = None
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(prefix=f".{path.name}.", suffix=".part", dir=path.parent)
        temporary = Path(name)
        with os.fdopen(handle, "w+b") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        temporary.chmod(0o644)
        temporary.replace(path)
        _sync_folder(path.parent)
    except OSError as error:
        raise MachineLacks(
            f"cannot be written: {error.strerror or error}",
            where=str(path),
            remedy="Free disk space or choose another folder.",
        ) from error
    finally:
        if temporary is not None:
            temporary.unlink(missing_ok=True)


def artifact(folder: Path, name: str) -> Artifact:
    """Name, hash, size and media type of a file of the package, as read back from the disk."""
    path = folder / name
    with path.open("rb") as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
    media_type = MEDIA_TYPES.get(path.suffix, "application/octet-stream")
    return Artifact(name=name, sha256=digest, size=path.stat().st_size, media_type=media_type)


def _sync_folder(folder: Path) -> None:
    """Make a rename durable: on POSIX the folder's own entry has to be flushed too."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
