"""A connection that sends all that it was given, and waits for nothing for ever.

psycopg 3.3.9 (its `_pipeline_communicate`) leaves a pipelined statement of over about 1 MB half sent where the server
takes it more slowly than it is written, and then waits to read; the server waits for the rest. So whenever this
connection waits to read, it goes on to send what libpq still holds. That holds for any statement, of any size.
"""

from collections.abc import Generator
from dataclasses import dataclass
from typing import Any, Final, TypeVar

import psycopg
from psycopg.abc import PQGen
from psycopg.conninfo import conninfo_to_dict, make_conninfo
from psycopg.pq.abc import PGconn
from psycopg.rows import DictRow
from psycopg.waiting import Ready, Wait

KEEPALIVE: Final = {"keepalives_idle": 30, "keepalives_interval": 10, "keepalives_count": 3, "connect_timeout": 10}
"""A server that vanished without a word is noticed after a minute."""

T = TypeVar("T")


@dataclass(frozen=True)
class Timeouts:
    """How long the database may take, in seconds."""

    statement_s: float = 60.0
    lock_s: float = 30.0
    """Waiting for a row or a table that another transaction has locked."""
    idle_s: float = 60.0
    """Between two statements of a transaction that is not pipelined."""
    transaction_s: float = 120.0
    """From the first statement to the commit. PostgreSQL does not notice that a pipelined transaction idles."""


class Connection(psycopg.AsyncConnection[DictRow]):
    """A connection, and when it was last asked whether it works."""

    checked: float = 0.0

    async def wait(self, gen: PQGen[T], *args: Any, **kwargs: Any) -> T:
        """As psycopg does, and what is not sent yet is sent meanwhile."""
        return await super().wait(_sending(gen, self.pgconn), *args, **kwargs)

    async def limit(self, timeouts: Timeouts) -> None:
        """Let the server end what takes too long; the connection is idle."""
        await self.set_autocommit(True)
        await self.execute(
            "SELECT set_config(name, value, false) FROM unnest(%s::text[], %s::text[]) AS settings (name, value)",
            [
                ["statement_timeout", "lock_timeout", "idle_in_transaction_session_timeout"],
                [f"{round(1000 * s)}ms" for s in (timeouts.statement_s, timeouts.lock_s, timeouts.idle_s)],
            ],
        )
        await self.set_autocommit(False)


def with_keepalive(dsn: str) -> str:
    """The connection string, with KEEPALIVE where it does not say otherwise."""
    stated = conninfo_to_dict(dsn)
    return make_conninfo(dsn, **{name: value for name, value in KEEPALIVE.items() if name not in stated})


def _sending(gen: PQGen[T], pgconn: PGconn) -> Generator[Any, Any, T]:
    """The same generator, but where it waits to read, also wait to write as long as something is unsent."""
    try:
        wanted = next(gen)
        while True:
            unsent = wanted == Wait.R and pgconn.flush()
            ready = yield Wait.RW if unsent else wanted
            if unsent and ready == Ready.W:
                continue
            wanted = gen.send(ready and Ready.R if unsent else ready)
    except StopIteration as end:
        result: T = end.value
        return result
