"""What people do with jobs: pause, resume, retry, archive, rank, label, find; and one job for a request sent twice."""

import pytest


def act(home, job, action):
    return home.client.post(f"/v1/jobs/{job['id']}/{action}")


def states(home, job, kind):
    return [task["state"] for task in home.tasks(job["id"], kind=kind)]


def test_a_paused_job_gives_nothing_out_and_goes_on_where_it_was(home):
    job, worker = home.submit(), home.worker()
    worker.finish(worker.must_claim(), tiles=3)
    running = worker.must_claim("render")
    assert act(home, job, "pause").json()["state"] == "paused"
    assert act(home, job, "pause").status_code == 200, "asking twice is no error"
    assert worker.claim() is None
    assert worker.beat(running) == {"stop": False, "reason": ""}, "what runs goes on"
    worker.finish(running)
    assert sorted(states(home, job, "render")) == ["completed", "queued", "queued"]
    assert act(home, job, "resume").json()["state"] == "active"
    assert act(home, job, "resume").status_code == 200
    while (claim := worker.claim()) is not None:
        worker.finish(claim)
    assert home.job(job["id"])["state"] == "completed"


def test_a_job_is_paused_before_it_began(home):
    job = home.submit()
    act(home, job, "pause").raise_for_status()
    assert home.worker().claim() is None
    assert act(home, job, "resume").json()["state"] == "queued"
    assert home.worker().claim() is not None


def test_a_stage_that_ends_during_a_pause_does_not_start_the_next(home):
    job, worker = home.submit(), home.worker()
    claim = worker.must_claim()
    act(home, job, "pause").raise_for_status()
    worker.finish(claim, tiles=2)
    assert states(home, job, "render") == ["queued", "queued"] and worker.claim() is None
    act(home, job, "resume").raise_for_status()
    assert worker.must_claim()["payload"]["kind"] == "render"


def test_an_attempt_that_fails_during_a_pause_is_tried_again_after_it(home):
    job, worker = home.submit(), home.worker()
    claim = worker.must_claim()
    act(home, job, "pause").raise_for_status()
    worker.fail(claim).raise_for_status()
    assert states(home, job, "prepare") == ["soft-failed"] and worker.claim() is None
    act(home, job, "resume").raise_for_status()
    assert worker.must_claim()["attempt"] == 2


def test_a_claim_that_waits_gets_the_tasks_of_a_resumed_job(home):
    job, worker = home.submit(), home.worker()
    act(home, job, "pause").raise_for_status()
    assert worker.claim(wait_s=0.3) is None
    act(home, job, "resume").raise_for_status()
    assert worker.must_claim()


def test_a_paused_job_can_be_canceled(home):
    job = home.submit()
    act(home, job, "pause").raise_for_status()
    assert act(home, job, "cancel").json()["state"] == "canceled"


def test_a_failed_job_is_retried_with_what_it_has(home):
    job, worker = home.submit(), home.worker()
    worker.finish(worker.must_claim(), tiles=3)
    worker.finish(worker.must_claim("render"))
    worker.fail(worker.must_claim("render"), code="input", status=422, log="no luck").raise_for_status()
    assert home.job(job["id"])["state"] == "failed"
    assert sorted(states(home, job, "render")) == ["canceled", "completed", "failed"]
    view = act(home, job, "retry").json()
    assert view["state"] == "queued" and view["error"] is None and view["finished"] is None
    assert sorted(states(home, job, "render")) == ["completed", "queued", "queued"]
    assert set(states(home, job, "fit") + states(home, job, "package")) == {"waiting"}
    while (claim := worker.claim()) is not None:
        worker.finish(claim)
    assert home.job(job["id"])["state"] == "completed"
    event = next(event for event in home.events(job["id"]) if event["kind"] == "tasks.reopened")
    assert event["actor"] == "client:owner" and event["detail"] == {"count": 5, "stage": "render"}


def test_a_canceled_job_is_retried_without_its_old_checkpoint(home):
    job, worker = home.submit(), home.worker()
    worker.advance(job["id"], until="fit")
    claim = worker.must_claim("fit")
    worker.checkpoint(claim, b"half way").raise_for_status()
    act(home, job, "cancel").raise_for_status()
    assert worker.beat(claim)["stop"]
    act(home, job, "retry").raise_for_status()
    again = worker.must_claim("fit")
    assert again["attempt"] == 2 and again["checkpoint"] is None


