"""Loss curves: what running attempts tell, thinned, until the result has the whole curve."""


def told(home, job):
    (curve,) = home.client.get(f"/v1/jobs/{job}/curves").raise_for_status().json()
    return curve


def test_a_curve_grows_with_heartbeats_and_ends_as_the_result_has_it(home):
    job = home.submit()["id"]
    worker = home.worker()
    assert home.client.get(f"/v1/jobs/{job}/curves").json() == []
    worker.advance(job, "fit")
    assert told(home, job)["points"] == [] and told(home, job)["state"] == "queued"
    fit = worker.must_claim("fit")
    for step in (1, 2, 3, 8):
        worker.beat(fit, progress={"done": step, "total": 100, "unit": "steps", "loss": 1.0 / step})
    worker.beat(fit, progress={"done": 9, "total": 100, "unit": "steps"})
    assert told(home, job)["points"] == [[1, 1.0], [2, 0.5], [3, 1 / 3], [8, 0.125]]
    assert told(home, job)["steps"] == 100
    # Another attempt goes on from a checkpoint at step 2: later steps of the first are no longer shown.
    worker.fail(fit)
    fit = worker.must_claim("fit")
    worker.beat(fit, progress={"done": 2, "total": 100, "unit": "steps", "loss": 0.4})
    assert told(home, job)["points"] == [[1, 1.0], [2, 0.4]]
    worker.finish(fit, curve=[{"step": 1, "loss": 0.9}, {"step": 2, "loss": 0.3}], steps=2)
    assert told(home, job)["points"] == [[1, 0.9], [2, 0.3]] and told(home, job)["state"] == "completed"
    assert home.sql("SELECT * FROM losses") == []


def test_a_long_curve_is_thinned_and_keeps_its_end(home):
    job = home.submit()["id"]
    worker = home.worker()
    worker.advance(job, "fit")
    fit = worker.must_claim("fit")
    home.sql("INSERT INTO losses SELECT %s, n, 1.0 / n FROM generate_series(1, 25000) AS n", fit["task_id"])
    worker.beat(fit, progress={"done": 25000, "total": 60000, "unit": "steps", "loss": 0.1})
    points = told(home, job)["points"]
    assert 900 <= len(points) <= 1001 and points[-1] == [25000, 0.1]
    assert points == sorted(points)


def test_an_unknown_job_has_no_curves(shared):
    assert shared.client.get("/v1/jobs/nobody/curves").status_code == 404
