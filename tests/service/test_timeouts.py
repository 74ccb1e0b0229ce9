"""No request stops the others: large statements are sent; what takes too long ends, and what nobody waits for."""

import asyncio
import json
import socket
import time
from concurrent.futures import ThreadPoolExecutor

import psycopg
import pytest

from kiln_service.config import Timing
from kiln_service.db import Database
from kiln_service.db.connection import Connection, Timeouts

LARGE = 5 * 2**20


async def large_statement(connection, size):
    """A statement of so many bytes between small ones, as `Tx` sends them."""
    async with asyncio.timeout(60), connection.pipeline():
        await (await connection.execute("SELECT 1")).fetchone()
        large = await connection.execute("SELECT length(%s::text) AS n", ["x" * size])
        await connection.execute("SELECT 2")
        await connection.commit()
        return (await large.fetchone())["n"]


@pytest.mark.parametrize("size", [2**16, 2**20, LARGE, 40 * 2**20])
def test_a_pipelined_statement_of_any_size_is_sent(dsn, size):
    async def ask():
        async with await Connection.connect(dsn, row_factory=psycopg.rows.dict_row) as connection:
            return await large_statement(connection, size)

    assert asyncio.run(ask()) == size


def test_many_large_statements_and_large_answers_at_once(dsn):
    """Both directions are full at the same time."""

    async def ask():
        async with Database(dsn) as database, database.transaction() as tx:
            sent = [await tx.connection.execute("SELECT %s::text AS t", [str(n) * 2**20]) for n in range(10)]
            return [(await cursor.fetchone())["t"] == str(n) * 2**20 for n, cursor in enumerate(sent)]

    assert all(asyncio.run(ask()))


def test_the_requests_that_stopped_the_farm(home, result):
    """A label of 5 MB; ten failures with a title of 1.5 MB each. All are refused, and the bake goes on."""
    job, worker = home.submit(), home.worker()
    worker.finish(worker.must_claim(), tiles=12)
    wanted = {"kind": "render", "labels": ["tile 0,0", "x" * LARGE]}
    assert home.client.post(f"/v1/jobs/{job['id']}/requeue", json=wanted).status_code == 422
    claims = [worker.must_claim("render") for _ in range(10)]

    def fail(claim):
        problem = {"title": "x" * (3 * 2**19), "status": 500, "detail": "it broke", "code": "internal"}
        body = {"attempt": claim["attempt"], "lease": claim["lease"], "problem": problem, "retryable": True}
        return home.client.post(f"/v1/tasks/{claim['task_id']}/fail", json=body).status_code

    with ThreadPoolExecutor(10) as threads:
        assert list(threads.map(fail, claims)) == [422] * 10
    assert home.client.get("/readyz").status_code == 200
    for claim in claims:
        worker.finish(claim)
    while (claim := worker.claim()) is not None:
        worker.finish(claim)
    assert home.job(job["id"])["state"] == "completed"


