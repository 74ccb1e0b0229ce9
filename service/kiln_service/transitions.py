"""The only writer of states: every move of a job or a task, its queue job and its event, in one transaction.

Each function is one move of the tables in `kiln_schemas.states`; an illegal one raises IllegalTransition. The
caller has locked the job and, for a move of a task, the task (`Tx`'s order of locks).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

from psycopg.types.json import Jsonb

from kiln_schemas.camera import Camera
from kiln_schemas.errors import IllegalTransition, Problem
from kiln_schemas.gates import GateResult, Gates, gate_problem
from kiln_schemas.settings import BakeSettings
from kiln_schemas.states import FINAL_JOB_STATES, JobState, TaskState, check_job_move, check_task_move
from kiln_schemas.tasks import Bundle, Result, TaskKind
from kiln_service import queue
from kiln_service.blobs import drop_blobs
from kiln_service.db import JobRow, TaskRow, Tx, WorkerRow
from kiln_service.events import add_event
from kiln_service.ids import new_id
from kiln_service.planner import Planned

COORDINATOR: Final = "coordinator"
"""The actor of what nobody asked for."""


@dataclass(frozen=True)
class Submission:
    """Who sent a request, under which `Idempotency-Key`, and the hash of what it said."""

    submitter: str
    key: str | None
    sha256: str


async def create_job(
    tx: Tx,
    *,
    name: str,
    method: str,
    settings: BakeSettings,
    bundle: Bundle,
    gates: Gates,
    cameras: Mapping[str, Camera],
    store_base: str,
    planned: Sequence[Planned],
    actor: str,
    priority: int,
    labels: Mapping[str, str],
    submission: Submission,
) -> JobRow:
    """A new job, queued, with its first tasks."""
    job_id = new_id()
    row = await tx.one(
        "insert_job",
        id=job_id,
        name=name,
        method=method,
        settings=Jsonb(settings.model_dump(mode="json")),
        bundle=Jsonb(bundle.model_dump(mode="json")),
        gates=Jsonb(gates.model_dump(mode="json")),
        cameras=Jsonb({name: camera.model_dump(mode="json") for name, camera in cameras.items()}),
        store_url=f"{store_base}/{job_id}.zarr",
        priority=priority,
        labels=Jsonb(dict(labels)),
        submitter=submission.submitter,
        idempotency_key=submission.key,
        request_sha256=submission.sha256,
    )
    job = JobRow.of(row)
    await add_event(tx, job.id, "job.created", actor, detail={"name": name})
    await add_tasks(tx, job, planned)
    return job


async def add_tasks(tx: Tx, job: JobRow, planned: Sequence[Planned]) -> None:
    """New tasks of a job: queued where ready, waiting otherwise."""
    rows = [
        {
            "id": new_id(),
            "place": place,
            "kind": task.kind.value,
            "label": task.label,
            "state": (TaskState.QUEUED if task.ready else TaskState.WAITING).value,
            "spec": task.spec,
        }
        for place, task in enumerate(planned)
    ]
    await tx.run("insert_tasks", job_id=job.id, tasks=Jsonb(rows))
    ready = [(str(row["id"]), task.kind) for row, task in zip(rows, planned, strict=True) if task.ready]
    await queue.defer(tx, job, ready)
    counts: dict[str, int] = {}
    for task in planned:
        counts[task.kind.value] = counts.get(task.kind.value, 0) + 1
    await add_event(tx, job.id, "tasks.planned", COORDINATOR, detail=counts)


async def release_task(tx: Tx, job: JobRow, task: TaskRow) -> None:
    """waiting > queued."""
    if task.state is not TaskState.WAITING:
        raise IllegalTransition(f"a task that is {task.state} cannot be released")
    check_task_move(task.state, TaskState.QUEUED)
    await _move(tx, "move_task_queued", task)
    await queue.defer(tx, job, [(task.id, task.kind)])
    await _task_event(tx, task, "task.queued", COORDINATOR)


async def claim_task(tx: Tx, job: JobRow, task: TaskRow, worker: WorkerRow) -> TaskRow:
    """queued > active under a new attempt; the job's first claim moves it to active too."""
    check_task_move(task.state, TaskState.ACTIVE)
    claimed = TaskRow.of(await tx.one("move_task_active", id=task.id, before=task.state, worker_id=worker.id))
    if job.state is JobState.QUEUED:
        await move_job(tx, job, JobState.ACTIVE, COORDINATOR)
    await _task_event(tx, claimed, "task.claimed", f"worker:{worker.id}", {"worker": worker.name})
    return claimed


