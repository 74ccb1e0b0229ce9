"""Whether a light-field store still has what was rendered into it, as far as the coordinator can see it.

Only names are looked at, never the data: a store is there if its `zarr.json` is, and a tile if each array has its
object (`kiln_workers.store.layout`: one object a tile). Damaged bytes are found by the workers that read them.
"""

import asyncio
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import obstore
from obstore.exceptions import BaseError

from kiln_schemas.conventions import (
    ARRAY_BETWEEN,
    ARRAY_FINE_IRRADIANCE,
    ARRAY_IRRADIANCE,
    ARRAY_LIGHT_FIELD,
    ARRAY_VISIBILITY,
)
from kiln_service.blobs import open_objects
from kiln_service.config import ServiceConfig
from kiln_service.db import Database, JobRow
from kiln_service.disk import local_folder

GROUP: Final = "zarr.json"
TAILS: Final[Mapping[str, str]] = {
    ARRAY_LIGHT_FIELD: "/0/0/0",
    ARRAY_VISIBILITY: "/0/0/0",
    ARRAY_BETWEEN: "/0/0/0/0",
    ARRAY_IRRADIANCE: "/0",
    ARRAY_FINE_IRRADIANCE: "/0",
}
"""What follows the tile's row and column in the name of its object."""


@dataclass(frozen=True)
class Look:
    """What the coordinator sees of a store."""

    seen: bool
    """False where the store is on a disk or in a bucket that the coordinator does not reach: nothing is known."""
    gone: bool = False
    """The whole store is."""
    lost: frozenset[tuple[int, int]] = frozenset()
    """Of the tiles asked for, the first row and column of those that are not there."""

    @property
    def whole(self) -> bool:
        """Whether nothing is known to be missing."""
        return not self.gone and not self.lost


async def look(
    config: ServiceConfig, store_url: str, job: JobRow | None = None, tiles: Iterable[tuple[int, int]] = ()
) -> Look:
    """Look for a store, and in it for the tiles of a prepared job."""
    base = local_folder(config.store_base)
    folder = local_folder(store_url)
    if folder is not None and (base is None or not base.is_dir()):
        return Look(seen=False)
    if folder is not None and not (folder / GROUP).is_file():
        return Look(seen=True, gone=True)
    try:
        objects = open_objects(store_url)
        try:
            await obstore.head_async(objects, GROUP)
        except FileNotFoundError:
            return Look(seen=True, gone=True)
        wanted = set(tiles)
        if job is None or not wanted:
            return Look(seen=True)
        side = job.settings.lightmap.tile
        found = await asyncio.gather(*(_objects(objects, array) for array in _arrays(job)))
    except (BaseError, OSError, ValueError):
        return Look(seen=False)
    lost = {
        (row, column)
        for row, column in wanted
        if any(
            f"{array}/c/{row // side}/{column // side}{TAILS[array]}" not in names
            for array, names in zip(_arrays(job), found, strict=True)
        )
    }
    return Look(seen=True, lost=frozenset(lost))


async def look_for_renders(config: ServiceConfig, database: Database, job: JobRow) -> Look:
    """Look for all that a job has rendered; a job that has rendered nothing yet misses nothing."""
    places = await database.first("rendered_places", job_id=job.id)
    if places is None or not places["rows"] or job.prepared is None:
        return Look(seen=False)
    return await look(config, job.store_url, job, zip(places["rows"], places["columns"], strict=True))


def _arrays(job: JobRow) -> Sequence[str]:
    """The arrays that each tile of a prepared job has an object in."""
    assert job.prepared is not None
    arrays = [ARRAY_LIGHT_FIELD, ARRAY_IRRADIANCE]
    if job.prepared["has_environment"]:
        arrays.append(ARRAY_VISIBILITY)
    if job.prepared.get("between"):
        arrays.append(ARRAY_BETWEEN)
    if job.prepared.get("fine"):
        arrays.append(ARRAY_FINE_IRRADIANCE)
    return arrays


async def _objects(objects: Any, array: str) -> set[str]:
    names: set[str] = set()
    async for page in obstore.list(objects, f"{array}/c", chunk_size=1000):
        names.update(entry["path"] for entry in page)
    return names
