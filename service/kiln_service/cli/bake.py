"""`lightkiln bake`: a scene in, a package out, everything in between on this machine.

`OUT/.lightkiln` holds the coordinator's data while the bake runs and `bake.json`, which says what is being baked;
an interrupted or failed bake leaves it for `--resume`, a finished one removes it (unless `--keep`) and leaves
`OUT/bake.json`, by which the same call made again knows that there is nothing to do.
"""

import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Final, TypeVar

from pydantic import ValidationError

from kiln_schemas.base import Contract
from kiln_schemas.camera import Camera
from kiln_schemas.client import Client
from kiln_schemas.conventions import MANIFEST_JSON
from kiln_schemas.errors import (
    Conflict,
    InputError,
    InternalError,
    KilnError,
    MachineLacks,
    NotFound,
    Problem,
    Unreachable,
)
from kiln_schemas.files import read_small
from kiln_schemas.gates import GateResult, Gates, check_gates
from kiln_schemas.job import JobRequest, JobView, TaskView
from kiln_schemas.manifest import Manifest
from kiln_schemas.options import of_options
from kiln_schemas.settings import make_settings
from kiln_schemas.states import PUBLISHED_JOB_STATES, JobState
from kiln_service.cli.bundle import LocalBundle, collect
from kiln_service.cli.farm import LocalFarm, share
from kiln_service.cli.fetch import download_package, remove_package, writing
from kiln_service.cli.gates import raise_unless_completed, write_junit, write_results
from kiln_service.cli.output import notices
from kiln_service.cli.progress import Display, follow, make_display
from kiln_service.cli.upload import upload_and_submit

EXAMPLES: Final = ("gallery", "courtyard")
DATA: Final = ".lightkiln"
RECORD: Final = "bake.json"
OUTAGE_S: Final = 180.0
"""How long the local coordinator may take to come back after a restart."""

T = TypeVar("T")


@dataclass(frozen=True)
class BakeOptions:
    """The command line of one bake."""

    scene: str | None
    out: Path
    environment: Path | None
    environment_scale: float
    environment_rotation_deg: float
    preset: str
    overrides: tuple[str, ...]
    gates: Gates
    cameras: Mapping[str, Camera]
    junit: Path | None
    workers: int | None
    resume: bool
    force: bool
    keep: bool


class Record(Contract):
    """`bake.json`: what is being baked into this folder, or was."""

    scene: str
    """The scene's file."""
    environment: str | None
    request: JobRequest


class Summary(Contract):
    """What a bake made; the answer of `lightkiln bake --json`."""

    out: str
    job_id: str | None
    already_done: bool
    manifest: str
    report: str | None
    files: tuple[str, ...]
    seconds: float
    stage_wall_seconds: dict[str, float]
    """From the first start to the last end of each stage's tasks."""
    stage_busy_seconds: dict[str, float]
    notes: tuple[str, ...]
    gates: tuple[GateResult, ...] = ()


def bake(options: BakeOptions) -> Summary:
    """Bake; the summary of what is in `options.out`, whether it meets its gates or not."""
    began = time.monotonic()
    if options.out.exists() and not options.out.is_dir():
        raise InputError("is not a folder", where=str(options.out), remedy="Choose another --out.")
    data = options.out / DATA
    record = _resumed(options, data) if options.resume else _planned(options)
    local = _collect(record)
    if record.request.bundle != local.bundle:
        raise Conflict(
            "the scene's files changed since the bake began", where=record.scene, remedy="Bake anew with --force."
        )
    if not options.resume:
        if not options.force and _is_done(options.out, record):
            done = _summary(options.out, None, (), began)
            if options.junit is not None:
                write_results(options.junit, record.request.name, done.gates)
            return done
        _make_room(options, data)
        _write(data / RECORD, record)
    try:
        with make_display() as display:
            job, tasks = _run(options, data, record.request, local, display)
    except KeyboardInterrupt:
        notices.print(f"Interrupted. Continue with: lightkiln bake --resume --out {options.out}", markup=False)
        raise
    if job.error is not None and not options.keep and isinstance(KilnError.from_problem(job.error), InputError):
        _leave_nothing(options.out, data)
    write_junit(options.junit, job)
    if job.state not in PUBLISHED_JOB_STATES:
        raise_unless_completed(job)
    _write(options.out / RECORD, record)
    if not options.keep:
        shutil.rmtree(data, ignore_errors=True)
    return _summary(options.out, job, tasks, began)


