"""Who asks too often is told how long to wait, and nobody else is."""

import httpx
import pytest

from kiln_schemas.client import Client
from kiln_schemas.errors import TooMany, wait_asked
from kiln_schemas.tasks import TaskKind, WorkerRegistration
from kiln_service.config import Limits, Rate, Rates
from kiln_service.rates import REMEMBERED, Buckets
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
    buckets.check("a")
    buckets.take("a")
    now[0] += 1000
    for _ in range(2):
        buckets.take("a")
    with pytest.raises(TooMany):
        buckets.check("a")


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


def test_sign_ins_that_fail_are_bounded_and_known_tokens_are_not(start):
    with start(limits=limits(failures=SLOW)) as home:
        token = home.client.post("/v1/tokens", json={"name": "ci", "scopes": ["read"]}).json()["token"]

        def asked(word):
            return httpx.get(f"{home.url}/v1/jobs", headers={"Authorization": f"Bearer {word}"}).status_code

        assert [asked(f"guess-{n}") for n in range(5)] == [401, 401, 401, 429, 429]
        assert asked(token) == 429, "to look it up would be another guess"
        assert home.client.get("/v1/jobs").status_code == 200
        assert httpx.get(f"{home.url}/healthz").status_code == 200


def test_guessed_cookies_and_forms_are_bounded_too(start):
    with start(limits=limits(failures=SLOW)) as home:

        def shown(cookie):
            return httpx.get(f"{home.url}/jobs", cookies={"kiln_session": cookie}).status_code

        assert [shown(f"guess-{n}") for n in range(5)] == [401, 401, 401, 429, 429]
        refused = httpx.post(f"{home.url}/login", data={"token": home.token})
        assert refused.status_code == 429 and int(refused.headers["retry-after"]) > 0


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