async def requeue_task(tx: Tx, job: JobRow, task: TaskRow, kind: str, actor: str, *, strike: bool, reason: str) -> None:
    """active > queued: another attempt may try; `kind` is the event (`task.retried`, `task.lost`)."""
    if task.state is not TaskState.ACTIVE:
        raise IllegalTransition(f"a task that is {task.state} cannot be retried")
    check_task_move(task.state, TaskState.QUEUED)
    await _move(tx, "move_task_requeued", task, strikes=int(strike))
    await queue.retry(tx, job, task.queue_job, (task.id, task.kind))
    await _task_event(tx, task, kind, actor, {"reason": reason, "strikes": task.strikes + int(strike)})


async def complete_task(tx: Tx, task: TaskRow, result: Result) -> None:
    """active > completed."""
    check_task_move(task.state, TaskState.COMPLETED)
    await _move(tx, "move_task_completed", task, result=Jsonb(result.model_dump(mode="json")))
    await _leave_queue(tx, task)
    await _task_event(tx, task, "task.completed", f"worker:{task.worker_id}", {"seconds": result.seconds})


async def fail_task(tx: Tx, job: JobRow, task: TaskRow, problem: Problem, actor: str) -> list[int]:
    """active > failed, and the job with it; returns the queue jobs to withdraw afterwards."""
    check_task_move(task.state, TaskState.FAILED)
    await _move(tx, "move_task_ended", task, after=TaskState.FAILED, error=Jsonb(problem.model_dump(mode="json")))
    await _leave_queue(tx, task)
    await _task_event(tx, task, "task.failed", actor, {"problem": problem.model_dump(mode="json")})
    return await fail_job(tx, job, problem, actor)


async def cancel_task(tx: Tx, task: TaskRow, actor: str, reason: str) -> None:
    """active > canceled: its worker was told to stop, or is lost."""
    check_task_move(task.state, TaskState.CANCELED)
    await _move(tx, "move_task_ended", task, after=TaskState.CANCELED, error=None)
    await _leave_queue(tx, task)
    await _task_event(tx, task, "task.canceled", actor, {"reason": reason})


async def cancel_idle_tasks(tx: Tx, job: JobRow, actor: str) -> list[int]:
    """waiting, queued > canceled, all of a job; returns the queue jobs to withdraw in a later transaction."""
    before = [TaskState.WAITING, TaskState.QUEUED]
    for state in before:
        check_task_move(state, TaskState.CANCELED)
    rows = await tx.all("cancel_idle_tasks", job_id=job.id, before=[state.value for state in before])
    for row in rows:
        if row["checkpoint"] is not None:
            await drop_blobs(tx, f"checkpoint:{row['id']}")
    if rows:
        await add_event(tx, job.id, "tasks.canceled", actor, detail={"count": len(rows)})
    return [row["queue_job"] for row in rows if row["queue_job"] is not None]


async def reuse_renders(tx: Tx, job: JobRow, source: str, store_url: str) -> int:
    """waiting > completed, all render tasks of a job whose light fields `source` has; how many."""
    check_task_move(TaskState.WAITING, TaskState.COMPLETED)
    await tx.run("share_renders", id=job.id, source=source, store_url=store_url)
    rows = await tx.all(
        "reuse_results", job_id=job.id, source=source, kind=TaskKind.RENDER, before=TaskState.WAITING.value
    )
    await add_event(tx, job.id, "tasks.reused", COORDINATOR, detail={"count": len(rows), "job": source})
    return len(rows)


async def pause_job(tx: Tx, job: JobRow, actor: str) -> list[int]:
    """queued, active > paused; returns the queue jobs to withdraw in a later transaction."""
    await move_job(tx, job, JobState.PAUSED, actor)
    return [row["queue_job"] for row in await tx.all("queued_queue_jobs", job_id=job.id)]