def _run(
    options: BakeOptions, data: Path, request: JobRequest, local: LocalBundle, display: Display
) -> tuple[JobView, tuple[TaskView, ...]]:
    """Start everything, bring the job to its end, download where there is a package, stop everything."""
    count, threads, memory = share(options.workers)
    with LocalFarm(data, workers=count, threads=threads, memory=memory, say=display.say) as farm:
        farm.start()
        with Client(farm.url, farm.token, patience_s=2.0) as api:
            job_id = _steadily(farm, lambda: _unfinished_job(api, display))
            if job_id is None:
                job_id = _steadily(farm, lambda: upload_and_submit(api, local, request, bar=False)).id
            job = follow(api, job_id, display, between=farm.revive)
            if job.state not in PUBLISHED_JOB_STATES:
                return job, ()
            tasks = _steadily(farm, lambda: api.tasks(job.id))
            _steadily(farm, lambda: download_package(api, job.id, options.out, force=True, bar=False))
    return job, tasks


def _steadily(farm: LocalFarm, call: Callable[[], T]) -> T:
    """The answer of `call`, the coordinator being restarted meanwhile where it must be."""
    deadline = time.monotonic() + OUTAGE_S
    while True:
        try:
            return call()
        except Unreachable:
            if time.monotonic() > deadline:
                raise
            farm.revive()


def _unfinished_job(api: Client, display: Display) -> str | None:
    """The job of an earlier call, noted or not, which this one can go on with; the data folder holds one bake.

    A job that failed stays failed, but what it lacked may be there now: then None, for a new job.
    """
    newest = next(iter(api.jobs(limit=1).jobs), None)
    if newest is None:
        return None
    if newest.state in (JobState.FAILED, JobState.CANCELED):
        why = f" ({newest.error.detail})" if newest.error else ""
        display.say(f"The bake {newest.state.value} before{why}; it begins anew.")
        return None
    return newest.id


def _leave_nothing(out: Path, data: Path) -> None:
    """Remove what a bake of a wrong input left: the same input cannot be resumed, and a mended one begins anew."""
    shutil.rmtree(data, ignore_errors=True)
    with suppress(OSError):
        out.rmdir()


def _planned(options: BakeOptions) -> Record:
    """A new bake, checked as far as it can be without starting anything."""
    if options.scene is None:
        raise InputError("no scene is given", where="SCENE", remedy="Name a file, `gallery` or `courtyard`.")
    make_settings(options.preset, options.overrides)
    check_gates(options.gates, options.cameras)
    scene, environment = Path(options.scene), options.environment
    if options.scene in EXAMPLES and not scene.exists():
        folder = options.out / "scene"
        write_examples(folder)
        scene = folder / f"{options.scene}.glb"
        if environment is None and (folder / f"{options.scene}.exr").is_file():
            environment = folder / f"{options.scene}.exr"
    local = collect(
        scene,
        environment,
        scale=options.environment_scale,
        rotation_deg=options.environment_rotation_deg,
    )
    request = of_options(
        JobRequest,
        {"name": "SCENE", "set": "--set"},
        name=scene.stem[:128],
        bundle=local.bundle,
        preset=options.preset,
        set=options.overrides,
        gates=options.gates,
        cameras=dict(options.cameras),
    )
    return Record(
        scene=str(scene.absolute()),
        environment=None if environment is None else str(environment.absolute()),
        request=request,
    )


def _resumed(options: BakeOptions, data: Path) -> Record:
    record = _read(data / RECORD)
    if record is None:
        raise NotFound(
            "there is no interrupted bake", where=str(options.out), remedy="Name a scene and leave --resume out."
        )
    return record


def _collect(record: Record) -> LocalBundle:
    reference = record.request.bundle.environment
    return collect(
        Path(record.scene),
        Path(record.environment) if record.environment else None,
        scale=reference.scale if reference else 1.0,
        rotation_deg=reference.rotation_deg if reference else 0.0,
    )


