"""Which worker gets which task: tags, tasks that failed elsewhere, blocks, sleep schedules."""

from concurrent.futures import ThreadPoolExecutor
from datetime import UTC, datetime, time, timedelta
from time import monotonic, sleep

import pytest
from pydantic import ValidationError

from kiln_schemas.operators import DAYS, SleepSchedule
from kiln_service.events import CLAIMS_WOKEN


def listed(home, name):
    return next(worker for worker in home.client.get("/v1/workers").json() if worker["name"] == name)


def test_a_job_goes_to_workers_with_its_tags(home):
    job = home.submit(tags=["gpu", "site-a"])
    plain, half, whole = (
        home.worker("plain"),
        home.worker("half", tags=["gpu"]),
        home.worker("whole", tags=["site-a", "gpu"]),
    )
    assert job["tags"] == ["gpu", "site-a"] and listed(home, "half")["tags"] == ["gpu"]
    assert plain.claim() is None and half.claim() is None
    claim = whole.must_claim()
    whole.finish(claim)
    home.client.patch(f"/v1/jobs/{job['id']}", json={"tags": []}).raise_for_status()
    assert plain.must_claim()["job_id"] == job["id"]


def test_changed_tags_wake_the_claims_that_wait(home):
    job, plain = home.submit(tags=["gpu"]), home.worker("plain")
    assert plain.claim(wait_s=0.2) is None
    home.client.patch(f"/v1/jobs/{job['id']}", json={"tags": []}).raise_for_status()
    assert plain.must_claim()


@pytest.mark.parametrize("tags", [["no space"], ["-x"], [""], ["a"] * 33, "gpu", [1]])
def test_tags_that_are_none_are_refused(home, tags):
    assert home.client.post("/v1/jobs", json=home.request(tags=tags)).status_code == 422


def test_a_task_that_failed_goes_to_another_worker_first(home):
    home.submit()
    one, two = home.worker("one"), home.worker("two")
    claim = one.must_claim()
    one.fail(claim).raise_for_status()
    assert one.claim() is None, "the other has not tried it"
    two.fail(two.must_claim()).raise_for_status()
    assert one.must_claim()["attempt"] == 3, "everybody has failed it"


def test_a_worker_alone_tries_again_itself(home):
    home.submit()
    one, other = home.worker("one"), home.worker("other", kinds=["fit"])
    one.fail(one.must_claim()).raise_for_status()
    assert other.claim("fit") is None
    assert one.must_claim()["attempt"] == 2


def test_a_worker_that_sleeps_is_nobody_to_wait_for(home):
    """By its schedule as by order: a task that it alone has not failed goes on elsewhere."""
    home.submit()
    one, other = home.worker("one"), home.worker("other")
    one.fail(one.must_claim()).raise_for_status()
    assert one.claim() is None
    always = {"days": list(DAYS), "begins": "00:00", "ends": "00:00"}
    home.client.put("/v1/schedules/other", json=always).raise_for_status()
    assert other.claim() is None and one.must_claim()["attempt"] == 2


def test_a_worker_without_the_tags_is_nobody_to_leave_the_rest_to(home):
    """The job fails with its first task that fails for good, where nobody else may do the others."""
    job, one, _ = home.submit(tags=["gpu"]), home.worker("one", tags=["gpu"]), home.worker("other")
    one.finish(one.must_claim(), tiles=4)
    one.fail(one.must_claim("render"), retryable=False).raise_for_status()
    assert home.client.get(f"/v1/jobs/{job['id']}").json()["state"] == "failed"


def test_a_worker_that_fails_two_tiles_is_blocked_and_forgiven(start):
    with start(max_attempts=2) as home:
        job, bad, good = home.submit(), home.worker("bad"), home.worker("good")
        good.finish(good.must_claim(), tiles=4)
        first = bad.must_claim("render")
        bad.fail(first).raise_for_status()
        bad.fail(bad.must_claim("render")).raise_for_status()
        assert bad.claim() is None
        assert [task["state"] for task in home.tasks(job["id"], kind="render")] == ["queued"] * 4
        assert home.sql("SELECT sum(strikes) AS strikes FROM tasks") == [{"strikes": 0}]
        event = next(event for event in home.events(job["id"]) if event["kind"] == "worker.blocked")
        assert event["detail"]["worker"] == "bad" and event["detail"]["kind"] == "render"
        assert [(block["job_id"], block["kind"]) for block in listed(home, "bad")["blocks"]] == [(job["id"], "render")]
        again = home.worker("bad")
        assert again.claim() is None, "a restart is no remedy"
        other = home.submit(set=["render.samples=9"])
        assert again.must_claim()["job_id"] == other["id"], "other jobs may fare better"
        home.client.delete(f"/v1/workers/{bad.id}/blocks").raise_for_status()
        assert bad.must_claim("render")["job_id"] == job["id"]


def test_a_task_that_a_blocked_worker_failed_for_good_is_tried_by_others(start):
    with start(max_attempts=1) as home:
        job, bad, good = home.submit(), home.worker("bad"), home.worker("good")
        good.finish(good.must_claim(), tiles=3)
        bad.fail(bad.must_claim("render")).raise_for_status()
        assert sorted(task["state"] for task in home.tasks(job["id"], kind="render")) == ["failed", "queued", "queued"]
        bad.fail(bad.must_claim("render")).raise_for_status()
        assert [task["state"] for task in home.tasks(job["id"], kind="render")] == ["queued"] * 3
        while (claim := good.claim()) is not None:
            good.finish(claim)
        assert home.job(job["id"])["state"] == "completed"


