"""Workers that fail tasks of a job get no more of them for a while.

A worker is blocked for a kind of tasks of a job once it has failed two of them, if another worker is there to do
them; a single task that fails everywhere blocks nobody. What the blocked worker failed counts no more: a machine
without disk space must not use up the attempts of good tiles. Workers are known by name, since one that restarts has
a new id.
"""

from typing import Final

from kiln_service import transitions
from kiln_service.config import ServiceConfig
from kiln_service.db import JobRow, TaskRow, Tx
from kiln_service.events import add_event

BLOCK_AFTER: Final = 2
"""Tasks of a kind of a job that a worker may fail."""


async def note_failure(tx: Tx, job: JobRow, task: TaskRow, config: ServiceConfig) -> bool:
    """Write down that the task's running attempt ended badly; whether its worker is blocked for that from now on."""
    worker = (await tx.one("find_worker", id=task.worker_id))["name"]
    about = {"job_id": job.id, "kind": task.kind.value, "worker": worker}
    row = await tx.one(
        "add_failure",
        task_id=task.id,
        attempt=task.attempt,
        worker_id=task.worker_id,
        stale_s=config.timing.stale_s,
        **about,
    )
    if row["tasks"] < BLOCK_AFTER or not row["others"]:
        return False
    await tx.run("add_block", seconds=config.timing.block_s, **about)
    forgiven = await transitions.forgive_worker(tx, job, task.kind, worker, config.max_attempts)
    detail = {"worker": worker, "kind": task.kind.value, "seconds": config.timing.block_s, "tasks": len(forgiven)}
    await add_event(tx, job.id, "worker.blocked", transitions.COORDINATOR, detail=detail)
    return True
