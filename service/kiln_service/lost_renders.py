"""What follows when light fields are gone or damaged: they are rendered again, and what was made of them stays.

A worker says so by failing with `store-lost` or `tiles-lost`, or the coordinator sees it when a job is retried. A store
that is gone as a whole is made anew by the prepare task; a job that read another job's store then gets one of its own.
Tiles are rendered again into the store that they were lost from: their bytes are the same whoever renders them.
"""

from collections.abc import Collection
from dataclasses import dataclass

from kiln_schemas.errors import StoreLost, TilesLost
from kiln_schemas.tasks import Failure, TaskKind, tile_label
from kiln_service import transitions
from kiln_service.config import ServiceConfig
from kiln_service.db import Database, JobRow, Tx
from kiln_service.stores import Look, look


@dataclass(frozen=True)
class Lost:
    """Light fields that a worker could not read: a whole store, or the tiles of some render tasks."""

    whole: bool
    labels: Collection[str] = ()


async def believed(database: Database, config: ServiceConfig, task_id: str, failure: Failure) -> Lost | None:
    """What a failed attempt says is lost, unless it is wrong: its worker may not have mounted the store.

    Where the coordinator does not reach the store itself, a second attempt has to say the same.
    """
    code, labels = failure.problem.code, failure.lost
    if code not in (StoreLost.code, TilesLost.code):
        return None
    row = await database.first("store_of_task", id=task_id)
    if row is None:
        return None
    found = await look(config, row["store_url"])
    if code == TilesLost.code and labels and not found.gone:
        return Lost(whole=False, labels=labels)
    if found.seen:
        return Lost(whole=True) if found.gone else None
    return Lost(whole=True) if row["strikes"] else None


async def redo_seen(tx: Tx, config: ServiceConfig, job: JobRow, found: Look) -> JobRow:
    """Have a locked job render again what the coordinator has seen to be gone."""
    if found.whole:
        return job
    labels = [tile_label(row, column) for row, column in sorted(found.lost)]
    return await redo(tx, config, job, Lost(whole=found.gone, labels=labels))


async def redo(tx: Tx, config: ServiceConfig, job: JobRow, lost: Lost) -> JobRow:
    """Have a locked job render again what is lost."""
    if lost.whole and job.renders_of is not None:
        job = await transitions.render_into_own_store(tx, job, f"{config.store_base}/{job.id}.zarr")
    kinds = {TaskKind.PREPARE, TaskKind.RENDER} if lost.whole else {TaskKind.RENDER}
    choice = transitions.Choice(labels=None if lost.whole else list(lost.labels))
    what = "the light-field store is gone" if lost.whole else "tiles of the light-field store are gone or damaged"
    await transitions.redo_lost(tx, job, kinds, choice, what)
    return job