def test_the_last_worker_is_never_blocked(home):
    job, only = home.submit(), home.worker("only")
    only.finish(only.must_claim(), tiles=4)
    claims = [only.must_claim("render") for _ in range(3)]
    for claim in claims:
        only.fail(claim).raise_for_status()
    assert listed(home, "only")["blocks"] == [] and listed(home, "only")["state"] == "error"
    only.finish(only.must_claim("render"))
    assert listed(home, "only")["state"] == "awake"
    assert "worker.blocked" not in home.kinds_of_events(job["id"])


def test_a_poisonous_tile_fails_alone(start):
    """Two workers fail it until its attempts are used up; nobody is blocked for it."""
    with start(max_attempts=4) as home:
        job, workers = home.submit(), [home.worker("one"), home.worker("two")]
        workers[0].finish(workers[0].must_claim(), tiles=6)
        poison = home.tasks(job["id"], kind="render")[2]["id"]
        for number in range(200):
            worker = workers[number % 2]
            claim = worker.claim()
            if claim is None:
                continue
            if claim["task_id"] == poison:
                worker.fail(claim, log=f"crash {claim['attempt']}\n").raise_for_status()
            else:
                worker.finish(claim)
        failed = home.job(job["id"])
        assert failed["state"] == "failed"
        stage = next(stage for stage in failed["stages"] if stage["kind"] == "render")
        assert (stage["completed"], stage["failed"]) == (5, 1)
        assert all(listed(home, name)["blocks"] == [] for name in ("one", "two"))
        assert "crash 4" in home.client.get(f"/v1/tasks/{poison}/log").text


def test_a_worker_sleeps_by_its_schedule(home):
    home.submit()
    worker = home.worker("night")
    always = {"days": list(DAYS), "begins": "00:00", "ends": "00:00", "timezone": "Europe/Stockholm"}
    home.client.put("/v1/schedules/night", json=always).raise_for_status()
    assert worker.claim() is None
    view = listed(home, "night")
    assert view["state"] == "asleep" and view["schedule"]["timezone"] == "Europe/Stockholm"
    home.client.delete("/v1/schedules/night").raise_for_status()
    assert worker.must_claim()
    assert [entry["action"] for entry in home.client.get("/v1/audit").json()] == ["worker.schedule"] * 2


@pytest.mark.parametrize(
    ("change", "word"),
    [
        ({"timezone": "Mars/Olympus"}, "no time zone"),
        ({"timezone": "../../etc/passwd"}, "no time zone"),
        ({"days": []}, "days"),
        ({"days": ["someday"]}, "days"),
        ({"begins": "25:00"}, "begins"),
        ({"ends": "08:00Z"}, "zone of its own"),
    ],
)
def test_a_schedule_that_is_none_is_refused(home, change, word):
    body = {"days": ["mon"], "begins": "08:00", "ends": "18:00"} | change
    reply = home.client.put("/v1/schedules/w", json=body)
    assert reply.status_code == 422 and word in reply.text


def sleeps_at(home, schedule, *instants):
    """Whether a worker with this schedule sleeps at each of these instants."""
    home.client.put("/v1/schedules/w", json=schedule.model_dump(mode="json")).raise_for_status()
    asked = "SELECT asleep_at('w', at) AS asleep FROM unnest(%s::timestamptz[]) WITH ORDINALITY AS t (at, n) ORDER BY n"
    return [row["asleep"] for row in home.sql(asked, list(instants))]


def test_the_span_of_a_schedule(home):
    """Every half hour of a week against the obvious reference: the union of spans laid out on a line."""
    for begins, ends in ((time(8), time(18)), (time(22), time(6)), (time(0), time(0))):
        schedule = SleepSchedule(days=("mon", "sun"), begins=begins, ends=ends)
        monday = datetime(2026, 11, 23, tzinfo=UTC)
        spans = []
        for week in (-1, 0, 1):
            for day in (0, 6):
                midnight = monday + timedelta(days=7 * week + day)
                start = midnight + timedelta(hours=begins.hour)
                length = (ends.hour - begins.hour) % 24 or 24
                spans.append((start, start + timedelta(hours=length)))
        week = [monday + timedelta(minutes=30 * half_hour) for half_hour in range(2 * 24 * 7)]
        expected = [any(start <= now < stop for start, stop in spans) for now in week]
        assert sleeps_at(home, schedule, *week) == expected, begins


def test_a_schedule_follows_the_local_clock(home):
    schedule = SleepSchedule(days=("wed",), begins=time(8), ends=time(9), timezone="America/New_York")
    summer, *winter = (datetime(2026, *when, tzinfo=UTC) for when in ((7, 1, 12, 30), (12, 2, 12, 30), (12, 2, 13, 30)))
    assert sleeps_at(home, schedule, summer, *winter) == [True, False, True], "in summer four hours behind"


def test_a_schedule_that_names_no_zone_is_refused():
    with pytest.raises(ValidationError):
        SleepSchedule(days=("wed",), begins=time(8), ends=time(9), timezone="")


def test_a_task_wakes_a_worker_of_its_kind_among_many_that_wait(home):
    """Only some waiting claims are woken for a task: none of another kind takes their place."""
    others = [home.worker(f"other {number}") for number in range(3 * CLAIMS_WOKEN)]
    one, found = home.worker("one"), []
    with ThreadPoolExecutor(len(others) + 1) as pool:
        waiting = [pool.submit(other.claim, "package", wait_s=4) for other in others]
        sleep(0.5)
        waiting.append(pool.submit(lambda: found.append(one.claim("prepare", wait_s=4))))
        sleep(0.5)
        began = monotonic()
        home.submit()
        waiting[-1].result()
        assert found[0] is not None and monotonic() - began < 2.5, "before it looked by itself"
        assert [claim.result() for claim in waiting[:-1]] == [None] * len(others)
