"""Lost workers, failing tasks, a damaged queue."""

import time


def attempts(home, job):
    return [(task["state"], task["attempt"]) for task in home.tasks(job["id"])]


def test_a_task_whose_worker_is_gone_goes_to_another(start, fast, eventually):
    with start(timing=fast) as home:
        job, gone, other = home.submit(), home.worker("gone"), home.worker("other")
        lost = gone.must_claim()
        eventually(lambda: attempts(home, job) == [("queued", 1)])
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
        eventually(lambda: worker.beat(held) and attempts(home, first) == [("queued", 1)])
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
        for state in ("queued", "queued", "failed"):
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
        assert home.tasks(job["id"], kind="fit")[0]["state"] == "queued"
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


def test_a_failed_task_stops_its_job(home):
    job, worker = home.submit(), home.worker()
    worker.finish(worker.must_claim(), tiles=4)
    one, two = worker.must_claim("render"), worker.must_claim("render")
    worker.fail(one, retryable=False).raise_for_status()
    states = sorted(task["state"] for task in home.tasks(job["id"]) if task["kind"] != "prepare")
    assert states == ["active", *(["canceled"] * 5), "failed"]
    assert worker.claim() is None
    assert worker.beat(two) == {"stop": True, "reason": "the job is failed"}
    assert home.tasks(job["id"], state="active") == []
    assert home.sql("SELECT count(*) AS left FROM procrastinate_jobs") == [{"left": 0}]


def test_a_queued_task_without_a_queue_job_is_deferred_again(home, eventually):
    job = home.submit()
    home.sql("DELETE FROM procrastinate_jobs")
    worker = home.worker()
    claim = worker.must_claim(wait_s=10)
    assert claim["job_id"] == job["id"]
    home.sql("DELETE FROM procrastinate_jobs")
    worker.finish(claim)
    assert home.tasks(job["id"])[0]["state"] == "completed", "a commit does not need its queue job"


def test_a_queue_job_without_a_queued_task_is_dropped(home, eventually):
    job = home.submit()
    home.client.post(f"/v1/jobs/{job['id']}/cancel").raise_for_status()
    task = home.tasks(job["id"])[0]["id"]
    home.sql(
        "INSERT INTO procrastinate_jobs (queue_name, task_name, args)"
        " VALUES ('prepare', 'kiln.task', jsonb_build_object('task_id', %s::text))",
        task,
    )
    assert home.worker().claim() is None
    eventually(lambda: home.sql("SELECT count(*) AS left FROM procrastinate_jobs") == [{"left": 0}])
    assert home.tasks(job["id"])[0]["state"] == "canceled"


def test_a_new_coordinator_gives_workers_time_to_return(start, fast):
    with start(timing=fast.model_copy(update={"stale_s": 600})) as home:
        job, worker = home.submit(), home.worker()
        claim = worker.must_claim()
    time.sleep(1.2)
    with start(timing=fast.model_copy(update={"stale_s": 1.0})) as home:
        time.sleep(0.5)
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
        eventually(lambda: attempts(one, job) == [("queued", 1)])
        assert one.kinds_of_events(job["id"]).count("task.lost") == 1, "one reaper"
