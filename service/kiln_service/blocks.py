"""Workers that fail tasks of a job get no more of them for a while.

A worker is blocked for a kind of tasks of a job once it has failed two of them, if another worker is there to do
them; a single task that fails everywhere blocks nobody. What the blocked worker failed counts no more: a machine
without disk space must not use up the attempts of good tiles. A worker is known by its name and by the token that
registered it (`registrant`): one that restarts has a new id, and who registers under somebody else's name is another.
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
    found = await tx.maybe("find_worker", id=task.worker_id)
    if found is None:  # forgotten meanwhile
        return False
    about = {"job_id": job.id, "kind": task.kind.value, "worker": found["registrant"]}
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
    forgiven = await transitions.forgive_worker(tx, job, task.kind, found["registrant"], config.max_attempts)
    detail = {
        "worker": found["name"],
        "kind": task.kind.value,
        "seconds": config.timing.block_s,
        "tasks": len(forgiven),
    }
    await add_event(tx, job.id, "worker.blocked", transitions.COORDINATOR, detail=detail)
    return True
