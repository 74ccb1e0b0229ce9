"""The coordinator's background work: reaper, collection of blobs, retention rules.

Of all coordinators on a database one does it, the holder of a session's advisory lock; if it dies, another takes over.
A new holder first waits out one stale period: while no coordinator ran, no heartbeat could arrive.
"""

import asyncio
import logging
import time
from typing import Final

import psycopg
from psycopg.rows import DictRow
from psycopg_pool import PoolTimeout

from kiln_service.blobs import Blobs
from kiln_service.clock import DatabaseClock
from kiln_service.config import ServiceConfig
from kiln_service.db import Database, execute
from kiln_service.reaper import forget_workers, reap
from kiln_service.retention import apply_rules
from kiln_service.work import Work

log = logging.getLogger(__name__)

LEADER_LOCK: Final = 0x6B696C6E_0002
"""Advisory lock number: "kiln", 2."""


class Maintenance:
    """A loop that runs as long as its coordinator."""

    def __init__(self, database: Database, config: ServiceConfig, work: Work, blobs: Blobs) -> None:
        self._database, self._timing, self._work, self._blobs = database, config.timing, work, blobs
        self._config = config
        self._next_collection = self._next_retention = 0.0

    async def run(self) -> None:
        """Until canceled; a database that is away for a while is waited for."""
        while True:
            try:
                async with await self._database.dedicated() as connection:
                    await self._lead(connection)
            except (psycopg.OperationalError, PoolTimeout) as error:
                log.warning("maintenance waits for the database: %s", error)
                await asyncio.sleep(self._timing.maintenance_s)

    async def _lead(self, connection: psycopg.AsyncConnection[DictRow]) -> None:
        """Wait for leadership, then work as long as the connection that holds it lives."""
        while not await self._leads(connection):
            await asyncio.sleep(self._timing.maintenance_s)
        grace_over = time.monotonic() + self._timing.stale_s
        clock = DatabaseClock(self._database)
        while True:
            await self._pass(clock, may_reap=time.monotonic() >= grace_over)
            await asyncio.sleep(self._timing.maintenance_s)
            await execute(connection, "ping")

    async def _leads(self, connection: psycopg.AsyncConnection[DictRow]) -> bool:
        row = await (await execute(connection, "try_leadership", lock=LEADER_LOCK)).fetchone()
        return row is not None and bool(row["leader"])

    async def _pass(self, clock: DatabaseClock, *, may_reap: bool) -> None:
        """One round of everything; a defect in one part is logged and does not end the others."""
        try:
            await clock.keep()
            if may_reap:
                await reap(self._database, self._work, self._timing.stale_s, clock)
                await forget_workers(self._database)
            if time.monotonic() >= self._next_collection:
                self._next_collection = time.monotonic() + self._timing.blob_grace_s / 4
                await self._blobs.collect(self._timing.blob_grace_s)
            if time.monotonic() >= self._next_retention:
                self._next_retention = time.monotonic() + self._config.retention.check_s
                await apply_rules(self._database, self._config)
        except (psycopg.OperationalError, PoolTimeout):
            raise
        except Exception:
            log.exception("a pass of the maintenance failed")
