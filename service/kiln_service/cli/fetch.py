"""Download a job's package so that a folder with a manifest is always whole.

Files arrive in `DIR.partial`, beside `DIR`, each checked against its hash; then they are moved into `DIR`, the manifest
last. Files of an older package in `DIR` go first, its manifest before the others. Below `DIR` no link is followed:
nothing outside of it is written, moved or removed, whatever a manifest names.
"""

import contextlib
import os
import shutil
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TypeVar

from pydantic import BaseModel
from rich.progress import BarColumn, DownloadColumn, Progress, TextColumn

from kiln_schemas.client import Client
from kiln_schemas.conventions import MANIFEST_JSON
from kiln_schemas.errors import DISK_FULL, Conflict, InputError, MachineLacks
from kiln_schemas.files import LeavesFolder, open_inside, parent_folder, read_small
from kiln_schemas.job import check_bundle_path
from kiln_schemas.tasks import Artifact
from kiln_service.cli.bundle import sha256_of
from kiln_service.cli.output import notices


class _Named(BaseModel):
    name: str


class _Listed(BaseModel):
    """What has to be known of a package to remove it."""

    files: list[_Named]


class _Checked(BaseModel):
    """What has to be known of a package to verify it."""

    files: list[Artifact]


M = TypeVar("M", bound=BaseModel)


def download_package(api: Client, job_id: str, out: Path, *, force: bool = False, bar: bool = True) -> list[Path]:
    """Put the job's artifacts into `out`; the files, the manifest last."""
    if (out / MANIFEST_JSON).exists() and not force:
        raise Conflict("there is a package already", where=str(out), remedy="Pass --force to replace it.")
    artifacts = sorted(api.artifacts(job_id), key=lambda a: (a.name == MANIFEST_JSON, a.name))
    if not artifacts or artifacts[-1].name != MANIFEST_JSON:
        raise InputError(
            "the job has no package", where=job_id, remedy=f"Ask `lightkiln status {job_id}` whether it completed."
        )
    for artifact in artifacts:
        check_bundle_path(artifact.name)
    partial = out.with_name(out.name + ".partial")
    with writing(out):
        partial.mkdir(parents=True, exist_ok=True)
        if partial.is_symlink():
            raise InputError("is a link", where=str(partial), remedy="Remove it, or choose another --out.")
        _fetch(api, job_id, artifacts, partial, bar)
        out.mkdir(parents=True, exist_ok=True)
        remove_package(out)
        for artifact in artifacts:
            with (
                parent_folder(partial, artifact.name) as (source, name),
                parent_folder(out, artifact.name, make=True) as (target, _),
            ):
                os.replace(name, name, src_dir_fd=source, dst_dir_fd=target)
        shutil.rmtree(partial)
    return [out / artifact.name for artifact in artifacts]


def damaged_files(folder: Path) -> tuple[int, list[str]]:
    """How many files a package's manifest names, and those that are missing or differ from it."""
    try:
        entries = _read(folder, _Checked).files
    except OSError as error:
        raise InputError(
            error.strerror or "it cannot be read",
            where=str(folder / MANIFEST_JSON),
            remedy="Name the folder of a package.",
        ) from None
    except ValueError:
        raise InputError("this is not a manifest that lightkiln wrote", where=str(folder / MANIFEST_JSON)) from None
    return len(entries), [entry.name for entry in entries if not _is_whole(folder, entry)]


def remove_package(out: Path) -> None:
    """Remove the files that the manifest in `out` names, the manifest first; nothing where there is none.

    A name that leads through a link is refused before anything is removed: what lies behind it is not the package's.
    """
    try:
        names = [check_bundle_path(entry.name) for entry in _read(out, _Listed).files]
    except FileNotFoundError:
        return
    except ValueError:
        raise Conflict(
            "this is not a manifest that lightkiln wrote",
            where=str(out / MANIFEST_JSON),
            remedy="Choose another --out.",
        ) from None
    for name in names:
        with contextlib.suppress(FileNotFoundError, NotADirectoryError), parent_folder(out, name):
            pass
    for name in (MANIFEST_JSON, *names):
        with (
            contextlib.suppress(FileNotFoundError, NotADirectoryError),
            parent_folder(out, name) as (parent, last),
        ):
            os.unlink(last, dir_fd=parent)


def _read(folder: Path, model: type[M]) -> M:
    """The manifest in `folder` as far as `model` wants it; OSError where there is none, ValueError where it is bad."""
    return model.model_validate_json(read_small(folder / MANIFEST_JSON))


def _is_whole(folder: Path, entry: Artifact) -> bool:
    try:
        with open_inside(folder, entry.name) as file:
            return sha256_of(file, entry.name) == entry.sha256
    except OSError:
        return False


@contextlib.contextmanager
def writing(where: Path) -> Iterator[None]:
    """Errors of the file system as sentences."""
    try:
        yield
    except OSError as error:
        if error.errno in DISK_FULL:
            raise MachineLacks("the disk is full", where=str(where), remedy="Free space and try again.") from None
        if isinstance(error, LeavesFolder):
            raise InputError(
                f"{error.strerror}, through which nothing is written or removed",
                where=str(error.filename or where),
                remedy="Remove the link, or choose another folder.",
            ) from None
        raise InputError(
            f"cannot be written: {error.strerror}", where=str(error.filename or where), remedy="Choose another folder."
        ) from None


def _fetch(api: Client, job_id: str, artifacts: Sequence[Artifact], partial: Path, bar: bool) -> None:
    """Download what an interrupted download has not left in `partial`."""
    columns = (TextColumn("downloading"), BarColumn(), DownloadColumn())
    with Progress(*columns, console=notices, transient=True, disable=not (bar and notices.is_terminal)) as shown:
        row = shown.add_task("downloading", total=sum(artifact.size for artifact in artifacts))
        for artifact in artifacts:
            with parent_folder(partial, artifact.name, make=True):
                pass
            if _is_whole(partial, artifact):
                shown.advance(row, artifact.size)
                continue
            api.download(job_id, artifact, partial / artifact.name, lambda size: shown.advance(row, size))
