"""The workers and what they have, tasks that seem stuck, and orders."""

from typing import Annotated, Final

from fastapi import APIRouter, Depends, Request
from fastapi.responses import Response

from kiln_schemas.operators import Order, Scope
from kiln_service import operators
from kiln_service.api.common import PartsHere, caller
from kiln_service.auth import Principal
from kiln_service.dashboard.pages import Form, page, see

router = APIRouter(include_in_schema=False)

SILENT_SHARE: Final = 0.5
"""A running task is shown as stuck at this share of the silence after which it is given to another worker,"""
TIMES: Final = 4.0
"""or when it takes so many times the median of its kind in its job,"""
LEAST_S: Final = 60.0
"""but not before so long."""


@router.get("/workers", dependencies=[Depends(caller(Scope.READ))])
async def workers(request: Request, parts: PartsHere) -> Response:
    """Workers that were seen within a week, and tasks that seem stuck."""
    found = await operators.list_workers(parts.database)
    async with parts.database.transaction() as tx:
        speed = {row["worker_id"]: row for row in await tx.all("throughput")}
        stuck = await tx.all(
            "stuck_tasks", silent_s=SILENT_SHARE * parts.config.timing.stale_s, times=TIMES, least_s=LEAST_S
        )
    return page(request, "workers.html", workers=found, speed=speed, stuck=stuck, times=TIMES)


@router.post("/workers/{worker_id}/orders/{order}")
async def tell_worker(
    worker_id: str, order: Order, parts: PartsHere, who: Annotated[Principal, Depends(caller(Scope.ADMIN))], _: Form
) -> Response:
    """Tell a worker to sleep, to wake or to leave."""
    await operators.order_worker(parts.database, worker_id, order, who.actor)
    return see("/workers")


@router.post("/workers/{worker_id}/unblock")
async def unblock(
    worker_id: str, parts: PartsHere, who: Annotated[Principal, Depends(caller(Scope.ADMIN))], _: Form
) -> Response:
    """Let a worker take tasks of all jobs again."""
    await operators.unblock_worker(parts.database, worker_id, who.actor)
    return see("/workers")
