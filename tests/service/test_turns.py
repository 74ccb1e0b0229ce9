"""What one worker asks many times at once takes one connection of the pool and leaves the others to other clients."""

import threading

import psycopg
import pytest

ASKED = 12
MINUTES_S = 120
"""No test of speed: what does not happen within minutes does not happen."""


@pytest.mark.parametrize("what", ["claim", "beat", "register"])
def test_calls_that_wait_for_one_row_leave_connections_to_others(start, eventually, what):
    with start(pool_size=4) as home, psycopg.connect(home.config.database) as holder:
        home.submit()
        worker = home.worker()
        claim = worker.must_claim()
        calls = {"claim": worker.claim, "beat": lambda: worker.beat(claim), "register": home.worker}
        if what == "register":
            holder.execute("LOCK TABLE workers IN EXCLUSIVE MODE")
        else:
            holder.execute("SELECT FROM workers WHERE id = %s FOR UPDATE", [worker.id])
        threads = [threading.Thread(target=calls[what]) for _ in range(ASKED)]
        for thread in threads:
            thread.start()
        eventually(lambda: waiting(home) >= 1, MINUTES_S)
        assert all(home.client.get("/v1/jobs").status_code == 200 for _ in range(5))
        assert waiting(home) == 1
        holder.rollback()
        for thread in threads:
            thread.join()


def waiting(home):
    """Connections that wait for a lock."""
    query = (
        "SELECT count(*) AS count FROM pg_stat_activity WHERE wait_event_type = 'Lock' AND datname = current_database()"
    )
    return home.sql(query)[0]["count"]
