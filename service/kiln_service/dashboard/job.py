"""A job's page, what may be done to the job, and the pages of its tasks with their logs."""

from collections.abc import Awaitable, Callable, Mapping, Set
from typing import Annotated, Final, Literal

from fastapi import APIRouter, Depends, Request
from fastapi.responses import Response
from psycopg.rows import DictRow

from kiln_schemas.errors import Conflict, InputError, NotFound
from kiln_schemas.job import EventView, JobChange, JobView, RequeueRequest, TaskView
from kiln_schemas.operators import Scope
from kiln_schemas.states import FINAL_JOB_STATES, LIVE_JOB_STATES, OVER_TASK_STATES, PUBLISHED_JOB_STATES, JobState
from kiln_schemas.tasks import TaskKind
from kiln_service import jobs, views
from kiln_service.api.common import Parts, PartsHere, caller
from kiln_service.auth import Principal
from kiln_service.dashboard.jobs import stretch
from kiln_service.dashboard.pages import Form, page, see
from kiln_service.db import Database, picked, readable_rows
from kiln_service.task_logs import read_log
from kiln_service.tile_maps import STATES

router = APIRouter(include_in_schema=False)

Reader = Depends(caller(Scope.READ))
Submitter = Annotated[Principal, Depends(caller(Scope.SUBMIT))]

EVENTS: Final = 100
TASKS: Final = 200
"""Most that a job's page lists."""
LOG_LINES: Final = 2000
"""Of a log the page shows so many of the last lines."""

Action = Literal["pause", "resume", "cancel", "retry", "archive"]
_DO: Final[Mapping[Action, Callable[[Database, str, str], Awaitable[None]]]] = {
    "pause": jobs.pause,
    "resume": jobs.resume,
    "cancel": jobs.cancel,
    "archive": jobs.archive,
}
_ACTIONS: Final[Mapping[Action, tuple[Set[JobState], str, str]]] = {
    "pause": (
        {JobState.QUEUED, JobState.ACTIVE},
        "Pause",
        "Its running tasks go on to their end; no other is given to a worker.",
    ),
    "resume": ({JobState.PAUSED}, "Resume", "Its tasks are given to workers again."),
    "cancel": (LIVE_JOB_STATES, "Cancel", "Its running tasks are stopped; what has completed stays."),
    "retry": (
        {JobState.FAILED, JobState.CANCELED},
        "Retry",
        "Its unfinished tasks are done again; what has completed stays.",
    ),
    "archive": (
        FINAL_JOB_STATES - {JobState.ARCHIVED},
        "Archive",
        "Lists leave it out from now on. Its package stays.",
    ),
}
"""In which states each is offered, its name, and what it does, for the question before it is done."""


@router.get("/jobs/{job_id}", dependencies=[Reader])
async def job(request: Request, job_id: str, parts: PartsHere) -> Response:
    """All about one job."""
    view = await views.job_view(parts.database, parts.config, job_id)
    async with parts.database.transaction() as tx:
        tasks = await tx.all("tasks_of_note", job_id=job_id, limit=TASKS)
        events = readable_rows(EventView, await tx.all("last_events", job_id=job_id, limit=EVENTS))
    return page(
        request,
        "job.html",
        job=view,
        bars=[(stage, stretch(stage)) for stage in view.stages],
        tasks=[picked(TaskView, views.task_values(row)) for row in tasks],
        events=events,
        artifacts=await views.artifacts(parts.database, job_id),
        actions=_allowed(view),
        limits={"events": EVENTS, "tasks": TASKS},
        live=view.state not in FINAL_JOB_STATES,
        states=STATES,
    )


@router.post("/jobs/{job_id}/priority")
async def rank(job_id: str, parts: PartsHere, who: Submitter, form: Form) -> Response:
    """Rank the job anew."""
    wanted = form.get("priority", "")
    if not wanted.isascii() or not wanted.isdigit() or len(wanted) > 3 or int(wanted) > 100:
        raise InputError(f"'{wanted}' is not a priority", where="priority", remedy="Give a whole number from 0 to 100.")
    await jobs.change(parts.database, job_id, JobChange(priority=int(wanted)), who.actor)
    return see(f"/jobs/{job_id}")


@router.post("/jobs/{job_id}/do/{action}")
async def act(job_id: str, action: Action, parts: PartsHere, who: Submitter, _: Form) -> Response:
    """Pause, resume, cancel, retry or archive the job."""
    if action == "retry":
        await jobs.retry(parts.database, parts.config, job_id, who.actor)
    else:
        await _DO[action](parts.database, job_id, who.actor)
    return see(f"/jobs/{job_id}")


@router.get("/tasks/{task_id}", dependencies=[Reader])
async def task(request: Request, task_id: str, parts: PartsHere) -> Response:
    """One task and its log, which a script follows while it runs."""
    row = await _task(parts, task_id)
    view = picked(TaskView, views.task_values(row))
    return page(
        request,
        "task.html",
        task=view,
        job_id=row["job_id"],
        log=(await read_log(parts.database, task_id, parts.config.limits.logs.answer_bytes, LOG_LINES)).text,
        lines=LOG_LINES,
        over=view.state in OVER_TASK_STATES,
        may_redo=view.state in OVER_TASK_STATES
        and view.kind is not TaskKind.PREPARE
        and JobState(row["job_state"]) in LIVE_JOB_STATES | PUBLISHED_JOB_STATES | {JobState.FAILED},
    )


@router.post("/tasks/{task_id}/requeue")
async def redo(task_id: str, parts: PartsHere, who: Submitter, _: Form) -> Response:
    """Do a task again, and what follows from it."""
    row = await _task(parts, task_id)
    if row["kind"] == TaskKind.PREPARE:
        raise Conflict("a scene is prepared once", where=row["label"], remedy="Submit the job again.")
    wanted = RequeueRequest(kind=row["kind"], labels=(row["label"],))
    await jobs.requeue(parts.database, parts.config, row["job_id"], wanted, who.actor)
    return see(f"/tasks/{task_id}")


async def _task(parts: Parts, task_id: str) -> DictRow:
    async with parts.database.transaction() as tx:
        row = await tx.maybe("one_task", id=task_id)
    if row is None:
        raise NotFound(f"no task '{task_id}'", where="task")
    return row


def _allowed(view: JobView) -> list[tuple[Action, str, str]]:
    """What may be done to the job as it is; to retry also where it goes on without tasks that failed."""
    failed = view.state in LIVE_JOB_STATES and any(stage.failed for stage in view.stages)
    return [
        (action, name, does)
        for action, (states, name, does) in _ACTIONS.items()
        if view.state in states or (action == "retry" and failed)
    ]
