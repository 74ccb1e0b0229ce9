"""Routes of jobs, their tasks, events and artifacts."""

from collections.abc import AsyncIterator
from typing import Annotated, Any, Final, Literal

from fastapi import APIRouter, Depends, Header, Query, Request, Response
from fastapi.responses import PlainTextResponse, StreamingResponse
from pydantic import TypeAdapter

from kiln_schemas.errors import InputError
from kiln_schemas.job import (
    CurveView,
    EventView,
    JobChange,
    JobPage,
    JobRequest,
    JobView,
    RequeueRequest,
    TaskView,
    read_labels,
)
from kiln_schemas.operators import Scope
from kiln_schemas.states import JobState, TaskState
from kiln_schemas.tasks import Artifact, TaskKind
from kiln_service import jobs, task_logs, views
from kiln_service.api.common import Parts, PartsHere, caller, problems
from kiln_service.api.files import serve_blob
from kiln_service.auth import Principal
from kiln_service.events import BATCH, is_over, read_events
from kiln_service.streams import CountedStream

router = APIRouter(prefix="/v1", tags=["jobs"])

Caller = Annotated[Principal, Depends(caller(Scope.READ))]
Reader = Depends(caller(Scope.READ))
Submitter = Annotated[Principal, Depends(caller(Scope.SUBMIT))]
UNSEEN: Final[dict[int | str, dict[str, Any]]] = {204: {"description": "Done; the token may not look at jobs"}}


@router.post("/jobs", status_code=201, responses=problems(409, 413, 422, 507))
async def submit(
    request: JobRequest,
    parts: PartsHere,
    who: Submitter,
    response: Response,
    idempotency_key: Annotated[
        str | None,
        Header(min_length=1, max_length=255, description="a request sent twice under a key makes one job"),
    ] = None,
) -> JobView:
    """Submit a bake of files that were uploaded before."""
    job = await jobs.submit(parts.database, parts.config, request, who, idempotency_key)
    response.headers["Location"] = f"/v1/jobs/{job.id}"
    return await views.job_view(parts.database, parts.config, job.id)


@router.get("/jobs", dependencies=[Reader], responses=problems(422))
async def list_jobs(
    parts: PartsHere,
    state: Annotated[
        list[JobState] | None, Query(description="only jobs in one of these states; else all that are not archived")
    ] = None,
    label: Annotated[
        list[str] | None, Query(max_length=32, description="KEY=VALUE; only jobs with all of these labels")
    ] = None,
    q: Annotated[str | None, Query(max_length=128, description="only jobs with this in their name")] = None,
    cursor: Annotated[str | None, Query(description="`next` of the page before")] = None,
    limit: Annotated[int, Query(ge=1, le=1000)] = 50,
) -> JobPage:
    """Jobs, newest first."""
    size = min(limit, parts.config.limits.page)
    return await views.job_page(
        parts.database,
        parts.config,
        states=state or (),
        labels=read_labels(label or (), "label"),
        text=q,
        cursor=views.parse_cursor(cursor),
        limit=size,
    )


@router.get("/jobs/{job_id}", dependencies=[Reader], responses=problems(404))
async def job(job_id: str, parts: PartsHere) -> JobView:
    """One job with its stages, the time left, its quality gates and, if it failed, why."""
    return await views.job_view(parts.database, parts.config, job_id)


@router.post("/jobs/{job_id}/cancel", response_model=JobView, responses=problems(404, 409) | UNSEEN)
async def cancel(job_id: str, parts: PartsHere, who: Submitter) -> JobView | Response:
    """Ask the job to stop; it is canceled once its running tasks have stopped."""
    await jobs.cancel(parts.database, job_id, who.actor)
    return await _seen(parts, job_id, who)


@router.patch("/jobs/{job_id}", response_model=JobView, responses=problems(404, 422) | UNSEEN)
async def change(job_id: str, wanted: JobChange, parts: PartsHere, who: Submitter) -> JobView | Response:
    """Rank the job anew among those that wait, or label it anew."""
    await jobs.change(parts.database, job_id, wanted, who.actor)
    return await _seen(parts, job_id, who)


@router.post("/jobs/{job_id}/pause", response_model=JobView, responses=problems(404, 409) | UNSEEN)
async def pause(job_id: str, parts: PartsHere, who: Submitter) -> JobView | Response:
    """Give no more of its tasks to workers; those that run go on to their end."""
    await jobs.pause(parts.database, job_id, who.actor)
    return await _seen(parts, job_id, who)


