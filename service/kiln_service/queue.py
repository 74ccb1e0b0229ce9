"""The queue behind the coordinator: procrastinate's JobManager, run inside our own transactions.

One procrastinate queue per kind of task; a queue job carries the task's id and nothing else. JobManager's
methods open their own connections, so each is given a connector whose "pool" is the transaction's connection:
a state and its queue job change together or not at all. Finished queue jobs are deleted; the history is
in `events`. What procrastinate does not do is done around it: the fence (`work.py`), the cap on attempts after
a crash (`reaper.py`), deferring again what was lost (`reconciler.py`).
"""

from collections.abc import AsyncIterator, Sequence
from contextlib import asynccontextmanager
from datetime import UTC, datetime
from typing import Any, Final

import psycopg
from procrastinate import PsycopgConnector
from procrastinate.exceptions import NoResult
from procrastinate.jobs import Job, Status
from procrastinate.manager import JobManager

from kiln_schemas.errors import InternalError
from kiln_schemas.states import JobState
from kiln_schemas.tasks import TaskKind
from kiln_service.db import JobRow, Tx
from kiln_service.planner import PRIORITY

TASK_NAME: Final = "kiln.task"
PRIORITY_STEP: Final = 8
"""A job's priority counts before its tasks' kinds, of which there are fewer."""


class _OneConnection:
    """What a connector takes for a pool: always the connection of one transaction."""

    def __init__(self, connection: psycopg.AsyncConnection[Any]) -> None:
        self._connection = connection

    @asynccontextmanager
    async def connection(self) -> AsyncIterator[psycopg.AsyncConnection[Any]]:
        yield self._connection


async def _manager(tx: Tx) -> JobManager:
    connector = PsycopgConnector()
    await connector.open_async(_OneConnection(tx.connection))  # type: ignore[arg-type]
    return JobManager(connector)


async def register_worker(tx: Tx) -> int:
    """A new row among procrastinate's workers."""
    return await (await _manager(tx)).register_worker()


async def beat(tx: Tx, queue_worker: int) -> None:
    """Tell procrastinate that the worker lives."""
    await (await _manager(tx)).update_heartbeat(queue_worker)


async def defer(tx: Tx, job: JobRow, tasks: Sequence[tuple[str, TaskKind]]) -> None:
    """Enqueue tasks (id, kind) of a job and remember their queue jobs; a task is never waiting in the queue twice.

    Those of a paused job stay out of the queue until it is resumed.
    """
    if not tasks or job.state is JobState.PAUSED:
        return
    manager = await _manager(tx)
    jobs = await manager.batch_defer_jobs_async(
        [
            Job(
                queue=kind.value,
                priority=job.priority * PRIORITY_STEP + PRIORITY[kind],
                lock=None,
                queueing_lock=task_id,
                task_name=TASK_NAME,
                task_kwargs={"task_id": task_id},
            )
            for task_id, kind in tasks
        ]
    )
    await tx.run("task_deferred", queue_jobs=[job.id for job in jobs])
    await tx.run("notify_queued", kinds=",".join(sorted({kind.value for _, kind in tasks})))


async def fetch(tx: Tx, kinds: Sequence[TaskKind], queue_worker: int) -> tuple[int, str] | None:
    """Take the next queue job of these kinds, if any: its id and its task's id."""
    job = await (await _manager(tx)).fetch_job([kind.value for kind in kinds], queue_worker)
    if job is None:
        return None
    if job.id is None:
        raise InternalError("procrastinate gave a job without an id")
    return job.id, str(job.task_kwargs["task_id"])


async def retry(tx: Tx, job: JobRow, queue_job: int | None, task: tuple[str, TaskKind]) -> None:
    """Put a running queue job back; defer a new one where it is gone. A paused job's is deleted."""
    if job.state is JobState.PAUSED:
        await finish(tx, queue_job)
    elif await _status(tx, queue_job) is Status.DOING and queue_job is not None:
        await (await _manager(tx)).retry_job_by_id_async(queue_job, retry_at=datetime.now(UTC))
        await tx.run("notify_queued", kinds=task[1].value)
    else:
        await defer(tx, job, [task])


async def finish(tx: Tx, queue_job: int | None) -> None:
    """Delete a queue job that runs; nothing where it is gone."""
    if await _status(tx, queue_job) in (Status.TODO, Status.DOING) and queue_job is not None:
        await (await _manager(tx)).finish_job_by_id_async(queue_job, Status.SUCCEEDED, delete_job=True)


async def withdraw(tx: Tx, queue_jobs: Sequence[int]) -> None:
    """Delete queue jobs that wait; one that was fetched meanwhile is dropped by its claim."""
    manager = await _manager(tx)
    for queue_job in queue_jobs:
        await manager.cancel_job_by_id_async(queue_job, delete_job=True)


async def _status(tx: Tx, queue_job: int | None) -> Status | None:
    if queue_job is None:
        return None
    try:
        return await (await _manager(tx)).get_job_status_async(queue_job, connection=tx.connection)
    except NoResult:
        return None