def test_a_legitimate_large_result_is_stored(start, result):
    """65,536 tiles, 13 MB with notes: within the bound of a body."""
    with start() as home:
        job, worker = home.submit(set=["lightmap.resolution=2048", "lightmap.tile=8"]), home.worker()
        claim = worker.must_claim()
        document = result(home, claim)
        places = [{"row": 8 * (n // 256), "column": 8 * (n % 256), "size": 8, "texels": 64} for n in range(65536)]
        document |= {"tiles": places, "notes": ["x" * 500] * 1000}
        reply = home.client.post(
            f"/v1/tasks/{claim['task_id']}/commit",
            json={"attempt": 1, "lease": claim["lease"], "result": document},
            timeout=300,
        )
        assert reply.status_code == 204, reply.text
        assert home.sql("SELECT count(*) AS tasks FROM tasks WHERE kind = 'render'") == [{"tasks": 65536}]
        assert home.client.post(f"/v1/jobs/{job['id']}/cancel", timeout=300).status_code == 200


def test_what_takes_too_long_ends(dsn):
    async def ask(timeouts, query, before=""):
        async with (
            await psycopg.AsyncConnection.connect(dsn) as other,
            Database(dsn, timeouts=timeouts) as database,
        ):
            await other.execute("CREATE TABLE IF NOT EXISTS things (n int)")
            await other.commit()
            await other.execute(before or "SELECT 1")
            with pytest.raises(psycopg.OperationalError) as caught:
                async with database.transaction() as tx:
                    await (await tx.connection.execute(query)).fetchone()
            async with database.transaction() as tx:  # its connection, or another, is usable
                assert (await (await tx.connection.execute("SELECT 7 AS n")).fetchone())["n"] == 7
            return caught.value

    slow = asyncio.run(ask(Timeouts(statement_s=0.2), "SELECT pg_sleep(600)"))
    assert isinstance(slow, psycopg.errors.QueryCanceled)
    lock = "LOCK TABLE things"
    locked = asyncio.run(ask(Timeouts(lock_s=0.2), "SELECT * FROM things", lock))
    assert isinstance(locked, psycopg.errors.LockNotAvailable)
    whole = asyncio.run(ask(Timeouts(transaction_s=0.2), "SELECT pg_sleep(600)"))
    assert "transaction took longer" in str(whole)


def test_a_transaction_that_idles_ends_and_a_patient_one_does_not(dsn):
    async def ask(patient):
        timeouts = Timeouts(idle_s=0.2, statement_s=0.2, transaction_s=0.5)
        async with Database(dsn, timeouts=timeouts) as database, database.transaction(patient=patient) as tx:
            await (await tx.connection.execute("SELECT pg_sleep(0.6)")).fetchone()
            await asyncio.sleep(0.6)
            return (await (await tx.connection.execute("SELECT 7 AS n")).fetchone())["n"]

    assert asyncio.run(ask(True)) == 7
    with pytest.raises(psycopg.OperationalError):
        asyncio.run(ask(False))


def test_every_connection_has_timeouts(home):
    home.submit()
    asked = "SELECT current_setting('statement_timeout') AS s, current_setting('lock_timeout') AS l"

    async def ask():
        parts = home.app.state.parts
        async with Database(home.config.database, timeouts=parts.database._timeouts) as database:
            async with database.transaction() as tx:
                pooled = await (await tx.connection.execute(asked)).fetchone()
            async with await database.dedicated() as connection:
                return pooled, await (await connection.execute(asked)).fetchone()

    assert asyncio.run(ask()) == ({"s": "1min", "l": "30s"},) * 2


def test_readyz_notices_a_pool_that_gives_no_connection(start, eventually):
    with start(pool_size=2, timing=Timing(ready_s=0.5, maintenance_s=60, poll_s=60)) as home:
        job = home.submit()
        eventually(lambda: home.client.get("/readyz").status_code == 200, 60)
        with (
            psycopg.connect(home.config.database) as holder,
            ThreadPoolExecutor(2) as threads,
        ):
            holder.execute("SELECT FROM jobs WHERE id = %s FOR UPDATE", [job["id"]])
            stuck = [threads.submit(home.client.post, f"/v1/jobs/{job['id']}/pause") for _ in range(2)]
            eventually(lambda: len(waiting_for_locks(home)) == 2, 60)
            eventually(lambda: home.client.get("/readyz").status_code == 503, 25)  # after the remembered answer
            assert home.client.get("/readyz").json()["where"] == "database"
            holder.rollback()
            assert {one.result().status_code for one in stuck} == {200}
        eventually(lambda: home.client.get("/readyz").status_code == 200, 60)


def waiting_for_locks(home):
    return home.sql("SELECT pid FROM pg_stat_activity WHERE datname = current_database() AND wait_event_type = 'Lock'")


@pytest.mark.parametrize("action", ["pause", "requeue"])
def test_a_request_whose_client_hung_up_ends_its_transaction(home, eventually, action):
    """Without a body and with one; the row is locked by somebody else all the time."""
    job = home.submit()
    body = json.dumps({"kind": "render"}).encode() if action == "requeue" else b""
    head = f"POST /v1/jobs/{job['id']}/{action} HTTP/1.1\r\nHost: h\r\nAuthorization: Bearer {home.token}\r\n"
    head += f"Content-Type: application/json\r\nContent-Length: {len(body)}\r\n\r\n"
    host, port = home.url.removeprefix("http://").split(":")
    with psycopg.connect(home.config.database) as holder:
        holder.execute("SELECT FROM jobs WHERE id = %s FOR UPDATE", [job["id"]])
        with socket.create_connection((host, int(port))) as client:
            client.sendall(head.encode() + body)
            eventually(lambda: waiting_for_locks(home), 60)
        began = time.monotonic()
        eventually(lambda: not waiting_for_locks(home), 60)
        assert time.monotonic() - began < home.config.timing.lock_s, "not the lock's timeout has ended it"
        holder.rollback()
    assert home.job(job["id"])["state"] == "queued"
    assert home.client.post(f"/v1/jobs/{job['id']}/pause").json()["state"] == "paused"


def test_those_who_wait_with_one_that_hung_up_get_their_answers(home, eventually):
    """Batches: the first to ask leaves, and the others are answered all the same."""
    home.submit()
    first = home.worker()
    first.finish(first.must_claim(), tiles=3)
    claims = [first.must_claim("render") for _ in range(3)]
    results = [
        {"kind": "render", "tile": c["payload"]["tile"], "paths": 1, "overflows": 0, "invalid": 0} for c in claims
    ]
    bodies = [
        {"attempt": c["attempt"], "lease": c["lease"], "result": r | {"seconds": 1}}
        for c, r in zip(claims, results, strict=True)
    ]
    sent = json.dumps(bodies[0]).encode()
    head = f"POST /v1/tasks/{claims[0]['task_id']}/commit HTTP/1.1\r\nHost: h\r\nAuthorization: Bearer {home.token}\r\n"
    head += f"Content-Type: application/json\r\nContent-Length: {len(sent)}\r\n\r\n"
    host, port = home.url.removeprefix("http://").split(":")
    with psycopg.connect(home.config.database) as holder, ThreadPoolExecutor(2) as threads:
        holder.execute("SELECT FROM jobs FOR UPDATE")
        with socket.create_connection((host, int(port))) as client:
            client.sendall(head.encode() + sent)
            eventually(lambda: waiting_for_locks(home), 60)
            paths = [f"/v1/tasks/{claim['task_id']}/commit" for claim in claims[1:]]
            others = [
                threads.submit(home.client.post, path, json=body) for path, body in zip(paths, bodies[1:], strict=True)
            ]
        holder.rollback()
        assert [one.result().status_code for one in others] == [204, 204]
