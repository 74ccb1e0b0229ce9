"""The queue: tasks that are queued or soft-failed, in the order of `rank`.

A task's state is all there is to the queue, so nothing can disagree with it: a claim picks a row, and whoever moves a
task into a claimable state wakes the claims that wait. What a worker may take depends on its kinds and tags,
on blocks, and on who else is there (the database function `next_task`).
"""

from collections.abc import Collection
from typing import Any, Final

from kiln_schemas.tasks import TaskKind
from kiln_service.db import Tx, WorkerRow
from kiln_service.planner import PRIORITY

RANK_STEP: Final = 8
"""A job's priority counts before its tasks' kinds, of which there are fewer."""


def rank(priority: int, kind: TaskKind) -> int:
    """The place of a task in the queue: the greater goes first; of equals that of the older job."""
    return priority * RANK_STEP + PRIORITY[kind]


def wanted(worker: WorkerRow, kinds: Collection[TaskKind], stale_s: float) -> dict[str, Any]:
    """What the database's `next_task` goes by; workers not seen for `stale_s` count as gone."""
    asked = [kind.value for kind in kinds]
    return {"worker": worker.registrant, "tags": list(worker.tags), "kinds": asked, "stale_s": stale_s}


async def look(tx: Tx, worker: WorkerRow, kinds: Collection[TaskKind], stale_s: float) -> str | None:
    """The id of the job whose task this worker would get next; nothing is locked."""
    row = await tx.maybe("pick_task", **wanted(worker, kinds, stale_s))
    return None if row is None else str(row["job_id"])


async def announce(tx: Tx, kinds: Collection[TaskKind]) -> None:
    """Wake the claims that wait, once the transaction is committed: tasks of these kinds may be claimed."""
    await tx.run("notify_queued", about=",".join(sorted(kind.value for kind in kinds)))


async def tell(tx: Tx, worker_id: str) -> None:
    """Wake the claim of one worker, once the transaction is committed: it has other orders."""
    await tx.run("notify_queued", about=worker_id)
