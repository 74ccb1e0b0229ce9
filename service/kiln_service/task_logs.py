"""What tasks print: kept within bounds, and read from its end or from a place on.

A log is rows of `task_logs`, a piece a heartbeat. It is bounded by attempt, by job and in all (`Limits.logs`): where
there is more, the oldest pieces go, down to KEPT of the bound, and whoever reads the log is told how much that was. The
database counts the bytes (triggers), so the bounds are checked by a glance at the sizes, once a coordinator has taken
LOOK_BYTES of log.
"""

import asyncio
import logging
from collections.abc import AsyncIterator, Sequence
from dataclasses import dataclass
from typing import Final

import psycopg
from psycopg.rows import DictRow
from psycopg_pool import PoolTimeout

from kiln_schemas.errors import NotFound
from kiln_schemas.states import OVER_TASK_STATES, TaskState
from kiln_service.config import LogLimits
from kiln_service.db import Database
from kiln_service.events import EVENT_CHANNEL, Signals, wait

log = logging.getLogger(__name__)

KEPT: Final = 0.75
"""So much of a bound is left when a log was over it."""
LOOK_BYTES: Final = 1 << 20
DROPPED_AT_ONCE: Final = 2000
"""Pieces that one transaction drops."""
PIECES_AT_ONCE: Final = 500
"""Pieces that one query reads."""


class LogBounds:
    """Keeps all logs within their bounds."""

    def __init__(self, database: Database, limits: LogLimits) -> None:
        self._database, self._limits = database, limits
        self._taken = LOOK_BYTES  # look soon after the start: the bounds may have been others
        self._look: asyncio.Task[None] | None = None

    def taken(self, lines: str) -> None:
        """Some log was written; look at the sizes once it was enough."""
        self._taken += len(lines)
        if self._taken >= LOOK_BYTES and (self._look is None or self._look.done()):
            self._look = asyncio.create_task(self._look_while_due(), name="logs")

    async def _look_while_due(self) -> None:
        try:
            while self._taken >= LOOK_BYTES:
                self._taken = 0
                await self.enforce()
        except (psycopg.OperationalError, PoolTimeout) as error:
            log.warning("logs could not be bounded: %s", error)
        except Exception:
            log.exception("logs could not be bounded")

    async def enforce(self) -> None:
        """Drop what is over the bounds."""
        async with self._database.transaction() as tx:
            attempts = await tx.all("long_logs", most=self._limits.attempt_bytes)
        for row in attempts:
            about = {"task_id": row["task_id"], "attempt": row["attempt"]}
            await self._drop("oldest_of_attempt", row["bytes"], self._limits.attempt_bytes, **about)
        async with self._database.transaction() as tx:
            jobs = await tx.all("logs_of_jobs")
        for row in jobs:
            await self._drop("oldest_of_job", row["bytes"], self._limits.job_bytes, job_id=row["job_id"])
        async with self._database.transaction() as tx:
            jobs = await tx.all("logs_of_jobs")
        await self._drop("oldest_of_all", sum(row["bytes"] for row in jobs), self._limits.all_bytes)

    async def _drop(self, oldest: str, size: int, most: int, **about: object) -> None:
        """Drop the oldest of `size` bytes where these are more than `most`."""
        excess = size - int(KEPT * most) if size > most else 0
        while excess > 0:
            async with self._database.transaction() as tx:
                ids = []
                for row in await tx.all(oldest, limit=DROPPED_AT_ONCE, **about):
                    if excess <= 0:
                        break
                    ids.append(row["id"])
                    excess -= row["bytes"]
                if not ids:
                    return
                await tx.run("drop_log_pieces", ids=ids)


@dataclass(frozen=True)
class LogPart:
    """A part of a log as text, at most `LogLimits.answer_bytes` and one piece."""

    text: str
    last: int
    """The last piece that was read, 0 where there is none."""
    attempt: int | None
    """Of that piece."""
    before: int | None
    """What comes before the part ends before this piece; None where nothing does, and where `tail` cut the part."""


async def read_log(
    database: Database, task_id: str, most: int, tail: int | None = None, before: int | None = None
) -> LogPart:
    """The end of a task's log, or of what comes before a piece: `tail` lines of it, and not more than `most` bytes."""
    async with database.transaction() as tx:
        if await tx.maybe("find_task", id=task_id) is None:
            raise NotFound(f"no task '{task_id}'", where="task")
        dropped = {row["attempt"]: row["dropped"] for row in await tx.all("dropped_log", task_id=task_id)}
    pieces: list[DictRow] = []
    lines, size, more = 0, 0, True
    while more and size < most and (tail is None or lines < tail):
        limit = PIECES_AT_ONCE if tail is None else min(tail - lines, PIECES_AT_ONCE)
        async with database.transaction() as tx:
            rows = await tx.all("log_before", task_id=task_id, before=before, limit=limit, most=most - size)
        pieces += rows
        more = bool(rows)
        before = rows[-1]["id"] if rows else before
        lines += sum(row["lines"].count("\n") + (not row["lines"].endswith("\n")) for row in rows)
        size += sum(len(row["lines"]) for row in rows)
    pieces.reverse()
    text = _text(pieces, None, dropped if not more else {})
    if tail is not None:
        kept = text.splitlines(keepends=True)
        text = "".join(kept[max(0, len(kept) - tail) :])
    elif more and size >= most:
        text = f"--- the log is longer: this is the end of it, X-Log-Before {before}\n{text}"
    last = pieces[-1] if pieces else None
    more_before = before if more and pieces and tail is None else None
    return LogPart(text, last["id"] if last else 0, last["attempt"] if last else None, more_before)


async def follow_log(
    database: Database, signals: Signals, task_id: str, most: int, tail: int | None, poll_s: float
) -> AsyncIterator[str]:
    """The end of a log, and what is written from now on until the task is over."""
    part = await read_log(database, task_id, most, tail)
    yield part.text
    last, attempt, over = part.last, part.attempt, False
    with signals.watch(EVENT_CHANNEL) as stopped:
        while not over and not signals.stopping:
            async with database.transaction() as tx:
                row = await tx.one("find_task", id=task_id)
                rows = await tx.all("log_after", task_id=task_id, after=last, limit=PIECES_AT_ONCE, most=most)
            over = TaskState(row["state"]) in OVER_TASK_STATES and not rows
            if rows:
                yield _text(rows, attempt, {})
                last, attempt = rows[-1]["id"], rows[-1]["attempt"]
            elif not over:
                await wait(stopped, poll_s)


def _text(pieces: Sequence[DictRow], attempt: int | None, dropped: dict[int, int]) -> str:
    """Pieces in their order, each attempt under a line that names it; and what was dropped, where that is told."""
    parts: list[str] = []
    told = dict(dropped)

    def head(number: int) -> None:
        parts.append(f"--- attempt {number}\n")
        if number in told:
            parts.append(f"--- {told.pop(number)} bytes before this were dropped, the log was too long\n")

    for piece in pieces:
        if piece["attempt"] != attempt:
            attempt = piece["attempt"]
            for gone in [number for number in told if number < attempt]:
                head(gone)
            head(attempt)
        parts.append(piece["lines"] if piece["lines"].endswith("\n") else piece["lines"] + "\n")
    for gone in list(told):
        head(gone)
    return "".join(parts)
