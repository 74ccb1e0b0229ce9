"""Connections and transactions.

A `Tx` runs named queries inside one transaction. The order in which rows are locked is the same everywhere,
so transactions do not deadlock: the worker that asks > the job > its tasks.
"""

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Any, Self

import psycopg
from psycopg.rows import DictRow, dict_row
from psycopg_pool import AsyncConnectionPool

from kiln_schemas.errors import InternalError
from kiln_service.db.queries import all_queries


class Tx:
    """One open transaction; every method runs the named query with the given parameters."""

    def __init__(self, connection: psycopg.AsyncConnection[DictRow]) -> None:
        self.connection = connection

    async def run(self, query: str, **parameters: Any) -> int:
        """The number of rows touched."""
        cursor = await self.connection.execute(all_queries()[query], parameters)
        return cursor.rowcount

    async def all(self, query: str, **parameters: Any) -> list[DictRow]:
        """All rows."""
        cursor = await self.connection.execute(all_queries()[query], parameters)
        return await cursor.fetchall()

    async def maybe(self, query: str, **parameters: Any) -> DictRow | None:
        """The first row, or None."""
        cursor = await self.connection.execute(all_queries()[query], parameters)
        return await cursor.fetchone()

    async def one(self, query: str, **parameters: Any) -> DictRow:
        """The row that must be there."""
        row = await self.maybe(query, **parameters)
        if row is None:
            raise InternalError(f"query '{query}' gave no row")
        return row


class Database:
    """A pool of connections to one PostgreSQL database."""

    def __init__(self, dsn: str, size: int = 10, patience_s: float = 15.0) -> None:
        self.dsn = dsn
        self._pool: AsyncConnectionPool[psycopg.AsyncConnection[DictRow]] = AsyncConnectionPool(
            dsn,
            min_size=2,
            max_size=size,
            timeout=patience_s,
            open=False,
            kwargs={"row_factory": dict_row},
            check=AsyncConnectionPool.check_connection,
            connection_class=psycopg.AsyncConnection[DictRow],
        )

    async def __aenter__(self) -> Self:
        await self._pool.open(wait=True, timeout=30.0)
        return self

    async def __aexit__(self, *_: object) -> None:
        await self._pool.close()

    @asynccontextmanager
    async def transaction(self) -> AsyncIterator[Tx]:
        """Commit at the end of the block, roll back when it raises."""
        async with self._pool.connection() as connection:
            yield Tx(connection)

    async def dedicated(self) -> psycopg.AsyncConnection[DictRow]:
        """A connection outside the pool, in autocommit, for LISTEN and session locks; the caller closes it."""
        return await psycopg.AsyncConnection.connect(self.dsn, autocommit=True, row_factory=dict_row)
