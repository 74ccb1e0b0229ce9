"""Webhooks: a job's events told to other programs, signed, tried again with growing pauses.

A delivery is a row that is written with its event, in the same transaction: what happened is told, even by a
coordinator that starts later. Receivers may be told twice (`X-Lightkiln-Delivery` names the delivery) and out of order.

    X-Lightkiln-Signature: t=UNIX_SECONDS,v1=HEX    HEX = HMAC-SHA256(secret, "UNIX_SECONDS." + body)
"""

import asyncio
import contextlib
import hashlib
import hmac
import ipaddress
import json
import logging
import secrets
import socket
import time
from collections import Counter
from collections.abc import Iterator
from typing import Final

import httpx
import psycopg
from psycopg.rows import DictRow
from psycopg_pool import PoolTimeout

from kiln_schemas import __version__
from kiln_schemas.errors import NotFound
from kiln_schemas.operators import DeliveryView, NewWebhook, WebhookRequest, WebhookView
from kiln_schemas.receivers import is_refused
from kiln_schemas.text import told
from kiln_service.config import Timing
from kiln_service.db import Database, picked
from kiln_service.events import wait
from kiln_service.ids import new_id
from kiln_service.operators import record

log = logging.getLogger(__name__)

AT_ONCE: Final = 64
"""Deliveries under way in one coordinator,"""
OF_ONE: Final = 4
"""and of these to one receiver, so that one that does not answer keeps no other waiting."""
MAX_ATTEMPTS: Final = 12
LONGEST_PAUSE_S: Final = 3600.0
TIMEOUT_S: Final = 10.0
LEASE_S: Final = 60.0


async def add_webhook(database: Database, request: WebhookRequest, actor: str) -> NewWebhook:
    """Tell a URL of events from now on; the secret is told this once."""
    secret = secrets.token_urlsafe(32)
    async with database.transaction() as tx:
        events = [event.value for event in request.events]
        row = await tx.one(
            "insert_webhook", id=new_id(), url=str(request.url), events=events, secret=secret, actor=actor
        )
        await record(tx, actor, "webhook.created", row["url"], {"id": row["id"]})
    return NewWebhook(**picked(WebhookView, row).model_dump(), secret=secret)


async def list_webhooks(database: Database) -> tuple[WebhookView, ...]:
    """All webhooks, without their secrets."""
    async with database.transaction() as tx:
        return tuple(picked(WebhookView, row) for row in await tx.all("list_webhooks"))


async def remove_webhook(database: Database, webhook_id: str, actor: str) -> None:
    """Tell it nothing more; NotFound where there is none."""
    async with database.transaction() as tx:
        row = await tx.maybe("delete_webhook", id=webhook_id)
        if row is None:
            raise NotFound(f"no webhook '{webhook_id}'", where="webhook", remedy="GET /v1/webhooks lists them.")
        await record(tx, actor, "webhook.removed", row["url"], {"id": webhook_id})


async def list_deliveries(database: Database, webhook_id: str, limit: int) -> tuple[DeliveryView, ...]:
    """What became of each telling, newest first."""
    async with database.transaction() as tx:
        rows = await tx.all("list_deliveries", webhook_id=webhook_id, limit=limit)
    return tuple(picked(DeliveryView, row) for row in rows)


