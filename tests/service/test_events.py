"""The history of a job, as a list and as a stream that can be resumed."""

import json
import threading
from contextlib import ExitStack, contextmanager

import httpx
import psycopg
import pytest

from kiln_service.config import Limits
from kiln_service.db import Tx


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
    reader.join()
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
        reader.join()
    assert [entry[1] for entry in got] == ["job.created", "tasks.planned"]


@contextmanager
def streams_of(home, job_id, count):
    """So many streams of a job, each of which has shown that it is there."""
    with ExitStack() as stack:
        opened = []
        for _ in range(count):
            reply = stack.enter_context(home.client.stream("GET", f"/v1/jobs/{job_id}/events", timeout=300))
            lines = reply.iter_lines()
            assert reply.status_code == 200 and next(lines).startswith("id: ")
            opened.append(lines)
        yield opened


def test_many_streams_of_a_job_are_fed_by_one_reader(home, monkeypatch):
    """However many there are, each new event is read once; and streams of another job cost no query at all."""
    asked, all_of = [], Tx.all

    async def noted(tx, query, **parameters):
        rows = await all_of(tx, query, **parameters)
        asked.extend(row["id"] for row in rows if query == "read_streamed" and row["id"] is not None)
        asked.extend([query] if query == "read_events" else [])
        return rows

    busy, idle = home.submit(name="busy"), home.submit(name="idle", priority=0)
    home.client.post(f"/v1/jobs/{idle['id']}/pause").raise_for_status()
    with streams_of(home, idle["id"], 10), streams_of(home, busy["id"], 10) as opened, monkeypatch.context() as patch:
        patch.setattr(Tx, "all", noted)
        run(home, busy)
        for lines in opened:
            assert "event: job.completed" in list(lines)
    kinds = {event["id"]: event["kind"] for event in home.events(busy["id"])}
    assert sorted(asked) == list(kinds)[2:] and "task.claimed" in kinds.values()


def test_a_stream_that_is_slow_or_late_misses_nothing(home, monkeypatch):
    monkeypatch.setattr("kiln_service.streams.TAIL", 3)
    monkeypatch.setattr("kiln_service.streams.BATCH", 4)
    job = home.submit()
    got = [[] for _ in range(3)]
    readers = [threading.Thread(target=read_stream, args=(home, job["id"]), kwargs={"got": one}) for one in got]
    readers[0].start()
    run(home, job)
    for reader in readers[1:]:
        reader.start()
    for reader in readers:
        reader.join()
    assert all([entry[2] for entry in one] == home.events(job["id"]) for one in got)


def test_a_token_has_so_many_streams(start):
    with start(limits=Limits(reserve_bytes=0, streams=3)) as home:
        job = home.submit()
        other = home.client.post("/v1/tokens", json={"name": "other", "scopes": ["read"]}).json()["token"]
        url = f"{home.url}/v1/jobs/{job['id']}/events"
        with streams_of(home, job["id"], 3):
            refused = home.client.get(url)
            assert refused.status_code == 429 and "limits.streams" in refused.json()["remedy"]
            assert int(refused.headers["retry-after"]) > 0
            with httpx.stream("GET", url, headers={"Authorization": f"Bearer {other}"}) as reply:
                assert reply.status_code == 200
        with streams_of(home, job["id"], 3):
            pass


def test_events_cannot_be_changed(home):
    home.submit()
    for statement in ("UPDATE events SET actor = 'me'", "DELETE FROM events"):
        with pytest.raises(psycopg.errors.RaiseException, match="append-only"):
            home.sql(statement)
