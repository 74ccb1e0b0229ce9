"""The payload of a task, put together when it is claimed: from its spec, its job and the results of earlier tasks.

Nothing is copied into rows: a fit of a thousand tiles has a row of twenty bytes.
"""

from typing import Any

from kiln_schemas.conventions import REFINE_HALO
from kiln_schemas.settings import Function
from kiln_schemas.tasks import (
    Block,
    FitPayload,
    FitResult,
    PackagePayload,
    Payload,
    PreparePayload,
    PrepareResult,
    RefinePayload,
    RefineResult,
    RenderPayload,
    RenderResult,
    TaskKind,
)
from kiln_service.db import JobRow, TaskRow, Tx, readable


async def build_payload(tx: Tx, job: JobRow, task: TaskRow) -> Payload:
    """What the worker that claimed `task` needs to know."""
    common: dict[str, Any] = {"kind": task.kind, "settings": job.settings, "store_url": job.store_url}
    match task.kind:
        case TaskKind.PREPARE:
            return PreparePayload(**common, bundle=job.bundle)
        case TaskKind.RENDER:
            return RenderPayload(**common, **_prepared_blobs(job), tile=task.spec["tile"])
        case TaskKind.FIT:
            return FitPayload(
                **common,
                function=task.spec["function"],
                texel_map=_prepared_blobs(job)["texel_map"],
                renders=await _renders(tx, job),
            )
        case TaskKind.REFINE:
            prepared = _prepared_blobs(job)
            block = Block.model_validate(task.spec["block"])
            fits = await _fits(tx, job)
            return RefinePayload(
                **common,
                block=block,
                texel_map=prepared["texel_map"],
                between=prepared["between"],
                renders=await _renders_near(tx, job, block),
                fit=next(result for result in fits if result.function is Function.LIGHT_FIELD),
            )
        case TaskKind.PACKAGE:
            refines = await tx.all("results_of_kind", job_id=job.id, kind=TaskKind.REFINE)
            return PackagePayload(
                **common,
                job_id=job.id,
                job_name=job.name,
                bundle=job.bundle,
                prepare=await _prepared(tx, job),
                renders=await _renders(tx, job),
                fits=await _fits(tx, job),
                refines=tuple(readable(RefineResult, row["result"]) for row in refines),
                gates=job.gates,
                cameras=job.cameras,
            )


def _prepared_blobs(job: JobRow) -> dict[str, Any]:
    """The blobs that the prepare task made, by the names that payloads have for them."""
    assert job.prepared is not None, "tasks after the prepare task wait for it"
    made = job.prepared
    return {"scene": made["scene"], "texel_map": made["texel_map"], "between": made.get("between", ())}


async def _prepared(tx: Tx, job: JobRow) -> PrepareResult:
    row = await tx.one("results_of_kind", job_id=job.id, kind=TaskKind.PREPARE)
    return readable(PrepareResult, row["result"])


async def _fits(tx: Tx, job: JobRow) -> tuple[FitResult, ...]:
    rows = await tx.all("results_of_kind", job_id=job.id, kind=TaskKind.FIT)
    return tuple(readable(FitResult, row["result"]) for row in rows)


async def _renders(tx: Tx, job: JobRow) -> tuple[RenderResult, ...]:
    rows = await tx.all("results_of_kind", job_id=job.id, kind=TaskKind.RENDER)
    return tuple(readable(RenderResult, row["result"]) for row in rows)


async def _renders_near(tx: Tx, job: JobRow, block: Block) -> tuple[RenderResult, ...]:
    """Of the tiles with texels in a block or its halo: some 9, where the light map may have 65536."""
    reach = block.size + REFINE_HALO
    rows = await tx.all(
        "renders_near",
        job_id=job.id,
        row_start=block.row - REFINE_HALO,
        row_stop=block.row + reach,
        column_start=block.column - REFINE_HALO,
        column_stop=block.column + reach,
    )
    return tuple(readable(RenderResult, row["result"]) for row in rows)
