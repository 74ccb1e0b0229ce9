"""Light fields that an earlier job has rendered: a job that changes lobes, network or package only skips rendering.

Tiles depend on the parsed scene, the texel map, the render settings and the program, all of which are hashed, and their
random numbers are seeded from that hash. So two jobs with the same key have the same bytes in their stores, and the
later one reads the earlier one's, once the coordinator has looked whether they are still there.
"""

import asyncio
import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

from psycopg.types.json import Jsonb

from kiln_schemas import __version__
from kiln_schemas.settings import BakeSettings
from kiln_schemas.tasks import PrepareResult
from kiln_service.config import ServiceConfig
from kiln_service.db import Database, JobRow, Tx
from kiln_service.stores import Look, look


@dataclass(frozen=True)
class Renders:
    """Where light fields are: another job's store."""

    job_id: str
    store_url: str


def render_key(result: PrepareResult, settings: BakeSettings) -> str:
    """sha256 over all that the light fields of a prepared scene depend on, except for those between texels."""
    depends = {
        "version": __version__,
        "scene_hash": result.scene_hash,
        "texel_map": result.texel_map,
        "tiles": [tile.model_dump(mode="json") for tile in result.tiles],
        "lightmap": settings.lightmap.model_dump(mode="json"),
        "render": settings.render.model_dump(mode="json"),
    }
    digest = hashlib.sha256()
    for piece in json.JSONEncoder(sort_keys=True).iterencode(depends):  # unlike `dumps` it lets other threads run
        digest.update(piece.encode())
    return digest.hexdigest()


async def check_sources(
    database: Database, config: ServiceConfig, task_id: str, result: PrepareResult
) -> tuple[str, ...]:
    """Ids of jobs whose light fields a job that is being prepared may read; no lock is held while looking.

    Their stores are there with every tile, or are on a disk that the coordinator does not reach.
    """
    row = await database.first("job_of_prepare", id=task_id)
    if row is None:
        return ()
    job = replace(JobRow.of(row), prepared=result.model_dump(mode="json", exclude={"tiles"}))
    places = [(tile.row, tile.column) for tile in result.tiles]
    async with database.transaction() as tx:
        rows = await tx.all("find_sources", id=job.id, **await asyncio.to_thread(_wanted, job, result))
    looks: dict[str, Look] = {}
    for store_url in {row["store_url"] for row in rows}:
        looks[store_url] = await look(config, store_url, job, places)
    return tuple(row["id"] for row in rows if looks[row["store_url"]].whole)


async def renders_to_reuse(tx: Tx, job: JobRow, result: PrepareResult, sources: Sequence[str]) -> Renders | None:
    """The newest of these jobs that still has the same light fields, all of them; the job is locked."""
    wanted = await asyncio.to_thread(_wanted, job, result)
    await tx.run("set_render_key", id=job.id, key=wanted["key"])
    row = await tx.maybe("find_renders", id=job.id, sources=list(sources), **wanted)
    return None if row is None else Renders(row["id"], row["store_url"])


def _wanted(job: JobRow, result: PrepareResult) -> dict[str, Any]:
    """What a source has to be like, as parameters of the queries."""
    between = Jsonb(list(result.between))
    return {"key": render_key(result, job.settings), "method": job.method, "between": between}