@router.post("/jobs/{job_id}/resume", response_model=JobView, responses=problems(404, 409) | UNSEEN)
async def resume(job_id: str, parts: PartsHere, who: Submitter) -> JobView | Response:
    """Go on with a paused job."""
    await jobs.resume(parts.database, job_id, who.actor)
    return await _seen(parts, job_id, who)


@router.post("/jobs/{job_id}/retry", response_model=JobView, responses=problems(404, 409) | UNSEEN)
async def retry(job_id: str, parts: PartsHere, who: Submitter) -> JobView | Response:
    """Do a failed or canceled job's unfinished tasks again, or a live one's failed tasks; what has completed stays."""
    await jobs.retry(parts.database, parts.config, job_id, who.actor)
    return await _seen(parts, job_id, who)


@router.post("/jobs/{job_id}/requeue", response_model=JobView, responses=problems(404, 409, 422) | UNSEEN)
async def requeue(job_id: str, wanted: RequeueRequest, parts: PartsHere, who: Submitter) -> JobView | Response:
    """Do tasks again though they are done, and all that follows from them; a completed job's artifacts go meanwhile."""
    await jobs.requeue(parts.database, parts.config, job_id, wanted, who.actor)
    return await _seen(parts, job_id, who)


@router.post("/jobs/{job_id}/archive", response_model=JobView, responses=problems(404, 409) | UNSEEN)
async def archive(job_id: str, parts: PartsHere, who: Submitter) -> JobView | Response:
    """Put a job that is over aside: lists leave it out unless asked for."""
    await jobs.archive(parts.database, job_id, who.actor)
    return await _seen(parts, job_id, who)


_TASKS: Final = TypeAdapter(tuple[TaskView, ...])
_TILES: Final = problems(404) | {
    200: {
        "description": "The map; X-Side tiles and X-Texels texels along each side",
        "content": {"application/octet-stream": {}},
    },
    304: {"description": "It is as the client has it (If-None-Match)"},
}


@router.get(
    "/jobs/{job_id}/tasks",
    dependencies=[Reader],
    response_model=tuple[TaskView, ...],
    responses=problems(404, 422),
)
async def tasks(
    job_id: str,
    parts: PartsHere,
    kind: TaskKind | None = None,
    state: TaskState | None = None,
    since: Annotated[
        int | None, Query(ge=0, lt=2**63, description="only what may have changed since X-Version of an answer")
    ] = None,
    cursor: Annotated[int | None, Query(ge=0, lt=2**31, description="X-Next-Cursor of the page before")] = None,
    limit: Annotated[int, Query(ge=1, le=500)] = 500,
) -> Response:
    """A page of the job's tasks in the order of planning; X-Next-Cursor is there where another follows."""
    page = await views.task_page(
        parts.database, job_id, kind=kind, state=state, since=since, cursor=cursor, limit=limit
    )
    headers = {"X-Version": str(page.version)}
    if page.next is not None:
        headers["X-Next-Cursor"] = str(page.next)
    return Response(_TASKS.dump_json(page.tasks), headers=headers, media_type="application/json")


@router.get("/jobs/{job_id}/tiles", dependencies=[Reader], response_class=Response, responses=_TILES)
async def tiles(job_id: str, parts: PartsHere, if_none_match: Annotated[str | None, Header()] = None) -> Response:
    """A byte a tile, row by row: 0 no tile, else 1 plus the place of its state among the states of a task."""
    found = await parts.tile_maps.read(job_id)
    headers = {"ETag": f'"{found.version}"', "Cache-Control": "no-cache", "X-Side": str(found.side)}
    headers["X-Texels"] = str(found.texels)
    if if_none_match == headers["ETag"]:
        return Response(status_code=304, headers=headers)
    return Response(found.cells, headers=headers, media_type="application/octet-stream")


@router.get("/jobs/{job_id}/curves", dependencies=[Reader], responses=problems(404))
async def curves(job_id: str, parts: PartsHere) -> tuple[CurveView, ...]:
    """The losses of the job's fits over their steps, while they run and after."""
    return await views.curves(parts.database, job_id)


