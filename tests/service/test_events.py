"""The history of a job, as a list and as a stream that can be resumed."""

import json
import threading

import psycopg
import pytest


def read_stream(home, job_id, headers=None, stop_after=None, got=None):
    """(id, event, data) of a stream until it ends or enough came."""
    got, current = [] if got is None else got, {}
    with home.client.stream("GET", f"/v1/jobs/{job_id}/events", headers=headers or {}) as reply:
        if reply.status_code == 204:
            return None
        assert reply.headers["content-type"].startswith("text/event-stream")
        for line in reply.iter_lines():
            if line == "" and current:
                got.append((int(current["id"]), current["event"], json.loads(current["data"])))
                current = {}
                if stop_after and len(got) == stop_after:
                    break
            elif not line.startswith(":"):
                key, _, value = line.partition(": ")
                current[key] = value
    return got


def run(home, job):
    worker = home.worker()
    while home.job(job["id"])["state"] not in ("completed", "failed"):
        claim = worker.claim(wait_s=0.2)
        if claim:
            worker.finish(claim)


def test_a_stream_follows_the_job_and_ends_with_it(home):
    job, got = home.submit(), []
    reader = threading.Thread(target=lambda: got.extend(read_stream(home, job["id"])))
    reader.start()
    run(home, job)
    reader.join(timeout=10)
    assert [entry[2] for entry in got] == home.events(job["id"])
    kinds = [entry[1] for entry in got]
    assert kinds[:4] == ["job.created", "tasks.planned", "job.active", "task.claimed"]
    assert kinds[-1] == "job.completed" and kinds.count("stage.completed") == 4
    ids = [entry[0] for entry in got]
    assert ids == sorted(set(ids))


def test_a_stream_goes_on_where_it_broke(home):
    job = home.submit()
    home.client.post(f"/v1/jobs/{job['id']}/cancel").raise_for_status()
    everything = read_stream(home, job["id"])
    first = read_stream(home, job["id"], stop_after=2)
    rest = read_stream(home, job["id"], headers={"Last-Event-ID": str(first[-1][0])})
    assert first + rest == everything and len(everything) == 5
    assert read_stream(home, job["id"], headers={"Last-Event-ID": str(everything[-1][0])}) is None


def test_lists_are_bounded_and_resumed(home):
    job = home.submit()
    url = f"/v1/jobs/{job['id']}/events"
    first = home.client.get(url, params={"format": "json", "limit": 1}).json()
    rest = home.client.get(url, params={"format": "json", "after": first[0]["id"]}).json()
    assert [event["kind"] for event in first + rest] == ["job.created", "tasks.planned"]
    assert first[0]["actor"] == "client:owner" and rest[0]["detail"] == {"prepare": 1}
    assert home.client.get(url, headers={"Last-Event-ID": "x"}).status_code == 422


def test_a_stream_ends_when_the_coordinator_stops(start, eventually):
    with start() as home:
        job, got = home.submit(), []
        reader = threading.Thread(target=read_stream, args=(home, job["id"]), kwargs={"got": got})
        reader.start()
        eventually(lambda: len(got) == 2)
        home.app.state.parts.signals.stop()
        reader.join(timeout=5)
        assert not reader.is_alive()
    assert [entry[1] for entry in got] == ["job.created", "tasks.planned"]


def test_events_cannot_be_changed(home):
    home.submit()
    for statement in ("UPDATE events SET actor = 'me'", "DELETE FROM events"):
        with pytest.raises(psycopg.errors.RaiseException, match="append-only"):
            home.sql(statement)
