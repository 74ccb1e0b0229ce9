"""An attempt belongs to who has the lease of its claim; a worker, its failures and blocks to the token it came with."""

import hashlib
import logging

import httpx
import pytest

from kiln_service.config import Limits, TokenEntry
from kiln_service.operators import FORGOTTEN_S, OFFLINE_S


def token_entry(name: str) -> TokenEntry:
    return TokenEntry(name=name, sha256=hashlib.sha256(f"secret of {name}".encode()).hexdigest(), scopes=("worker",))


class Stranger:
    """Somebody else's worker token, and nothing else."""

    def __init__(self, home, name: str = "stranger") -> None:
        headers = {"Authorization": f"Bearer secret of {name}"}
        self.config, self.upload = home.config, home.upload
        self.client = httpx.Client(base_url=home.url, headers=headers, timeout=30)


@pytest.fixture
def guarded(start):
    with start(tokens=(token_entry("stranger"), token_entry("other"))) as home:
        yield home


@pytest.fixture
def worker_of(guarded, make_worker):
    """Registers a worker with another token."""
    found = {}

    def register(token: str, name: str):
        found.setdefault(token, Stranger(guarded, token))
        return make_worker(found[token], name)

    yield register
    for one in found.values():
        one.client.close()


def test_a_stranger_ends_no_attempt_of_others(guarded, worker_of, result):
    """The attack: claim, give back, wait until another holds attempt 2, and speak for that."""
    home = guarded
    job = home.submit()
    stranger, honest = worker_of("stranger", "stranger"), home.worker("honest")
    first = stranger.must_claim()
    stranger.fail(first, code="canceled").raise_for_status()
    second = honest.must_claim()
    assert (second["task_id"], second["attempt"]) == (first["task_id"], 2)
    before = home.events(job["id"])
    for lease in (first["lease"], "", "x" * 43):
        forged = second | {"lease": lease}
        replies = [
            stranger.commit(forged, result(home, forged)),
            stranger.fail(forged),
            stranger.fail(forged, code="input", retryable=False),
            stranger.checkpoint(forged, b"mine"),
        ]
        for reply in replies:
            assert (reply.status_code, reply.json()["code"]) == (409, "stale-attempt")
            assert honest.id not in reply.text and "honest" not in reply.text and second["lease"] not in reply.text
        assert stranger.beat(forged, log="forged\n")["stop"] is True
    assert stranger.beat(second, log="forged\n")["stop"] is True, "the lease is not this worker's"
    assert home.events(job["id"]) == before and home.job(job["id"])["state"] == "active"
    assert home.sql("SELECT count(*) AS lines FROM task_logs") == [{"lines": 0}]
    assert home.sql("SELECT checkpoint, state, attempt FROM tasks") == [
        {"checkpoint": None, "state": "active", "attempt": 2}
    ]
    assert honest.beat(second)["stop"] is False
    honest.finish(second)


def test_a_missing_lease_is_refused_as_a_wrong_one_is(guarded, result):
    guarded.submit()
    worker = guarded.worker()
    claim = worker.must_claim()
    body = {"attempt": 1, "result": result(guarded, claim)}
    reply = guarded.client.post(f"/v1/tasks/{claim['task_id']}/commit", json=body)
    assert (reply.status_code, reply.json()["code"]) == (409, "stale-attempt")
    worker.finish(claim)
    assert worker.commit(claim | {"lease": "wrong"}, body["result"]).status_code == 409, "a repetition needs it too"
    assert worker.commit(claim, body["result"]).status_code == 204


def test_a_lease_is_in_no_view_log_or_event_and_its_hash_alone_is_stored(guarded, caplog):
    caplog.set_level(logging.DEBUG)
    home = guarded
    job, worker = home.submit(), home.worker()
    claim = worker.must_claim()
    wrong = {"attempt": 1, "lease": claim["lease"], "result": {"kind": "prepare"}}
    told = [home.client.post(f"/v1/tasks/{claim['task_id']}/commit", json=wrong | extra) for extra in ({}, {"x": 1})]
    told.append(home.client.post(f"/v1/tasks/{claim['task_id']}/fail", json={"lease": claim["lease"], "attempt": 1}))
    assert {reply.status_code for reply in told} == {422}
    worker.beat(claim)
    told += [
        home.client.get(f"/v1/jobs/{job['id']}{view}") for view in ("", "/tasks", "/events?format=json", "/curves")
    ]
    told += [home.client.get(f"/jobs/{job['id']}", headers={"Accept": "text/html"}), home.client.get("/v1/workers")]
    assert not any(claim["lease"] in reply.text for reply in told)
    assert claim["lease"] not in caplog.text
    (row,) = home.sql("SELECT tasks::text AS text, lease_sha256 FROM tasks")
    assert claim["lease"] not in row["text"]
    assert row["lease_sha256"] == hashlib.sha256(claim["lease"].encode()).hexdigest()


