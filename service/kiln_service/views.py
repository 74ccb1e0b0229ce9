"""Jobs and tasks as clients see them, with an honest estimate of the time left."""

from collections.abc import AsyncIterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

from psycopg.rows import DictRow
from psycopg.types.json import Jsonb
from pydantic import ValidationError

from kiln_schemas.errors import InputError, InternalError, NotFound
from kiln_schemas.job import CurveView, JobPage, JobView, StageView, TaskView
from kiln_schemas.states import FINAL_JOB_STATES, OVER_TASK_STATES, JobState, TaskState
from kiln_schemas.tasks import Artifact, TaskKind
from kiln_service.db import Database, JobRow, TaskRow, Tx, job_rows, readable, readable_rows
from kiln_service.db.lenient import note_unreadable
from kiln_service.events import EVENT_CHANNEL, Signals, wait
from kiln_service.planner import METHODS

LEAST_FRACTION: Final = 0.05
"""A running task says nothing about its duration before this."""
CURVE_POINTS: Final = 1000
"""About the most points of the curve of a task that runs."""


async def job_view(database: Database, job_id: str) -> JobView:
    """One job; NotFound where there is none."""
    async with database.transaction() as tx:
        row = await tx.maybe("find_job", id=job_id)
        if row is None:
            raise NotFound(f"no job '{job_id}'", where="job")
        found = await _views(tx, [JobRow.of(row)])
    if not found:
        raise InternalError(f"job {job_id} cannot be read", where="job", remedy="The coordinator's log says why.")
    return found[0]


async def job_page(
    database: Database,
    *,
    states: Sequence[JobState] = (),
    labels: Mapping[str, str] | None = None,
    text: str | None = None,
    cursor: str | None = None,
    limit: int,
) -> JobPage:
    """Jobs, newest first, that have all these labels and `text` in their name; `next` is the cursor of the page after.

    Without `states` all but those that are archived.
    """
    async with database.transaction() as tx:
        rows = await tx.all(
            "page_of_jobs",
            before=cursor,
            states=[state.value for state in states or set(JobState) - {JobState.ARCHIVED}],
            labels=Jsonb(dict(labels or {})),
            text=text,
            limit=limit + 1,
        )
        views = await _views(tx, job_rows(rows[:limit]))
    return JobPage(jobs=tuple(views), next=rows[limit - 1]["id"] if len(rows) > limit else None)


async def task_views(
    database: Database, job_id: str, kind: TaskKind | None, state: TaskState | None
) -> tuple[TaskView, ...]:
    """Tasks of a job in the order of planning."""
    async with database.transaction() as tx:
        await _require_job(tx, job_id)
        rows = await tx.all("list_tasks", job_id=job_id, kind=kind, state=state)
    return tuple(task_view(TaskRow.of(row), row["worker"]) for row in rows)


async def curves(database: Database, job_id: str) -> tuple[CurveView, ...]:
    """The losses of a job's fits, while they run and after."""
    async with database.transaction() as tx:
        await _require_job(tx, job_id)
        rows = await tx.all("list_curves", job_id=job_id, points=CURVE_POINTS)
    return tuple(readable_rows(CurveView, rows))


async def task_log(database: Database, task_id: str, tail: int | None = None) -> str:
    """All that the attempts of a task wrote, each under a line that names it; or the last `tail` lines of that."""
    return await _log_so_far(database, task_id, LogPlace(), tail)


async def follow_log(
    database: Database, signals: Signals, task_id: str, tail: int | None, poll_s: float
) -> AsyncIterator[str]:
    """The same, and what is written from now on until the task is over."""
    place, over = LogPlace(), False
    yield await _log_so_far(database, task_id, place, tail)
    with signals.watch(EVENT_CHANNEL) as woken:
        while not over and not signals.stopping:
            woken.clear()
            async with database.transaction() as tx:
                row = await tx.one("find_task", id=task_id)
            over = TaskState(row["state"]) in OVER_TASK_STATES
            async for piece in _log_pieces(database, task_id, place):
                yield piece
            if not over:
                await wait(woken, poll_s)


@dataclass
class LogPlace:
    """How far a log was read."""

    row: int = 0
    attempt: int | None = None


async def _log_so_far(database: Database, task_id: str, place: LogPlace, tail: int | None) -> str:
    """What there is after `place`, or the last `tail` lines of it."""
    text = "".join([piece async for piece in _log_pieces(database, task_id, place)])
    lines = text.splitlines(keepends=True)
    return text if tail is None else "".join(lines[max(0, len(lines) - tail) :])


async def _log_pieces(database: Database, task_id: str, place: LogPlace) -> AsyncIterator[str]:
    async with database.transaction() as tx:
        if await tx.maybe("find_task", id=task_id) is None:
            raise NotFound(f"no task '{task_id}'", where="task")
        rows = await tx.all("task_log", task_id=task_id, after=place.row)
    for row in rows:
        if row["attempt"] != place.attempt:
            yield f"--- attempt {row['attempt']}\n"
        place.row, place.attempt = row["id"], row["attempt"]
        yield row["lines"] if row["lines"].endswith("\n") else row["lines"] + "\n"


