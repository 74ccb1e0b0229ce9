"""`lightkiln compare`: solvers on a bake's own stored light fields, by the worker's program.

A job's id stands for its package, which is downloaded into the output folder first, and its store, which the
coordinator keeps under the job's id.
"""

import re
from pathlib import Path
from typing import Annotated, Final

import typer
from pydantic import ValidationError

from kiln_schemas.client import Client
from kiln_schemas.conventions import MANIFEST_JSON
from kiln_schemas.errors import InputError, NotFound
from kiln_schemas.files import read_small
from kiln_schemas.job import JobView
from kiln_schemas.manifest import Manifest
from kiln_service.cli import options
from kiln_service.cli.become import become
from kiln_service.cli.fetch import download_package, writing
from kiln_service.cli.gates import raise_unless_completed

JOB_ID: Final = re.compile(r"[0-9a-f]{32}")
PACKAGE: Final = "package"


def add_compare_command(app: typer.Typer) -> None:
    """Register the command."""
    app.command()(compare)


def compare(
    subject: Annotated[
        str, typer.Argument(metavar="JOB|STORE|PACKAGE", help="A job's id, a light-field store or a package's folder.")
    ],
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="Folder for tables, pages and the cache.")],
    solvers: Annotated[str | None, typer.Option("--solvers", help="Names by commas; all by default.")] = None,
    lobes: Annotated[str, typer.Option("--lobes", help="Numbers by commas, e.g. 8,16,32,64.")] = "16",
    resolutions: Annotated[
        str | None, typer.Option("--resolutions", help="Light-map sizes for the network's convergence, by commas.")
    ] = None,
    resolution_image_size: Annotated[
        int, typer.Option("--resolution-image-size", help="Light-field pixels a side of these.")
    ] = 32,
    warm: Annotated[
        str | None, typer.Option("--warm", metavar="FILE|DIR", help="Start from this network: weights, or a kept bake.")
    ] = None,
    cameras: Annotated[
        list[str] | None, typer.Option("--cameras", metavar="FILE", help="JSON with cameras; may be repeated.")
    ] = None,
    size: Annotated[str, typer.Option("--size", metavar="WIDTHxHEIGHT", help="Pixels of the pictures.")] = "480x270",
    reference_samples: Annotated[
        int, typer.Option("--reference-samples", min=1, help="Paths a pixel of the references.")
    ] = 512,
    stored: Annotated[bool, typer.Option("--stored", help="Shade from the stored light fields too.")] = False,
    tiles: Annotated[
        int | None, typer.Option("--tiles", min=1, help="Only so many tiles, evenly chosen; no pictures then.")
    ] = None,
    between: Annotated[int, typer.Option("--between", min=1, help="Points of each kind between texels.")] = 300,
    between_samples: Annotated[
        float, typer.Option("--between-samples", help="Their paths a pixel over the bake's.")
    ] = 4.0,
    package: Annotated[Path | None, typer.Option("--package", help="Package of the bake whose store is named.")] = None,
    store: Annotated[str | None, typer.Option("--store", help="Store of the bake whose package is named.")] = None,
    env: options.Environment = None,
    memory: Annotated[str | None, typer.Option("--memory", help="Main memory to use, e.g. 4GiB.")] = None,
    threads: Annotated[int | None, typer.Option("--threads", min=1, help="Cores to use; all by default.")] = None,
    url: options.Url = options.DEFAULT_URL,
    token: options.Token = None,
    data: options.Data = None,
    json: options.Json = False,
) -> None:
    """Compare solvers on a bake's stored light fields: tables, curves and pictures."""
    if JOB_ID.fullmatch(subject) and not Path(subject).exists():
        with options.connect(url, token, data) as api:
            view = api.job(subject)
            raise_unless_completed(view)
            store = store or _store(subject, data)
            package, env = _fetch(api, view, out, env)
        subject = str(package)
    flags: dict[str, object] = {"--out": out, "--solvers": solvers, "--lobes": lobes, "--resolutions": resolutions}
    flags |= {"--resolution-image-size": resolution_image_size, "--size": size, "--tiles": tiles, "--between": between}
    flags |= {"--reference-samples": reference_samples, "--between-samples": between_samples, "--package": package}
    flags |= {"--store": store, "--env": env, "--memory": memory, "--threads": threads, "--warm": warm}
    given = [f"{flag}={value}" for flag, value in flags.items() if value is not None]
    given += [f"--cameras={camera}" for camera in cameras or ()]
    given += [flag for flag, wanted in (("--stored", stored), ("--json", json)) if wanted]
    become("kiln_workers", ["compare", *given, "--", subject])


def _store(job: str, data: Path | None) -> str:
    """The store of a job of the coordinator whose data folder is here."""
    place = None if data is None else data.absolute() / "store" / f"{job}.zarr"
    if place is None or not place.is_dir():
        raise NotFound(
            "the job's light-field store is not known",
            where=job,
            remedy=f"Name it with --store: what the coordinator was given as --store, and /{job}.zarr.",
        )
    return place.as_uri()


def _fetch(api: Client, job: JobView, out: Path, env: Path | None) -> tuple[Path, Path | None]:
    """The job's package and its environment's file, downloaded into `out` where they are not there yet."""
    folder = out / PACKAGE
    if not _is_package_of(folder, job.id):
        download_package(api, job.id, folder)
    return folder, env or _environment(api, job, out)


def _environment(api: Client, job: JobView, out: Path) -> Path | None:
    """The environment that the job was given, if there is one."""
    wanted = job.bundle.environment
    if wanted is None:
        return None
    target = out / f"environment{Path(wanted.file).suffix}"
    with writing(out):
        api.get_blob(job.bundle.files[wanted.file], target)
    return target


def _is_package_of(folder: Path, job: str) -> bool:
    """Whether the package in `folder` is the job's; InputError where it is another's."""
    try:
        found = Manifest.model_validate_json(read_small(folder / MANIFEST_JSON))
    except (OSError, ValidationError):
        return False
    if found.job_id != job:
        raise InputError("is the package of another job", where=str(folder), remedy="Choose another --out.")
    return True
