"""Take tasks away from workers that are no longer heard of.

A worker that crashes reports nothing, so its attempts end here: a task that was lost too often fails with a
sentence and the last lines it wrote. The heartbeat watched is the task's own, not its worker's: a worker
whose claim's answer was lost on the way lives on without knowing of the task.
"""

import logging
from typing import Final

from kiln_schemas.errors import BakeFailed, Problem
from kiln_schemas.states import TaskState
from kiln_service import transitions
from kiln_service.clock import DatabaseClock
from kiln_service.db import Database, TaskRow, Tx
from kiln_service.operators import FORGOTTEN_S
from kiln_service.waiting import REFUSED_S
from kiln_service.work import Work, locked_task

log = logging.getLogger(__name__)

LOG_LINES: Final = 8
"""Lines of a lost task's log that its error quotes."""


async def reap(database: Database, work: Work, stale_s: float, clock: DatabaseClock) -> int:
    """End every attempt without a heartbeat for `stale_s`; how many."""
    async with database.transaction() as tx:
        rows = await tx.all("stale_tasks", seconds=stale_s)
    if rows:
        # The clock may have been set since it was looked at.
        await clock.keep()
    return sum([await _reap_one(database, work, row["id"], stale_s) for row in rows])


async def forget_workers(database: Database) -> int:
    """Forget registrations that were not heard of for so long that lists leave them out; how many."""
    async with database.transaction() as tx:
        await tx.run("forget_refused_workers", seconds=REFUSED_S)
        return await tx.count("forget_workers", forgotten_s=FORGOTTEN_S)


async def _reap_one(database: Database, work: Work, task_id: str, stale_s: float) -> int:
    async with locked_task(database, task_id) as (tx, job, task):
        still = await tx.one("task_is_stale", id=task_id, seconds=stale_s)
        if task.state is not TaskState.ACTIVE or not still["stale"]:
            return 0
        ids = {"job_id": job.id, "task_id": task.id, "worker_id": task.worker_id}
        log.warning("%s %s: no heartbeat for %.0f s", task.kind, task.label, stale_s, extra=ids)
        await work.end_attempt(
            tx,
            job,
            task,
            await _lost(tx, task, stale_s),
            kind="task.lost",
            actor=transitions.COORDINATOR,
            retryable=True,
        )
    return 1


async def _lost(tx: Tx, task: TaskRow, stale_s: float) -> Problem:
    """What the task's error says if this was its last attempt."""
    pieces = await tx.all("last_log", task_id=task.id)
    lines = "".join(reversed([row["lines"] for row in pieces])).strip().splitlines()[-LOG_LINES:]
    quoted = f" Its last lines: {' | '.join(lines)}" if lines else " It wrote no log."
    return BakeFailed(
        f"the worker of attempt {task.attempt} was not heard of for {stale_s:g} s, "
        f"the {task.strikes + 1}. attempt in a row to end without progress.{quoted}",
        where=f"{task.kind} {task.label}",
        remedy="Look for workers that crash or run out of memory (`lightkiln worker --memory`), then submit again.",
    ).problem()
