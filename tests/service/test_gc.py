"""What archived jobs leave behind is freed, and nothing that any other job needs."""

from pathlib import Path
from urllib.parse import urlparse

import pytest

from kiln_service.config import Retention


def baked(home, **changes):
    """A completed job with a store on the disk."""
    job, worker = home.submit(**changes), home.worker()
    while (claim := worker.claim()) is not None:
        if claim["payload"]["kind"] == "prepare":
            store = Path(urlparse(claim["payload"]["store_url"]).path)
            store.mkdir(parents=True)
            (store / "zarr.json").write_text("{}")
        if claim["payload"]["kind"] == "render":
            side, tile = claim["payload"]["settings"]["lightmap"]["tile"], claim["payload"]["tile"]
            for array, tail in (("light_field", "0/0/0"), ("irradiance", "0"), ("between", "0/0/0/0")):
                shard = store / array / "c" / str(tile["row"] // side) / str(tile["column"] // side) / tail
                shard.parent.mkdir(parents=True, exist_ok=True)
                shard.touch()
        worker.finish(claim)
    assert home.job(job["id"])["state"] == "completed"
    return job["id"]


def store_of(home, job_id):
    (row,) = home.sql("SELECT store_url FROM jobs WHERE id = %s", job_id)
    return Path(urlparse(row["store_url"]).path)


def archive(home, job_id):
    home.client.post(f"/v1/jobs/{job_id}/archive").raise_for_status()


def gc(home, **body):
    return home.client.post("/v1/gc", json=body).raise_for_status().json()


def test_only_archived_jobs_are_freed_and_their_packages_stay(home):
    kept, gone = baked(home, set=["render.samples=8"]), baked(home, set=["render.samples=9"])
    archive(home, gone)
    assert [job["job_id"] for job in gc(home, dry_run=True)["jobs"]] == [gone]
    assert store_of(home, gone).exists(), "that was a dry run"
    report = gc(home)
    (freed,) = report["jobs"]
    assert freed["job_id"] == gone and len(freed["stores"]) == 1 and not report["dry_run"]
    assert not store_of(home, gone).exists() and store_of(home, kept).exists()
    assert gc(home)["jobs"] == [], "it is done once"
    owners = {row["owner"].partition(":")[0] for row in home.sql("SELECT owner FROM blob_uses")}
    assert owners == {"job", "result"}
    (name,) = [a["name"] for a in home.client.get(f"/v1/jobs/{gone}/artifacts").json() if a["name"].endswith("ktx2")]
    assert home.client.get(f"/v1/jobs/{gone}/artifacts/{name}").status_code == 200
    assert home.client.get("/v1/audit").json()[0]["action"] == "gc"


def test_a_shared_store_stays_until_its_last_reader_is_archived(home):
    first = baked(home)
    second = baked(home, set=["fit.lobes=4"])
    assert home.job(second)["renders_of"] == first
    shared = store_of(home, first)
    assert store_of(home, second) == shared
    archive(home, first)
    (freed,) = gc(home)["jobs"]
    assert freed["stores"] == [] and shared.exists()
    archive(home, second)
    (freed,) = gc(home)["jobs"]
    assert not shared.exists() and len(freed["stores"]) == 2, "its own empty one and the shared one"
    assert list(shared.parent.iterdir()) == []


def test_light_fields_of_an_archived_job_are_not_shared(home):
    archive(home, baked(home))
    home.submit(set=["fit.lobes=4"])
    worker = home.worker()
    worker.finish(worker.must_claim("prepare"))
    assert worker.must_claim()["payload"]["kind"] == "render"


def test_younger_jobs_are_kept(home):
    job = baked(home)
    archive(home, job)
    assert gc(home, days=1)["jobs"] == []
    home.sql("UPDATE jobs SET finished = now() - interval '25 hours'")
    assert [one["job_id"] for one in gc(home, days=1)["jobs"]] == [job]


def test_a_store_elsewhere_is_left_alone(home, tmp_path):
    """A store outside of the coordinator's own folder is not for it to delete, whatever a row says."""
    job = baked(home)
    precious = tmp_path / "precious.zarr"
    precious.mkdir()
    home.sql("UPDATE jobs SET store_url = %s", precious.as_uri())
    archive(home, job)
    gc(home)
    assert precious.exists()


@pytest.mark.parametrize("body", [{"days": -1}, {"days": "x"}, {"dry_run": 3}, {"more": 1}])
def test_wrong_requests_are_refused(shared, body):
    assert shared.client.post("/v1/gc", json=body).status_code == 422


def aged(home, job_id, days):
    home.sql("UPDATE jobs SET finished = now() - make_interval(days => %s) WHERE id = %s", days, job_id)


def test_logs_of_old_jobs_go_and_their_events_stay(start, eventually):
    with start() as home:
        young, old, kept = (baked(home, set=[f"render.samples={8 + n}"]) for n in range(3))
        home.client.patch(f"/v1/jobs/{kept}", json={"labels": {"keep": "true"}}).raise_for_status()
        tasks = {job: home.tasks(job)[0]["id"] for job in (young, old, kept)}
        for job, days in ((young, 89), (old, 91), (kept, 1000)):
            home.sql("INSERT INTO task_logs (task_id, attempt, lines) VALUES (%s, 1, 'said')", tasks[job])
            aged(home, job, days)
    with start(retention=Retention(log_days=90, check_s=0.1)) as home:
        logs = {job: f"/v1/tasks/{task}/log" for job, task in tasks.items()}
        eventually(lambda: home.client.get(logs[old]).text == "")
        assert all("said" in home.client.get(logs[job]).text for job in (young, kept))
        assert home.events(old)


def test_retention_rules_archive_and_free_what_is_old_and_nothing_that_is_needed(start, eventually):
    rules = Retention(archive_days=30, free_days=60, check_s=0.1)
    with start() as home:
        young, old, ancient, kept, read = (baked(home, set=[f"render.samples={8 + n}"]) for n in range(5))
        home.client.patch(f"/v1/jobs/{kept}", json={"labels": {"keep": "true"}}).raise_for_status()
        live = home.submit(set=["render.samples=12", "fit.lobes=4"])["id"]
        worker = home.worker()
        worker.finish(worker.must_claim("prepare"))
        running = worker.must_claim()
        assert home.job(live)["renders_of"] == read and running["job_id"] == live
        for job_id, days in ((young, 29), (old, 31), (ancient, 61), (kept, 1000), (read, 1000)):
            aged(home, job_id, days)
    with start(retention=rules) as home:
        eventually(lambda: home.sql("SELECT id FROM jobs WHERE id = %s AND freed IS NOT NULL", ancient))
        eventually(lambda: home.sql("SELECT id FROM jobs WHERE id = %s AND freed IS NOT NULL", read))
        states = {job_id: home.job(job_id)["state"] for job_id in (young, old, ancient, kept, read, live)}
        assert states == {
            young: "completed",
            old: "archived",
            ancient: "archived",
            kept: "completed",
            read: "archived",
            live: "active",
        }
        assert not store_of(home, ancient).exists()
        assert all(store_of(home, job_id).exists() for job_id in (young, old, kept))
        assert store_of(home, live).exists(), "a job that runs reads it"
        assert home.events(old)[-1]["actor"] == "coordinator" and home.events(old)[-1]["kind"] == "job.archived"
        assert home.client.get(f"/v1/jobs/{ancient}/artifacts").json() != []
        audit = home.client.get("/v1/audit").json()
        assert {entry["actor"] for entry in audit if entry["action"] == "gc"} == {"coordinator"}


def test_without_rules_nothing_goes(start, eventually):
    with start() as home:
        job = baked(home)
        aged(home, job, 10_000)
        archive(home, baked(home, set=["render.samples=9"]))
    with start(retention=Retention(check_s=0.05)) as home:
        unused = home.sql("SELECT count(*) AS freed FROM jobs WHERE freed IS NOT NULL")
        lead = "SELECT pid FROM pg_locks JOIN pg_stat_activity USING (pid) WHERE locktype = 'advisory'"
        lead += " AND datname = current_database()"
        eventually(lambda: home.sql(lead))
        home.worker().claim(wait_s=1)
        assert unused == [{"freed": 0}] and home.job(job)["state"] == "completed"
        assert home.sql("SELECT count(*) AS freed FROM jobs WHERE freed IS NOT NULL") == [{"freed": 0}]
