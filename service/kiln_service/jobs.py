"""What clients ask of a job: submit it, cancel it."""

from collections.abc import Sequence

from kiln_schemas.errors import Conflict, InputError, NotFound
from kiln_schemas.gates import check_gates
from kiln_schemas.job import JobRequest, check_bundle
from kiln_schemas.settings import BakeSettings, make_settings
from kiln_schemas.states import FINAL_JOB_STATES, JobState
from kiln_service import queue, transitions
from kiln_service.blobs import require_blobs, use_blobs
from kiln_service.config import ServiceConfig
from kiln_service.db import Database, JobRow, Tx
from kiln_service.planner import SG_LIGHTFIELD, plan_job


def settings_of(request: JobRequest) -> BakeSettings:
    """The settings that a request asks for: complete ones, or a preset with overrides."""
    if request.settings is None:
        return make_settings(request.preset or "preview", request.set)
    if request.preset is not None or request.set:
        raise InputError(
            "both complete settings and a preset or overrides were given",
            where="settings",
            remedy="Send either `settings`, or `preset` and `set`.",
        )
    return request.settings


async def submit(database: Database, config: ServiceConfig, request: JobRequest, actor: str) -> JobRow:
    """Accept a job: its settings and gates are valid, its bundle is closed and its files are here."""
    settings = settings_of(request)
    bundle = check_bundle(request.bundle)
    gates = check_gates(request.gates, request.cameras)
    async with database.transaction() as tx:
        if absent := await require_blobs(tx, bundle.files.values()):
            names = sorted(f"{path} ({sha256})" for path, sha256 in bundle.files.items() if sha256 in absent)
            raise Conflict(
                f"{len(names)} files of the bundle were not uploaded: {', '.join(names[:8])}",
                where="bundle.files",
                remedy="PUT them to /v1/blobs/{sha256} and submit again.",
            )
        job = await transitions.create_job(
            tx,
            name=request.name,
            method=SG_LIGHTFIELD.name,
            settings=settings,
            bundle=bundle,
            gates=gates,
            cameras=request.cameras,
            store_base=config.store_base,
            planned=plan_job(),
            actor=actor,
        )
        await use_blobs(tx, f"job:{job.id}", bundle.files.values())
    return job


async def cancel(database: Database, job_id: str, actor: str) -> None:
    """Ask a job to stop; it is canceled when no worker has a task of it any more. Asking twice is no error."""
    async with database.transaction() as tx:
        job = await lock_job(tx, job_id)
        if job.state in (JobState.CANCEL_REQUESTED, JobState.CANCELED):
            return
        if job.state in FINAL_JOB_STATES:
            raise Conflict(f"job {job_id} is {job.state} already", where="job")
        job = await transitions.move_job(tx, job, JobState.CANCEL_REQUESTED, actor)
        idle = await transitions.cancel_idle_tasks(tx, job, actor)
        await settle_cancel(tx, job)
    await withdraw(database, idle)


async def settle_cancel(tx: Tx, job: JobRow) -> None:
    """cancel-requested > canceled, once no worker has a task of the job."""
    if job.state is JobState.CANCEL_REQUESTED and (await tx.one("count_active", job_id=job.id))["tasks"] == 0:
        await transitions.move_job(tx, job, JobState.CANCELED, transitions.COORDINATOR)


async def withdraw(database: Database, queue_jobs: Sequence[int]) -> None:
    """Take canceled tasks out of the queue, after the transaction that canceled them (see `Tx` on locks)."""
    if queue_jobs:
        async with database.transaction() as tx:
            await queue.withdraw(tx, queue_jobs)


async def lock_job(tx: Tx, job_id: str) -> JobRow:
    """The job, locked until the transaction ends."""
    row = await tx.maybe("lock_job", id=job_id)
    if row is None:
        raise NotFound(f"no job '{job_id}'", where="job")
    return JobRow.of(row)
