"""Bring the queue back in line with the tasks: the tasks are the truth.

States and queue jobs change in one transaction, so they differ only when something else touched the queue (a restore
from a backup, an operator's DELETE). A queued task that nothing will bring to a worker is deferred again; a
queue job that waits for a task which is not queued is deleted.
"""

import logging

from kiln_schemas.states import JobState, TaskState
from kiln_service import queue
from kiln_service.db import Database
from kiln_service.work import lock_task

log = logging.getLogger(__name__)


async def reconcile(database: Database) -> int:
    """Repair every difference; how many."""
    async with database.transaction() as tx:
        orphans = await tx.all("queued_without_queue_job")
        strays = await tx.all("queue_jobs_without_task", task_name=queue.TASK_NAME)
        await queue.withdraw(tx, [row["id"] for row in strays])
    repaired = len(strays)
    for row in orphans:
        async with database.transaction() as tx:
            job, task = await lock_task(tx, row["id"])
            present = (await tx.one("has_queue_job", queue_job=task.queue_job))["present"]
            if task.state is TaskState.QUEUED and job.state is not JobState.PAUSED and not present:
                ids = {"job_id": job.id, "task_id": task.id}
                log.warning("%s %s was queued without a queue job; deferred again", task.kind, task.label, extra=ids)
                await queue.defer(tx, job, [(task.id, task.kind)])
                repaired += 1
    return repaired
