"""A job from its submission to its artifacts, and what clients see of it on the way."""

import json
import socket
import threading
import time

import httpx


def test_a_job_runs_through_all_stages(home):
    job = home.submit()
    assert job["state"] == "queued" and [s["kind"] for s in job["stages"]] == ["prepare"]
    worker = home.worker()

    claim = worker.must_claim()
    payload = claim["payload"]
    assert payload["kind"] == "prepare" and payload["bundle"] == job["bundle"]
    assert payload["store_url"].startswith("file://") and job["id"] in payload["store_url"]
    assert home.job(job["id"])["state"] == "active"
    worker.finish(claim, tiles=3, has_environment=True)

    states = {(task["kind"], task["state"]) for task in home.tasks(job["id"])}
    later = {(kind, "waiting") for kind in ("fit", "refine", "package")}
    assert states == {("prepare", "completed"), ("render", "queued"), *later}
    renders = [worker.must_claim() for _ in range(3)]
    assert worker.claim() is None, "fits wait for the last tile"
    assert [claim["payload"]["tile"]["column"] for claim in renders] == [0, 8, 16]
    for claim in renders:
        worker.finish(claim)

    fits = [worker.must_claim(), worker.must_claim()]
    assert [claim["payload"]["function"] for claim in fits] == ["light_field", "visibility"]
    assert [len(claim["payload"]["renders"]) for claim in fits] == [3, 3]
    for claim in fits:
        worker.finish(claim)

    refine = worker.must_claim()
    payload = refine["payload"]
    assert worker.claim() is None, "the package waits for the last block"
    assert payload["block"] == {"row": 0, "column": 0, "size": 32} and len(payload["between"]) == 3
    assert [fit["function"] for fit in payload["fits"]] == ["light_field", "visibility"]
    assert len(payload["renders"]) == 3
    elsewhere = {"row": 32, "column": 0, "size": 32}
    wrong = {"kind": "refine", "block": elsewhere, "lobes": "0" * 64, "texels": 1, "steps": 1, "seconds": 1.0}
    refused = worker.commit(refine, wrong)
    assert refused.status_code == 422 and "block" in refused.json()["detail"]
    worker.finish(refine)

    claim = worker.must_claim()
    assert [result["block"]["row"] for result in claim["payload"]["refines"]] == [0]
    assert claim["payload"]["job_id"] == job["id"] and len(claim["payload"]["fits"]) == 2
    assert home.client.get(f"/v1/jobs/{job['id']}/artifacts").json() == []
    worker.finish(claim)

    done = home.job(job["id"])
    assert done["state"] == "completed" and done["finished"] and done["remaining_s"] is None
    assert done["notes"] == ["unwrapped"]
    assert {s["kind"]: (s["total"], s["completed"], s["fraction"]) for s in done["stages"]} == {
        "prepare": (1, 1, 1.0),
        "render": (3, 3, 1.0),
        "fit": (2, 2, 1.0),
        "refine": (1, 1, 1.0),
        "package": (1, 1, 1.0),
    }
    names = [artifact["name"] for artifact in home.client.get(f"/v1/jobs/{job['id']}/artifacts").json()]
    assert names == ["lightfield.ktx2", "shaders/light.glsl"]


def test_a_block_gets_the_tiles_around_it(home):
    """Tiles at columns 0, 8, 16 and 24: the first block of 16 texels needs none of the last, whose halo is 4."""
    job, worker = home.submit(set=["fit.block=16"]), home.worker()
    worker.advance(job["id"], "refine", tiles=4)
    blocks = [worker.must_claim()["payload"] for _ in range(2)]
    columns = {b["block"]["column"]: [r["tile"]["column"] for r in b["renders"]] for b in blocks}
    assert columns == {0: [0, 8, 16], 16: [8, 16, 24]}


def test_the_networks_lobes_may_be_final(home):
    """Without refine tasks the package follows the last fit."""
    job, worker = home.submit(set=["fit.solver=cnn"]), home.worker()
    worker.advance(job["id"], "package")
    assert home.tasks(job["id"], kind="refine") == []
    claim = worker.must_claim()
    assert claim["payload"]["refines"] == []
    worker.finish(claim)
    assert home.job(job["id"])["state"] == "completed"