async def resume_job(tx: Tx, job: JobRow, actor: str) -> JobRow:
    """paused > queued, or > active where it has begun; its tasks are in the queue again."""
    if job.state is not JobState.PAUSED:
        raise IllegalTransition(f"a job that is {job.state} cannot be resumed")
    job = await move_job(tx, job, JobState.ACTIVE if job.started else JobState.QUEUED, actor)
    await enqueue(tx, job)
    return job


async def reopen_job(tx: Tx, job: JobRow, stage: TaskKind, actor: str) -> JobRow:
    """failed, canceled > queued, with the failed and canceled tasks: queued in `stage`, waiting in later ones."""
    before = [TaskState.FAILED, TaskState.CANCELED]
    for state in before:
        check_task_move(state, TaskState.QUEUED)
    job = await move_job(tx, job, JobState.QUEUED, actor)
    parameters = {"job_id": job.id, "stage": stage.value, "before": [state.value for state in before]}
    rows = await tx.all("reopen_tasks", **parameters)
    await enqueue(tx, job)
    await add_event(tx, job.id, "tasks.reopened", actor, detail={"count": len(rows), "stage": stage.value})
    return job


async def enqueue(tx: Tx, job: JobRow) -> None:
    """Put those of a job's queued tasks into the queue that are not there."""
    rows = await tx.all("queued_outside_of_queue", job_id=job.id)
    await queue.defer(tx, job, [(row["id"], TaskKind(row["kind"])) for row in rows])


async def move_job(
    tx: Tx,
    job: JobRow,
    after: JobState,
    actor: str,
    *,
    error: Problem | None = None,
    detail: dict[str, Any] | None = None,
) -> JobRow:
    """Move a job and tell it."""
    check_job_move(job.state, after)
    moved = await tx.run(
        "move_job",
        id=job.id,
        before=job.state,
        after=after.value,
        final=after in FINAL_JOB_STATES,
        error=Jsonb(error.model_dump(mode="json")) if error else None,
    )
    if moved != 1:
        raise IllegalTransition(f"job {job.id} is no longer {job.state}")
    told = (detail or {}) | ({"problem": error.model_dump(mode="json")} if error else {})
    await add_event(tx, job.id, f"job.{after.value}", actor, detail=told)
    return replace(job, state=after, error=error or job.error)


async def finish_job(tx: Tx, job: JobRow, gates: Sequence[GateResult]) -> None:
    """active > completed, or > gate-failed where the package misses a gate; its artifacts are published either way."""
    measured = [gate.model_dump(mode="json") for gate in gates]
    await tx.run("set_gate_results", id=job.id, results=Jsonb(measured))
    missed = gate_problem(gates)
    after = JobState.GATE_FAILED if missed else JobState.COMPLETED
    await move_job(tx, job, after, COORDINATOR, error=missed, detail={"gates": measured} if measured else None)


async def fail_job(tx: Tx, job: JobRow, problem: Problem, actor: str) -> list[int]:
    """The job fails with this error and its idle tasks are canceled; returns the queue jobs to withdraw."""
    idle = await cancel_idle_tasks(tx, job, actor)
    await move_job(tx, job, JobState.FAILED, actor, error=problem)
    return idle


async def _leave_queue(tx: Tx, task: TaskRow) -> None:
    """A task that is over has no queue job and needs no checkpoint."""
    await queue.finish(tx, task.queue_job)
    await drop_blobs(tx, f"checkpoint:{task.id}")


async def _move(tx: Tx, query: str, task: TaskRow, **parameters: Any) -> None:
    if await tx.run(query, id=task.id, before=task.state, **parameters) != 1:
        raise IllegalTransition(f"task {task.id} is no longer {task.state}")


async def _task_event(tx: Tx, task: TaskRow, kind: str, actor: str, detail: dict[str, Any] | None = None) -> None:
    about = {"kind": task.kind.value, "label": task.label, "attempt": task.attempt}
    await add_event(tx, task.job_id, kind, actor, task_id=task.id, detail=about | (detail or {}))