def test_a_job_whose_input_is_wrong_is_not_retried(home, result):
    job, worker = home.submit(), home.worker()
    worker.finish(worker.must_claim(), has_light=False)
    assert home.job(job["id"])["state"] == "failed"
    refused = act(home, job, "retry")
    assert refused.status_code == 409 and "no light" in refused.json()["detail"]


@pytest.mark.parametrize(("action", "word"), [("resume", "resumed"), ("retry", "retried"), ("pause", "paused")])
def test_what_a_state_does_not_allow_is_refused(home, action, word):
    job, worker = home.submit(), home.worker()
    worker.advance(job["id"], until="package")
    worker.finish(worker.must_claim())
    refused = act(home, job, action)
    assert refused.status_code == 409 and f"completed and cannot be {word}" in refused.json()["detail"]


def test_an_archived_job_is_left_out_of_lists_and_keeps_its_package(home):
    job, worker = home.submit(), home.worker()
    assert act(home, job, "archive").status_code == 409, "it is not over"
    worker.advance(job["id"], until="package")
    worker.finish(worker.must_claim())
    finished = home.job(job["id"])["finished"]
    view = act(home, job, "archive").json()
    assert view["state"] == "archived" and view["finished"] == finished
    assert home.client.get("/v1/jobs").json()["jobs"] == []
    assert len(home.client.get("/v1/jobs", params={"state": "archived"}).json()["jobs"]) == 1
    assert len(home.client.get(f"/v1/jobs/{job['id']}/artifacts").json()) == 2


def test_the_greater_priority_goes_first_and_can_be_changed(home):
    low, middle, high = (home.submit(priority=priority, name=str(priority)) for priority in (10, 50, 90))
    worker = home.worker()
    assert worker.must_claim()["job_id"] == high["id"]
    change = home.client.patch(f"/v1/jobs/{low['id']}", json={"priority": 60})
    assert change.json()["priority"] == 60
    assert [worker.must_claim()["job_id"] for _ in range(2)] == [low["id"], middle["id"]]
    assert home.client.patch(f"/v1/jobs/{low['id']}", json={"priority": 101}).status_code == 422
    assert "job.changed" in home.kinds_of_events(low["id"])


def test_the_later_stage_goes_first_within_a_priority_only(home):
    worker = home.worker()
    first = home.submit(priority=50)
    worker.finish(worker.must_claim(), tiles=2)
    home.submit(priority=50)
    urgent = home.submit(priority=51)
    claims = [worker.must_claim() for _ in range(3)]
    assert [claim["job_id"] for claim in claims] == [urgent["id"], first["id"], first["id"]]


def test_jobs_are_found_by_label_and_name(home):
    first = home.submit(name="Kitchen day", labels={"project": "alpha", "shot": "sc010/sh020"})
    second = home.submit(name="kitchen night", labels={"project": "alpha"})
    home.submit(name="street", labels={"project": "beta"})

    def found(**query):
        return {job["id"] for job in home.client.get("/v1/jobs", params=query).raise_for_status().json()["jobs"]}

    assert found(label="project=alpha") == {first["id"], second["id"]} == found(q="KITCHEN")
    assert found(label=["project=alpha", "shot=sc010/sh020"]) == {first["id"]}
    assert found(label="project=gamma") == set() == found(q="%")
    home.client.patch(f"/v1/jobs/{second['id']}", json={"labels": {"project": "beta"}}).raise_for_status()
    assert found(label="project=alpha") == {first["id"]}
    refused = home.client.get("/v1/jobs", params={"label": "project"})
    assert refused.status_code == 422 and "KEY=VALUE" in refused.json()["remedy"]
    for labels in ({"": "x"}, {"a b": "x"}, {"k": "v" * 129}, {str(k): "v" for k in range(33)}):
        assert home.client.post("/v1/jobs", json=home.request(labels=labels)).status_code == 422


