"""Light fields that are gone or damaged are rendered again, and nobody reuses what is not there."""

import shutil
from pathlib import Path
from urllib.parse import urlparse

ARRAYS = (("light_field", "0/0/0"), ("irradiance", "0"), ("between", "0/0/0/0"))


def folder_of(claim):
    return Path(urlparse(claim["payload"]["store_url"]).path)


def objects_of(claim):
    """Where a tile's data lie in the store."""
    side, tile = claim["payload"]["settings"]["lightmap"]["tile"], claim["payload"]["tile"]
    place = f"c/{tile['row'] // side}/{tile['column'] // side}"
    return [folder_of(claim) / array / place / tail for array, tail in ARRAYS]


def work(worker, claim):
    """Do what a worker does to the store, as far as the coordinator looks, and commit."""
    kind, store = claim["payload"]["kind"], folder_of(claim)
    if kind == "prepare":
        store.mkdir(parents=True, exist_ok=True)
        (store / "zarr.json").write_text("{}")
    if kind == "render":
        for file in objects_of(claim):
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_text("light")
    worker.finish(claim, tiles=3)


def work_on(worker, until=None):
    """Work until a task of a kind is claimed, or there is none; its claim, and the labels of what was done."""
    done = []
    while (claim := worker.claim()) is not None and claim["payload"]["kind"] != until:
        done.append(claim["payload"]["kind"])
        work(worker, claim)
    return claim, done


def lose(home, worker, claim, code, *labels):
    problem = {"title": "t", "status": 507, "detail": "it is not there", "code": code}
    body = {"attempt": claim["attempt"], "lease": claim["lease"]} | {
        "problem": problem,
        "retryable": True,
        "lost": labels,
    }
    return home.client.post(f"/v1/tasks/{claim['task_id']}/fail", json=body)


def states(home, job, kind):
    return [task["state"] for task in home.tasks(job["id"], kind=kind)]


# The fakes' tiles are 8 texels wide, so that a store with tiles of 8 texels has an object for each.
TILES_OF_8 = ["lightmap.tile=8"]


def test_a_store_that_is_deleted_while_tiles_render_is_made_and_filled_again(home):
    job, worker = home.submit(set=TILES_OF_8), home.worker()
    work(worker, worker.must_claim("prepare"))
    work(worker, worker.must_claim("render"))
    claim, other = worker.must_claim("render"), home.worker("other").must_claim("render")
    shutil.rmtree(folder_of(claim))
    assert lose(home, worker, claim, "store-lost").status_code == 204
    assert states(home, job, "prepare") == ["queued"] and states(home, job, "render") == ["waiting"] * 3
    assert lose(home, worker, other, "store-lost").status_code == 409, "the attempt was taken away"
    _, done = work_on(home.worker("third"))
    assert done[:4] == ["prepare", "render", "render", "render"] and done[-1] == "package"
    assert home.job(job["id"])["state"] == "completed"
    assert home.kinds_of_events(job["id"]).count("tasks.lost") == 1


def test_a_worker_that_does_not_see_the_store_is_not_believed(home):
    job, worker = home.submit(set=TILES_OF_8), home.worker()
    work(worker, worker.must_claim("prepare"))
    work(worker, worker.must_claim("render"))
    claim = worker.must_claim("render")
    assert lose(home, worker, claim, "store-lost").status_code == 204
    assert states(home, job, "prepare") == ["completed"]
    assert sorted(states(home, job, "render")) == ["completed", "queued", "soft-failed"]


def test_lost_tiles_are_rendered_again_and_the_fit_goes_on_from_its_checkpoint(home):
    job, worker = home.submit(set=TILES_OF_8), home.worker()
    fit, _ = work_on(worker, "fit")
    assert worker.checkpoint(fit, b"half trained").status_code == 204
    lost = home.tasks(job["id"], kind="render")[1]
    assert lose(home, worker, fit, "tiles-lost", lost["label"], "tile 900,900").status_code == 204
    assert states(home, job, "render") == ["completed", "queued", "completed"]
    assert states(home, job, "fit") == ["waiting"]
    again = worker.must_claim("render")
    assert again["task_id"] == lost["id"]
    work(worker, again)
    resumed = worker.must_claim("fit")
    assert resumed["task_id"] == fit["task_id"] and resumed["checkpoint"] is not None
    work(worker, resumed)
    assert "render" not in work_on(worker)[1] and home.job(job["id"])["state"] == "completed"


def test_a_task_that_keeps_losing_its_tiles_fails_in_the_end(home):
    job, worker = home.submit(set=TILES_OF_8), home.worker()
    for _ in range(4):
        fit, _ = work_on(worker, "fit")
        assert lose(home, worker, fit, "tiles-lost", "tile 0,8").status_code == 204
    assert worker.claim() is None
    assert home.job(job["id"])["state"] == "failed" and "it is not there" in home.job(job["id"])["error"]["detail"]


