"""Free what archived jobs leave behind: light-field stores and the blobs between tasks. Packages stay.

A store is deleted when no job reads it that is not freed itself: jobs share stores (`reuse`). The job is locked
meanwhile, and light fields of archived jobs are never shared anew, so nobody begins to read what is being deleted.
Blobs go with the coordinator's next collection. A run that is cut off is repeated by the next.
"""

import asyncio
import shutil
from collections.abc import Mapping

import obstore
from psycopg.types.json import Jsonb

from kiln_schemas.operators import Freed, GcReport
from kiln_schemas.states import JobState
from kiln_service.blobs import open_objects
from kiln_service.config import ServiceConfig
from kiln_service.db import Database, Tx
from kiln_service.disk import local_folder
from kiln_service.jobs import lock_job
from kiln_service.operators import record


class _DryRun(Exception):
    """Rolls back what was only tried."""


async def free_archived(
    database: Database,
    config: ServiceConfig,
    days: float,
    *,
    dry_run: bool,
    actor: str,
    keep: Mapping[str, str] | None = None,
) -> GcReport:
    """Free archived jobs that ended `days` ago or earlier and have no label of `keep`; with `dry_run` only say what."""
    async with database.transaction() as tx:
        rows = await tx.all("find_freeable", days=days, keep=Jsonb(dict(keep or {})))
    candidates = [row["id"] for row in rows]
    freed = []
    for job_id in candidates:
        done = await _free(database, config, job_id, dry_run=dry_run)
        if done is not None:
            freed.append(done)
    if freed and not dry_run:
        async with database.transaction() as tx:
            detail = {"jobs": [one.job_id for one in freed], "days": days}
            await record(tx, actor, "gc", f"{len(freed)} jobs", detail)
    return GcReport(dry_run=dry_run, jobs=tuple(freed))


async def _free(database: Database, config: ServiceConfig, job_id: str, *, dry_run: bool) -> Freed | None:
    """One job; None where it is no longer archived."""
    try:
        async with database.transaction(patient=True) as tx:  # a store is up to tens of GB
            job = await lock_job(tx, job_id)
            if job.state is not JobState.ARCHIVED:
                return None
            own = f"{config.store_base}/{job.id}.zarr"
            stores = sorted({own, job.store_url} - await _needed(tx, job_id, [own, job.store_url]))
            size = (await tx.one("drop_data_uses", id=job_id))["bytes"]
            there = tuple([store for store in stores if await _exists(store)])
            freed = Freed(job_id=job_id, name=job.name, stores=there, blob_bytes=size)
            if dry_run:
                raise _DryRun
            for store in stores:
                await _delete(store, config.store_base)
            await tx.run("set_freed", id=job_id)
    except _DryRun:
        pass
    return freed


async def _needed(tx: Tx, job_id: str, stores: list[str]) -> set[str]:
    return {row["store_url"] for row in await tx.all("stores_needed_by_others", id=job_id, stores=stores)}


async def _exists(url: str) -> bool:
    if (folder := local_folder(url)) is not None:
        return folder.is_dir()
    pages = obstore.list(open_objects(url), chunk_size=1)
    async for page in pages:
        return len(page) > 0
    return False


async def _delete(url: str, base: str) -> None:
    """Delete a store of this coordinator; one that an earlier configuration put elsewhere is left alone."""
    if not url.startswith(f"{base}/") or not url.endswith(".zarr"):
        return
    if (folder := local_folder(url)) is not None:
        await asyncio.to_thread(shutil.rmtree, folder, ignore_errors=True)
        return
    store = open_objects(url)
    async for page in obstore.list(store, chunk_size=1000):
        await obstore.delete_async(store, [entry["path"] for entry in page])
