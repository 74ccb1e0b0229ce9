"""The coordinator's log as JSON lines, with the ids of jobs, tasks, workers and requests."""

import json
import logging
import subprocess
import sys
from pathlib import Path

import httpx
import pytest

from kiln_schemas.logs import JsonFormatter, TextFormatter, bound


@pytest.fixture
def record():
    def make(**extra):
        made = logging.makeLogRecord({"name": "kiln", "levelno": 20, "levelname": "INFO", "msg": "%s lost"} | extra)
        made.args = ("a tile",)
        return made

    return make


def test_a_record_is_a_line_with_what_is_bound(record):
    with bound(job_id="j", request_id="r"), bound(task_id="t"):
        line = json.loads(JsonFormatter().format(record(worker_id="w")))
        text = TextFormatter().format(record(worker_id="w"))
    assert line.pop("time").endswith("Z")
    assert line == {
        "level": "info",
        "logger": "kiln",
        "message": "a tile lost",
        "job_id": "j",
        "request_id": "r",
        "task_id": "t",
        "worker_id": "w",
    }
    assert text.endswith("INFO kiln: a tile lost job_id=j request_id=r task_id=t worker_id=w")
    assert "job_id" not in JsonFormatter().format(record())


def test_a_traceback_is_within_its_line(record):
    try:
        raise ValueError("two\nlines")
    except ValueError:
        text = JsonFormatter().format(record(exc_info=sys.exc_info()))
    assert "\n" not in text and json.loads(text)["exception"].endswith("ValueError: two\nlines")


def test_request_ids_are_answered(shared):
    assert shared.client.get("/healthz", headers={"X-Request-Id": "proxy-17"}).headers["x-request-id"] == "proxy-17"
    assert len(shared.client.get("/healthz").headers["x-request-id"]) == 32
    for odd in ("a b", "x" * 65, '"}'):
        assert len(shared.client.get("/healthz", headers={"X-Request-Id": odd}).headers["x-request-id"]) == 32
    assert httpx.get(shared.url + "/v1/jobs", headers={"X-Request-Id": "refused"}).headers["x-request-id"] == "refused"


def test_the_coordinator_logs_what_happens(home, tmp_path):
    """A second coordinator, a real process, on the database of `home`."""
    log = tmp_path / "log"
    command = [sys.executable, "-m", "kiln_service", "--data", str(tmp_path / "second"), "--port", "0", "--json"]
    with log.open("wb") as output:
        process = subprocess.Popen(
            [*command, "--database", home.config.database, "--log-format", "json"],
            stdout=subprocess.PIPE,
            stderr=output,
            text=True,
        )
    with process:
        try:
            ready = json.loads(process.stdout.readline())
            headers = {"Authorization": f"Bearer {Path(ready['token_file']).read_text().strip()}"}
            worker = home.worker()
            with httpx.Client(base_url=ready["url"], headers=headers) as client:
                body = home.request()
                job = client.post("/v1/jobs", json=body, headers={"X-Request-Id": "from-ci"}).raise_for_status().json()
                claim = client.post(f"/v1/workers/{worker.id}/claim", json={"kinds": ["prepare"]}).json()
                beat = {"task_id": claim["task_id"], "attempt": 1}
                client.post(f"/v1/workers/{worker.id}/heartbeat", json=beat).raise_for_status()
                client.post(f"/v1/tasks/{claim['task_id']}/commit", json={"attempt": 1}).json()
                client.get("/v1/none", headers={"Authorization": "Bearer wrong"})
        finally:
            process.terminate()
    assert process.returncode == 0
    lines = [json.loads(line) for line in log.read_text().splitlines()]
    assert all({"time", "level", "logger", "message"} <= line.keys() for line in lines)
    (created,) = [line for line in lines if line["message"] == "job.created"]
    assert (created["job_id"], created["request_id"], created["actor"]) == (job["id"], "from-ci", "client:owner")
    (claimed,) = [line for line in lines if line["message"] == "task.claimed"]
    assert (claimed["job_id"], claimed["task_id"]) == (job["id"], claim["task_id"])
    assert claimed["worker_id"] == worker.id
    asked = {(line["route"], line["status"]): line for line in lines if "route" in line}
    submitted = asked["/v1/jobs", 201]
    assert submitted["request_id"] == "from-ci" and submitted["token"] == "owner" and submitted["ms"] > 0
    refused = asked["/v1/tasks/{task_id}/commit", 422]
    assert refused["task_id"] == claim["task_id"] and refused["method"] == "POST"
    assert asked["none", 401]["token"] is None
    assert not any("heartbeat" in route for route, _ in asked), "what is asked for all the time is not logged"
