"""Routes for operators: workers and their orders, access tokens, the record, metrics."""

from typing import Annotated

from fastapi import APIRouter, Depends, Path, Query, Request, Response

from kiln_schemas.operators import (
    AuditEntry,
    DeliveryView,
    GcReport,
    GcRequest,
    NewToken,
    NewWebhook,
    Order,
    Scope,
    SleepSchedule,
    TokenRequest,
    TokenView,
    WebhookRequest,
    WebhookView,
    WorkerView,
)
from kiln_service import gc, metrics, operators, webhooks
from kiln_service.api.common import PartsHere, caller, problems
from kiln_service.auth import Principal

router = APIRouter(prefix="/v1", tags=["operators"])

Reader = Depends(caller(Scope.READ))
WorkerName = Annotated[str, Path(min_length=1, max_length=128, description="a worker's name")]
Admin = Annotated[Principal, Depends(caller(Scope.ADMIN))]


@router.get("/workers", dependencies=[Reader], responses=problems())
async def workers(parts: PartsHere) -> tuple[WorkerView, ...]:
    """Workers that were seen within a week, with the task that each has."""
    return await operators.list_workers(parts.database)


@router.post("/workers/{worker_id}/orders/{order}", status_code=204, responses=problems(404, 422))
async def order(worker_id: str, order: Order, parts: PartsHere, who: Admin) -> None:
    """Tell a worker to sleep, to wake, or to leave once its task is done."""
    await operators.order_worker(parts.database, worker_id, order, who.actor)


@router.delete("/workers/{worker_id}/blocks", status_code=204, responses=problems(404))
async def unblock(worker_id: str, parts: PartsHere, who: Admin) -> None:
    """Let a worker take tasks of all jobs again, though it failed some."""
    await operators.unblock_worker(parts.database, worker_id, who.actor)


@router.put("/schedules/{worker}", status_code=204, responses=problems(422))
async def set_schedule(worker: WorkerName, schedule: SleepSchedule, parts: PartsHere, who: Admin) -> None:
    """Let workers of this name sleep at given times."""
    await operators.set_schedule(parts.database, worker, schedule, who.actor)


@router.delete("/schedules/{worker}", status_code=204, responses=problems(422))
async def drop_schedule(worker: WorkerName, parts: PartsHere, who: Admin) -> None:
    """Let them sleep only when they are told to."""
    await operators.drop_schedule(parts.database, worker, who.actor)


@router.get("/tokens", responses=problems())
async def tokens(parts: PartsHere, _: Admin) -> tuple[TokenView, ...]:
    """All tokens that were made here, without themselves."""
    return await operators.list_tokens(parts.database)


@router.post("/tokens", status_code=201, responses=problems(409, 422))
async def create_token(request: TokenRequest, parts: PartsHere, who: Admin) -> NewToken:
    """A new token. This answer alone tells it."""
    return await operators.create_token(parts.database, parts.config, request, who.actor)


@router.delete("/tokens/{name}", status_code=204, responses=problems(404))
async def revoke_token(name: str, parts: PartsHere, who: Admin) -> None:
    """Refuse a token from now on."""
    await operators.revoke_token(parts.database, name, who.actor)


@router.get("/audit", responses=problems(422))
async def audit(
    parts: PartsHere,
    _: Admin,
    before: Annotated[int | None, Query(ge=0, lt=2**63, description="only entries with smaller ids")] = None,
    limit: Annotated[int, Query(ge=1, le=1000)] = 100,
) -> tuple[AuditEntry, ...]:
    """Who did what to tokens and workers, newest first. What was done to jobs is in their events."""
    return await operators.list_audit(parts.database, before, limit)


@router.get("/webhooks", responses=problems())
async def list_webhooks(parts: PartsHere, _: Admin) -> tuple[WebhookView, ...]:
    """All webhooks, without their secrets."""
    return await webhooks.list_webhooks(parts.database)


@router.post("/webhooks", status_code=201, responses=problems(422))
async def add_webhook(request: WebhookRequest, parts: PartsHere, who: Admin) -> NewWebhook:
    """Tell a URL of jobs' events from now on. This answer alone tells the secret that signs them."""
    return await webhooks.add_webhook(parts.database, request, who.actor)


@router.delete("/webhooks/{webhook_id}", status_code=204, responses=problems(404))
async def remove_webhook(webhook_id: str, parts: PartsHere, who: Admin) -> None:
    """Tell it nothing more."""
    await webhooks.remove_webhook(parts.database, webhook_id, who.actor)


@router.get("/webhooks/{webhook_id}/deliveries", responses=problems(422))
async def deliveries(
    webhook_id: str, parts: PartsHere, _: Admin, limit: Annotated[int, Query(ge=1, le=1000)] = 100
) -> tuple[DeliveryView, ...]:
    """What became of each telling, newest first."""
    return await webhooks.list_deliveries(parts.database, webhook_id, limit)


@router.post("/gc", responses=problems(422))
async def collect_garbage(request: GcRequest, parts: PartsHere, who: Admin) -> GcReport:
    """Free what archived jobs have besides their packages: light-field stores that no other job reads, and blobs."""
    days, dry = request.days, request.dry_run
    return await gc.free_archived(parts.database, parts.config, days, dry_run=dry, actor=who.actor)


@router.get(
    "/metrics",
    dependencies=[Reader],
    response_class=Response,
    responses=problems() | {200: {"description": "In Prometheus' text format", "content": {"text/plain": {}}}},
)
async def prometheus(parts: PartsHere, request: Request) -> Response:
    """Queue, tasks, workers, storage and this coordinator's requests for Prometheus."""
    own: metrics.RequestSeconds = request.app.state.request_seconds
    return Response(await metrics.text(parts.database) + own.text(), media_type=metrics.MEDIA_TYPE)
