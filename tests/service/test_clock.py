"""The database's clock is set while tasks run (libfaketime): nobody is lost, and who is lost is noticed."""

import hashlib
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from unittest.mock import patch

import psycopg
import pytest
from farm_clock import FarmClock

from kiln_service.clock import Ahead
from kiln_service.embedded import EmbeddedPostgres
from kiln_service.reaper import reap

HOUR_S = 3600
MINUTES_S = 120
"""No test of speed: what does not happen within minutes does not happen."""


@pytest.fixture(scope="module")
def server() -> Iterator[tuple[EmbeddedPostgres, FarmClock]]:
    """A database server whose processes alone have a clock of their own."""
    with TemporaryDirectory(prefix="kiln-test-") as folder:
        clock = FarmClock()
        assert clock.works, "libfaketime is missing: deploy/install/faketime.sh"
        settings = {"fsync": "off", "full_page_writes": "off"}
        with (
            patch.dict("os.environ", clock.environment()),
            EmbeddedPostgres(Path(folder) / "postgres", settings) as server,
        ):
            yield server, clock
        clock.close()


@pytest.fixture
def clock(server: tuple[EmbeddedPostgres, FarmClock]) -> Iterator[FarmClock]:
    """The server's clock, which is right at the beginning."""
    yield server[1]
    server[1].set(0)


@pytest.fixture
def dsn(server: tuple[EmbeddedPostgres, FarmClock], request: pytest.FixtureRequest) -> str:
    """A database of the test's own on that server."""
    name = "t" + hashlib.sha256(request.node.nodeid.encode()).hexdigest()[:16]
    with psycopg.connect(server[0].dsn, autocommit=True) as connection:
        connection.execute(f"CREATE DATABASE {name}")
    return server[0].dsn.replace("dbname=postgres", f"dbname={name}")


@pytest.fixture
def passes(monkeypatch):
    """A list that grows with each pass of the reaper."""
    done = []

    async def counted(*arguments):
        done.append(await reap(*arguments))

    monkeypatch.setattr("kiln_service.maintenance.reap", counted)
    return done


def test_a_clock_set_forth_takes_no_task_away(start, clock, fast, passes, eventually):
    with start(timing=fast.model_copy(update={"stale_s": 30, "maintenance_s": 0.1})) as home:
        job, worker = home.submit(), home.worker()
        claim = worker.must_claim()
        eventually(lambda: passes, MINUTES_S)
        worker.beat(claim)  # the first pass comes as late as the task could be lost
        count = len(passes)
        clock.set(HOUR_S)
        eventually(lambda: len(passes) > count + 2, MINUTES_S)
        assert "task.lost" not in home.kinds_of_events(job["id"])
        assert worker.beat(claim)["stop"] is False


def test_a_clock_set_back_hides_no_lost_worker(start, clock, fast, passes, eventually):
    with start(timing=fast) as home:
        job, worker = home.submit(), home.worker()
        eventually(lambda: passes, MINUTES_S)
        worker.must_claim()
        clock.set(-HOUR_S)
        eventually(lambda: "task.lost" in home.kinds_of_events(job["id"]), MINUTES_S)


def test_a_clock_set_back_before_a_start_hides_none_either(start, clock, fast, eventually):
    with start(timing=fast) as home:
        job = home.submit()
        home.worker().must_claim()
    clock.set(-HOUR_S)
    with start(timing=fast) as home:
        eventually(lambda: "task.lost" in home.kinds_of_events(job["id"]), MINUTES_S)


def test_what_is_surely_a_setting():
    assert Ahead(10, 10.1).parted_from(Ahead(10, 12)) == 0
    assert Ahead(15, 15.1).parted_from(Ahead(10, 12)) == 3
    assert Ahead(3, 5).parted_from(Ahead(10, 12)) == -5
    assert Ahead(9.5, 9.6).parted_from(Ahead(10, 12)) == 0
