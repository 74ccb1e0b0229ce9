"""Retention rules: jobs that are over are archived after a while, archived ones give up their light fields, logs go.

Run by the coordinator that leads (`maintenance`), by the functions that serve `archive` and `gc` asked for by hand:
nothing that another job needs is freed. Jobs with a label of `Retention.keep` are left alone.
"""

import contextlib
import logging

from psycopg.types.json import Jsonb

from kiln_schemas.errors import Conflict
from kiln_schemas.states import FINAL_JOB_STATES, JobState
from kiln_service import transitions
from kiln_service.config import ServiceConfig
from kiln_service.db import Database
from kiln_service.gc import free_archived
from kiln_service.jobs import archive

log = logging.getLogger(__name__)


async def apply_rules(database: Database, config: ServiceConfig) -> None:
    """One round of all rules; a rule without a number of days does nothing."""
    rules = config.retention
    if rules.archive_days is not None:
        await _archive_old(database, config, rules.archive_days)
    if rules.free_days is not None:
        report = await free_archived(
            database, config, rules.free_days, dry_run=False, actor=transitions.COORDINATOR, keep=rules.keep
        )
        for freed in report.jobs:
            log.info("freed by the retention rules: %s", ", ".join(freed.stores), extra={"job_id": freed.job_id})
    if rules.log_days is not None:
        states = sorted(FINAL_JOB_STATES)
        async with database.transaction(patient=True) as tx:
            dropped = await tx.count("drop_logs", states=states, days=rules.log_days, keep=Jsonb(rules.keep))
        if dropped:
            log.info("%d pieces of logs dropped by the retention rules", dropped)


async def _archive_old(database: Database, config: ServiceConfig, days: float) -> None:
    states = sorted(FINAL_JOB_STATES - {JobState.ARCHIVED})
    async with database.transaction() as tx:
        rows = await tx.all("find_archivable", states=states, days=days, keep=Jsonb(config.retention.keep))
    for row in rows:
        with contextlib.suppress(Conflict):  # retried just now
            await archive(database, row["id"], transitions.COORDINATOR)
