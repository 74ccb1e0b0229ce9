"""When workers sleep by themselves: a daily span of local time on some days of the week."""

from collections.abc import Sequence
from datetime import datetime, timedelta
from zoneinfo import ZoneInfo

from psycopg.rows import DictRow

from kiln_schemas.operators import DAYS, SleepSchedule
from kiln_service.db import Tx


def sleeps_at(schedule: SleepSchedule, now: datetime) -> bool:
    """Whether a worker with this schedule sleeps at an instant; a span over midnight belongs to the day it begins."""
    local = now.astimezone(ZoneInfo(schedule.timezone))
    for begun in (local, local - timedelta(days=1)):
        if DAYS[begun.weekday()] not in schedule.days:
            continue
        clock, same_day = local.time(), begun.date() == local.date()
        overnight = schedule.ends <= schedule.begins
        if same_day and schedule.begins <= clock and (overnight or clock < schedule.ends):
            return True
        if not same_day and overnight and clock < schedule.ends:
            return True
    return False


def read_schedule(row: DictRow) -> SleepSchedule:
    """Of a row of `schedules`."""
    days: Sequence[int] = row["days"]
    return SleepSchedule(
        days=tuple(DAYS[day] for day in days), begins=row["begins"], ends=row["ends"], timezone=row["timezone"]
    )


async def is_asleep(tx: Tx, worker: str) -> bool:
    """Whether the worker of this name sleeps now."""
    row = await tx.maybe("find_schedule", worker=worker)
    return row is not None and sleeps_at(read_schedule(row), row["now"])