def _make_room(options: BakeOptions, data: Path) -> None:
    """Refuse to mix with an older bake, or remove it where --force says so."""
    if not options.force:
        if data.exists():
            raise Conflict(
                "an unfinished bake is here",
                where=str(options.out),
                remedy="Continue it with --resume, or start over with --force.",
            )
        if (options.out / MANIFEST_JSON).exists():
            raise Conflict(
                "another package is here", where=str(options.out), remedy="Choose another --out, or pass --force."
            )
    with writing(options.out):
        shutil.rmtree(data, ignore_errors=True)
        remove_package(options.out)
        (options.out / RECORD).unlink(missing_ok=True)
        data.mkdir(parents=True, exist_ok=True, mode=0o700)


def _is_done(out: Path, record: Record) -> bool:
    before = _read(out / RECORD)
    return before is not None and before.request == record.request and (out / MANIFEST_JSON).is_file()


def write_examples(folder: Path) -> list[Path]:
    """Have the worker's code write the example scenes; their files."""
    done = subprocess.run(
        [sys.executable, "-m", "kiln_workers", "examples", "write", str(folder), "--json"],
        capture_output=True,
        text=True,
    )
    if done.returncode != 0:
        raise worker_error(done)
    return sorted(path for path in folder.iterdir() if path.is_file())


def worker_error(done: subprocess.CompletedProcess[str]) -> KilnError:
    """The problem that a worker's command printed, or its last words."""
    lines = (done.stdout.strip() or done.stderr.strip()).splitlines()
    with suppress(IndexError, ValidationError):
        return KilnError.from_problem(Problem.model_validate_json(lines[-1]))
    words = lines[-1] if lines else f"status {done.returncode}"
    if done.returncode < 0:
        return MachineLacks(
            f"the worker's process was ended by signal {-done.returncode}", remedy="Run `lightkiln doctor`."
        )
    return InternalError(f"the worker's command failed: {words}", remedy="Run `lightkiln doctor`.")


def _summary(out: Path, job: JobView | None, tasks: tuple[TaskView, ...], began: float) -> Summary:
    files = sorted(str(p.relative_to(out)) for p in out.rglob("*") if p.is_file() and DATA not in p.parts)
    report = out / "report.html"
    wall: dict[str, float] = {}
    for kind in dict.fromkeys(task.kind for task in tasks):
        spans = [(t.started, t.finished) for t in tasks if t.kind is kind]
        starts, ends = [s for s, _ in spans if s is not None], [e for _, e in spans if e is not None]
        if starts and ends:
            wall[kind.value] = (max(ends) - min(starts)).total_seconds()
    return Summary(
        out=str(out),
        job_id=job.id if job else None,
        already_done=job is None,
        manifest=str(out / MANIFEST_JSON),
        report=str(report) if report.is_file() else None,
        files=tuple(files),
        seconds=time.monotonic() - began,
        stage_wall_seconds=wall,
        stage_busy_seconds={stage.kind.value: stage.seconds for stage in job.stages} if job else {},
        notes=job.notes if job else (),
        gates=job.gate_results if job else _gates_of(out / MANIFEST_JSON),
    )


def _gates_of(manifest: Path) -> tuple[GateResult, ...]:
    """The gates of a package that was baked before."""
    try:
        return Manifest.model_validate_json(read_small(manifest)).gates
    except (OSError, ValidationError):
        raise Conflict(
            "this is not a manifest that lightkiln wrote", where=str(manifest), remedy="Bake anew with --force."
        ) from None


def _read(path: Path) -> Record | None:
    try:
        return Record.model_validate_json(read_small(path))
    except (FileNotFoundError, NotADirectoryError):
        return None
    except (OSError, ValidationError):
        raise Conflict(
            "this is not a file that lightkiln wrote", where=str(path), remedy="Choose another --out, or pass --force."
        ) from None


def _write(path: Path, record: Record) -> None:
    """Replace the record as a whole."""
    with writing(path):
        draft = path.with_name(path.name + ".new")
        draft.write_text(record.model_dump_json(indent=1))
        draft.replace(path)