def test_a_worker_belongs_to_the_token_that_registered_it(guarded, worker_of):
    home, job = guarded, guarded.submit()
    honest, stranger = home.worker("honest"), worker_of("stranger", "stranger")
    claim = honest.must_claim()
    stranger.id = honest.id
    body = {"kinds": ["prepare"], "wait_s": 0}
    assert stranger.home.client.post(f"/v1/workers/{honest.id}/claim", json=body).status_code == 404
    beat = {"task_id": claim["task_id"], "attempt": 1, "lease": claim["lease"], "log": "forged\n"}
    assert stranger.home.client.post(f"/v1/workers/{honest.id}/heartbeat", json=beat).status_code == 404
    assert home.sql("SELECT count(*) AS lines FROM task_logs") == [{"lines": 0}]
    honest.finish(claim)
    assert home.job(job["id"])["state"] == "active"


def test_a_namesake_of_another_token_blocks_nobody(guarded, worker_of):
    home = guarded
    job, good, helper = home.submit(), home.worker("good"), home.worker("helper")
    good.finish(good.must_claim(), tiles=4)
    namesake = worker_of("stranger", "good")
    for _ in range(2):
        namesake.fail(namesake.must_claim("render")).raise_for_status()
    assert namesake.claim() is None, "it is blocked itself"
    listed = {worker["id"]: worker for worker in home.client.get("/v1/workers").json()}
    assert listed[good.id]["blocks"] == [] and listed[good.id]["state"] == "awake"
    assert [block["job_id"] for block in listed[namesake.id]["blocks"]] == [job["id"]]
    again = worker_of("stranger", "good")
    assert again.claim() is None, "a restart under the same token is no remedy"
    assert good.must_claim("render")["job_id"] == job["id"] and helper.must_claim("render")
    home.client.delete(f"/v1/workers/{namesake.id}/blocks").raise_for_status()
    assert again.must_claim("render")["job_id"] == job["id"]


def test_a_token_registers_so_many_workers(start, make_worker):
    with start(tokens=(token_entry("stranger"),), limits=Limits(reserve_bytes=0, workers=3)) as home:
        stranger = Stranger(home)
        mine = home.worker("mine")
        first, *_ = [make_worker(stranger, f"w{number}") for number in range(3)]
        refused = stranger.client.post("/v1/workers", json=first.registration)
        assert refused.status_code == 429 and refused.headers["Retry-After"] == "60"
        assert refused.json()["where"] == "limits.workers" and "stranger" in refused.json()["detail"]
        assert home.worker("another") and mine.claim() is None, "other tokens have their own"
        gone = "UPDATE workers SET seen = now() - make_interval(secs => %s) WHERE id = %s"
        home.sql(gone, OFFLINE_S + 1, first.id)
        newest = make_worker(stranger, "new")
        body = {"kinds": ["prepare"], "wait_s": 0}
        assert stranger.client.post(f"/v1/workers/{first.id}/claim", json=body).status_code == 404, "it made room"
        assert newest.claim() is None
        stranger.client.close()


def test_workers_long_gone_are_forgotten_and_their_work_is_not(start, fast, eventually):
    with start(timing=fast) as home:
        check_forgotten(home, eventually)


def check_forgotten(home, eventually):
    job, old, busy = home.submit(), home.worker("old"), home.worker("busy")
    old.finish(old.must_claim(), tiles=2)
    claim = busy.must_claim("render")
    home.sql("UPDATE tasks SET heartbeat = now() + interval '1 hour' WHERE state = 'active'")
    home.sql("UPDATE workers SET seen = now() - make_interval(secs => %s)", FORGOTTEN_S + 60)
    eventually(lambda: [row["id"] for row in home.sql("SELECT id FROM workers")] == [busy.id])
    (prepared,) = home.tasks(job["id"], kind="prepare")
    assert prepared["worker"] == "old"
    completed = next(event for event in home.events(job["id"]) if event["kind"] == "task.completed")
    assert completed["actor"] == f"worker:{old.id}"
    page = home.client.get(f"/tasks/{prepared['id']}", headers={"Accept": "text/html"})
    assert page.status_code == 200 and "old" in page.text
    busy.finish(claim)
    metrics = home.client.get("/v1/metrics")
    assert 'lightkiln_task_seconds_count{kind="prepare"} 1.0' in metrics.text
