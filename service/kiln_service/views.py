"""Jobs and tasks as clients see them, with an honest estimate of the time left."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

from psycopg.rows import DictRow
from psycopg.types.json import Jsonb
from pydantic import ValidationError

from kiln_schemas.errors import InputError, InternalError, NotFound
from kiln_schemas.job import CurveView, JobPage, JobView, StageView, TaskView
from kiln_schemas.states import FINAL_JOB_STATES, JobState, TaskState
from kiln_schemas.tasks import Artifact, TaskKind
from kiln_service.config import ServiceConfig
from kiln_service.db import Database, JobRow, Tx, job_rows, readable, readable_rows
from kiln_service.db.lenient import note_unreadable, readable_outcome
from kiln_service.planner import METHODS
from kiln_service.waiting import reasons

LEAST_FRACTION: Final = 0.05
"""A running task says nothing about its duration before this."""
MOST_CHANGES: Final = 2000
"""After more events than this all tasks count as changed."""
CURVE_POINTS: Final = 1000
"""About the most points of the curve of a task that runs."""


async def job_view(database: Database, config: ServiceConfig, job_id: str) -> JobView:
    """One job; NotFound where there is none."""
    async with database.transaction() as tx:
        row = await tx.maybe("find_job", id=job_id)
        if row is None:
            raise NotFound(f"no job '{job_id}'", where="job")
        found = await _views(tx, config, [JobRow.of(row)])
    if not found:
        raise InternalError(f"job {job_id} cannot be read", where="job", remedy="The coordinator's log says why.")
    return found[0]


async def job_page(
    database: Database,
    config: ServiceConfig,
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
        views = await _views(tx, config, job_rows(rows[:limit]))
    return JobPage(jobs=tuple(views), next=rows[limit - 1]["id"] if len(rows) > limit else None)


@dataclass(frozen=True)
class TaskPage:
    """Some tasks of a job in the order of planning."""

    tasks: tuple[TaskView, ...]
    next: int | None
    """Cursor of the next page."""
    version: int
    """The id of an event: what is `since` it has changed after this page was read."""


async def task_page(
    database: Database,
    job_id: str,
    *,
    kind: TaskKind | None,
    state: TaskState | None,
    since: int | None,
    cursor: int | None,
    limit: int,
) -> TaskPage:
    """Tasks of a kind and in a state after a cursor; with `since`, those alone that may have changed after an event."""
    about = {"job_id": job_id, "kind": kind, "state": state, "cursor": -1 if cursor is None else cursor}
    async with database.transaction() as tx:
        version = await tx.maybe("tile_map_version", job_id=job_id)
        if version is None:
            raise NotFound(f"no job '{job_id}'", where="job")
        if since is not None:
            changes = await tx.one("changes_since", job_id=job_id, since=since, most=MOST_CHANGES + 1)
            if changes["of_many"] or changes["changes"] > MOST_CHANGES:
                since = None
        if since is None:
            rows = await tx.all("page_of_tasks", **about, limit=limit + 1)
        else:
            rows = await tx.all("page_of_changed_tasks", **about, since=since, limit=limit + 1)
    following = rows[limit - 1]["ordinal"] if len(rows) > limit else None
    return TaskPage(tuple(readable_rows(TaskView, map(task_values, rows[:limit]))), following, version["version"])


def task_values(row: DictRow) -> DictRow:
    """A row of `page_of_tasks` as a `TaskView` has it; what an older version stored is read as far as it can be."""
    values = {name: value for name, value in row.items() if name != "ordinal"}
    return values | readable_outcome(row)


async def curves(database: Database, job_id: str) -> tuple[CurveView, ...]:
    """The losses of a job's fits, while they run and after."""
    async with database.transaction() as tx:
        await _require_job(tx, job_id)
        rows = await tx.all("list_curves", job_id=job_id, points=CURVE_POINTS)
    return tuple(readable_rows(CurveView, rows))


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


async def _views(tx: Tx, config: ServiceConfig, jobs: Sequence[JobRow]) -> list[JobView]:
    """Those that can be shown."""
    by_job: dict[str, dict[str, DictRow]] = {job.id: {} for job in jobs}
    for row in await tx.all("stages", job_ids=list(by_job)):
        by_job[row["job_id"]][row["kind"]] = row
    waits = await reasons(tx, config, jobs, by_job)
    views = []
    for job in jobs:
        try:
            views.append(_job_view(job, by_job[job.id], waits.get(job.id)))
        except (ValidationError, KeyError) as error:
            note_unreadable("job", {"id": job.id}, error)
    return views


def _job_view(job: JobRow, rows: dict[str, DictRow], waits_for: str | None) -> JobView:
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
        "lightmap_side": job.lightmap_side,
        "renders_of": job.renders_of,
        "waits_for": waits_for,
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


async def require_task(database: Database, task_id: str) -> None:
    """NotFound where there is no such task."""
    async with database.transaction() as tx:
        if await tx.maybe("find_task", id=task_id) is None:
            raise NotFound(f"no task '{task_id}'", where="task")


async def _require_job(tx: Tx, job_id: str) -> None:
    if await tx.maybe("job_state", id=job_id) is None:
        raise NotFound(f"no job '{job_id}'", where="job")
