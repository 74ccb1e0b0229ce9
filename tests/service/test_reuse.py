"""A job that changes lobes, network or package only reads the light fields that an earlier job has rendered."""

import pytest


def baked(home, **changes):
    """A completed job."""
    job, worker = home.submit(**changes), home.worker()
    while (claim := worker.claim()) is not None:
        worker.finish(claim)
    assert home.job(job["id"])["state"] == "completed"
    return job


def prepared(home, worker, **changes):
    """A submitted job whose scene was prepared, and the claim that comes after."""
    job = home.submit(**changes)
    worker.finish(worker.must_claim("prepare"))
    return home.job(job["id"]), worker.must_claim()


@pytest.mark.parametrize("change", ["fit.lobes=4", "fit.solver=cnn", "package.environment_size=32", "seed=3"])
def test_rendering_is_skipped_where_the_light_is_the_same(home, change):
    first, worker = baked(home), home.worker()
    store = home.sql("SELECT store_url FROM jobs")[0]["store_url"]
    job, claim = prepared(home, worker, set=[change])
    assert claim["payload"]["kind"] == "fit" and claim["payload"]["store_url"] == store
    assert len(claim["payload"]["renders"]) == 2
    assert job["renders_of"] == first["id"]
    assert [task["state"] for task in home.tasks(job["id"], kind="render")] == ["completed", "completed"]
    event = next(event for event in home.events(job["id"]) if event["kind"] == "tasks.reused")
    assert event["detail"] == {"count": 2, "job": first["id"]}
    worker.finish(claim)
    while (claim := worker.claim()) is not None:
        worker.finish(claim)
    assert home.job(job["id"])["state"] == "completed"


@pytest.mark.parametrize("change", ["render.samples=8", "render.max_depth=2", "lightmap.tile=16"])
def test_other_light_is_rendered(home, change):
    baked(home)
    job, claim = prepared(home, home.worker(), set=[change])
    assert claim["payload"]["kind"] == "render" and job["renders_of"] is None


def test_light_fields_of_a_job_without_points_between_do_not_serve_one_that_needs_them(home):
    job, worker = home.submit(set=["fit.solver=cnn"]), home.worker()
    worker.finish(worker.must_claim("prepare"), between=[])
    while (claim := worker.claim()) is not None:
        worker.finish(claim)
    _, claim = prepared(home, worker)
    assert claim["payload"]["kind"] == "render"
    assert home.job(job["id"])["state"] == "completed"


def test_a_job_that_has_not_rendered_all_tiles_is_no_source(home):
    home.submit()
    worker = home.worker()
    worker.finish(worker.must_claim("prepare"))
    worker.finish(worker.must_claim("render"))
    job, claim = prepared(home, worker, set=["fit.lobes=4"])
    assert claim["payload"]["kind"] == "render" and job["renders_of"] is None


def test_a_job_that_failed_after_rendering_is_a_source(home):
    home.submit()
    worker = home.worker()
    worker.finish(worker.must_claim("prepare"))
    for _ in range(2):
        worker.finish(worker.must_claim("render"))
    worker.fail(worker.must_claim("fit"), retryable=False).raise_for_status()
    _, claim = prepared(home, worker, set=["fit.lobes=4"])
    assert claim["payload"]["kind"] == "fit"
