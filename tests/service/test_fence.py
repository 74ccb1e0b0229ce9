"""The fence, idempotent commits, and the fan-in that happens once."""

import threading

import pytest


def test_a_zombie_cannot_commit(home, result):
    home.submit()
    zombie, other = home.worker("zombie"), home.worker("other")
    old = zombie.must_claim()
    zombie.fail(old).raise_for_status()
    new = other.must_claim()
    assert (old["task_id"], old["attempt"], new["attempt"]) == (new["task_id"], 1, 2)

    refused = zombie.commit(old, result(home, old))
    assert refused.status_code == 409 and refused.json()["code"] == "stale-attempt"
    assert zombie.beat(old)["stop"] is True
    assert zombie.fail(old).json()["code"] == "stale-attempt"
    assert zombie.checkpoint(old, b"c").json()["code"] == "stale-attempt"
    assert other.beat(new)["stop"] is False
    other.finish(new)


def test_the_same_commit_twice_is_no_error_and_has_no_second_effect(home, result):
    job, worker = home.submit(), home.worker()
    claim = worker.must_claim()
    document = result(home, claim)
    assert [worker.commit(claim, document).status_code for _ in range(2)] == [204, 204]
    assert len(home.tasks(job["id"], kind="render")) == 2
    other = worker.commit(claim, document | {"triangles": 99})
    assert other.status_code == 409 and other.json()["code"] == "stale-attempt"


@pytest.mark.parametrize("tiles", [2, 12])
def test_concurrent_commits_of_the_last_tiles_fan_in_once(home, result, tiles):
    job, worker = home.submit(), home.worker()
    worker.finish(worker.must_claim(), tiles=tiles, has_environment=True)
    claims = [worker.must_claim("render") for _ in range(tiles)]
    gate, codes = threading.Barrier(2 * tiles), []

    def commit(claim):
        document = result(home, claim)
        gate.wait()
        codes.append(worker.commit(claim, document).status_code)

    threads = [threading.Thread(target=commit, args=(claim,)) for claim in claims for _ in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert codes == [204] * 2 * tiles
    assert [task["state"] for task in home.tasks(job["id"], kind="fit")] == ["queued", "queued"]
    kinds = home.kinds_of_events(job["id"])
    assert kinds.count("stage.completed") == 2 and kinds.count("tasks.queued") == 1
    assert kinds.count("task.completed") == 1 + tiles


def test_concurrent_claims_never_share_a_task(home):
    job, worker = home.submit(), home.worker()
    worker.finish(worker.must_claim(), tiles=16)
    workers = [home.worker(f"w{i}") for i in range(8)]
    taken = []

    def take(one):
        while (claim := one.claim("render")) is not None:
            taken.append((claim["task_id"], claim["attempt"]))

    threads = [threading.Thread(target=take, args=(one,)) for one in workers]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(taken) == len(set(taken)) == 16 and {attempt for _, attempt in taken} == {1}
    assert {task["state"] for task in home.tasks(job["id"], kind="render")} == {"active"}


def test_a_result_must_be_of_the_task(home, result):
    home.submit()
    worker = home.worker()
    claim = worker.must_claim()
    render = {"kind": "render", "tile": {"row": 0, "column": 0, "size": 8, "texels": 5}, "paths": 1}
    render |= {"overflows": 0, "invalid": 0, "seconds": 1}
    refused = worker.commit(claim, render)
    assert refused.status_code == 422 and "render" in refused.json()["detail"]
    worker.finish(claim)
    tile = worker.must_claim("render")
    wrong = result(home, tile) | {"tile": {"row": 0, "column": 8, "size": 8, "texels": 5}}
    assert worker.commit(tile, wrong).status_code == 422
    assert home.tasks(home.client.get("/v1/jobs").json()["jobs"][0]["id"], state="active")


def test_a_result_may_only_name_blobs_that_are_here(home, result):
    job, worker = home.submit(), home.worker()
    claim = worker.must_claim()
    refused = worker.commit(claim, result(home, claim) | {"texel_map": "e" * 64})
    assert refused.status_code == 409 and refused.json()["code"] == "conflict" and "e" * 64 in refused.json()["detail"]
    assert home.tasks(job["id"])[0]["state"] == "active", "nothing happened"
    assert worker.commit(claim, result(home, claim)).status_code == 204


def test_the_last_checkpoint_comes_with_the_next_claim(home):
    job, worker = home.submit(), home.worker()
    worker.advance(job["id"], "fit")
    claim = worker.must_claim()
    assert claim["checkpoint"] is None
    worker.checkpoint(claim, b"step 100").raise_for_status()
    worker.checkpoint(claim, b"step 200").raise_for_status()
    worker.fail(claim).raise_for_status()
    again = worker.must_claim()
    assert home.client.get(f"/v1/blobs/{again['checkpoint']}").content == b"step 200"
    owners = home.sql("SELECT sha256 FROM blob_uses WHERE owner LIKE 'checkpoint:%%'")
    assert [row["sha256"] for row in owners] == [again["checkpoint"]]
    worker.finish(again)
    assert home.sql("SELECT sha256 FROM blob_uses WHERE owner LIKE 'checkpoint:%%'") == []


def test_unknown_workers_and_tasks_are_not_found(home):
    worker = home.worker()
    worker.id = "nobody"
    reply = home.client.post("/v1/workers/nobody/claim", json={"kinds": ["render"], "wait_s": 0})
    assert reply.status_code == 404 and "Register" in reply.json()["remedy"]
    assert home.client.post("/v1/tasks/none/fail", json={}).status_code == 422
    body = {"attempt": 1, "sha256": "0" * 64}
    assert home.client.post("/v1/tasks/none/checkpoint", json=body).status_code == 404
