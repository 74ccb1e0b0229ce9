"""The append-only history of every job, and the signals that wake who waits for more of it (`kiln_service.streams`).

One connection per coordinator LISTENs for all; waiting claims and the reader of events sleep on an in-process signal
and wake at the latest after `poll_s`, so a lost notification costs a second and nothing else.
"""

import asyncio
import contextlib
import logging
from collections.abc import Collection, Iterator
from typing import Any, Final

import psycopg
import psycopg.sql
from psycopg.rows import DictRow
from psycopg.types.json import Jsonb

from kiln_schemas.errors import NotFound
from kiln_schemas.job import EventView
from kiln_schemas.states import FINAL_JOB_STATES, JobState
from kiln_service.db import Database, Tx, readable_rows

log = logging.getLogger(__name__)

QUEUED_CHANNEL: Final = "kiln_queued"
EVENT_CHANNEL: Final = "kiln_event"
ANY_JOB: Final = "any job"
"""What the reader of events waits for."""
CLAIMS_WOKEN: Final = 8
"""Of the claims that wait, so many look for a task when one was queued, and one more for each that found one: were all
woken, a thousand idle workers would ask the database a thousand times for every task."""
BATCH: Final = 500
"""Events read at a time."""


async def add_event(
    tx: Tx, job_id: str, kind: str, actor: str, *, task_id: str | None = None, detail: dict[str, Any] | None = None
) -> None:
    """Append to a job's history; the job is locked."""
    log.info(kind, extra={"job_id": job_id, "actor": actor} | ({"task_id": task_id} if task_id else {}))
    await tx.run("add_event", job_id=job_id, task_id=task_id, kind=kind, actor=actor, detail=Jsonb(detail or {}))


async def read_events(database: Database, job_id: str, after: int, limit: int = BATCH) -> list[EventView]:
    """Events of a job with ids greater than `after`, oldest first."""
    return (await read_state_and_events(database, job_id, after, limit))[1]


async def read_state_and_events(
    database: Database, job_id: str, after: int, limit: int
) -> tuple[JobState, list[EventView]]:
    """The job's state, read before the events: if it is final, its last event is among them or was read earlier."""
    async with database.transaction() as tx:
        job = await tx.maybe("job_state", id=job_id)
        if job is None:
            raise NotFound(f"no job '{job_id}'", where="job")
        rows = await tx.all("read_events", job_id=job_id, after=after, limit=limit)
    return JobState(job["state"]), readable_rows(EventView, rows)


async def is_over(database: Database, job_id: str, after: int) -> bool:
    """Whether nothing will come after the event `after`: a stream that resumes there need not begin."""
    state, events = await read_state_and_events(database, job_id, after, 1)
    return state in FINAL_JOB_STATES and not events


async def wait(woken: asyncio.Event, at_most_s: float) -> None:
    """Sleep until woken, or for so long."""
    with contextlib.suppress(TimeoutError):
        async with asyncio.timeout(at_most_s):  # wait_for of Python 3.11 may swallow a cancellation
            await woken.wait()


class Signals:
    """Wakes coroutines of this process when a task was queued or an event was added anywhere."""

    def __init__(self, database: Database) -> None:
        self._database = database
        self._waiting: dict[str, dict[asyncio.Event, frozenset[str]]] = {QUEUED_CHANNEL: {}, EVENT_CHANNEL: {}}
        self.stopping = False

    async def listen(self) -> None:
        """Forward notifications until canceled, over a connection that is renewed when it breaks."""
        while True:
            try:
                async with await self._database.dedicated() as connection:
                    await self._forward(connection)
            except psycopg.OperationalError as error:
                log.warning("lost the connection for notifications: %s", error)
                await asyncio.sleep(1.0)

    async def _forward(self, connection: psycopg.AsyncConnection[DictRow]) -> None:
        for channel in self._waiting:
            await connection.execute(psycopg.sql.SQL("LISTEN {}").format(psycopg.sql.Identifier(channel)))
            self.wake(channel)
        async for notification in connection.notifies():
            if notification.channel == QUEUED_CHANNEL:
                self.wake(QUEUED_CHANNEL, CLAIMS_WOKEN, notification.payload.split(","))
            else:
                self.wake(EVENT_CHANNEL, about=[ANY_JOB])

    def wake(self, channel: str, at_most: int | None = None, about: Collection[str] = ()) -> None:
        """Wake who sleeps on the channel, or `at_most` of them: those first that were not woken for longest.

        Where it is said what it is `about`, only those that wait for some of it.
        """
        waiting = self._waiting[channel]
        concerned = (event for event, wanted in waiting.items() if not about or not wanted.isdisjoint(about))
        for event in [event for event in concerned if not event.is_set()][:at_most]:
            event.set()
            waiting[event] = waiting.pop(event)

    def claim_poll_s(self, poll_s: float) -> float:
        """How long a waiting claim sleeps: together they look CLAIMS_WOKEN times in `poll_s`, however many they are."""
        return poll_s * max(1.0, len(self._waiting[QUEUED_CHANNEL]) / CLAIMS_WOKEN)

    def stop(self) -> None:
        """End all long polls and streams: the coordinator is about to stop."""
        self.stopping = True
        for channel in self._waiting:
            self.wake(channel)

    @contextlib.contextmanager
    def watch(self, channel: str, wanted: Collection[str] = ()) -> Iterator[asyncio.Event]:
        """An event that `wake` sets, for the time of the block; for the queue, by kinds of tasks and ids.

        Without anything `wanted` it is set only by `wake` without `about`: when the coordinator stops.
        """
        event = asyncio.Event()
        self._waiting[channel][event] = frozenset(wanted)
        try:
            yield event
        finally:
            del self._waiting[channel][event]
