"""Notice that the clock of the database's machine was set, and keep what was counted by it.

Signs of life, blocks and deliveries are times of the database's clock. Set forth by an hour, it would make every
worker of the farm a lost one at once; set back by an hour, it would have the last sign of life of a lost worker lie in
the future, and its task wait for so long. So each pass of the maintenance compares that clock with the monotonic one of
this machine, which cannot be set, and where the two have parted moves those times along.
"""

import logging
import time
from dataclasses import dataclass
from typing import Final

from kiln_service.db import Database, Tx

log = logging.getLogger(__name__)

TOLERANCE_S: Final = 1.0
"""Less is no setting of a clock but its drift, or time that passed between two looks."""


@dataclass(frozen=True)
class Ahead:
    """By how many seconds the database's clock was ahead of the monotonic one: at least and at most."""

    least: float
    most: float

    def parted_from(self, before: "Ahead") -> float:
        """Seconds by which the clock was surely set since then; 0 where it may not have been."""
        forth, back = self.least - before.most, before.least - self.most
        return forth if forth > TOLERANCE_S else -back if back > TOLERANCE_S else 0.0


class DatabaseClock:
    """The clock of a database as one leader of the maintenance sees it."""

    def __init__(self, database: Database) -> None:
        self._database = database
        self._ahead: Ahead | None = None

    async def keep(self) -> float:
        """Move along what was counted by the clock, if it was set; by how many seconds it was.

        At the first look nothing is known of the past, and only signs of life from the future are made to be of now.
        """
        async with self._database.transaction() as tx:
            ahead = await self._look(tx)
            if self._ahead is None:
                await tx.run("forget_the_future")
                seconds = 0.0
            elif seconds := ahead.parted_from(self._ahead):
                await tx.run("clock_set_forth" if seconds > 0 else "clock_set_back", seconds=abs(seconds))
        if seconds:
            log.warning("the database's clock was set by %+.0f s; what runs is not taken for lost", seconds)
        self._ahead = ahead
        return seconds

    async def _look(self, tx: Tx) -> Ahead:
        asked = time.monotonic()
        epoch = (await tx.one("database_clock"))["epoch"]
        return Ahead(epoch - time.monotonic(), epoch - asked)
