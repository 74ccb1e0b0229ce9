"""The payload of a task, put together when it is claimed: from its spec, its job and the results of earlier tasks.

Nothing is copied into rows: a fit of a thousand tiles has a row of twenty bytes. Lists that may have 65,536 entries
(all results of a kind, all tiles) go from the database into the answer as the JSON that they are there: to make objects
of them and JSON of these would hold up the event loop for seconds.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from kiln_schemas.conventions import REFINE_HALO
from kiln_schemas.tasks import (
    Block,
    Claim,
    FitPayload,
    FitResult,
    PackagePayload,
    Payload,
    PreparePayload,
    PrepareResult,
    RefinePayload,
    RenderPayload,
    RenderResult,
    TaskKind,
)
from kiln_service.db import JobRow, TaskRow, Tx, readable


@dataclass(frozen=True)
class Built:
    """A payload without its long lists, and these as JSON by the names of their fields."""

    payload: Payload
    lists: Mapping[str, str]


@dataclass(frozen=True)
class Handed:
    """A claim as it is handed out: without its payload's long lists, and these as JSON."""

    claim: Claim
    lists: Mapping[str, str]

    def json(self) -> bytes:
        """The whole claim. (No text within JSON can look like an empty field: its quotes are escaped.)"""
        text = self.claim.model_dump_json()
        for name, entries in self.lists.items():
            before, empty, after = text.partition(f'"{name}":[]')
            assert empty, f"the payload has no empty list '{name}'"
            text = f'{before}"{name}":{entries}{after}'
        return text.encode()


async def build_payload(tx: Tx, job: JobRow, task: TaskRow) -> Built:
    """What the worker that claimed `task` needs to know."""
    common: dict[str, Any] = {"kind": task.kind, "settings": job.settings, "store_url": job.store_url}
    match task.kind:
        case TaskKind.PREPARE:
            return Built(PreparePayload(**common, bundle=job.bundle), {})
        case TaskKind.RENDER:
            return Built(RenderPayload(**common, **_prepared_blobs(job), tile=task.spec["tile"]), {})
        case TaskKind.FIT:
            texel_map = _prepared_blobs(job)["texel_map"]
            payload = FitPayload(**common, function=task.spec["function"], texel_map=texel_map, renders=())
            return Built(payload, {"renders": await _results(tx, job, TaskKind.RENDER)})
        case TaskKind.REFINE:
            prepared = _prepared_blobs(job)
            block = Block.model_validate(task.spec["block"])
            refine = RefinePayload(
                **common,
                block=block,
                texel_map=prepared["texel_map"],
                between=prepared["between"],
                renders=await _renders_near(tx, job, block),
                fits=await _fits(tx, job),
            )
            return Built(refine, {})
        case TaskKind.PACKAGE:
            assert job.prepared is not None, "the package waits for the prepare task"
            package = PackagePayload(
                **common,
                job_id=job.id,
                job_name=job.name,
                bundle=job.bundle,
                prepare=PrepareResult(**job.prepared, tiles=()),
                renders=(),
                fits=await _fits(tx, job),
                refines=(),
                gates=job.gates,
                cameras=job.cameras,
            )
            lists = {
                "tiles": str((await tx.one("tiles_as_text", job_id=job.id))["tiles"]),
                "renders": await _results(tx, job, TaskKind.RENDER),
                "refines": await _results(tx, job, TaskKind.REFINE),
            }
            return Built(package, lists)


def _prepared_blobs(job: JobRow) -> dict[str, Any]:
    """The blobs that the prepare task made, by the names that payloads have for them."""
    assert job.prepared is not None, "tasks after the prepare task wait for it"
    made = job.prepared
    return {
        "scene": made["scene"],
        "texel_map": made["texel_map"],
        "between": made.get("between", ()),
        "fine": made.get("fine"),
        "cache": made.get("cache"),
    }


async def _fits(tx: Tx, job: JobRow) -> tuple[FitResult, ...]:
    rows = await tx.all("results_of_kind", job_id=job.id, kind=TaskKind.FIT)
    return tuple(readable(FitResult, row["result"]) for row in rows)


async def _results(tx: Tx, job: JobRow, kind: TaskKind) -> str:
    """Results of all tasks of a kind, as a JSON array."""
    return str((await tx.one("results_as_text", job_id=job.id, kind=kind))["results"])


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