@router.get(
    "/tasks/{task_id}/log",
    response_class=PlainTextResponse,
    response_model=None,
    responses=problems(404, 422),
)
async def log(
    task_id: str,
    parts: PartsHere,
    who: Caller,
    tail: Annotated[int | None, Query(ge=0, le=100_000, description="only so many of the last lines")] = None,
    before: Annotated[
        int | None, Query(ge=1, lt=2**63, description="only what comes before: X-Log-Before of the answer after it")
    ] = None,
    follow: Annotated[bool, Query(description="stay, and send what is written until the task is over")] = False,
) -> Response:
    """The end of what the task's attempts wrote; X-Log-Before is there where more comes before it."""
    most = parts.config.limits.logs.answer_bytes
    if not follow:
        part = await task_logs.read_log(parts.database, task_id, most, tail, before)
        headers = {} if part.before is None else {"X-Log-Before": str(part.before)}
        return PlainTextResponse(part.text, headers=headers)
    await views.require_task(parts.database, task_id)
    stream = task_logs.follow_log(parts.database, parts.signals, task_id, most, tail, parts.config.timing.poll_s)
    return CountedStream(parts.streams, who.name, stream, "text/plain; charset=utf-8")


@router.get(
    "/jobs/{job_id}/events",
    response_model=None,
    responses=problems(404, 422)
    | {
        200: {
            "description": "The history so far as a list (`format=json`), or past and coming events as a stream",
            "content": {
                "text/event-stream": {"schema": {"type": "string"}},
                "application/json": {"schema": {"type": "array", "items": EventView.model_json_schema()}},
            },
        },
        204: {"description": "The job is over and every event was read: do not reconnect"},
    },
)
async def events(
    job_id: str,
    parts: PartsHere,
    who: Caller,
    format: Literal["sse", "json"] = "sse",
    after: Annotated[int | None, Query(ge=0, lt=2**63, description="only events with greater ids")] = None,
    limit: Annotated[int, Query(ge=1, le=10_000, description="most events of a list")] = BATCH,
    last_event_id: Annotated[str | None, Header(description="where a stream that broke goes on")] = None,
) -> Response:
    """The job's history. A stream ends when the job is over and goes on after `Last-Event-ID`."""
    start = after if after is not None else _event_id(last_event_id)
    if format == "json":
        first = await read_events(parts.database, job_id, start, min(limit, BATCH))
        return StreamingResponse(_event_list(parts, job_id, first, limit), media_type="application/json")
    if await is_over(parts.database, job_id, start):
        return Response(status_code=204)
    stream = parts.streams.stream(job_id, start)
    return CountedStream(parts.streams, who.name, stream, "text/event-stream")


@router.get("/jobs/{job_id}/artifacts", dependencies=[Reader], responses=problems(404))
async def artifacts(job_id: str, parts: PartsHere) -> tuple[Artifact, ...]:
    """What the job published: empty until it has completed, whether its quality gates are met or not."""
    return await views.artifacts(parts.database, job_id)


_ARTIFACT: Final[dict[str, Any]] = {
    "dependencies": [Reader],
    "response_class": Response,
    "responses": problems(404, 416)
    | {
        200: {"description": "The file; its ETag is the sha256", "content": {"application/octet-stream": {}}},
        206: {"description": "The range asked for"},
        304: {"description": "The client has it"},
    },
}


@router.head("/jobs/{job_id}/artifacts/{name:path}", operation_id="artifact_head", **_ARTIFACT)
@router.get("/jobs/{job_id}/artifacts/{name:path}", **_ARTIFACT)
async def artifact(job_id: str, name: str, request: Request, parts: PartsHere) -> Response:
    """Download an artifact, whole or a range of it."""
    found = await views.artifact(parts.database, job_id, name)
    return await serve_blob(request, parts.blobs, found.sha256, found.size, found.media_type)


async def _seen(parts: Parts, job_id: str, who: Principal) -> JobView | Response:
    """The job as it is now, where the caller may look at jobs."""
    if not who.scopes & {Scope.READ, Scope.ADMIN}:
        return Response(status_code=204)
    return await views.job_view(parts.database, parts.config, job_id)


async def _event_list(parts: Parts, job_id: str, page: list[EventView], limit: int) -> AsyncIterator[str]:
    """Events as a JSON array, page by page: ten thousand at once would hold up everybody else."""
    separator = "["
    while page:
        yield separator + ",".join(event.model_dump_json() for event in page)
        separator = ","
        limit -= len(page)
        page = await read_events(parts.database, job_id, page[-1].id, min(limit, BATCH)) if limit > 0 else []
    yield "[]" if separator == "[" else "]"


def _event_id(header: str | None) -> int:
    if not header:
        return 0
    if not header.isascii() or not header.isdigit() or len(header) > 18:
        raise InputError(f"'{header}' is not an event's id", where="Last-Event-ID")
    return int(header)
