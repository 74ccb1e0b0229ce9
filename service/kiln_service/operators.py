"""What operators do: access tokens, orders to workers, and the record of who did what."""

import hashlib
import secrets
from collections.abc import Mapping, Sequence
from typing import Any, Final

from psycopg.rows import DictRow
from psycopg.types.json import Jsonb

from kiln_schemas.errors import Conflict, NotFound
from kiln_schemas.operators import (
    DAYS,
    AuditEntry,
    NewToken,
    Order,
    Scope,
    SleepSchedule,
    TokenRequest,
    TokenView,
    WorkerState,
    WorkerView,
)
from kiln_service import queue
from kiln_service.config import OWN_TOKEN, ServiceConfig
from kiln_service.db import Database, Tx, picked, readable_rows

OFFLINE_S: Final = 60.0
ERROR_AFTER: Final = 3
"""Attempts in a row that ended badly, after which a worker is listed as in error."""
FORGOTTEN_S: Final = 7 * 86400.0
"""Workers not seen for so long are left out of lists."""

_ORDERS: Final[Mapping[Order, str]] = {Order.WAKE: "work", Order.SLEEP: "sleep", Order.DRAIN: "drain"}


async def create_token(database: Database, config: ServiceConfig, request: TokenRequest, actor: str) -> NewToken:
    """A new token; told this once, kept as a hash. Conflict where the name is taken."""
    token = secrets.token_urlsafe(32)
    scopes = tuple(scope for scope in Scope if scope in request.scopes)
    taken = request.name in {OWN_TOKEN, *(entry.name for entry in config.tokens)}
    async with database.transaction() as tx:
        row = (
            None
            if taken
            else await tx.maybe(
                "insert_token",
                name=request.name,
                sha256=hashlib.sha256(token.encode()).hexdigest(),
                scopes=[scope.value for scope in scopes],
                actor=actor,
            )
        )
        if row is None:
            raise Conflict(
                f"there is a token '{request.name}'", where="name", remedy="Revoke it first, or choose another name."
            )
        await record(tx, actor, "token.created", request.name, {"scopes": [scope.value for scope in scopes]})
    return NewToken(**picked(TokenView, row).model_dump(), token=token)


async def list_tokens(database: Database) -> tuple[TokenView, ...]:
    """All tokens that were made here."""
    async with database.transaction() as tx:
        return tuple(picked(TokenView, row) for row in await tx.all("list_tokens"))


async def revoke_token(database: Database, name: str, actor: str) -> None:
    """Refuse a token from now on (`auth.MEMORY_S` at the latest); NotFound where there is none."""
    async with database.transaction() as tx:
        if await tx.maybe("delete_token", name=name) is None:
            raise NotFound(
                f"no token '{name}' was made here",
                where="name",
                remedy="Tokens of the configuration and of the data folder are removed there.",
            )
        await record(tx, actor, "token.revoked", name)


async def list_workers(database: Database) -> tuple[WorkerView, ...]:
    """Workers that were seen within a week."""
    async with database.transaction() as tx:
        rows = await tx.all("list_workers", offline_s=OFFLINE_S, forgotten_s=FORGOTTEN_S)
    return tuple(readable_rows(WorkerView, [_worker_values(row) for row in rows]))


async def order_worker(database: Database, worker_id: str, order: Order, actor: str) -> None:
    """Tell a worker what to do once it has no task; NotFound where there is none."""
    async with database.transaction() as tx:
        row = await tx.maybe("order_worker", id=worker_id, orders=_ORDERS[order])
        if row is None:
            raise NotFound(f"no worker '{worker_id}'", where="worker", remedy="GET /v1/workers lists them.")
        await queue.tell(tx, worker_id)
        await record(tx, actor, f"worker.{order.value}", row["name"], {"worker": worker_id})


async def unblock_worker(database: Database, worker_id: str, actor: str) -> None:
    """Let workers of this one's name take tasks of all jobs again; NotFound where there is none."""
    async with database.transaction() as tx:
        row = await tx.maybe("find_worker", id=worker_id)
        if row is None:
            raise NotFound(f"no worker '{worker_id}'", where="worker", remedy="GET /v1/workers lists them.")
        await tx.run("delete_blocks", worker=row["registrant"])
        await record(tx, actor, "worker.unblocked", row["name"], {"worker": worker_id})


async def set_schedule(database: Database, worker: str, schedule: SleepSchedule, actor: str) -> None:
    """From now on the workers of this name sleep by this schedule."""
    days = [DAYS.index(day) for day in schedule.days]
    async with database.transaction() as tx:
        await tx.run("put_schedule", worker=worker, **schedule.model_dump() | {"days": days})
        await record(tx, actor, "worker.schedule", worker, schedule.model_dump(mode="json"))


async def drop_schedule(database: Database, worker: str, actor: str) -> None:
    """They sleep when they are told to and at no other time. Asking twice is no error."""
    async with database.transaction() as tx:
        if await tx.count("delete_schedule", worker=worker):
            await record(tx, actor, "worker.schedule", worker)


async def list_audit(database: Database, before: int | None, limit: int) -> tuple[AuditEntry, ...]:
    """The record, newest first."""
    async with database.transaction() as tx:
        return tuple(readable_rows(AuditEntry, await tx.all("list_audit", before=before, limit=limit)))


async def record(tx: Tx, actor: str, action: str, target: str, detail: Mapping[str, Any] | None = None) -> None:
    """Write down who did what to what, in the transaction that does it."""
    await tx.run("add_audit", actor=actor, action=action, target=target, detail=Jsonb(dict(detail or {})))


def _worker_values(row: DictRow) -> DictRow:
    task = None if row["task_id"] is None else f"{row['kind']} {row['label']}"
    made = {"state": _state(row), "task": task, "schedule": _schedule(row)}
    return {name: row[name] for name in WorkerView.model_fields if name not in made} | made


def _schedule(row: DictRow) -> SleepSchedule | None:
    if row["days"] is None:
        return None
    days: Sequence[int] = row["days"]
    return SleepSchedule(
        days=tuple(DAYS[day] for day in days), begins=row["begins"], ends=row["ends"], timezone=row["timezone"]
    )


def _state(row: DictRow) -> WorkerState:
    if row["offline"]:
        return WorkerState.OFFLINE
    if row["orders"] == "drain":
        return WorkerState.DRAINING
    if row["orders"] == "sleep" or row["asleep"]:
        return WorkerState.ASLEEP
    return WorkerState.ERROR if row["strikes"] >= ERROR_AFTER else WorkerState.AWAKE
