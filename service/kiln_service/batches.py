"""One transaction for many: what is asked of a job while others have its turn is answered together in the next one.

A job's claims and commits exclude each other, and each would be a few round trips under the job's lock. Together they
take as many as one of them, so that the more workers ask, the more of them are answered at a time.
"""

import asyncio
from collections.abc import Awaitable, Callable, Sequence
from typing import Final, Generic, TypeVar

from psycopg import OperationalError
from psycopg_pool import PoolTimeout

from kiln_service.db import Database, Tx

MOST: Final = 32
"""So many are answered by one transaction."""

Q = TypeVar("Q")
A = TypeVar("A")
Serve = Callable[[Tx, str, Sequence[Q]], Awaitable[Sequence[A | Exception]]]
"""Locks a job and answers each question about it, in order; an exception is the answer to its question alone."""


class Batches(Generic[Q, A]):
    """Collects questions by job, and has them served."""

    def __init__(self, database: Database, serve: Serve[Q, A]) -> None:
        self._database, self._serve = database, serve
        self._waiting: dict[str, list[tuple[Q, asyncio.Future[A]]]] = {}
        self._serving: dict[str, asyncio.Task[None]] = {}

    async def ask(self, job_id: str, question: Q) -> A:
        """The answer, once the transaction that gave it is committed."""
        answer: asyncio.Future[A] = asyncio.get_running_loop().create_future()
        self._waiting.setdefault(job_id, []).append((question, answer))
        if job_id not in self._serving:
            self._serving[job_id] = asyncio.create_task(self._take_turns(job_id), name=f"batches of {job_id}")
        return await answer

    async def _take_turns(self, job_id: str) -> None:
        """Answer until nobody asks. A task of its own: whoever asked may hang up while the others wait on."""
        try:
            while job_id in self._waiting:
                async with self._database.turn(job_id):
                    waiting = [one for one in self._waiting.pop(job_id) if not one[1].done()]
                    if waiting[MOST:]:
                        self._waiting[job_id] = waiting[MOST:]
                    if waiting:
                        await self._answer(job_id, waiting[:MOST])
        finally:
            del self._serving[job_id]
            for _, answer in self._waiting.pop(job_id, ()):  # the coordinator stops
                answer.cancel()

    async def _answer(self, job_id: str, batch: list[tuple[Q, asyncio.Future[A]]]) -> None:
        """All at once; one by one where that fails, so that each gets its own error. Nothing is written twice."""
        try:
            async with self._database.transaction() as tx:
                answers = await self._serve(tx, job_id, [question for question, _ in batch])
        except Exception as error:
            if len(batch) > 1 and not isinstance(error, (OperationalError, PoolTimeout)):
                for one in batch:
                    await self._answer(job_id, [one])
                return
            answers = [error] * len(batch)
        except BaseException:
            for _, future in batch:
                future.cancel()
            raise
        for (_, future), answer in zip(batch, answers, strict=True):
            if future.cancelled():
                continue
            if isinstance(answer, Exception):
                future.set_exception(answer)
            else:
                future.set_result(answer)
