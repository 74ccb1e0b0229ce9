"""Light fields that an earlier job has rendered: a job that changes lobes, network or package only skips rendering.

Tiles depend on the parsed scene, the texel map, the render settings and the program, all of which are hashed, and their
random numbers are seeded from that hash. So two jobs with the same key have the same bytes in their stores, and the
later one reads the earlier one's.
"""

import hashlib
import json
from dataclasses import dataclass

from psycopg.types.json import Jsonb

from kiln_schemas import __version__
from kiln_schemas.settings import BakeSettings
from kiln_schemas.tasks import PrepareResult
from kiln_service.db import JobRow, Tx


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
    return hashlib.sha256(json.dumps(depends, sort_keys=True).encode()).hexdigest()


async def renders_to_reuse(tx: Tx, job: JobRow, result: PrepareResult) -> Renders | None:
    """The newest other job with the same light fields, all of them, if there is one; the job is locked."""
    key = render_key(result, job.settings)
    await tx.run("set_render_key", id=job.id, key=key)
    row = await tx.maybe("find_renders", id=job.id, key=key, method=job.method, between=Jsonb(list(result.between)))
    return None if row is None else Renders(row["id"], row["store_url"])