async def artifacts(database: Database, job_id: str) -> tuple[Artifact, ...]:
    """What a job published; nothing before its package is there."""
    async with database.transaction() as tx:
        await _require_job(tx, job_id)
        rows = await tx.all("list_artifacts", job_id=job_id)
    return tuple(readable_rows(Artifact, rows))


async def artifact(database: Database, job_id: str, name: str) -> Artifact:
    """One artifact of a job; NotFound where it is not published."""
    async with database.transaction() as tx:
        await _require_job(tx, job_id)
        row = await tx.maybe("find_artifact", job_id=job_id, name=name)
    if row is None:
        raise NotFound(
            f"job {job_id} has no artifact '{name}'", where="artifact", remedy="GET .../artifacts lists what there is."
        )
    return Artifact.model_validate(row)


def parse_cursor(cursor: str | None) -> str | None:
    """A cursor is the id of the last job of the page before."""
    if cursor is not None and (len(cursor) != 32 or not all(c in "0123456789abcdef" for c in cursor)):
        raise InputError(f"'{cursor}' is not a cursor", where="cursor", remedy="Use `next` of the page before.")
    return cursor


def remaining_seconds(rows: Sequence[DictRow]) -> float | None:
    """Seconds until the tasks that are planned now and can be estimated are done, at the present number of workers.

    A kind of task is estimated from the mean of its completed tasks, else from those that run and have come far
    enough; kinds with neither are not counted, and where that leaves no kind at all, nothing is said.
    """
    known = [seconds for row in rows if (seconds := _remaining_of_kind(row)) is not None]
    return sum(known) if known else None


def _remaining_of_kind(row: DictRow) -> float | None:
    """The same for one kind (a row of the query `stages`); None where it is done or unknown."""
    unfinished = row["total"] - row["completed"]
    if unfinished == 0:
        return None
    running = list(zip(row["fractions"] or [], row["elapsed"] or [], strict=True))
    if row["completed"]:
        each = row["seconds"] / row["completed"]
        parts = [max(each * (1 - fraction), 0.0) for fraction, _ in running]
    else:
        told = [elapsed / fraction for fraction, elapsed in running if fraction >= LEAST_FRACTION]
        if not told:
            return None
        each = sum(told) / len(told)
        parts = [each * (1 - fraction) for fraction, _ in running]
    idle = each * (unfinished - len(running))
    return float(max((sum(parts) + idle) / max(len(running), 1), max(parts, default=0.0), 0.0))


async def _views(tx: Tx, jobs: Sequence[JobRow]) -> list[JobView]:
    """Those that can be shown."""
    by_job: dict[str, dict[str, DictRow]] = {job.id: {} for job in jobs}
    for row in await tx.all("stages", job_ids=list(by_job)):
        by_job[row["job_id"]][row["kind"]] = row
    views = []
    for job in jobs:
        try:
            views.append(_job_view(job, by_job[job.id]))
        except (ValidationError, KeyError) as error:
            note_unreadable("job", {"id": job.id}, error)
    return views


def _job_view(job: JobRow, rows: dict[str, DictRow]) -> JobView:
    ordered = [rows[kind] for kind in METHODS[job.method].stages if kind in rows]
    values = {
        "id": job.id,
        "name": job.name,
        "state": job.state,
        "settings": job.settings,
        "bundle": job.bundle,
        "created": job.created,
        "started": job.started,
        "finished": job.finished,
        "stages": tuple(_stage_view(row) for row in ordered),
        "remaining_s": None if job.state in FINAL_JOB_STATES else remaining_seconds(ordered),
        "notes": job.notes,
        "error": job.error,
        "gates": job.gates,
        "cameras": job.cameras,
        "gate_results": job.gate_results,
        "priority": job.priority,
        "labels": job.labels,
        "tags": job.tags,
        "outcome": job.outcome,
        "submitter": job.submitter,
        "renders_of": job.renders_of,
    }
    return readable(JobView, values)


def _stage_view(row: DictRow) -> StageView:
    return StageView(
        kind=TaskKind(row["kind"]),
        total=row["total"],
        completed=row["completed"],
        active=row["active"],
        failed=row["failed"],
        soft_failed=row["soft_failed"],
        fraction=min((row["completed"] + sum(row["fractions"] or [])) / row["total"], 1.0),
        seconds=max(row["seconds"], 0.0),  # a clock that was set back makes it negative
    )


def task_view(task: TaskRow, worker: str | None) -> TaskView:
    """A task with the name of its worker."""
    values = {
        "id": task.id,
        "kind": task.kind,
        "label": task.label,
        "state": task.state,
        "attempt": task.attempt,
        "worker": worker,
        "progress": task.progress,
        "created": task.created,
        "started": task.started,
        "finished": task.finished,
        "error": task.error,
    }
    return readable(TaskView, values)


async def require_task(database: Database, task_id: str) -> None:
    """NotFound where there is no such task."""
    async with database.transaction() as tx:
        if await tx.maybe("find_task", id=task_id) is None:
            raise NotFound(f"no task '{task_id}'", where="task")


async def _require_job(tx: Tx, job_id: str) -> None:
    if await tx.maybe("job_state", id=job_id) is None:
        raise NotFound(f"no job '{job_id}'", where="job")
