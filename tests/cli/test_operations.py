"""Tasks done again, logs that are followed, tags, sleep schedules and blocks, by the command line."""

from collections.abc import Iterator

import httpx
import pytest

from kiln_schemas import __version__


@pytest.fixture
def farm(coordinator) -> Iterator[httpx.Client]:
    with httpx.Client(base_url=coordinator.url, headers={"Authorization": f"Bearer {coordinator.farm.token}"}) as http:
        yield http


@pytest.fixture
def ask(lightkiln, coordinator):
    """A command with `--json` at this coordinator: its exit code and document."""

    def run(*arguments, code: int = 0):
        done = lightkiln(*arguments, "--url", coordinator.url, "--token", coordinator.farm.token, "--json")
        assert done.code == code, done
        return done.document

    return run


def register(farm: httpx.Client, name: str, **more) -> str:
    body = {"name": name, "kinds": ["prepare"], "memory_bytes": 1, "threads": 1, "device": "d", "version": __version__}
    return farm.post("/v1/workers", json=body | more).raise_for_status().json()["worker_id"]


def test_tags_bring_a_job_to_its_workers_and_its_log_is_followed(ask, lightkiln, farm, coordinator, lit_glb) -> None:
    for other in farm.get("/v1/jobs", params={"state": "queued"}).json()["jobs"]:
        ask("cancel", other["id"])
    job = ask("submit", lit_glb, "--preset", "draft", "--tag", "deep", "--tag", "blue")["id"]
    assert ask("status", job)["tags"] == ["deep", "blue"]
    plain, tagged = register(farm, "plain"), register(farm, "tagged", tags=["blue", "deep", "other"])
    body = {"kinds": ["prepare"], "wait_s": 0}
    assert farm.post(f"/v1/workers/{plain}/claim", json=body).status_code == 204
    assert ask("change", job, "--tag", "blue")["tags"] == ["blue"]
    claim = farm.post(f"/v1/workers/{tagged}/claim", json=body).json()
    held = {"attempt": 1, "lease": claim["lease"]}
    beat = held | {"task_id": claim["task_id"], "log": "one\ntwo\nthree\n"}
    farm.post(f"/v1/workers/{tagged}/heartbeat", json=beat).raise_for_status()
    assert ask("logs", job, "--tail", "2")[0]["log"] == "two\nthree\n"
    farm.post(f"/v1/workers/{tagged}/heartbeat", json=beat | {"log": ""}).raise_for_status()  # commands take seconds
    problem = {"title": "t", "status": 422, "detail": "it is no scene", "code": "input"}
    failure = held | {"problem": problem, "retryable": False}
    farm.post(f"/v1/tasks/{claim['task_id']}/fail", json=failure).raise_for_status()
    followed = lightkiln("logs", job, "scene", "-f", "--url", coordinator.url, "--token", coordinator.farm.token)
    assert followed.code == 0 and followed.out.endswith("one\ntwo\nthree\n")
    assert "none can be requeued" in ask("requeue", job, code=4)["detail"]
    assert "names" not in ask("logs", job, "none", code=3)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["requeue", "0", "--rows", "8"], "'8' is not a range"),
        (["requeue", "0", "--rows", "8:8"], "'8:8' is not a range"),
        (["requeue", "0", "--kind", "prepare"], "--kind 'prepare' is refused"),
        (["change", "0", "--tag", "no blanks"], "'no blanks' is refused as a tag"),
        (["workers", "schedule", "w"], "either a span or none"),
        (["workers", "schedule", "w", "--from", "8", "--to", "9:00"], "--from"),
        (["workers", "schedule", "w", "--from", "08:00", "--to", "09:00", "--timezone", "Moon/Base"], "--timezone"),
        (["workers", "schedule", "w", "--days", "mon,xyz", "--from", "08:00", "--to", "09:00"], "--days"),
        (["workers", "unblock", "nobody"], "no worker 'nobody'"),
    ],
)
def test_what_is_refused(ask, arguments: list[str], words: str) -> None:
    problem = ask(*arguments, code=3)
    assert words in f"{problem['where']} {problem['detail']}"


def test_a_schedule_comes_and_goes(ask, farm) -> None:
    register(farm, "sleeper")
    span = ("--from", "08:00", "--to", "18:00", "--timezone", "Europe/Stockholm")
    days = ask("workers", "schedule", "sleeper", "--days", "fri-mon", *span)["schedule"]["days"]
    assert days == ["fri", "sat", "sun", "mon"]
    view = next(worker for worker in ask("workers", "list") if worker["name"] == "sleeper")
    assert view["schedule"]["begins"] == "08:00:00" and view["blocks"] == []
    ask("workers", "schedule", "sleeper", "--never")
    view = next(worker for worker in ask("workers", "list") if worker["name"] == "sleeper")
    assert view["schedule"] is None
    assert ask("workers", "unblock", "sleeper")["unblocked"] == [view["id"]]
