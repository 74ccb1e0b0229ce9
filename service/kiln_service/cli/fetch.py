"""Download a job's package so that a folder with a manifest is always whole.

Files arrive in `DIR.partial`, beside `DIR`, each checked against its hash; then they are moved into `DIR`, the manifest
last. Files of an older package in `DIR` go first, its manifest before the others.
"""

import contextlib
import json
import shutil
from collections.abc import Iterator, Sequence
from pathlib import Path

from rich.progress import BarColumn, DownloadColumn, Progress, TextColumn

from kiln_schemas.client import Client
from kiln_schemas.conventions import MANIFEST_JSON
from kiln_schemas.errors import DISK_FULL, Conflict, InputError, MachineLacks
from kiln_schemas.job import check_bundle_path
from kiln_schemas.tasks import Artifact
from kiln_service.cli.bundle import sha256_of
from kiln_service.cli.output import notices


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
        _fetch(api, job_id, artifacts, partial, bar)
        remove_package(out)
        for artifact in artifacts:
            target = out / artifact.name
            target.parent.mkdir(parents=True, exist_ok=True)
            (partial / artifact.name).replace(target)
        shutil.rmtree(partial)
    return [out / artifact.name for artifact in artifacts]


def damaged_files(folder: Path) -> tuple[int, list[str]]:
    """How many files a package's manifest names, and those that are missing or differ from it."""
    path = folder / MANIFEST_JSON
    try:
        entries = [Artifact.model_validate(entry) for entry in json.loads(path.read_text())["files"]]
        names = [check_bundle_path(entry.name) for entry in entries]
    except OSError as error:
        reason = error.strerror or "it cannot be read"
        raise InputError(reason, where=str(path), remedy="Name the folder of a package.") from None
    except (ValueError, KeyError, TypeError):
        raise InputError("this is not a manifest that lightkiln wrote", where=str(path)) from None
    whole = [
        (folder / name).is_file() and sha256_of(folder / name) == e.sha256
        for name, e in zip(names, entries, strict=True)
    ]
    return len(names), [name for name, good in zip(names, whole, strict=True) if not good]


def remove_package(out: Path) -> None:
    """Remove the files that the manifest in `out` names, the manifest first; nothing where there is none."""
    manifest = out / MANIFEST_JSON
    if not manifest.is_file():
        return
    try:
        names = [check_bundle_path(entry["name"]) for entry in json.loads(manifest.read_text())["files"]]
    except (ValueError, KeyError, TypeError):
        raise Conflict(
            "this is not a manifest that lightkiln wrote", where=str(manifest), remedy="Choose another --out."
        ) from None
    manifest.unlink()
    for name in names:
        (out / name).unlink(missing_ok=True)


@contextlib.contextmanager
def writing(where: Path) -> Iterator[None]:
    """Errors of the file system as sentences."""
    try:
        yield
    except OSError as error:
        if error.errno in DISK_FULL:
            raise MachineLacks("the disk is full", where=str(where), remedy="Free space and try again.") from None
        raise InputError(
            f"cannot be written: {error.strerror}", where=str(error.filename or where), remedy="Choose another folder."
        ) from None


def _fetch(api: Client, job_id: str, artifacts: Sequence[Artifact], partial: Path, bar: bool) -> None:
    """Download what an interrupted download has not left in `partial`."""
    columns = (TextColumn("downloading"), BarColumn(), DownloadColumn())
    with Progress(*columns, console=notices, transient=True, disable=not (bar and notices.is_terminal)) as shown:
        row = shown.add_task("downloading", total=sum(artifact.size for artifact in artifacts))
        for artifact in artifacts:
            target = partial / artifact.name
            target.parent.mkdir(parents=True, exist_ok=True)
            if target.is_file() and sha256_of(target) == artifact.sha256:
                shown.advance(row, artifact.size)
                continue
            api.download(job_id, artifact, target, lambda size: shown.advance(row, size))
