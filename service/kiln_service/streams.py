"""Event streams: one reader of a coordinator reads new events, once, and all streams are fed from what it read.

A stream begins with the pages of history that its client lacks, which it reads itself, a few streams at a time. From
then on it takes lines from its job's `_Tail`, the newest events that the reader has seen. A client that is slower than
the tail is long reads pages again.
"""

import asyncio
import contextlib
import time
from collections import Counter, deque
from collections.abc import AsyncIterator, Iterator
from typing import Final

import psycopg
from psycopg_pool import PoolTimeout
from starlette.responses import StreamingResponse
from starlette.types import Receive, Scope, Send

from kiln_schemas.errors import TooMany
from kiln_schemas.job import EventView
from kiln_schemas.states import FINAL_JOB_STATES, JobState
from kiln_service.db import Database
from kiln_service.events import ANY_JOB, BATCH, EVENT_CHANNEL, Signals, read_state_and_events, wait

UNBUFFERED: Final = {"Cache-Control": "no-store", "X-Accel-Buffering": "no"}
"""Headers of a stream, so that no proxy holds it back."""
KEEPALIVE_S: Final = 15.0
"""An idle stream sends a comment this often, so that proxies and dead clients are noticed."""
TAIL: Final = 1000
"""Events that are kept of a job with streams."""
PAUSE_S: Final = 0.05
"""Between two looks for new events; longer by PAUSE_OF_ONE_S for each stream, as each look may wake all of them."""
PAUSE_OF_ONE_S: Final = 0.002
PAGES_AT_ONCE: Final = 2
"""Pages of history that are read at the same time, of the pool's connections."""


class _Tail:
    """The newest events of one job, as lines of a stream."""

    def __init__(self, after: int) -> None:
        self.first = self.last = after
        """All events after `first` up to `last` are in `lines`."""
        self.lines: deque[tuple[int, str]] = deque()
        self.over = False
        """Whether the job is over and `last` is its last event."""
        self.streams: set[asyncio.Event] = set()

    def add(self, event_id: int, line: str) -> None:
        """The next event."""
        self.lines.append((event_id, line))
        self.last = event_id
        if len(self.lines) > TAIL:
            self.first = self.lines.popleft()[0]

    def after(self, event_id: int) -> str:
        """The lines of later events."""
        newer = []
        for number, line in reversed(self.lines):
            if number <= event_id:
                break
            newer.append(line)
        return "".join(reversed(newer))


class Streams:
    """All event streams of one coordinator, and their reader."""

    def __init__(self, database: Database, signals: Signals, poll_s: float, of_token: int) -> None:
        self._database, self._signals, self._poll_s, self._of_token = database, signals, poll_s, of_token
        self._tails: dict[str, _Tail] = {}
        self._pages = asyncio.Semaphore(PAGES_AT_ONCE)
        self._open: Counter[str] = Counter()

    @contextlib.contextmanager
    def place(self, token: str) -> Iterator[None]:
        """A place for one stream of a token, for the time of the block; TooMany where it has as many as may be."""
        if self._open[token] >= self._of_token:
            raise TooMany(
                f"the token '{token}' has {self._of_token} streams open",
                remedy="Close some; limits.streams of the coordinator says how many are allowed.",
                wait_s=1,
            )
        self._open[token] += 1
        try:
            yield
        finally:
            self._open[token] -= 1
            self._open += Counter()  # forgets tokens with none

    async def read(self) -> None:
        """The reader: until the coordinator stops. A database that is away for a while is waited for."""
        with self._signals.watch(EVENT_CHANNEL, [ANY_JOB]) as woken:
            while not self._signals.stopping:
                woken.clear()
                with contextlib.suppress(psycopg.OperationalError, PoolTimeout):
                    await self._read_new()
                streams = sum(len(tail.streams) for tail in self._tails.values())
                await asyncio.sleep(PAUSE_S + PAUSE_OF_ONE_S * streams)
                await wait(woken, self._poll_s)

    async def _read_new(self) -> None:
        """One query for the new events of all jobs that have streams."""
        tails = dict(self._tails)
        if not tails:
            return
        before = {job: tail.last for job, tail in tails.items()}
        async with self._database.transaction() as tx:
            rows = await tx.all("read_streamed", job_ids=list(before), afters=list(before.values()), limit=BATCH)
        read = Counter[str]()
        for row in rows:
            tail, state = tails[row["streamed"]], JobState(row.pop("state"))
            read[row.pop("streamed")] += 1
            if row["id"] is not None:
                tail.add(row["id"], line_of(EventView.model_validate(row)))
            tail.over = state in FINAL_JOB_STATES
        for job, tail in tails.items():
            if read[job] == BATCH:
                tail.over = False  # there may be more
            if tail.over or tail.last > before[job]:
                for woken in tail.streams:
                    woken.set()

    async def stream(self, job_id: str, after: int) -> AsyncIterator[str]:
        """Server-sent events (WHATWG HTML, 9.2) of a job, past and coming, until the job is over."""
        while not self._signals.stopping:
            async with self._pages:
                state, events = await read_state_and_events(self._database, job_id, after, BATCH)
            if events:
                yield "".join(map(line_of, events))
                after = events[-1].id
            if len(events) == BATCH:
                continue
            if state in FINAL_JOB_STATES:
                return
            with self._joined(job_id, after) as (tail, woken):
                quiet = time.monotonic()
                while after >= tail.first and not self._signals.stopping:
                    woken.clear()
                    if lines := tail.after(after):
                        after = tail.last
                        yield lines
                        quiet = time.monotonic()
                    elif tail.over:
                        return
                    elif time.monotonic() - quiet > KEEPALIVE_S:
                        yield ": still here\n\n"
                        quiet = time.monotonic()
                    await wait(woken, KEEPALIVE_S)

    @contextlib.contextmanager
    def _joined(self, job_id: str, after: int) -> Iterator[tuple[_Tail, asyncio.Event]]:
        """A job's tail for the time of the block, and what is set when it has grown or when the coordinator stops."""
        tail = self._tails.setdefault(job_id, _Tail(after))
        with self._signals.watch(EVENT_CHANNEL) as woken:
            tail.streams.add(woken)
            try:
                yield tail, woken
            finally:
                tail.streams.discard(woken)
                if not tail.streams and self._tails.get(job_id) is tail:
                    del self._tails[job_id]


class CountedStream(StreamingResponse):
    """A stream that takes one of its token's places as long as it is sent."""

    def __init__(self, streams: Streams, token: str, lines: AsyncIterator[str], media_type: str) -> None:
        super().__init__(lines, media_type=media_type, headers=UNBUFFERED)
        self._place = contextlib.ExitStack()
        self._place.enter_context(streams.place(token))

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        with self._place:
            await super().__call__(scope, receive, send)


def line_of(event: EventView) -> str:
    """An event as a stream has it."""
    return f"id: {event.id}\nevent: {event.kind}\ndata: {event.model_dump_json()}\n\n"
