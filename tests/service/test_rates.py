"""Who asks too often is told how long to wait, and nobody else is."""

import asyncio

import httpx
import pytest

from kiln_schemas.client import Client
from kiln_schemas.errors import InputError, TooMany, wait_asked
from kiln_schemas.tasks import TaskKind, WorkerRegistration
from kiln_service.auth import digest_of
from kiln_service.config import Limits, Rate, Rates, make_config
from kiln_service.db import Tx
from kiln_service.rates import REMEMBERED, Buckets, network_of
from kiln_workers.runner.client import CoordinatorClient

SLOW = Rate(per_s=0.01, burst=3)


def limits(**rates):
    return Limits(reserve_bytes=0, rates=Rates(**rates))


def test_a_bucket_empties_and_fills():
    now = [100.0]
    buckets = Buckets(Rate(per_s=0.5, burst=2), lambda: now[0])
    for _ in range(2):
        buckets.take("a")
    with pytest.raises(TooMany, match=r"Ask again in 2 s") as refused:
        buckets.take("a")
    assert refused.value.wait_s == 2
    buckets.take("b")
    now[0] += 1.9
    with pytest.raises(TooMany, match=r"in 1 s"):
        buckets.take("a")
    now[0] += 0.1
    buckets.take("a")
    now[0] += 1000
    for _ in range(2):
        buckets.take("a")
    with pytest.raises(TooMany):
        buckets.take("a")


def test_callers_without_end_do_not_fill_the_memory():
    buckets = Buckets(Rate(per_s=1, burst=1), lambda: 0.0)
    for number in range(REMEMBERED + 10):
        buckets.take(str(number))
    assert len(buckets._levels) == REMEMBERED


def test_a_token_that_asks_too_often_is_told_when_to_return(start):
    with start(limits=limits(clients=SLOW)) as home:
        ci = {"name": "ci", "scopes": ["read", "worker"]}
        token = home.client.post("/v1/tokens", json=ci).json()["token"]
        worker = home.worker()
        statuses = [home.client.get("/v1/jobs").status_code for _ in range(3)]
        assert statuses == [200, 200, 429]
        refused = home.client.get("/v1/jobs")
        problem = refused.json()
        assert refused.headers["content-type"] == "application/problem+json" and problem["status"] == 429
        assert problem["code"] == "too-many-requests" and 90 <= int(refused.headers["retry-after"]) <= 100
        other = httpx.get(f"{home.url}/v1/jobs", headers={"Authorization": f"Bearer {token}"})
        assert other.status_code == 200, "another token has its own bucket"
        assert home.client.get("/healthz").status_code == home.client.get("/readyz").status_code == 200
        for _ in range(20):
            assert worker.claim() is None, "a farm behind this token goes on"
        home.upload(b"and so do its blobs")


def test_guesses_are_bounded_and_valid_tokens_and_sessions_are_not(start, monkeypatch):
    """The tokens are new to the coordinator when the guesses have been made: it has to look them up."""
    monkeypatch.setattr("kiln_service.auth.MEMORY_S", 0.0)
    monkeypatch.setattr("kiln_service.rates.SLOWED_S", 0.1)
    with start(limits=limits(failures=SLOW)) as home:
        token = home.client.post("/v1/tokens", json={"name": "ci", "scopes": ["read"]}).json()["token"]
        signed_in = httpx.post(f"{home.url}/login", data={"token": token})
        session = {"kiln_session": signed_in.cookies["kiln_session"]}

        def asked(word):
            return httpx.get(f"{home.url}/v1/jobs", headers={"Authorization": f"Bearer {word}"}).status_code

        def shown(cookie):
            return httpx.get(f"{home.url}/jobs", cookies={"kiln_session": cookie}).status_code

        assert [asked(f"guess-{n}") for n in range(5)] == [401, 401, 401, 429, 429]
        assert shown("guess") == 429
        refused = httpx.post(f"{home.url}/login", data={"token": "guess"})
        assert refused.status_code == 429 and int(refused.headers["retry-after"]) > 0
        assert asked(token) == asked(home.token) == 200
        assert httpx.get(f"{home.url}/jobs", cookies=session).status_code == 200
        assert httpx.post(f"{home.url}/login", data={"token": token}).status_code == 303
        assert httpx.get(f"{home.url}/healthz").status_code == 200


