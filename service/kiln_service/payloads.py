"""The payload of a task, put together when it is claimed: from its spec, its job and the results of earlier tasks.

Nothing is copied into rows: a fit of a thousand tiles has a row of twenty bytes.
"""

from typing import Any

from kiln_schemas.tasks import (
    FitPayload,
    FitResult,
    PackagePayload,
    Payload,
    PreparePayload,
    PrepareResult,
    RenderPayload,
    RenderResult,
    TaskKind,
)
from kiln_service.db import JobRow, TaskRow, Tx


async def build_payload(tx: Tx, job: JobRow, task: TaskRow) -> Payload:
    """What the worker that claimed `task` needs to know."""
    common: dict[str, Any] = {"kind": task.kind, "settings": job.settings, "store_url": job.store_url}
    match task.kind:
        case TaskKind.PREPARE:
            return PreparePayload(**common, bundle=job.bundle)
        case TaskKind.RENDER:
            return RenderPayload(**common, **await tx.one("prepared_blobs", job_id=job.id), tile=task.spec["tile"])
        case TaskKind.FIT:
            return FitPayload(
                **common,
                function=task.spec["function"],
                texel_map=(await tx.one("prepared_blobs", job_id=job.id))["texel_map"],
                renders=await _renders(tx, job),
            )
        case TaskKind.PACKAGE:
            fits = await tx.all("results_of_kind", job_id=job.id, kind=TaskKind.FIT)
            return PackagePayload(
                **common,
                job_id=job.id,
                job_name=job.name,
                bundle=job.bundle,
                prepare=await _prepared(tx, job),
                renders=await _renders(tx, job),
                fits=tuple(FitResult.model_validate(row["result"]) for row in fits),
                gates=job.gates,
                cameras=job.cameras,
            )


async def _prepared(tx: Tx, job: JobRow) -> PrepareResult:
    row = await tx.one("results_of_kind", job_id=job.id, kind=TaskKind.PREPARE)
    return PrepareResult.model_validate(row["result"])


async def _renders(tx: Tx, job: JobRow) -> tuple[RenderResult, ...]:
    rows = await tx.all("results_of_kind", job_id=job.id, kind=TaskKind.RENDER)
    return tuple(RenderResult.model_validate(row["result"]) for row in rows)
