"""What clients ask of a job: submit, rank and label, pause and resume, cancel, retry, do parts again, archive it."""

import hashlib
from collections.abc import Set
from contextlib import nullcontext
from typing import Final

from psycopg.types.json import Jsonb

from kiln_schemas.errors import Conflict, InputError, NotFound
from kiln_schemas.gates import check_gates
from kiln_schemas.job import JobChange, JobRequest, RequeueRequest, check_bundle
from kiln_schemas.settings import BakeSettings, make_settings
from kiln_schemas.states import FINAL_JOB_STATES, LIVE_JOB_STATES, PUBLISHED_JOB_STATES, JobState, TaskState
from kiln_schemas.tasks import TaskKind
from kiln_service import queue, transitions
from kiln_service.auth import Principal
from kiln_service.blobs import require_blobs, use_blobs
from kiln_service.config import ServiceConfig
from kiln_service.damage import redo_damaged
from kiln_service.db import Database, JobRow, Tx
from kiln_service.disk import Disk
from kiln_service.events import add_event
from kiln_service.lost_renders import redo_seen
from kiln_service.planner import METHODS, SG_LIGHTFIELD, plan_job
from kiln_service.stores import Look, look_for_renders

REOPENED_JOB_STATES: Final = frozenset({JobState.FAILED, JobState.CANCELED})
"""Those of a job that is over and did not come to its end: it may be taken up again."""


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


async def submit(
    database: Database, config: ServiceConfig, request: JobRequest, who: Principal, key: str | None = None
) -> JobRow:
    """Accept a job: its settings and gates are valid, its bundle is closed and its files are here.

    The same request under the same `Idempotency-Key` `key` makes no second job; another one is refused.
    """
    submission = transitions.Submission(who.name, key, hashlib.sha256(request.model_dump_json().encode()).hexdigest())
    settings = settings_of(request)
    bundle = check_bundle(request.bundle)
    gates = check_gates(request.gates, request.cameras)
    Disk(config).require()
    turn = database.turn(f"submissions of {who.name} as {key}") if key else nullcontext()
    async with turn, database.transaction() as tx:
        if (earlier := await _submitted(tx, submission)) is not None:
            return earlier
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
            actor=who.actor,
            priority=request.priority,
            labels=request.labels,
            tags=request.tags,
            submission=submission,
        )
        await use_blobs(tx, f"job:{job.id}", bundle.files.values())
    return job


async def _submitted(tx: Tx, submission: transitions.Submission) -> JobRow | None:
    """The job that a submission with this key has made before; InputError where that asked for something else."""
    if submission.key is None:
        return None
    await tx.run("lock_idempotency_key", key=f"{submission.submitter}:{submission.key}")
    row = await tx.maybe("find_submission", submitter=submission.submitter, key=submission.key)
    if row is None:
        return None
    if row["request_sha256"] != submission.sha256:
        raise InputError(
            f"the key '{submission.key}' was sent with another request, which is job {row['id']}",
            where="Idempotency-Key",
            remedy="Send a key of its own with each request, and the same only with a repetition.",
        )
    return JobRow.of(row)


async def change(database: Database, job_id: str, wanted: JobChange, actor: str) -> None:
    """Rank or label a job anew, or have it done by other workers; its tasks change their place in the queue."""
    async with database.transaction() as tx:
        await lock_job(tx, job_id)
        labels = None if wanted.labels is None else Jsonb(dict(wanted.labels))
        tags = None if wanted.tags is None else list(wanted.tags)
        await tx.run("change_job", id=job_id, priority=wanted.priority, labels=labels, tags=tags)
        if wanted.priority is not None:
            await tx.run("rank_tasks", job_id=job_id, priority=wanted.priority, step=queue.RANK_STEP)
        if wanted.tags is not None:
            await queue.announce(tx, list(TaskKind))
        await add_event(tx, job_id, "job.changed", actor, detail=wanted.model_dump(mode="json", exclude_none=True))


