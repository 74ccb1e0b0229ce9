"""Routes for workers: register, claim, heartbeat, and the end of a task.

A worker belongs to the token that registered it; an attempt to whoever has the lease that its claim was given.
"""

from typing import Annotated

from fastapi import APIRouter, Depends, Request, Response

from kiln_schemas.operators import Scope
from kiln_schemas.tasks import (
    Checkpoint,
    Claim,
    ClaimRequest,
    Commit,
    Failure,
    Heartbeat,
    HeartbeatReply,
    WorkerRegistration,
    WorkerWelcome,
)
from kiln_service.api.commits import CommitRoute
from kiln_service.api.common import PartsHere, caller, problems
from kiln_service.auth import Principal

_worker = caller(Scope.WORKER)
Worker = Annotated[Principal, Depends(_worker)]

router = APIRouter(prefix="/v1", tags=["workers"], dependencies=[Depends(_worker)])


@router.post("/workers", status_code=201, responses=problems(409, 422))
async def register(registration: WorkerRegistration, parts: PartsHere, who: Worker) -> WorkerWelcome:
    """Register a worker; its id stays valid when the coordinator restarts, for this token."""
    worker_id = await parts.work.register(registration, who.name)
    return WorkerWelcome(worker_id=worker_id, heartbeat_s=parts.config.timing.heartbeat_s)


@router.post(
    "/workers/{worker_id}/claim",
    response_model=Claim,
    responses=problems(404, 409, 422) | {204: {"description": "Nothing to do within `wait_s`"}},
)
async def claim(worker_id: str, request: ClaimRequest, parts: PartsHere, who: Worker, http: Request) -> Response:
    """Take the next task; held open up to `wait_s` while there is none. 409 `drained`: leave."""
    handed = await parts.work.claim(worker_id, request, who.name, http.is_disconnected)
    if handed is None:
        return Response(status_code=204)
    return Response(handed.json(), media_type="application/json")


@router.post("/workers/{worker_id}/heartbeat", responses=problems(404, 422))
async def heartbeat(worker_id: str, beat: Heartbeat, parts: PartsHere, who: Worker) -> HeartbeatReply:
    """Say that an attempt lives and how far it is; the answer may be to stop."""
    return await parts.work.heartbeat(worker_id, beat, who.name)


async def commit(task_id: str, commit: Commit, parts: PartsHere) -> None:
    """Hand in the result of an attempt. Repeating the same commit is no error. 409 `stale-attempt`: it is not yours."""
    await parts.work.commit(task_id, commit)


router.add_api_route(
    "/tasks/{task_id}/commit",
    commit,
    methods=["POST"],
    status_code=204,
    responses=problems(404, 409, 422),
    route_class_override=CommitRoute,
)


@router.post("/tasks/{task_id}/fail", status_code=204, responses=problems(404, 409, 422))
async def fail(task_id: str, failure: Failure, parts: PartsHere) -> None:
    """Report that an attempt ended without a result."""
    await parts.work.fail(task_id, failure)


@router.post("/tasks/{task_id}/checkpoint", status_code=204, responses=problems(404, 409, 422))
async def checkpoint(task_id: str, checkpoint: Checkpoint, parts: PartsHere) -> None:
    """Publish a checkpoint that later attempts begin from."""
    await parts.work.checkpoint(task_id, checkpoint)
