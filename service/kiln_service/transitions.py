"""The only writer of states: every move of a job or a task and its event, in one transaction.

Each function is one move of the tables in `kiln_schemas.states`; an illegal one raises IllegalTransition. The
caller has locked the job and, for a move of a task, the task (`Tx`'s order of locks).
"""

import asyncio
import json
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

from psycopg.types.json import Jsonb

from kiln_schemas.camera import Camera
from kiln_schemas.errors import IllegalTransition, NotFound, Problem
from kiln_schemas.gates import GateResult, Gates, gate_problem
from kiln_schemas.settings import BakeSettings
from kiln_schemas.states import (
    CLAIMABLE_TASK_STATES,
    FINAL_JOB_STATES,
    TASK_TRANSITIONS,
    JobState,
    TaskState,
    check_job_move,
    check_task_move,
)
from kiln_schemas.tasks import Bundle, Result, TaskKind
from kiln_service import queue
from kiln_service.blobs import drop_blobs
from kiln_service.db import JobRow, TaskRow, Tx, WorkerRow
from kiln_service.events import add_event
from kiln_service.ids import new_id
from kiln_service.planner import METHODS, Planned

COORDINATOR: Final = "coordinator"
"""The actor of what nobody asked for."""
MANY_TASKS: Final = 500
"""So many new ones change which way of finding the next is the fastest."""
PIECE: Final = 2000
"""So many tasks at a time are planned and sent: all of a large light map at once would hold up everybody else."""


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
    tags: Sequence[str],
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
        tags=list(tags),
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
    for start in range(0, len(planned), PIECE):
        rows = await asyncio.to_thread(_rows, job, planned[start : start + PIECE])
        await tx.run("insert_tasks", job_id=job.id, tasks=Jsonb(rows, dumps=str))
    if len(planned) >= MANY_TASKS:
        await tx.run("analyze_tasks")
    if ready := {task.kind for task in planned if task.ready}:
        await queue.announce(tx, ready)
    counts: dict[str, int] = {}
    for task in planned:
        counts[task.kind.value] = counts.get(task.kind.value, 0) + 1
    await add_event(tx, job.id, "tasks.planned", COORDINATOR, detail=counts)


def _rows(job: JobRow, planned: Sequence[Planned]) -> str:
    """Rows of the query `insert_tasks` as JSON."""
    rows = [
        {
            "id": new_id(),
            "place": place,
            "kind": task.kind.value,
            "label": task.label,
            "state": (TaskState.QUEUED if task.ready else TaskState.WAITING).value,
            "rank": queue.rank(job.priority, task.kind),
            "spec": task.spec,
        }
        for place, task in enumerate(planned)
    ]
    return json.dumps(rows)


async def release_tasks(tx: Tx, job: JobRow, kind: TaskKind) -> None:
    """waiting > queued, all tasks of a kind of a job."""
    check_task_move(TaskState.WAITING, TaskState.QUEUED)
    rows = await tx.all("release_tasks", job_id=job.id, kind=kind, before=TaskState.WAITING)
    if rows:
        await queue.announce(tx, [kind])
        await add_event(tx, job.id, "tasks.queued", COORDINATOR, detail={"kind": kind.value, "count": len(rows)})


async def claim_next(
    tx: Tx,
    job_id: str,
    askers: Sequence[tuple[WorkerRow, Collection[TaskKind]]],
    leases_sha256: Sequence[str],
    stale_s: float,
) -> tuple[JobRow, list[TaskRow | None]]:
    """queued, soft-failed > active under new attempts: the tasks of a job that workers get next; it locks the job.

    The job's first claim moves it to active too. None for a worker that the job has no task for.
    """
    for state in CLAIMABLE_TASK_STATES:
        check_task_move(state, TaskState.ACTIVE)
    locked = await tx.ask("lock_job", id=job_id)
    asked = [
        await tx.ask(
            "claim_next",
            job_id=job_id,
            worker_id=worker.id,
            worker_name=worker.name,
            lease_sha256=lease_sha256,
            **queue.wanted(worker, kinds, stale_s),
        )
        for (worker, kinds), lease_sha256 in zip(askers, leases_sha256, strict=True)
    ]
    row = await locked.fetchone()
    if row is None:
        raise NotFound(f"no job '{job_id}'", where="job")
    job = JobRow.of(row)
    found = [await cursor.fetchone() for cursor in asked]
    tasks = [None if row is None else TaskRow.of(row) for row in found]
    if any(tasks) and job.state is JobState.QUEUED:
        job = await move_job(tx, job, JobState.ACTIVE, COORDINATOR)
    for (worker, _), task in zip(askers, tasks, strict=True):
        if task is not None:
            await _task_event(tx, task, "task.claimed", f"worker:{worker.id}", {"worker": worker.name})
    return job, tasks


