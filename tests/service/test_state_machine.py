"""Whatever people and workers do in whatever order: no illegal state, nothing forgotten, nothing stuck.

Hypothesis drives a real coordinator on a real database with calls in random order, and looks at the rows after each.
"""

from collections import Counter

import pytest
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.stateful import (
    Bundle,
    RuleBasedStateMachine,
    initialize,
    invariant,
    multiple,
    rule,
    run_state_machine_as_test,
)

from kiln_schemas.states import FINAL_JOB_STATES, LIVE_JOB_STATES

ACTIONS = ("pause", "resume", "cancel", "retry", "archive")
EXPECTED = {200, 201, 204, 409}
ROUNDS = 400
"""More calls than any job needs to come to its end."""


class Farm(RuleBasedStateMachine):
    """Two workers and a handful of jobs, of which some have the same light."""

    jobs = Bundle("jobs")
    home = result = None  # of the test

    @initialize()
    def begin(self):
        self.mine, self.claims = [], []
        self.workers = [self.home.worker(f"w{number}") for number in range(2)]

    def teardown(self):
        for job in getattr(self, "mine", []):
            self.home.client.post(f"/v1/jobs/{job}/resume")
        for _ in range(ROUNDS):
            if not self.end(self.workers[0]):
                break
        states = self.rows("SELECT id, state FROM jobs WHERE id = ANY(%s)")
        for row in states:
            if row["state"] in LIVE_JOB_STATES or row["state"] == "cancel-requested":
                self.home.client.post(f"/v1/jobs/{row['id']}/cancel")

    def end(self, worker):
        """Finish what is claimed and what is there; whether there was anything."""
        claim = self.claims.pop() if self.claims else worker.claim()
        if claim is None:
            return False
        assert self.commit(worker, claim).status_code in EXPECTED
        return True

    def commit(self, worker, claim):
        return worker.commit(claim, self.result(self.home, claim))

    def rows(self, query):
        return self.home.sql(query, self.mine) if self.mine else []

    @rule(target=jobs, light=st.integers(0, 1), priority=st.sampled_from([0, 50, 100]))
    def submit(self, light, priority):
        if len(self.mine) >= 4:
            return multiple()
        job = self.home.submit(set=[f"render.samples={8 + light}"], priority=priority)["id"]
        self.mine.append(job)
        return job

    @rule(job=jobs, action=st.sampled_from(ACTIONS))
    def act(self, job, action):
        assert self.home.client.post(f"/v1/jobs/{job}/{action}").status_code in EXPECTED

    @rule(job=jobs, kind=st.sampled_from(["render", "fit", "package"]))
    def requeue(self, job, kind):
        assert self.home.client.post(f"/v1/jobs/{job}/requeue", json={"kind": kind}).status_code in EXPECTED | {422}

    @rule(number=st.integers(0, 1))
    def claim(self, number):
        found = self.workers[number].claim()
        if found is not None:
            self.claims.append(found)

    @rule(data=st.data())
    def finish(self, data):
        if self.claims:
            claim = self.claims.pop(data.draw(st.integers(0, len(self.claims) - 1)))
            assert self.commit(self.workers[0], claim).status_code in EXPECTED

    @rule(data=st.data(), retryable=st.booleans())
    def fail(self, data, retryable):
        if self.claims:
            claim = self.claims.pop(data.draw(st.integers(0, len(self.claims) - 1)))
            assert self.workers[0].fail(claim, retryable=retryable).status_code in EXPECTED

    @rule(data=st.data())
    def beat(self, data):
        if self.claims:
            number = data.draw(st.integers(0, len(self.claims) - 1))
            if self.workers[0].beat(self.claims[number])["stop"]:
                del self.claims[number]

    @invariant()
    def jobs_agree_with_their_tasks(self):
        if not getattr(self, "mine", []):
            return
        tasks = {job: Counter() for job in self.mine}
        for row in self.rows("SELECT job_id, state FROM tasks WHERE job_id = ANY(%s)"):
            tasks[row["job_id"]][row["state"]] += 1
        artifacts = Counter(row["job_id"] for row in self.rows("SELECT job_id FROM artifacts WHERE job_id = ANY(%s)"))
        for row in self.rows("SELECT id, state, error, finished FROM jobs WHERE id = ANY(%s)"):
            state, counts = row["state"], tasks[row["id"]]
            assert (row["finished"] is not None) == (state in FINAL_JOB_STATES)
            assert (row["error"] is not None) == (state == "failed") or state == "archived"
            if state == "completed":
                assert set(counts) == {"completed"} and artifacts[row["id"]] == 2
            elif state != "archived":
                assert artifacts[row["id"]] == 0
            if state in LIVE_JOB_STATES:
                assert counts["queued"] + counts["soft-failed"] + counts["active"] > 0, "a live job has something to do"
                assert counts["canceled"] == 0
            elif state == "cancel-requested":
                assert counts["active"] > 0 and counts["queued"] == counts["soft-failed"] == counts["waiting"] == 0
            else:
                assert counts["queued"] == counts["soft-failed"] == counts["waiting"] == 0

    @invariant()
    def the_history_ends_in_the_state(self):
        for row in (
            self.rows(
                "SELECT jobs.state, (SELECT kind FROM events WHERE job_id = jobs.id AND kind ~ '^job[.]'"
                " AND kind NOT IN ('job.created', 'job.changed') ORDER BY id DESC LIMIT 1) AS last"
                " FROM jobs WHERE id = ANY(%s)"
            )
            if getattr(self, "mine", [])
            else []
        ):
            assert row["last"] in (None, f"job.{row['state']}")


@pytest.mark.filterwarnings("ignore::hypothesis.errors.NonInteractiveExampleWarning")
def test_no_order_of_calls_leads_to_an_illegal_state(home, result):
    machine = type("FarmOfTheTest", (Farm,), {"home": home, "result": staticmethod(result)})
    run_state_machine_as_test(
        machine,
        settings=settings(
            max_examples=25,
            stateful_step_count=30,
            deadline=None,
            derandomize=True,
            suppress_health_check=list(HealthCheck),
            database=None,
        ),
    )
