"""Connections and transactions.

A `Tx` runs named queries inside one transaction. The order in which rows are locked is the same everywhere,
so transactions do not deadlock: the worker that asks > the job > its tasks.

With a thousand workers, how long a job's lock is held bounds how many of its tasks are claimed. So statements are
pipelined (psycopg's pipeline mode): what is not read is sent together with what comes after it. And who waits for a
job (`turn`) waits in this process, where the next one goes on at once and no connection is held meanwhile.

Everything here ends: statements, waits for locks, transactions (`Timeouts`), and the wait for a connection.
"""

import asyncio
import time
import weakref
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Any, Final, Self

import psycopg
from psycopg import AsyncCursor, AsyncPipeline, OperationalError
from psycopg.rows import DictRow, dict_row
from psycopg_pool import AsyncConnectionPool

from kiln_schemas.errors import InternalError
from kiln_service.db.connection import Connection, Timeouts, with_keepalive
from kiln_service.db.queries import all_queries

FRESH_S: Final = 1.0
"""A connection that worked so short a time ago is used again without asking whether it still does."""


class Tx:
    """One open transaction; every method sends the named query with the given parameters."""

    def __init__(self, connection: psycopg.AsyncConnection[DictRow], pipeline: AsyncPipeline) -> None:
        self.connection, self._pipeline = connection, pipeline
        self._moves: list[tuple[AsyncCursor[DictRow], Exception]] = []

    async def run(self, query: str, **parameters: Any) -> None:
        """Without waiting; an error is raised by what is waited for next, at the latest by the commit."""
        await execute(self.connection, query, **parameters)

    async def ask(self, query: str, **parameters: Any) -> AsyncCursor[DictRow]:
        """Without waiting, to be fetched from later."""
        return await execute(self.connection, query, **parameters)

    async def move(self, query: str, otherwise: Exception, **parameters: Any) -> None:
        """Without waiting; `otherwise` is raised before the commit unless one row was touched."""
        self._moves.append((await self.ask(query, **parameters), otherwise))

    async def check_moves(self) -> None:
        """Wait for what `move` was told, if it is not there yet."""
        if any(cursor.pgresult is None for cursor, _ in self._moves):
            await self._pipeline.sync()
        for cursor, otherwise in self._moves:
            if cursor.rowcount != 1:
                raise otherwise

    async def count(self, query: str, **parameters: Any) -> int:
        """The number of rows touched."""
        cursor = await self.ask(query, **parameters)
        await self._pipeline.sync()
        return cursor.rowcount

    async def all(self, query: str, **parameters: Any) -> list[DictRow]:
        """All rows."""
        return await (await self.ask(query, **parameters)).fetchall()

    async def maybe(self, query: str, **parameters: Any) -> DictRow | None:
        """The first row, or None."""
        return await (await self.ask(query, **parameters)).fetchone()

    async def one(self, query: str, **parameters: Any) -> DictRow:
        """The row that must be there."""
        return await fetched(await self.ask(query, **parameters))


class Database:
    """A pool of connections to one PostgreSQL database."""

    def __init__(self, dsn: str, size: int = 10, patience_s: float = 15.0, timeouts: Timeouts = Timeouts()) -> None:
        self._dsn, self._timeouts = with_keepalive(dsn), timeouts
        self._turns: weakref.WeakValueDictionary[str, asyncio.Lock] = weakref.WeakValueDictionary()
        self._pool: AsyncConnectionPool[Connection] = AsyncConnectionPool(
            self._dsn,
            min_size=2,
            max_size=size,
            timeout=patience_s,
            open=False,
            kwargs={"row_factory": dict_row},
            check=_check,
            configure=lambda connection: connection.limit(timeouts),
            connection_class=Connection,
        )

    async def __aenter__(self) -> Self:
        await self._pool.open(wait=True, timeout=30.0)
        return self

    async def __aexit__(self, *_: object) -> None:
        await self._pool.close()

    @asynccontextmanager
    async def transaction(self, *, patient: bool = False) -> AsyncIterator[Tx]:
        """Commit at the end of the block, roll back when it raises; OperationalError where it takes too long.

        A `patient` one is background work on many rows, or waits for something outside; only its locks are bounded.
        """
        async with (
            self._pool.connection() as connection,
            _within(None if patient else self._timeouts.transaction_s, "a transaction"),
            connection.pipeline() as pipeline,
        ):
            tx = Tx(connection, pipeline)
            if patient:
                await tx.run("be_patient")
            yield tx
            await tx.check_moves()
            await connection.commit()  # together with what was not waited for

    async def ping(self, within_s: float) -> None:
        """OperationalError unless a connection is to be had and the database answers so soon."""
        async with _within(within_s, "a connection to the database"), self.transaction() as tx:
            await tx.one("ping")

    def turn(self, key: str) -> asyncio.Lock:
        """What those wait for who will lock this job or worker: in order, and with no connection in hand."""
        return self._turns.setdefault(key, asyncio.Lock())

    async def first(self, query: str, **parameters: Any) -> DictRow | None:
        """The first row of one query that is a transaction of its own, or None."""
        async with self._pool.connection() as connection, _within(self._timeouts.transaction_s, "a query"):
            await connection.set_autocommit(True)
            try:
                return await (await execute(connection, query, **parameters)).fetchone()
            finally:
                await connection.set_autocommit(False)

    async def dedicated(self, *, patient: bool = False) -> Connection:
        """A connection outside the pool, in autocommit, for LISTEN and session locks; the caller closes it.

        A `patient` one is for migrations: they wait for each other and may write every row of a large table.
        """
        connection = await Connection.connect(self._dsn, row_factory=dict_row)
        if not patient:
            await connection.limit(self._timeouts)
        await connection.set_autocommit(True)
        return connection


@asynccontextmanager
async def _within(seconds: float | None, what: str) -> AsyncIterator[None]:
    """OperationalError where the block takes longer: it is canceled, and its statement with it."""
    try:
        async with asyncio.timeout(seconds):
            yield
    except TimeoutError as error:
        raise OperationalError(f"{what} took longer than {seconds:g} s") from error


async def fetched(cursor: AsyncCursor[DictRow]) -> DictRow:
    """The next row, which must be there."""
    row = await cursor.fetchone()
    if row is None:
        raise InternalError("a query gave no row")
    return row


async def execute(
    connection: psycopg.AsyncConnection[DictRow], query: str, **parameters: Any
) -> psycopg.AsyncCursor[DictRow]:
    """One named query on a connection of one's own."""
    return await connection.execute(all_queries()[query], parameters)


async def _check(connection: Connection) -> None:
    """Raise where a connection no longer works; the pool then opens another."""
    now = time.monotonic()
    if now - connection.checked > FRESH_S:
        await AsyncConnectionPool.check_connection(connection)
        connection.checked = now