def test_guesses_that_come_together_are_looked_up_together(start):
    """Whatever waits is one query, so that a valid token among a thousand guesses waits for two at most."""
    with start(limits=limits(failures=Rate(per_s=1, burst=10**6))) as home:
        token = home.client.post("/v1/tokens", json={"name": "ci", "scopes": ["read"]}).json()["token"]
        book, database = home.app.state.parts.tokens, home.app.state.parts.database
        asked, all_of = [], Tx.all

        async def counted(tx, query, **parameters):
            asked.append((query, len(parameters["hashes"])))
            return await all_of(tx, query, **parameters)

        async def together():
            words = [*(f"guess-{n}" for n in range(1000)), token]
            return await asyncio.gather(*(book.find(digest_of(word), database) for word in words))

        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(Tx, "all", counted)
            found = asyncio.run_coroutine_threadsafe(together(), home.loop).result()
        assert [principal.name for principal in found if principal] == ["ci"]
        assert [query for query, _ in asked] == ["find_tokens"] * len(asked)
        assert len(asked) <= 2 and sum(count for _, count in asked) == 1001


@pytest.mark.parametrize("trusted", [False, True])
def test_forwarded_addresses_count_where_the_proxy_is_trusted(start, monkeypatch, trusted):
    monkeypatch.setattr("kiln_service.rates.SLOWED_S", 0.0)
    proxies = {"trusted_proxies": ("127.0.0.1",)} if trusted else {}
    with start(limits=limits(failures=SLOW), **proxies) as home:

        def guess(client):
            headers = {"Authorization": "Bearer guess", "X-Forwarded-For": client}
            return httpx.get(f"{home.url}/v1/jobs", headers=headers).status_code

        assert [guess(f"192.0.2.{n}") for n in range(5)] == ([401] * 5 if trusted else [401] * 3 + [429] * 2)
        # The proxy appends what it sees: what its client has made up stands before that.
        told = [guess(f"192.0.2.{n}, 198.51.100.7") for n in range(5)]
        assert told == ([401] * 3 + [429] * 2 if trusted else [429] * 5)


def test_a_proxy_that_is_no_address_is_a_sentence():
    with pytest.raises(InputError, match="trusted_proxies"):
        make_config({"data": "x", "trusted_proxies": ["localhost"]})


@pytest.mark.parametrize(
    ("host", "counted"),
    [
        ("192.0.2.1", "192.0.2.1"),
        ("::ffff:192.0.2.1", "192.0.2.1"),
        ("2001:db8::1", "2001:db8::/64"),
        ("2001:db8::ffff:1", "2001:db8::/64"),
        ("", ""),
    ],
)
def test_what_counts_as_one_address(host, counted):
    assert network_of(host) == counted


def test_the_client_waits_as_long_as_it_is_told(start):
    with start(limits=limits(clients=Rate(per_s=1, burst=1))) as home:
        with Client(home.url, home.token, patience_s=20) as patient:
            assert [len(patient.jobs().jobs) for _ in range(3)] == [0, 0, 0]
        with Client(home.url, home.token, patience_s=0) as hasty, pytest.raises(TooMany, match=r"Ask again in 1 s"):
            for _ in range(3):
                hasty.jobs()


def test_a_worker_waits_as_long_as_it_is_told(start):
    registration = WorkerRegistration(
        name="w", kinds=(TaskKind.FIT,), memory_bytes=1, threads=1, device="", version="0.1.0"
    )
    with (
        start(limits=limits(workers=Rate(per_s=1, burst=1))) as home,
        CoordinatorClient(home.url, home.token, patience_s=20) as worker,
    ):
        assert len({worker.register(registration).worker_id for _ in range(3)}) == 3


@pytest.mark.parametrize(("header", "seconds"), [(None, 0), ("7", 7), ("Wed, 21 Oct 2026 07:28:00 GMT", 0), ("-1", 0)])
def test_retry_after(header, seconds):
    assert wait_asked(header) == seconds
