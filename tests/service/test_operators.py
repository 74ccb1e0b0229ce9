"""What operators do: tokens that come and go, orders to workers, the record, metrics."""

import time
from concurrent.futures import ThreadPoolExecutor

import httpx
import pytest
from prometheus_client.parser import text_string_to_metric_families

from kiln_service import auth
from kiln_service.config import Timing


def make(home, name="ci", scopes=("submit",)):
    return home.client.post("/v1/tokens", json={"name": name, "scopes": list(scopes)})


def asked(home, token, method="GET", path="/v1/jobs"):
    return httpx.request(method, home.url + path, headers={"Authorization": f"Bearer {token}"}).status_code


def test_a_token_allows_its_scopes_until_it_is_revoked(home, monkeypatch, eventually):
    monkeypatch.setattr(auth, "MEMORY_S", 0.1)
    made = make(home, scopes=("read", "submit")).json()
    token = made["token"]
    assert made["scopes"] == ["read", "submit"] and made["created_by"] == "client:owner" and len(token) >= 43
    assert asked(home, token) == 200 and asked(home, token, "POST", "/v1/workers") == 403
    assert asked(home, token, "GET", "/v1/tokens") == 403
    (listed,) = home.client.get("/v1/tokens").json()
    assert listed["name"] == "ci" and listed["used"] is not None and "token" not in listed
    assert token not in str(home.sql("SELECT * FROM tokens"))
    assert home.client.delete("/v1/tokens/ci").status_code == 204
    eventually(lambda: asked(home, token) == 401)
    assert home.client.delete("/v1/tokens/ci").status_code == 404


def test_a_revoked_token_is_remembered_for_two_seconds_at_most(home):
    token = make(home, scopes=("read",)).json()["token"]
    assert asked(home, token) == 200
    home.client.delete("/v1/tokens/ci").raise_for_status()
    time.sleep(auth.MEMORY_S + 0.1)
    assert asked(home, token) == 401


def test_what_is_done_with_a_token_bears_its_name(home):
    token = make(home, "build-server").json()["token"]
    job = httpx.post(f"{home.url}/v1/jobs", json=home.request(), headers={"Authorization": f"Bearer {token}"}).json()
    assert job["submitter"] == "build-server"
    assert home.events(job["id"])[0]["actor"] == "client:build-server"


@pytest.mark.parametrize("name", ["owner", "ci"])
def test_names_are_taken_once(home, name):
    make(home, "ci").raise_for_status()
    refused = make(home, name)
    assert refused.status_code == 409 and name in refused.json()["detail"]


@pytest.mark.parametrize(
    "body",
    [
        {"name": "", "scopes": ["read"]},
        {"name": "a b", "scopes": ["read"]},
        {"name": "x" * 65, "scopes": ["read"]},
        {"name": "a", "scopes": []},
        {"name": "a", "scopes": ["root"]},
        {"name": "a"},
    ],
)
def test_tokens_that_are_refused(shared, body):
    assert shared.client.post("/v1/tokens", json=body).status_code == 422


def test_a_sleeping_worker_takes_nothing_until_it_is_woken(home):
    home.submit()
    worker = home.worker("night")

    def order(word):
        return home.client.post(f"/v1/workers/{worker.id}/orders/{word}").status_code

    assert order("sleep") == 204 and worker.claim() is None
    (view,) = home.client.get("/v1/workers").json()
    assert (view["name"], view["state"], view["task"]) == ("night", "asleep", None)
    assert order("wake") == 204
    claim = worker.must_claim()
    (view,) = home.client.get("/v1/workers").json()
    assert (view["state"], view["task"], view["job_id"]) == ("awake", "prepare scene", claim["job_id"])
    assert order("dance") == 422
    assert home.client.post("/v1/workers/none/orders/sleep").status_code == 404


def test_a_drained_worker_finishes_its_task_and_is_told_to_leave(home):
    home.submit()
    worker = home.worker()
    claim = worker.must_claim()
    home.client.post(f"/v1/workers/{worker.id}/orders/drain").raise_for_status()
    assert home.client.get("/v1/workers").json()[0]["state"] == "draining"
    assert worker.beat(claim) == {"stop": False, "reason": ""}
    worker.finish(claim)
    refused = home.client.post(f"/v1/workers/{worker.id}/claim", json={"kinds": ["render"], "wait_s": 5})
    assert refused.status_code == 409 and refused.json()["code"] == "drained"
    home.sql("UPDATE workers SET seen = now() - interval '2 minutes'")
    assert home.client.get("/v1/workers").json()[0]["state"] == "offline"