async def requeue_task(tx: Tx, task: TaskRow, kind: str, actor: str, *, strike: bool, reason: str) -> None:
    """active > soft-failed after a strike, > queued otherwise; `kind` is the event (`task.retried`, `task.lost`)."""
    after = TaskState.SOFT_FAILED if strike or task.strikes else TaskState.QUEUED
    if task.state is not TaskState.ACTIVE:
        raise IllegalTransition(f"a task that is {task.state} cannot be tried again")
    check_task_move(task.state, after)
    await _move(tx, "move_task_requeued", task, after=after, strikes=int(strike))
    await queue.announce(tx, [task.kind])
    await _task_event(tx, task, kind, actor, {"reason": reason, "strikes": task.strikes + int(strike)})


async def complete_task(tx: Tx, task: TaskRow, result: Result) -> None:
    """active > completed."""
    check_task_move(task.state, TaskState.COMPLETED)
    await _move(tx, "move_task_completed", task, result=Jsonb(result, dumps=_json))
    await _need_no_checkpoint(tx, task)
    await _task_event(tx, task, "task.completed", f"worker:{task.worker_id}", {"seconds": result.seconds})


def _json(result: Result) -> str:
    """A result as JSON, which takes a quarter of the time that objects of JSON take."""
    return result.model_dump_json()


async def fail_task(tx: Tx, task: TaskRow, problem: Problem, actor: str) -> None:
    """active > failed. What that means for the job: `Work.end_attempt`."""
    check_task_move(task.state, TaskState.FAILED)
    await _move(tx, "move_task_ended", task, after=TaskState.FAILED, error=Jsonb(problem.model_dump(mode="json")))
    await _need_no_checkpoint(tx, task)
    await _task_event(tx, task, "task.failed", actor, {"problem": problem.model_dump(mode="json")})


async def cancel_task(tx: Tx, task: TaskRow, actor: str, reason: str) -> None:
    """active > canceled: its worker was told to stop, or is lost."""
    check_task_move(task.state, TaskState.CANCELED)
    await _move(tx, "move_task_ended", task, after=TaskState.CANCELED, error=None)
    await _need_no_checkpoint(tx, task)
    await _task_event(tx, task, "task.canceled", actor, {"reason": reason})


async def cancel_idle_tasks(tx: Tx, job: JobRow, actor: str) -> None:
    """waiting, queued, soft-failed > canceled, all of a job."""
    before = [TaskState.WAITING, *CLAIMABLE_TASK_STATES]
    for state in before:
        check_task_move(state, TaskState.CANCELED)
    rows = await tx.all("cancel_idle_tasks", job_id=job.id, before=[state.value for state in before])
    await drop_blobs(tx, *(f"checkpoint:{row['id']}" for row in rows if row["checkpoint"] is not None))
    if rows:
        await add_event(tx, job.id, "tasks.canceled", actor, detail={"count": len(rows)})


async def reuse_renders(tx: Tx, job: JobRow, source: str, store_url: str) -> int:
    """waiting > completed, all render tasks of a job whose light fields `source` has; how many."""
    check_task_move(TaskState.WAITING, TaskState.COMPLETED)
    await tx.run("share_renders", id=job.id, source=source, store_url=store_url)
    count = await tx.count(
        "reuse_results", job_id=job.id, source=source, kind=TaskKind.RENDER, before=TaskState.WAITING.value
    )
    await add_event(tx, job.id, "tasks.reused", COORDINATOR, detail={"count": count, "job": source})
    return count


async def resume_job(tx: Tx, job: JobRow, actor: str) -> JobRow:
    """paused > queued, or > active where it has begun."""
    if job.state is not JobState.PAUSED:
        raise IllegalTransition(f"a job that is {job.state} cannot be resumed")
    job = await move_job(tx, job, JobState.ACTIVE if job.started else JobState.QUEUED, actor)
    await queue.announce(tx, list(TaskKind))
    return job


async def reopen_tasks(tx: Tx, job: JobRow, stage: TaskKind, before: Sequence[TaskState], actor: str) -> int:
    """failed, canceled > queued in `stage`, > waiting in later ones; how many."""
    for state in before:
        check_task_move(state, TaskState.QUEUED)
        check_task_move(state, TaskState.WAITING)
    states = [state.value for state in before]
    count: int = (await tx.one("reopen_tasks", job_id=job.id, stage=stage.value, before=states))["moved"]
    await queue.announce(tx, [stage])
    await add_event(tx, job.id, "tasks.reopened", actor, detail={"count": count, "stage": stage.value})
    return count


@dataclass(frozen=True)
class Choice:
    """Some of the tasks of a job: those that are in all that is given."""

    ids: Sequence[str] | None = None
    labels: Sequence[str] | None = None
    rows: tuple[int, int] | None = None
    """Texels of a tile or block: the first row, and the one after the last."""
    columns: tuple[int, int] | None = None


@dataclass(frozen=True)
class Redone:
    """How many tasks of some kinds there are, were chosen and are done again; the kinds of the last."""

    total: int
    chosen: int
    moved: int
    kinds: Sequence[TaskKind]