async def pause(database: Database, job_id: str, actor: str) -> None:
    """Give no more of a job's tasks to workers; those that run go on. Asking twice is no error."""
    async with database.transaction() as tx:
        job = await lock_job(tx, job_id)
        if job.state is JobState.PAUSED:
            return
        _require(job, {JobState.QUEUED, JobState.ACTIVE}, "paused")
        await transitions.move_job(tx, job, JobState.PAUSED, actor)


async def resume(database: Database, job_id: str, actor: str) -> None:
    """Go on with a paused job. Asking twice is no error."""
    async with database.transaction() as tx:
        job = await lock_job(tx, job_id)
        if job.state in (JobState.QUEUED, JobState.ACTIVE):
            return
        _require(job, {JobState.PAUSED}, "resumed")
        await transitions.resume_job(tx, job, actor)


async def retry(database: Database, config: ServiceConfig, job_id: str, actor: str) -> None:
    """Do a failed or canceled job's unfinished tasks again, or the failed ones of a job that goes on without them.

    What a job that is over has lost meanwhile (light fields, blobs of results) is made again as well.
    """
    found = await _look(database, config, job_id)
    async with database.transaction() as tx:
        job = await lock_job(tx, job_id)
        _require(job, {*LIVE_JOB_STATES, *REOPENED_JOB_STATES}, "retried")
        if job.state in REOPENED_JOB_STATES:
            job = await restore(tx, config, job, found)
        stage = await _first_unfinished(tx, job)
        if stage is None:
            raise Conflict(
                f"job {job_id} has no unfinished task: {job.error.sentence() if job.error else job.state}",
                where="job",
                remedy="Mend the input and submit it again.",
            )
        if job.state in LIVE_JOB_STATES:
            if not await transitions.reopen_tasks(tx, job, stage, [TaskState.FAILED], actor):
                raise Conflict(f"job {job_id} is {job.state}, and none of its tasks has failed", where="job")
            return
        await _reopen(tx, job, stage, actor)


async def _first_unfinished(tx: Tx, job: JobRow) -> TaskKind | None:
    """The first stage of a locked job with tasks that have not completed."""
    kinds = {TaskKind(row["kind"]) for row in await tx.all("unfinished_kinds", job_id=job.id)}
    return next((stage for stage in METHODS[job.method].stages if stage in kinds), None)


async def _look(database: Database, config: ServiceConfig, job_id: str) -> Look:
    """What is left of a job's light fields; before any lock, as it may take seconds."""
    row = await database.first("find_job", id=job_id)
    if row is None:
        raise NotFound(f"no job '{job_id}'", where="job")
    return await look_for_renders(config, database, JobRow.of(row))


async def restore(tx: Tx, config: ServiceConfig, job: JobRow, found: Look) -> JobRow:
    """Have a locked job make again what it has lost; Damaged where that is a file that only the client has."""
    job = await redo_seen(tx, config, job, found)
    if (error := await redo_damaged(tx, job)) is not None:
        raise error
    return job


async def _reopen(tx: Tx, job: JobRow, stage: TaskKind, actor: str) -> None:
    """A failed or canceled job goes on with the stage that it has come to."""
    job = await transitions.move_job(tx, job, JobState.QUEUED, actor)
    await transitions.reopen_tasks(tx, job, stage, [TaskState.FAILED, TaskState.CANCELED], actor)