class Deliverer:
    """Tells what is due, as long as its coordinator runs; several coordinators share the work."""

    def __init__(self, database: Database, timing: Timing) -> None:
        self._database, self._timing = database, timing
        self._running: Counter[str] = Counter()
        self._ended = asyncio.Event()

    async def run(self) -> None:
        """Until canceled; a database that is away for a while is waited for."""
        client = httpx.AsyncClient(timeout=TIMEOUT_S, follow_redirects=False)
        async with client as http, asyncio.TaskGroup() as deliveries:
            while True:
                with self._errors_logged():
                    for row in await self._take_due():
                        self._running[row["webhook_id"]] += 1
                        deliveries.create_task(self._deliver(http, row))
                await wait(self._ended, self._timing.maintenance_s)
                self._ended.clear()

    async def _take_due(self) -> list[DictRow]:
        """Deliveries that are due, as many as may begin now."""
        free = AT_ONCE - self._running.total()
        if not free:
            return []
        busy = list(self._running)
        async with self._database.transaction() as tx:
            rows = await tx.all("take_due_deliveries", lease_s=LEASE_S, limit=free, busy=busy, of_one=OF_ONE)
        return rows

    @contextlib.contextmanager
    def _errors_logged(self) -> Iterator[None]:
        try:
            yield
        except (psycopg.OperationalError, PoolTimeout) as error:
            log.warning("webhooks wait for the database: %s", error)
        except Exception:
            log.exception("a pass of the webhooks failed")

    async def _deliver(self, http: httpx.AsyncClient, row: DictRow) -> None:
        """One delivery to its end; what goes wrong is logged, and it is tried again when its lease is over."""
        try:
            with self._errors_logged():
                await self._try(http, row)
        finally:
            self._running[row["webhook_id"]] -= 1
            self._running += Counter()  # forgets those with none
            self._ended.set()

    async def _try(self, http: httpx.AsyncClient, row: DictRow) -> None:
        status, error = await _send(http, row)
        told = status is not None and 200 <= status < 300
        last = row["attempts"] >= MAX_ATTEMPTS
        outcome = "delivered" if told else "failed" if last else "pending"
        pause = min(LONGEST_PAUSE_S, self._timing.maintenance_s * 2 ** row["attempts"])
        if not told:
            log.warning(
                "webhook %s: attempt %d failed: %s",
                row["url"],
                row["attempts"],
                error or f"status {status}",
                extra={"job_id": row["job_id"]},
            )
        async with self._database.transaction() as tx:
            await tx.run("end_delivery", id=row["id"], outcome=outcome, status=status, error=error, pause_s=pause)


def signature(secret: str, seconds: int, body: bytes) -> str:
    """The header's value."""
    digest = hmac.new(secret.encode(), f"{seconds}.".encode() + body, hashlib.sha256).hexdigest()
    return f"t={seconds},v1={digest}"


async def _send(http: httpx.AsyncClient, row: DictRow) -> tuple[int | None, str | None]:
    """Status of the answer, or why there is none."""
    document = {
        "event": row["kind"],
        "event_id": row["event_id"],
        "at": row["at"].isoformat(),
        "job_id": row["job_id"],
        "actor": row["actor"],
        "detail": row["detail"],
    }
    body = json.dumps(document, sort_keys=True).encode()
    headers = {
        "Content-Type": "application/json",
        "User-Agent": f"lightkiln/{__version__}",
        "X-Lightkiln-Event": row["kind"],
        "X-Lightkiln-Delivery": str(row["id"]),
        "X-Lightkiln-Signature": signature(row["secret"], int(time.time()), body),
    }
    try:
        async with asyncio.timeout(TIMEOUT_S):
            url = httpx.URL(row["url"])
            request = http.build_request(
                "POST",
                url.copy_with(host=await _address(url)),
                content=body,
                headers=headers | {"Host": url.netloc.decode()},
                extensions={"sni_hostname": url.host},
            )
            reply = await http.send(request, stream=True)
            await reply.aclose()  # its body is nobody's business, and may have no end
            return reply.status_code, None
    except TimeoutError:
        return None, f"no answer within {TIMEOUT_S:.0f} s"
    except (httpx.HTTPError, httpx.InvalidURL, OSError, ValueError) as error:
        return None, told(str(error) or type(error).__name__)


async def _address(url: httpx.URL) -> str:
    """Where to connect to: the host's address, looked up once; ValueError where it is one that is refused."""
    found = await asyncio.get_running_loop().getaddrinfo(url.host, url.port, type=socket.SOCK_STREAM)
    addresses = [str(entry[4][0]) for entry in found]
    for address in addresses:
        if is_refused(ipaddress.ip_address(address)):
            raise ValueError(f"'{url.host}' is at {address}, to which nothing is sent")
    return addresses[0]
