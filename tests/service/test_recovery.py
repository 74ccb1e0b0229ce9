"""Lost workers and failing tasks."""

import time
from collections import Counter

from kiln_service.config import FailedTasks


def attempts(home, job):
    return [(task["state"], task["attempt"]) for task in home.tasks(job["id"])]


def test_a_task_whose_worker_is_gone_goes_to_another(start, fast, eventually):
    with start(timing=fast) as home:
        job, gone, other = home.submit(), home.worker("gone"), home.worker("other")
        lost = gone.must_claim()
        eventually(lambda: attempts(home, job) == [("soft-failed", 1)])
        claim = other.must_claim()
        assert claim["task_id"] == lost["task_id"] and claim["attempt"] == 2
        assert "task.lost" in home.kinds_of_events(job["id"])
        assert gone.beat(lost)["stop"] is True


def test_a_heartbeat_keeps_a_task(start, fast):
    with start(timing=fast) as home:
        job, worker = home.submit(), home.worker()
        claim = worker.must_claim()
        for _ in range(12):
            time.sleep(fast.stale_s / 4)
            assert worker.beat(claim)["stop"] is False
        assert attempts(home, job) == [("active", 1)]


def test_beating_for_one_task_does_not_keep_another(start, fast, eventually):
    with start(timing=fast) as home:
        first, second, worker = home.submit(), home.submit(), home.worker()
        worker.must_claim()
        held = worker.must_claim()
        eventually(lambda: worker.beat(held) and attempts(home, first) == [("soft-failed", 1)])
        assert attempts(home, second) == [("active", 1)]


def test_a_task_that_is_lost_too_often_fails_with_its_log(start, fast, eventually):
    with start(timing=fast, max_attempts=2) as home:
        job = home.submit()
        for attempt in (1, 2):
            worker = home.worker()
            claim = worker.must_claim(wait_s=10)
            assert claim["attempt"] == attempt
            worker.beat(claim, log=f"about to crash {attempt}\n")
        eventually(lambda: home.job(job["id"])["state"] == "failed")
        error = home.job(job["id"])["error"]
        assert "about to crash 2" in error["detail"] and error["where"] == "prepare scene" and error["remedy"]


def test_retryable_failures_are_capped(start):
    with start(max_attempts=3) as home:
        job, worker = home.submit(), home.worker()
        for state in ("soft-failed", "soft-failed", "failed"):
            worker.fail(worker.must_claim()).raise_for_status()
            assert home.tasks(job["id"])[0]["state"] == state
        assert home.job(job["id"])["error"]["detail"] == "it broke"


def test_a_checkpoint_clears_the_strikes(start):
    with start(max_attempts=2) as home:
        job, worker = home.submit(), home.worker()
        worker.advance(job["id"], "fit")
        for step in range(4):
            claim = worker.must_claim()
            worker.checkpoint(claim, f"step {step}".encode()).raise_for_status()
            worker.fail(claim).raise_for_status()
        assert home.tasks(job["id"], kind="fit")[0]["state"] == "soft-failed"
        for state in ("failed",):
            worker.fail(worker.must_claim()).raise_for_status()
            assert home.tasks(job["id"], kind="fit")[0]["state"] == state


def test_a_worker_that_leaves_in_good_order_is_no_strike(start):
    with start(max_attempts=2) as home:
        job, worker = home.submit(), home.worker()
        for _ in range(5):
            worker.fail(worker.must_claim(), code="canceled", status=409).raise_for_status()
        assert attempts(home, job) == [("queued", 5)]


def test_an_input_error_is_final(home):
    job, worker = home.submit(), home.worker()
    worker.fail(worker.must_claim(), code="input", status=422, retryable=True).raise_for_status()
    failed = home.job(job["id"])
    assert failed["state"] == "failed" and failed["error"]["code"] == "input"


