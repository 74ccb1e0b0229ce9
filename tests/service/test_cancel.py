"""Canceling a job in each state."""


def cancel(home, job):
    return home.client.post(f"/v1/jobs/{job['id']}/cancel")


def test_a_job_that_nobody_works_on_is_canceled_at_once(home):
    job = home.submit()
    assert cancel(home, job).json()["state"] == "canceled"
    assert home.worker().claim() is None
    kinds = home.kinds_of_events(job["id"])
    assert kinds == ["job.created", "tasks.planned", "job.cancel-requested", "tasks.canceled", "job.canceled"]
    assert cancel(home, job).json()["state"] == "canceled", "asking twice is no error"


def test_running_tasks_are_told_to_stop(home):
    job, worker = home.submit(), home.worker()
    worker.finish(worker.must_claim(), tiles=3)
    claims = [worker.must_claim("render") for _ in range(2)]
    assert cancel(home, job).json()["state"] == "cancel-requested"
    assert worker.beat(claims[0]) == {"stop": True, "reason": "the job is cancel-requested"}
    assert home.job(job["id"])["state"] == "cancel-requested", "one task still runs"
    assert worker.fail(claims[1]).status_code == 204
    assert home.job(job["id"])["state"] == "canceled"
    states = {task["state"] for task in home.tasks(job["id"]) if task["kind"] != "prepare"}
    assert states == {"canceled"}


def test_a_result_that_comes_too_late_is_refused(home, result):
    job, worker = home.submit(), home.worker()
    claim = worker.must_claim()
    cancel(home, job)
    refused = worker.commit(claim, result(home, claim))
    assert refused.status_code == 409 and refused.json()["code"] == "stale-attempt"
    assert home.job(job["id"])["state"] == "canceled"


def test_lost_workers_do_not_hold_up_a_cancel(start, fast, eventually):
    with start(timing=fast) as home:
        job = home.submit()
        home.worker().must_claim()
        cancel(home, job)
        eventually(lambda: home.job(job["id"])["state"] == "canceled")


def test_what_is_over_cannot_be_canceled(home):
    job, worker = home.submit(), home.worker()
    worker.fail(worker.must_claim(), retryable=False).raise_for_status()
    refused = cancel(home, job)
    assert refused.status_code == 409 and "failed already" in refused.json()["detail"]
    assert home.client.post("/v1/jobs/none/cancel").status_code == 404