def test_a_request_sent_twice_under_a_key_makes_one_job(home):
    request, headers = home.request(), {"Idempotency-Key": "build-17"}
    first, again = (home.client.post("/v1/jobs", json=request, headers=headers) for _ in range(2))
    assert first.status_code == again.status_code == 201
    assert first.json()["id"] == again.json()["id"]
    assert len(home.client.get("/v1/jobs").json()["jobs"]) == 1
    other = home.client.post("/v1/jobs", json=request | {"name": "other"}, headers=headers)
    assert other.status_code == 422 and first.json()["id"] in other.json()["detail"]
    assert home.client.post("/v1/jobs", json=request).json()["id"] != first.json()["id"]
    assert first.json()["submitter"] == "owner"


def requeue(home, job, **wanted):
    return home.client.post(f"/v1/jobs/{job['id']}/requeue", json=wanted)


def finish_all(worker):
    while (claim := worker.claim()) is not None:
        worker.finish(claim)


def test_some_tiles_of_a_completed_job_are_done_again_and_all_that_follows(home):
    job, worker = home.submit(), home.worker()
    worker.finish(worker.must_claim(), tiles=8)
    finish_all(worker)
    assert home.job(job["id"])["state"] == "completed"
    view = requeue(home, job, kind="render", rows=[8, 16], columns=[0, 9]).json()
    assert view["state"] == "queued" and view["finished"] is None
    again = [task["label"] for task in home.tasks(job["id"], kind="render", state="queued")]
    assert again == ["tile 8,0", "tile 8,8"], "tiles of 8 texels, two rows of four"
    assert set(states(home, job, "fit") + states(home, job, "refine") + states(home, job, "package")) == {"waiting"}
    assert home.client.get(f"/v1/jobs/{job['id']}/artifacts").json() == []
    finish_all(worker)
    assert home.job(job["id"])["state"] == "completed"
    assert len(home.client.get(f"/v1/jobs/{job['id']}/artifacts").json()) == 2
    assert "tasks.requeued" in home.kinds_of_events(job["id"])


def test_a_worker_of_a_task_that_is_requeued_has_to_stop(home):
    job, worker = home.submit(), home.worker()
    worker.advance(job["id"], until="fit")
    fit = worker.must_claim("fit")
    requeue(home, job, kind="render").raise_for_status()
    assert worker.beat(fit)["stop"] is True
    assert worker.commit(fit, {}).status_code == 422
    finish_all(worker)
    assert home.job(job["id"])["state"] == "completed"


def test_what_is_not_done_yet_is_not_requeued(home):
    job, worker = home.submit(), home.worker()
    worker.finish(worker.must_claim(), tiles=2)
    refused = requeue(home, job, kind="fit")
    assert refused.status_code == 409 and "not done yet" in refused.json()["detail"]
    refused = requeue(home, job, kind="render", rows=[100, 200])
    assert refused.status_code == 422 and "none of the 2 render tasks" in refused.json()["detail"]
    assert requeue(home, job, kind="prepare").status_code == 422
    act(home, job, "cancel").raise_for_status()
    assert requeue(home, job, kind="render").status_code == 409


def test_a_log_is_followed_to_its_end(home):
    home.submit()
    worker = home.worker()
    claim = worker.must_claim()
    worker.beat(claim, log="one\ntwo\n")
    url = f"/v1/tasks/{claim['task_id']}/log"
    assert home.client.get(url, params={"tail": 1}).text == "two\n"
    assert home.client.get(url, params={"tail": 0}).text == ""
    pieces = []
    with home.client.stream("GET", url, params={"follow": True, "tail": 2}) as stream:
        for piece in stream.iter_text():
            pieces.append(piece)
            if len(pieces) == 1:
                worker.beat(claim, log="three\n")
            elif "three" in piece:
                worker.finish(claim)
    assert "".join(pieces) == "one\ntwo\nthree\n"
    assert home.client.get("/v1/tasks/none/log", params={"follow": True}).status_code == 404


def test_an_archived_job_tells_how_it_ended(home):
    completed, canceled, worker = home.submit(), home.submit(), home.worker()
    act(home, canceled, "cancel").raise_for_status()
    finish_all(worker)
    for job, outcome in ((completed, "completed"), (canceled, "canceled")):
        assert home.job(job["id"])["outcome"] == outcome
        assert act(home, job, "archive").json()["outcome"] == outcome


def test_a_job_that_is_done_again_has_not_ended(home):
    job, worker = home.submit(), home.worker()
    finish_all(worker)
    requeue(home, job, kind="package").raise_for_status()
    assert home.job(job["id"])["outcome"] is None