def test_a_worker_that_waits_hears_its_orders_at_once(start):
    """Not when its long poll ends, nor when it would look again by itself."""
    with (
        start(timing=Timing(heartbeat_s=0.2, stale_s=600, poll_s=60, maintenance_s=0.3)) as home,
        ThreadPoolExecutor() as threads,
    ):
        worker, other = home.worker("one"), home.worker("other")
        body = {"kinds": ["render"], "wait_s": 20}
        waiting = threads.submit(home.client.post, f"/v1/workers/{worker.id}/claim", json=body)
        others = threads.submit(other.claim, "render", wait_s=3)
        time.sleep(1)
        began = time.monotonic()
        home.client.post(f"/v1/workers/{worker.id}/orders/drain").raise_for_status()
        assert waiting.result().status_code == 409 and time.monotonic() - began < 10
        assert others.result() is None, "the order is not theirs"


def test_a_worker_of_another_version_is_refused(shared):
    registration = {"name": "old", "kinds": ["render"], "memory_bytes": 1, "threads": 1, "device": "", "version": "0"}
    refused = shared.client.post("/v1/workers", json=registration)
    assert refused.status_code == 409 and "lightkiln 0, the coordinator" in refused.json()["detail"]


def test_the_record_tells_who_did_what_and_cannot_be_changed(home):
    make(home, "ci").raise_for_status()
    worker = home.worker("w1")
    home.client.post(f"/v1/workers/{worker.id}/orders/drain").raise_for_status()
    home.client.delete("/v1/tokens/ci").raise_for_status()
    entries = home.client.get("/v1/audit").json()
    assert [(entry["action"], entry["target"]) for entry in entries] == [
        ("token.revoked", "ci"),
        ("worker.drain", "w1"),
        ("token.created", "ci"),
    ]
    assert {entry["actor"] for entry in entries} == {"client:owner"}
    assert [entry["id"] for entry in home.client.get("/v1/audit", params={"before": entries[0]["id"]}).json()] == [
        entry["id"] for entry in entries[1:]
    ]
    with pytest.raises(Exception, match="append-only"):
        home.sql("DELETE FROM audit")


def test_a_histogram_counts_a_task_at_its_bound_and_beyond_the_last(home):
    job, worker = home.submit(), home.worker()
    worker.finish(worker.must_claim(), tiles=3)
    for seconds in (5.0, 5.1, 1e6):
        claim = worker.must_claim("render")
        result = {"kind": "render", "tile": claim["payload"]["tile"], "paths": 1, "overflows": 0, "invalid": 0}
        assert worker.commit(claim, result | {"seconds": seconds}).status_code == 204
    families = text_string_to_metric_families(home.client.get("/v1/metrics").text)
    (family,) = [family for family in families if family.name == "lightkiln_task_seconds"]
    counted = {s.labels["le"]: s.value for s in family.samples if s.labels.get("le") and s.labels["kind"] == "render"}
    bounds = ("1.0", "5.0", "15.0", "60.0", "300.0", "900.0", "3600.0", "14400.0", "+Inf")
    assert [counted[bound] for bound in bounds] == [0, 1, 2, 2, 2, 2, 2, 2, 3]
    assert job["state"] == "queued"


def test_metrics_tell_what_the_farm_does(home):
    job = home.submit()
    worker = home.worker()
    worker.finish(worker.must_claim(), tiles=3)
    worker.finish(worker.must_claim("render"))
    worker.fail(worker.must_claim("render")).raise_for_status()
    reply = home.client.get("/v1/metrics")
    assert reply.headers["content-type"].startswith("text/plain")
    families = list(text_string_to_metric_families(reply.text))
    assert len({family.name for family in families}) == len(families)
    assert all(family.documentation and family.type in ("gauge", "counter", "histogram") for family in families)
    assert all(s.name.endswith("_total") for f in families if f.type == "counter" for s in f.samples)
    found = {(s.name, *sorted(s.labels.values())): s.value for family in families for s in family.samples}
    assert found["lightkiln_tasks", "queued", "render"] == found["lightkiln_tasks", "render", "soft-failed"] == 1
    assert found["lightkiln_tasks", "render", "waiting"] == 0
    assert found["lightkiln_task_seconds_count", "render"] == 1
    assert found["lightkiln_task_seconds_sum", "prepare"] == 0.5
    assert [found["lightkiln_task_seconds_bucket", le, "prepare"] for le in ("1.0", "5.0", "+Inf")] == [1, 1, 1]
    assert found["lightkiln_task_seconds_count", "prepare"] == 1 and found["lightkiln_task_seconds_count", "fit"] == 0
    size = home.job(job["id"])["settings"]["render"]["image_size"]
    assert found["lightkiln_store_bytes",] == 5 * size * size * 6
    assert found["lightkiln_request_seconds_count", "/v1/jobs", "2xx", "POST"] == 1
    assert found["lightkiln_request_seconds_bucket", "+Inf", "/v1/jobs", "2xx", "POST"] == 1
    assert (found["lightkiln_rendered_texels_total",], found["lightkiln_traced_paths_total",]) == (5, 10)
    assert found["lightkiln_attempts_without_result_total", "failed"] == 1
    assert found["lightkiln_jobs", "active"] == 1 and found["lightkiln_workers", "awake"] == 1
    assert found["lightkiln_blob_bytes",] > 0