def test_without_an_environment_there_is_no_visibility_to_fit(home):
    job, worker = home.submit(), home.worker()
    worker.advance(job["id"], "fit")
    assert [task["label"] for task in home.tasks(job["id"], kind="fit")] == ["light_field"]


def test_progress_and_estimate(home):
    job, worker = home.submit(), home.worker()
    assert home.job(job["id"])["remaining_s"] is None
    claim = worker.must_claim()
    worker.beat(claim, progress={"done": 1, "total": 4, "unit": "meshes"})
    home.sql("UPDATE tasks SET started = now() - interval '10 s' WHERE state = 'active'")
    view = home.job(job["id"])
    assert view["stages"][0]["fraction"] == 0.25
    assert 29 < view["remaining_s"] < 40, "10 s for a quarter leave 30 s"
    task = home.tasks(job["id"])[0]
    assert task["progress"]["unit"] == "meshes" and task["worker"] == "w"


def test_kinds_are_respected_and_waiting_claims_are_woken(home):
    worker = home.worker()
    home.submit()
    assert worker.claim("render", "fit") is None
    assert worker.claim("prepare") is not None


def test_a_waiting_claim_gets_the_task_that_comes(home):
    worker, got = home.worker(), []
    thread = threading.Thread(target=lambda: got.append((worker.claim(wait_s=20), time.monotonic())))
    thread.start()
    time.sleep(0.3)
    submitted = time.monotonic()
    home.submit()
    thread.join()
    claim, at = got[0]
    assert claim["payload"]["kind"] == "prepare" and at - submitted < 5


def test_a_worker_that_hung_up_is_given_nothing(home):
    gone, other = home.worker("gone"), home.worker("other")
    body = json.dumps({"kinds": ["prepare"], "wait_s": 30})
    address = httpx.URL(home.url)
    with socket.create_connection((address.host, address.port)) as connection:
        connection.sendall(
            f"POST /v1/workers/{gone.id}/claim HTTP/1.1\r\nHost: x\r\nAuthorization: Bearer {home.token}\r\n"
            f"Content-Type: application/json\r\nContent-Length: {len(body)}\r\n\r\n{body}".encode()
        )
        time.sleep(0.3)
    home.submit()
    time.sleep(0.3)
    assert other.must_claim()["attempt"] == 1


def test_jobs_are_paged_and_filtered(home):
    ids = [home.submit(name=f"job {i}")["id"] for i in range(5)]
    home.client.post(f"/v1/jobs/{ids[2]}/cancel").raise_for_status()
    seen, cursor = [], None
    while True:
        page = home.client.get("/v1/jobs", params={"limit": 2} | ({"cursor": cursor} if cursor else {})).json()
        seen += [job["id"] for job in page["jobs"]]
        cursor = page["next"]
        if cursor is None:
            break
    assert seen == ids[::-1]
    canceled = home.client.get("/v1/jobs", params={"state": "canceled"}).json()
    assert [job["id"] for job in canceled["jobs"]] == [ids[2]]


def test_later_stages_go_first(home):
    older, worker = home.submit(), home.worker()
    worker.advance(older["id"], "fit")
    home.submit()
    assert worker.must_claim()["payload"]["kind"] == "fit"


def test_nothing_to_bake_fails_the_job_with_a_sentence(home):
    for choices, word in (({"tiles": 0}, "no texel"), ({"has_light": False}, "no light")):
        job, worker = home.submit(), home.worker()
        worker.finish(worker.must_claim(), **choices)
        failed = home.job(job["id"])
        assert failed["state"] == "failed" and word in failed["error"]["detail"] and failed["error"]["remedy"]


def test_tasks_keep_their_log(home):
    home.submit()
    worker = home.worker()
    claim = worker.must_claim()
    worker.beat(claim, log="reading\n")
    worker.fail(claim, log="boom").raise_for_status()
    again = worker.must_claim()
    worker.beat(again, log="second try")
    log = home.client.get(f"/v1/tasks/{claim['task_id']}/log").text
    assert log == "--- attempt 1\nreading\nboom\n--- attempt 2\nsecond try\n"
