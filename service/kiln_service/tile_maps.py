"""A byte a tile: what of a light map is done, for whoever draws it while it is rendered.

A map of 65,536 tiles is 64 KiB. It is kept in memory with the id of the job's newest event: every move of a task writes
an event in its transaction, so the map is as good as new while there is no newer one. Events that name a task tell
which bytes have changed; after any other (a stage is released, a job canceled) the whole map is read again.
"""

import asyncio
from collections import OrderedDict
from dataclasses import dataclass
from typing import Final

from kiln_schemas.errors import NotFound
from kiln_schemas.states import TaskState
from kiln_schemas.tasks import TaskKind
from kiln_service.db import Database

STATES: Final = tuple(state.value for state in TaskState)
KEPT: Final = 64
"""Maps of the jobs that were asked for last."""
MOST_CHANGES: Final = 2000
"""After more events than this the whole map is read."""


@dataclass(frozen=True)
class TileMap:
    """Tiles of a light map, row by row: 0 where there is none, else 1 plus the place of the state in `STATES`."""

    version: int
    """Id of the job's newest event."""
    texels: int
    """Along each side of the light map; 0 as long as its size is not chosen."""
    side: int
    """Tiles along each side."""
    cells: bytes
    """[side * side]"""


class TileMaps:
    """The maps of one coordinator."""

    def __init__(self, database: Database) -> None:
        self._database = database
        self._kept: OrderedDict[str, TileMap] = OrderedDict()
        self._reading = asyncio.Lock()

    async def read(self, job_id: str) -> TileMap:
        """The map of a job as it is now; NotFound where there is no such job."""
        async with self._reading:
            found = await self._read(job_id, self._kept.pop(job_id, None))
            self._kept[job_id] = found
            if len(self._kept) > KEPT:
                self._kept.popitem(last=False)
            return found

    async def _read(self, job_id: str, known: TileMap | None) -> TileMap:
        async with self._database.transaction() as tx:
            row = await tx.maybe("tile_map_version", job_id=job_id)
            if row is None:
                raise NotFound(f"no job '{job_id}'", where="job")
            tile, version = row["tile"], row["version"]
            texels, side = row["resolution"], -(-row["resolution"] // tile)
            if not side:
                return TileMap(version, 0, 0, b"")
            about = {
                "job_id": job_id,
                "kind": TaskKind.RENDER.value,
                "states": list(STATES),
                "tile": tile,
                "side": side,
            }
            if known is not None and known.side == side:
                if known.version == version:
                    return known
                since = await tx.one("changes_since", job_id=job_id, since=known.version, most=MOST_CHANGES + 1)
                if not since["of_many"] and since["changes"] <= MOST_CHANGES:
                    cells = bytearray(known.cells)
                    for changed in await tx.all("changed_tiles", **about, since=known.version):
                        cells[changed["cell"]] = changed["code"]
                    return TileMap(version, texels, side, bytes(cells))
            return TileMap(version, texels, side, bytes((await tx.one("all_tiles", **about))["cells"]))
