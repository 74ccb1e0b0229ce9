"""A job of which no task runs says why."""

import subprocess
import sys
from pathlib import Path

import pytest

from kiln_schemas import __version__
from kiln_schemas.operators import DAYS
from kiln_schemas.text import NOTE_LENGTH
from kiln_service.config import Limits

ALWAYS = {"days": list(DAYS), "begins": "00:00", "ends": "00:00"}


def why(home, job):
    return home.job(job["id"])["waits_for"]


def order(home, worker, name):
    home.client.post(f"/v1/workers/{worker.id}/orders/{name}").raise_for_status()


def test_nobody_is_there_until_somebody_takes_its_task(home):
    job = home.submit()
    assert "No worker is there" in why(home, job)
    worker = home.worker()
    assert why(home, job) is None, "an idle worker may take it"
    claim = worker.must_claim()
    assert why(home, job) is None
    worker.finish(claim)
    worker.advance(job["id"], "package")
    worker.finish(worker.must_claim())
    home.sql("UPDATE workers SET seen = seen - interval '1 day'")
    assert home.job(job["id"])["state"] == "completed" and why(home, job) is None


def test_a_worker_not_heard_of_is_not_there(home):
    job, _ = home.submit(), home.worker()
    assert why(home, job) is None
    home.sql("UPDATE workers SET seen = seen - interval '1 day'")
    assert "No worker is there" in why(home, job)


def test_the_kind_is_named(home):
    job, _ = home.submit(), home.worker(kinds=["render", "fit"])
    assert "(1) does prepare tasks" in why(home, job)


def test_tags_that_are_missing_are_named(home):
    job, one = home.submit(tags=["gpu", "site-a", "night"]), home.worker("one", tags=["gpu"])
    assert "has the tags 'site-a', 'night'" in why(home, job) and "'gpu'" not in why(home, job)
    home.worker("other", tags=["site-a", "night"])
    assert "has all of the tags 'gpu', 'site-a', 'night'" in why(home, job)
    home.worker("of-another-kind", tags=["gpu", "site-a", "night"], kinds=["fit"])
    assert why(home, job) and one.claim() is None
    home.worker("whole", tags=["gpu", "site-a", "night"])
    assert why(home, job) is None


def test_many_long_tags_make_a_sentence_of_bounded_length(home):
    job, _ = home.submit(tags=[f"{number:02}{61 * 'x'}" for number in range(32)]), home.worker()
    assert "and 28 more" in why(home, job) and len(why(home, job)) <= NOTE_LENGTH


@pytest.mark.parametrize(("orders", "words"), [("drain", "told to leave"), ("sleep", "asleep")])
def test_orders_keep_workers_from_it(home, orders, words):
    job, worker = home.submit(), home.worker()
    order(home, worker, orders)
    assert words in why(home, job)
    order(home, worker, "wake")
    assert why(home, job) is None and worker.must_claim()


def test_a_schedule_keeps_workers_from_it(home):
    job, worker = home.submit(), home.worker("sleeper")
    home.client.put("/v1/schedules/sleeper", json=ALWAYS).raise_for_status()
    assert "asleep" in why(home, job) and worker.claim() is None
    home.client.delete("/v1/schedules/sleeper").raise_for_status()
    assert why(home, job) is None and worker.must_claim()


def test_blocks_keep_workers_from_it(home):
    job, one, other = home.submit(), home.worker("one"), home.worker("other")
    one.finish(one.must_claim(), tiles=4)
    for _ in range(2):
        one.fail(one.must_claim("render")).raise_for_status()
    assert one.claim() is None and why(home, job) is None, "the other is not blocked"
    order(home, other, "sleep")
    assert "(2) takes one: 1 asleep" in why(home, job) and "1 blocked for this job" in why(home, job)
    home.client.delete(f"/v1/workers/{one.id}/blocks").raise_for_status()
    assert why(home, job) is None and one.must_claim("render")


def test_workers_at_work_are_counted(home):
    first, second, worker = home.submit(), home.submit(name="second"), home.worker()
    claim = worker.must_claim()
    assert claim["job_id"] == first["id"] and why(home, first) is None
    assert "(1) is at work on another job" in why(home, second)
    worker.fail(claim, code="canceled").raise_for_status()
    assert why(home, second) is None


def test_a_worker_of_another_version_is_named(home):
    job = home.submit()
    body = home.worker("old").registration | {"version": "0.0.1"}
    home.sql("DELETE FROM workers")
    assert home.client.post("/v1/workers", json=body).status_code == 409
    assert "'old' was refused: it is lightkiln 0.0.1" in why(home, job) and __version__ in why(home, job)
    home.sql("UPDATE refused_workers SET at = at - interval '1 day'")
    assert "refused" not in why(home, job)


def test_refused_workers_are_bounded(start):
    with start(limits=Limits(reserve_bytes=0, workers=3)) as home:
        body = home.worker().registration | {"version": "0.0.1"}
        for number in range(6):
            assert home.client.post("/v1/workers", json=body | {"name": f"w{number}"}).status_code == 409
        assert home.client.post("/v1/workers", json=body | {"name": "w0", "version": "0.0.2"}).status_code == 409
        rows = home.sql("SELECT name, version FROM refused_workers ORDER BY name")
        assert [(row["name"], row["version"]) for row in rows] == [("w0", "0.0.2"), ("w1", "0.0.1"), ("w2", "0.0.1")]


def test_a_paused_job_says_so(home):
    job, _ = home.submit(), home.worker()
    home.client.post(f"/v1/jobs/{job['id']}/pause").raise_for_status()
    assert "paused" in why(home, job)
    home.client.post(f"/v1/jobs/{job['id']}/resume").raise_for_status()
    assert why(home, job) is None


def test_a_full_disk_is_said(start):
    with start() as home:
        job, _ = home.submit(), home.worker()
    with start(limits=Limits(reserve_bytes=2**60)) as home:
        assert "disk is full" in why(home, job)


def test_lists_pages_and_status_say_it(home):
    job, taken = home.submit(tags=["gpu"]), home.submit(name="taken")
    home.worker().must_claim()
    listed = {one["id"]: one["waits_for"] for one in home.client.get("/v1/jobs").json()["jobs"]}
    assert "'gpu'" in listed[job["id"]] and listed[taken["id"]] is None
    assert "the tag &#39;gpu&#39;" in home.client.get(f"/jobs/{job['id']}").text
    assert home.client.get("/jobs").text.count("has the tag &#39;gpu&#39;") == 1
    program = Path(sys.executable).with_name("lightkiln")
    words = [program, "status", job["id"], "--url", home.url, "--token", home.token]
    shown = subprocess.run(words, capture_output=True, text=True, check=True).stdout
    assert "has the tag 'gpu'" in shown