async def redo_tasks(
    tx: Tx,
    job: JobRow,
    kinds: Collection[TaskKind],
    after: TaskState,
    choice: Choice = Choice(),
    before: Collection[TaskState] = frozenset(TaskState) - {TaskState.WAITING, TaskState.CANCELED},
) -> Redone:
    """> queued or waiting, from any of `before`: tasks are done again."""
    states = [state.value for state in TaskState if state in before and after in TASK_TRANSITIONS[state]]
    (row_start, row_stop), (column_start, column_stop) = choice.rows or (None, None), choice.columns or (None, None)
    row = await tx.one(
        "redo_tasks",
        job_id=job.id,
        kinds=[kind.value for kind in kinds],
        ids=None if choice.ids is None else list(choice.ids),
        labels=None if choice.labels is None else list(choice.labels),
        row_start=row_start,
        row_stop=row_stop,
        column_start=column_start,
        column_stop=column_stop,
        before=states,
        after=after,
    )
    return Redone(row["total"], row["chosen"], row["moved"], [TaskKind(kind) for kind in row["kinds"]])


async def redo_lost(tx: Tx, job: JobRow, kinds: Collection[TaskKind], choice: Choice, reason: str) -> None:
    """What completed tasks of a locked job had made is gone: they are done again.

    Tasks of later stages wait for them and keep their checkpoints: what is made again has the same bytes. Of those that
    completed, only what a network's weights led to is done again, as its bytes depend on the machine that trains it.
    """
    redone = await redo_tasks(tx, job, kinds, TaskState.WAITING, choice, before=[TaskState.COMPLETED])
    if not redone.moved:
        return
    stages = METHODS[job.method].stages
    first = min(stages.index(kind) for kind in redone.kinds)
    if stages[first] in (TaskKind.FIT, TaskKind.REFINE):
        await redo_tasks(tx, job, stages[first + 1 :], TaskState.WAITING)
    await hold_later(tx, job, stages[first])
    await add_event(tx, job.id, "tasks.lost", COORDINATOR, detail={"count": redone.moved, "reason": reason})
    await release_first_stage(tx, job)


async def hold_later(tx: Tx, job: JobRow, stage: TaskKind) -> None:
    """queued, soft-failed, active > waiting: the tasks of all stages after one; they keep their checkpoints."""
    before = CLAIMABLE_TASK_STATES | {TaskState.ACTIVE}
    for state in before:
        check_task_move(state, TaskState.WAITING)
    stages = METHODS[job.method].stages
    kinds = [kind.value for kind in stages[stages.index(stage) + 1 :]]
    await tx.run("hold_tasks", job_id=job.id, kinds=kinds, before=[state.value for state in before])


async def release_first_stage(tx: Tx, job: JobRow) -> None:
    """waiting > queued: the tasks of the first stage of a job that is not completed."""
    for stage in METHODS[job.method].stages:
        if (await tx.one("stage_left", job_id=job.id, kind=stage))["unfinished"]:
            await release_tasks(tx, job, stage)
            return


async def render_into_own_store(tx: Tx, job: JobRow, store_url: str) -> JobRow:
    """The job no longer reads another job's light fields."""
    await tx.run("share_renders", id=job.id, source=None, store_url=store_url)
    return replace(job, store_url=store_url, renders_of=None)


async def forgive_worker(tx: Tx, job: JobRow, kind: TaskKind, worker: str, max_attempts: int) -> list[str]:
    """failed, soft-failed > queued (or soft-failed still, where others failed it too); the tasks' ids."""
    check_task_move(TaskState.FAILED, TaskState.QUEUED)
    check_task_move(TaskState.SOFT_FAILED, TaskState.QUEUED)
    about = {"job_id": job.id, "kind": kind.value, "worker": worker}
    rows = await tx.all("forgive_tasks", **about, max_attempts=max_attempts)
    await tx.run("forget_worker_failures", **about)
    await tx.run("recount_strikes", job_id=job.id, kind=kind.value)
    await queue.announce(tx, [kind])
    return [row["id"] for row in rows]


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
    await tx.move(
        "move_job",
        IllegalTransition(f"job {job.id} is no longer {job.state}"),
        id=job.id,
        before=job.state,
        after=after.value,
        final=after in FINAL_JOB_STATES,
        error=Jsonb(error.model_dump(mode="json")) if error else None,
    )
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


async def fail_job(tx: Tx, job: JobRow, problem: Problem, actor: str) -> None:
    """The job fails with this error and its idle tasks are canceled."""
    await cancel_idle_tasks(tx, job, actor)
    await move_job(tx, job, JobState.FAILED, actor, error=problem)


async def _need_no_checkpoint(tx: Tx, task: TaskRow) -> None:
    await drop_blobs(tx, f"checkpoint:{task.id}")


async def _move(tx: Tx, query: str, task: TaskRow, **parameters: Any) -> None:
    moved_by_others = IllegalTransition(f"task {task.id} is no longer {task.state}")
    await tx.move(query, moved_by_others, id=task.id, before=task.state, **parameters)


async def _task_event(tx: Tx, task: TaskRow, kind: str, actor: str, detail: dict[str, Any] | None = None) -> None:
    about = {"kind": task.kind.value, "label": task.label, "attempt": task.attempt}
    await add_event(tx, task.job_id, kind, actor, task_id=task.id, detail=about | (detail or {}))