def test_a_failed_task_leaves_the_others_to_go_on(home):
    job, worker = home.submit(), home.worker()
    worker.finish(worker.must_claim(), tiles=4)
    worker.finish(worker.must_claim("render"))
    poison = worker.must_claim("render")
    worker.fail(poison, retryable=False).raise_for_status()
    assert home.job(job["id"])["state"] == "active"
    for _ in range(2):
        worker.finish(worker.must_claim("render"))
    failed = home.job(job["id"])
    assert failed["state"] == "failed" and failed["error"]["detail"] == "it broke"
    states = Counter(task["state"] for task in home.tasks(job["id"]))
    assert states == {"completed": 4, "failed": 1, "canceled": 3}, "the tiles were done, what follows was not"
    assert worker.claim() is None


def test_a_job_with_failed_tasks_can_be_mended_while_it_goes_on(home):
    job, worker = home.submit(), home.worker()
    worker.finish(worker.must_claim(), tiles=3)
    worker.finish(worker.must_claim("render"))
    worker.fail(worker.must_claim("render"), retryable=False).raise_for_status()
    home.client.post(f"/v1/jobs/{job['id']}/retry").raise_for_status()
    assert home.client.post(f"/v1/jobs/{job['id']}/retry").status_code == 409
    while claim := worker.claim():
        worker.finish(claim)
    assert home.job(job["id"])["state"] == "completed"


def test_a_job_fails_with_its_first_tile_where_nobody_else_could_do_the_others(home):
    """The only worker has no disk, say: to let every tile fail on it would take long and help nobody."""
    job, worker = home.submit(), home.worker("only")
    worker.finish(worker.must_claim(), tiles=4)
    worker.fail(worker.must_claim("render"), retryable=False).raise_for_status()
    assert home.job(job["id"])["state"] == "failed"
    other, helper = home.submit(set=["render.samples=9"]), home.worker("helper")
    worker.finish(worker.must_claim("prepare"), tiles=4)
    worker.fail(worker.must_claim("render"), retryable=False).raise_for_status()
    assert home.job(other["id"])["state"] == "active"
    while claim := helper.claim("render"):
        helper.finish(claim)
    assert home.job(other["id"])["state"] == "failed"


def test_an_input_error_of_a_tile_stops_its_job(home):
    job, worker = home.submit(), home.worker()
    worker.finish(worker.must_claim(), tiles=4)
    one, two = worker.must_claim("render"), worker.must_claim("render")
    worker.fail(one, code="input", status=422).raise_for_status()
    states = sorted(task["state"] for task in home.tasks(job["id"]) if task["kind"] != "prepare")
    assert states == ["active", *(["canceled"] * 5), "failed"]
    assert worker.claim() is None
    assert worker.beat(two) == {"stop": True, "reason": "the job is failed"}
    assert home.tasks(job["id"], state="active") == []


def test_a_job_of_which_too_many_tasks_fail_fails_at_once(start):
    with start(failed_tasks=FailedTasks(least=3, of_all=0.2)) as home:
        job, worker = home.submit(), home.worker()
        worker.finish(worker.must_claim(), tiles=16)
        worker.finish(worker.must_claim("render"))
        for state in ("active", "active", "active", "failed"):
            worker.fail(worker.must_claim("render"), retryable=False).raise_for_status()
            assert home.job(job["id"])["state"] == state
        assert worker.claim() is None


def test_a_new_coordinator_gives_workers_time_to_return(start, fast):
    with start(timing=fast.model_copy(update={"stale_s": 600})) as home:
        job, worker = home.submit(), home.worker()
        claim = worker.must_claim()
        home.sql("UPDATE tasks SET heartbeat = now() - interval '1 hour' WHERE id = %s", claim["task_id"])
    with start(timing=fast.model_copy(update={"stale_s": 300})) as home:
        worker.home = home
        assert worker.beat(claim)["stop"] is False, "its silence was the coordinator's"
        assert attempts(home, job) == [("active", 1)]
        worker.finish(claim)


def test_two_coordinators_share_the_work(start, fast, eventually):
    with start(timing=fast) as one, start(timing=fast) as two:
        job = one.submit()
        worker = two.worker()
        claim = worker.must_claim()
        assert claim["job_id"] == job["id"]
        eventually(lambda: attempts(one, job) == [("soft-failed", 1)])
        assert one.kinds_of_events(job["id"]).count("task.lost") == 1, "one reaper"