async def requeue(database: Database, config: ServiceConfig, job_id: str, wanted: RequeueRequest, actor: str) -> None:
    """Do tasks again that are done, and all that follows from them; what a completed job had published is gone.

    A job that is over goes on with them, and makes again what it has lost meanwhile.
    """
    found = await _look(database, config, job_id)
    async with database.transaction() as tx:
        job = await lock_job(tx, job_id)
        _require(job, LIVE_JOB_STATES | PUBLISHED_JOB_STATES | {JobState.FAILED}, "requeued")
        stages = METHODS[job.method].stages
        later = stages[stages.index(wanted.kind) + 1 :]
        choice = transitions.Choice(labels=wanted.labels, rows=wanted.rows, columns=wanted.columns)
        redone = await transitions.redo_tasks(tx, job, [wanted.kind], TaskState.QUEUED, choice)
        if not redone.chosen:
            raise _chose_nothing(job, wanted.kind, redone.total)
        if not redone.moved and job.state is not JobState.FAILED:
            raise Conflict(f"the {wanted.kind} tasks of job {job_id} are not done yet", where="job")
        waiting = (await transitions.redo_tasks(tx, job, later, TaskState.WAITING)).moved
        await tx.run("delete_artifacts", job_id=job.id)
        if job.state not in LIVE_JOB_STATES:
            job = await restore(tx, config, job, found)
        detail = wanted.model_dump(mode="json", exclude_none=True) | {"count": redone.moved, "waiting": waiting}
        await add_event(tx, job.id, "tasks.requeued", actor, detail=detail)
        if job.state in PUBLISHED_JOB_STATES:
            await tx.run("set_gate_results", id=job.id, results=Jsonb([]))
            await transitions.move_job(tx, job, JobState.QUEUED, actor)
        first = await _first_unfinished(tx, job)
        assert first is not None, "what is done again is unfinished"
        if job.state is JobState.FAILED:
            await _reopen(tx, job, first, actor)
        await transitions.hold_later(tx, job, first)
        await queue.announce(tx, [first])


def _chose_nothing(job: JobRow, kind: TaskKind, total: int) -> Conflict | InputError:
    if not total:
        return Conflict(f"job {job.id} has no {kind} tasks yet, so none can be requeued", where="job")
    return InputError(
        f"none of the {total} {kind} tasks of job {job.id} has the labels, rows and columns that were asked for",
        where="requeue",
        remedy="GET .../tasks lists them with their labels.",
    )


async def archive(database: Database, job_id: str, actor: str) -> None:
    """Put a job that is over aside: lists leave it out unless asked for. Asking twice is no error."""
    async with database.transaction() as tx:
        job = await lock_job(tx, job_id)
        if job.state is JobState.ARCHIVED:
            return
        _require(job, FINAL_JOB_STATES, "archived")
        await transitions.move_job(tx, job, JobState.ARCHIVED, actor)


def _require(job: JobRow, states: Set[JobState], what: str) -> None:
    if job.state not in states:
        wanted = " or ".join(sorted(states))
        raise Conflict(f"job {job.id} is {job.state} and cannot be {what}; it would have to be {wanted}", where="job")


async def cancel(database: Database, job_id: str, actor: str) -> None:
    """Ask a job to stop; it is canceled when no worker has a task of it any more. Asking twice is no error."""
    async with database.transaction() as tx:
        job = await lock_job(tx, job_id)
        if job.state in (JobState.CANCEL_REQUESTED, JobState.CANCELED):
            return
        if job.state in FINAL_JOB_STATES:
            raise Conflict(f"job {job_id} is {job.state} already", where="job")
        job = await transitions.move_job(tx, job, JobState.CANCEL_REQUESTED, actor)
        await transitions.cancel_idle_tasks(tx, job, actor)
        await settle_cancel(tx, job)


async def settle_cancel(tx: Tx, job: JobRow) -> None:
    """cancel-requested > canceled, once no worker has a task of the job."""
    if job.state is JobState.CANCEL_REQUESTED and (await tx.one("count_active", job_id=job.id))["tasks"] == 0:
        await transitions.move_job(tx, job, JobState.CANCELED, transitions.COORDINATOR)


async def lock_job(tx: Tx, job_id: str) -> JobRow:
    """The job, locked until the transaction ends."""
    row = await tx.maybe("lock_job", id=job_id)
    if row is None:
        raise NotFound(f"no job '{job_id}'", where="job")
    return JobRow.of(row)
