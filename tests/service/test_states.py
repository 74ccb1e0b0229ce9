"""Moves that the tables allow happen, all others raise; one module writes states."""

import asyncio
import re
from dataclasses import replace
from pathlib import Path

import pytest

import kiln_service
from kiln_schemas.errors import IllegalTransition, InternalError
from kiln_schemas.states import JOB_TRANSITIONS, JobState, TaskState
from kiln_service import transitions
from kiln_service.db import Database, TaskRow, WorkerRow
from kiln_service.db.queries import all_queries, parse_queries
from kiln_service.jobs import lock_job


def moves(row, job):
    """Every move of a task by name, as a function of a transaction."""
    worker = WorkerRow(
        id=row.worker_id or "", name="w", kinds=(), tags=(), orders="work", asleep=False, owner="", registrant=""
    )
    problem = transitions.IllegalTransition("x").problem()

    async def claim(tx):
        if (await transitions.claim_next(tx, job.id, [(worker, [row.kind])], ["0" * 64], 1.0))[1] == [None]:
            raise IllegalTransition("there was nothing to claim")

    return {
        "claim": claim,
        "requeue": lambda tx: transitions.requeue_task(tx, row, "task.retried", "test", strike=True, reason=""),
        "fail": lambda tx: transitions.fail_task(tx, row, problem, "test"),
        "cancel": lambda tx: transitions.cancel_task(tx, row, "test", ""),
    }


ALLOWED = {
    TaskState.WAITING: {"cancel"},
    TaskState.QUEUED: {"claim", "cancel"},
    TaskState.SOFT_FAILED: {"claim", "cancel"},
    TaskState.ACTIVE: {"requeue", "fail", "cancel"},
    TaskState.COMPLETED: set(),
    TaskState.FAILED: set(),
    TaskState.CANCELED: set(),
}


class Undo(Exception):
    """Rolls a transaction back."""


async def locked(tx, task_id):
    """A task's job and the task."""
    row = TaskRow.of(await tx.one("lock_task", id=task_id))
    return await lock_job(tx, row.job_id), row


async def try_move(dsn, task_id, state, name):
    """Whether a task that is in a state takes a move; nothing stays changed."""
    async with Database(dsn) as database:
        try:
            async with database.transaction() as tx:
                done = "'{}'" if state is TaskState.COMPLETED else "NULL"
                await tx.connection.execute(f"UPDATE tasks SET state = '{state}', result = {done}".encode())
                job, row = await locked(tx, task_id)
                await moves(row, job)[name](tx)
                await tx.check_moves()
                raise Undo
        except Undo:
            return True
        except IllegalTransition:
            return False


def test_a_task_makes_exactly_the_moves_of_the_table(home):
    home.submit()
    claim = home.worker().must_claim()

    async def all_moves():
        return {
            state: {
                name
                for name in ("claim", "requeue", "fail", "cancel")
                if await try_move(home.config.database, claim["task_id"], state, name)
            }
            for state in TaskState
        }

    assert asyncio.run(all_moves()) == ALLOWED


def test_a_job_makes_exactly_the_moves_of_the_table(home):
    job_id = home.submit()["id"]

    async def legal(before, after):
        async with Database(home.config.database) as database:
            try:
                async with database.transaction() as tx:
                    await tx.connection.execute(f"UPDATE jobs SET state = '{before}'".encode())
                    await transitions.move_job(tx, await lock_job(tx, job_id), after, "test")
                    await tx.check_moves()
                    raise Undo
            except Undo:
                return True
            except IllegalTransition:
                return False

    async def table():
        return {before: {after for after in JobState if await legal(before, after)} for before in JobState}

    assert asyncio.run(table()) == {before: set(after) for before, after in JOB_TRANSITIONS.items()}


def test_a_move_from_a_state_that_is_no_longer_true_raises(home):
    home.submit()
    claim = home.worker().must_claim()

    async def move_twice():
        async with Database(home.config.database) as database, database.transaction() as tx:
            _, row = await locked(tx, claim["task_id"])
            stale = replace(row, state=TaskState.ACTIVE)
            await transitions.cancel_task(tx, row, "test", "")
            await transitions.cancel_task(tx, stale, "test", "")

    with pytest.raises(IllegalTransition, match="no longer active"):
        asyncio.run(move_twice())
    assert TaskRow.of(home.sql("SELECT * FROM tasks")[0]).state is TaskState.ACTIVE, "rolled back as one"


def test_one_file_of_queries_writes_states_and_one_module_uses_it():
    folder = Path(kiln_service.__file__).parent
    writers = [
        file.name for file in folder.rglob("*.sql") if re.search(r"SET\s+state|INTO (jobs|tasks)", file.read_text())
    ]
    assert writers == ["transitions.sql"]
    queries = parse_queries((folder / "db" / "transitions.sql").read_text(), "transitions.sql")
    for module in folder.rglob("*.py"):
        used = [name for name in queries if f'"{name}"' in module.read_text()]
        assert sorted(used) == (sorted(queries) if module.name == "transitions.py" else []), module


def test_every_query_is_used_and_described():
    folder = Path(kiln_service.__file__).parent
    source = "".join(file.read_text() for file in folder.rglob("*.py"))
    assert [name for name in all_queries() if f'"{name}"' not in source] == []
    with pytest.raises(InternalError):
        parse_queries("-- name: bare\nSELECT 1;\n", "test")