def test_a_source_that_is_gone_is_no_source_and_neither_is_its_copy(home):
    first = home.submit(set=TILES_OF_8)
    claim, _ = work_on(home.worker(), "fit")
    store = folder_of(claim)
    work(home.worker(), claim)
    work_on(home.worker())
    copy = home.submit(set=[*TILES_OF_8, "fit.lobes=4"])
    assert "render" not in work_on(home.worker())[1]
    assert home.job(copy["id"])["renders_of"] == first["id"]
    shutil.rmtree(store)
    third = home.submit(set=[*TILES_OF_8, "fit.lobes=5"])
    assert work_on(home.worker())[1].count("render") == 3
    assert home.job(third["id"])["renders_of"] is None and home.job(third["id"])["state"] == "completed"
    fourth = home.submit(set=[*TILES_OF_8, "fit.lobes=6"])
    assert "render" not in work_on(home.worker())[1]
    assert home.job(fourth["id"])["renders_of"] == third["id"]


def test_a_source_that_misses_one_object_of_one_tile_is_none(home):
    home.submit(set=TILES_OF_8)
    worker = home.worker()
    work(worker, worker.must_claim("prepare"))
    claim = worker.must_claim("render")
    work(worker, claim)
    work_on(worker)
    for number, file in enumerate(objects_of(claim)):
        content = file.read_text()
        file.unlink()
        home.submit(set=[*TILES_OF_8, f"fit.lobes={4 + number}"])
        assert work_on(worker)[1].count("render") == 3, file
        file.write_text(content)
        home.sql("UPDATE jobs SET state = 'archived' WHERE settings -> 'fit' ->> 'lobes' = %s", str(4 + number))
    home.submit(set=[*TILES_OF_8, "fit.lobes=9"])
    assert "render" not in work_on(worker)[1]


def test_a_copy_whose_source_goes_while_it_runs_renders_into_a_store_of_its_own(home):
    home.submit(set=TILES_OF_8)
    work_on(home.worker())
    copy = home.submit(set=[*TILES_OF_8, "fit.lobes=4"])
    fit, _ = work_on(home.worker(), "fit")
    shutil.rmtree(folder_of(fit))
    assert lose(home, home.worker(), fit, "store-lost").status_code == 204
    _, done = work_on(home.worker())
    assert done[:4] == ["prepare", "render", "render", "render"]
    view = home.job(copy["id"])
    assert view["state"] == "completed" and view["renders_of"] is None
    (row,) = home.sql("SELECT store_url FROM jobs WHERE id = %s", copy["id"])
    assert row["store_url"].endswith(f"{copy['id']}.zarr")


def failed_fit(home):
    """A job whose fit has failed for good, and the claim of it."""
    job, worker = home.submit(set=TILES_OF_8), home.worker()
    fit, _ = work_on(worker, "fit")
    worker.fail(fit, code="fit-failed", retryable=False)
    assert home.job(job["id"])["state"] == "failed"
    return job, fit


def test_retry_renders_again_what_is_gone(home):
    for number, lost in enumerate(("store", "tile", "nothing")):
        job, fit = failed_fit(home)
        store = folder_of(fit)
        if lost == "store":
            shutil.rmtree(store)
        elif lost == "tile":
            next((store / "irradiance").rglob("1/0")).unlink()
        home.client.post(f"/v1/jobs/{job['id']}/retry").raise_for_status()
        _, done = work_on(home.worker(f"again {number}"))
        assert done.count("render") == {"store": 3, "tile": 1, "nothing": 0}[lost]
        assert done.count("prepare") == int(lost == "store")
        assert home.job(job["id"])["state"] == "completed"
        home.client.post(f"/v1/jobs/{job['id']}/archive").raise_for_status()


def test_requeue_takes_up_a_failed_job(home):
    job, fit = failed_fit(home)
    shutil.rmtree(folder_of(fit))
    body = {"kind": "fit"}
    home.client.post(f"/v1/jobs/{job['id']}/requeue", json=body).raise_for_status()
    assert states(home, job, "fit") == ["waiting"] and states(home, job, "prepare") == ["queued"]
    _, done = work_on(home.worker("again"))
    assert done.count("render") == 3 and home.job(job["id"])["state"] == "completed"


def test_a_package_whose_store_is_gone_may_be_made_again(home):
    job, worker = home.submit(set=TILES_OF_8), home.worker()
    claim, _ = work_on(worker, "package")
    work(worker, claim)
    shutil.rmtree(folder_of(claim))
    home.client.post(f"/v1/jobs/{job['id']}/requeue", json={"kind": "package"}).raise_for_status()
    _, done = work_on(worker)
    assert done == ["prepare", "render", "render", "render", "package"]
    assert home.job(job["id"])["state"] == "completed"
