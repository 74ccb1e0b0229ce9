"""Logs of tasks: bounded by attempt, by job and in all, and read by ranges."""

import psycopg
import pytest

from kiln_service.config import Limits, LogLimits
from kiln_service.db import Tx

LINE = "x" * 99 + "\n"


@pytest.fixture
def small(start, monkeypatch):
    """A coordinator with small bounds that looks at the sizes at every piece."""
    monkeypatch.setattr("kiln_service.task_logs.LOOK_BYTES", 1)
    bounds = LogLimits(attempt_bytes=20_000, job_bytes=50_000, all_bytes=80_000, answer_bytes=3_000)
    with start(limits=Limits(reserve_bytes=0, logs=bounds)) as home:
        yield home


def size(home, where="true"):
    (row,) = home.sql(f"SELECT COALESCE(sum(octet_length(lines)), 0)::int AS n FROM task_logs WHERE {where}")
    return row["n"]


def has_looked(home):
    """Whether the coordinator has looked at the sizes since the last piece came in."""
    return home.app.state.parts.work._logs._look.done()


def write(worker, claim, pieces):
    """So many pieces of ten lines, each numbered."""
    for number in range(pieces):
        worker.beat(claim, log=f"piece {number}\n" + 9 * LINE)


def claims_of(home, jobs, tiles):
    """Tiles of so many jobs, claimed."""
    worker, claims = home.worker(), []
    for number in range(jobs):
        job = home.submit(set=[f"render.samples={8 + number}"])
        worker.finish(worker.must_claim("prepare"), tiles=tiles)
        claims += [(job["id"], worker.must_claim("render")) for _ in range(tiles)]
    return worker, claims


def test_an_attempt_keeps_its_newest_lines_and_says_what_it_dropped(small, eventually):
    worker, ((_, claim),) = claims_of(small, 1, 1)
    write(worker, claim, 60)
    eventually(lambda: has_looked(small) and size(small) <= 20_000)
    kept = small.client.get(f"/v1/tasks/{claim['task_id']}/log", params={"tail": 1000}).text
    told = [line for line in kept.splitlines() if "dropped" in line]
    (row,) = small.sql("SELECT bytes::int, dropped::int FROM log_sizes")
    assert row["bytes"] == size(small) and row["bytes"] + row["dropped"] == sum(
        len(f"piece {number}\n") + 900 for number in range(60)
    )
    assert "piece 59\n" in kept and "\npiece 0\n" not in kept and row["dropped"] > 30_000
    whole = read_whole(small, claim)
    assert f"--- {row['dropped']} bytes before this were dropped, the log was too long" in whole and told == []


def read_whole(home, claim):
    """A log, answer by answer from its end."""
    parts, params = [], {}
    while True:
        reply = home.client.get(f"/v1/tasks/{claim['task_id']}/log", params=params).raise_for_status()
        assert len(reply.content) <= 3_000 + 2_000, "a bound and a piece"
        text = reply.text
        if text.startswith("--- the log is longer"):
            text = text.partition("\n")[2]
        parts.append(text)
        if "x-log-before" not in reply.headers:
            return "".join(reversed(parts))
        params = {"before": reply.headers["x-log-before"]}


def test_a_log_is_read_answer_by_answer_and_a_tail_alone(home, monkeypatch):
    monkeypatch.setattr(
        home.config.limits.logs, "__dict__", {**home.config.limits.logs.__dict__, "answer_bytes": 3_000}
    )
    worker, ((_, claim),) = claims_of(home, 1, 1)
    write(worker, claim, 30)
    worker.beat(claim, log="the last line")
    lines = [line for line in read_whole(home, claim).splitlines() if not line.startswith("---")]
    expected = [line for number in range(30) for line in (f"piece {number}", *9 * [LINE.strip()])]
    assert lines == [*expected, "the last line"]

    read, all_of = [], Tx.all

    async def noted(tx, query, **parameters):
        rows = await all_of(tx, query, **parameters)
        read.extend(rows if query == "log_before" else [])
        return rows

    with monkeypatch.context() as patch:
        patch.setattr(Tx, "all", noted)
        reply = home.client.get(f"/v1/tasks/{claim['task_id']}/log", params={"tail": 1})
        assert reply.text == "the last line\n" and len(read) == 1, "of 31 pieces"


def test_jobs_and_the_whole_farm_are_bounded_too(small, eventually):
    worker, claims = claims_of(small, 3, 4)
    for _, claim in claims:
        write(worker, claim, 18)  # of each attempt less than its bound
    eventually(lambda: has_looked(small) and size(small) <= 80_000)
    first, *_, (last, newest) = claims
    for job, _ in claims[::4]:
        assert size(small, f"task_id IN (SELECT id FROM tasks WHERE job_id = '{job}')") <= 50_000
    assert size(small, f"task_id IN (SELECT id FROM tasks WHERE job_id = '{last}')") > 0
    assert "bytes before this were dropped" in read_whole(small, first[1])
    assert "piece 17" in read_whole(small, newest)


def test_a_heartbeat_that_logs_waits_for_nobody_who_holds_the_job(home):
    """Commits and claims lock the job, then its tasks; a heartbeat has its task and must not ask for the job."""
    job = home.submit()
    worker = home.worker()
    claim = worker.must_claim()
    with psycopg.connect(home.config.database or "") as holder:
        holder.execute("SELECT 1 FROM jobs WHERE id = %s FOR UPDATE", (job["id"],))
        worker.beat(claim, log="a line\n")
    assert size(home) == len("a line\n")
