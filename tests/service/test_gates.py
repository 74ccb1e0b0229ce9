"""Quality gates in the coordinator: requests accepted and refused, the package task, the job's own final state."""

import asyncio
import json

import psycopg
import pytest

from kiln_schemas.settings import PRESETS
from kiln_service.db import Database
from kiln_service.db.migrate import migrate, migrations

FRONT = {"position": [0, 1, 3], "target": [0, 1, 0], "fov_deg": 42}
GATES = {"log_mse_rel": 0.2, "flip": {"front": 0.08}}


def measured(log_mse_rel: float, flip: float) -> list[dict[str, object]]:
    return [
        {"name": "log_mse_rel", "value": log_mse_rel, "threshold": 0.2, "passed": log_mse_rel <= 0.2},
        {
            "name": "flip.front",
            "value": flip,
            "threshold": 0.08,
            "passed": flip <= 0.08,
            "flip_of_halves": 0.015,
            "noise_floor": 0.01,
        },
    ]


def to_package(home):
    """A job with gates, and the claim of its package task."""
    job, worker = home.submit(gates=GATES, cameras={"front": FRONT}), home.worker()
    worker.advance(job["id"], "package")
    return job["id"], worker, worker.must_claim("package")


def test_gates_reach_the_package_task_and_the_client(home):
    job_id, _, claim = to_package(home)
    view, payload = home.job(job_id), claim["payload"]
    expected = {"log_mse_rel": 0.2, "visibility_log_mse_rel": None, "flip": {"front": 0.08}}
    assert view["gates"] == payload["gates"] == expected
    assert view["cameras"] == payload["cameras"] == {"front": FRONT | {"up": [0, 1, 0]}}
    assert view["gate_results"] == []


@pytest.mark.parametrize(
    ("log_mse_rel", "flip", "state", "missed"),
    [
        (0.1, 0.08, "completed", []),
        (0.1, 0.09, "gate-failed", ["flip.front is 0.09, more than the threshold 0.08"]),
        (0.3, 0.09, "gate-failed", ["log_mse_rel is 0.3, more than the threshold 0.2", "flip.front is 0.09"]),
    ],
)
def test_a_job_ends_as_its_gates_say(home, result, log_mse_rel, flip, state, missed):
    job_id, worker, claim = to_package(home)
    done = result(home, claim) | {"gates": measured(log_mse_rel, flip)}
    assert worker.commit(claim, done).status_code == 204
    assert worker.commit(claim, done).status_code == 204, "the same commit again is no error"
    view = home.job(job_id)
    assert view["state"] == state and view["finished"] and view["remaining_s"] is None
    assert [gate["value"] for gate in view["gate_results"]] == [log_mse_rel, flip]
    assert home.tasks(job_id, kind="package")[0]["state"] == "completed", "an unmet gate is no failure of the task"
    assert len(home.client.get(f"/v1/jobs/{job_id}/artifacts").json()) == 2
    assert home.client.get(f"/v1/jobs/{job_id}/artifacts/lightfield.ktx2").content == b"0123456789" * 100
    event = home.events(job_id)[-1]
    assert event["kind"] == f"job.{state}" and len(event["detail"]["gates"]) == 2
    if not missed:
        assert view["error"] is None
        return
    problem = view["error"]
    assert problem["code"] == "gate-failed" and event["detail"]["problem"] == problem
    assert all(sentence in problem["detail"] for sentence in missed) and problem["remedy"]
    assert home.client.post(f"/v1/jobs/{job_id}/cancel").status_code == 409
    listed = home.client.get("/v1/jobs", params={"state": "gate-failed"}).json()["jobs"]
    assert [job["id"] for job in listed] == [job_id]


@pytest.mark.parametrize(
    "gates",
    [
        [],
        measured(0.1, 0.01)[:1],
        [*measured(0.1, 0.01), measured(0.1, 0.01)[0]],
        [measured(0.1, 0.01)[0] | {"threshold": 0.9}, measured(0.1, 0.01)[1]],
        [measured(0.1, 0.01)[0] | {"passed": False}, measured(0.1, 0.01)[1]],
    ],
    ids=["none", "one missing", "one twice", "another threshold", "a wrong verdict"],
)
def test_a_worker_cannot_leave_gates_out_or_bend_them(home, result, gates):
    job_id, worker, claim = to_package(home)
    reply = worker.commit(claim, result(home, claim) | {"gates": gates})
    assert reply.status_code == 422 and reply.json()["code"] == "input"
    assert home.job(job_id)["state"] == "active"


def test_gates_that_are_accepted(home):
    for changes in (
        {"gates": {}},
        {"gates": {"log_mse_rel": 1}},
        {"gates": {"visibility_log_mse_rel": 0.05}},
        {"gates": {"flip": {"a.b-c_1": 0.5}}, "cameras": {"a.b-c_1": FRONT}},
        {"cameras": {"unused": FRONT}},
        {"cameras": {f"c{number}": FRONT for number in range(32)}},
    ):
        job = home.submit(**changes)
        assert changes.get("gates", {}).items() <= job["gates"].items()
        assert job["cameras"].keys() == changes.get("cameras", {}).keys()


@pytest.mark.parametrize(
    ("changes", "where", "word"),
    [
        ({"gates": {"log_mse": 0.2}}, "gates.log_mse", "0.2"),
        ({"gates": {"log_mse_rel": 0}}, "gates.log_mse_rel", "0"),
        ({"gates": {"log_mse_rel": 1.5}}, "gates.log_mse_rel", "1.5"),
        ({"gates": {"log_mse_rel": "good"}}, "gates.log_mse_rel", "good"),
        ({"gates": {"flip": {"front": 0.1}}}, "gates.flip.front", "no camera 'front'"),
        ({"gates": {"flip": {"front": -1}}, "cameras": {"front": FRONT}}, "gates.flip.front", "-1"),
        ({"gates": {"flip": 0.1}}, "gates.flip", "0.1"),
        ({"cameras": {"../front": FRONT}}, "cameras", "../front"),
        ({"cameras": {"front_reference": FRONT}}, "cameras", "front_reference"),
        ({"cameras": {"front": FRONT | {"fov_deg": 180}}}, "cameras.front.fov_deg", "180"),
        ({"cameras": {"front": FRONT | {"target": [0, 1, 3]}}}, "cameras.front", "coincide"),
        ({"cameras": {"front": FRONT | {"target": [0, 9, 3]}}}, "cameras.front", "along"),
        ({"cameras": {"front": {"position": [0, 1, 3]}}}, "cameras.front.target", "required"),
        ({"cameras": {f"c{number}": FRONT for number in range(33)}}, "cameras", "32"),
    ],
)
def test_gates_that_are_refused(shared, changes, where, word):
    before = shared.sql("SELECT count(*) AS jobs FROM jobs")
    reply = shared.client.post("/v1/jobs", json=shared.request(**changes))
    problem = reply.json()
    assert reply.status_code == 422 and problem["where"].startswith(where), problem
    assert word in problem["detail"]
    assert shared.sql("SELECT count(*) AS jobs FROM jobs") == before


def test_a_visibility_gate_needs_an_environment(home):
    """Nothing is rendered for a gate that has nothing to measure."""
    job, worker = home.submit(gates={"visibility_log_mse_rel": 0.05}), home.worker()
    worker.finish(worker.must_claim("prepare"), has_environment=False)
    view = home.job(job["id"])
    assert view["state"] == "failed" and view["error"]["where"] == "gates.visibility_log_mse_rel"
    assert worker.claim() is None


def test_an_old_database_keeps_its_jobs(start, dsn, monkeypatch):
    """A database of version 1 that holds jobs is migrated by the coordinator that starts on it."""
    known = migrations()
    with monkeypatch.context() as old:
        old.setattr("kiln_service.db.migrate.migrations", lambda: known[:1])
        assert asyncio.run(migrated(dsn)) == ["0001_initial.sql"]
    jobs = {"a" * 32: "completed", "b" * 32: "queued"}
    settings, bundle = PRESETS["draft"].model_dump_json(), json.dumps({"entry": "a", "files": {"a": "0" * 64}})
    with psycopg.connect(dsn, autocommit=True) as connection:
        for job_id, state in jobs.items():
            connection.execute(
                "INSERT INTO jobs (id, name, method, state, settings, bundle, store_url)"
                " VALUES (%s, 'old', 'sg_lightfield', %s, %s, %s, 'file:///store')",
                [job_id, state, settings, bundle],
            )
        with pytest.raises(psycopg.errors.CheckViolation):
            connection.execute("UPDATE jobs SET state = 'gate-failed'")
        insert = (
            "INSERT INTO tasks (id, job_id, ordinal, kind, label, state, spec)"
            " VALUES (%s, %s, 1, %s, 'x', 'waiting', '{}')"
        )
        connection.execute(insert, ["c" * 32, "a" * 32, "package"])
        with pytest.raises(psycopg.errors.CheckViolation):
            connection.execute(insert, ["d" * 32, "a" * 32, "refine"])
    with start() as home:
        versions = [row["version"] for row in home.sql("SELECT version FROM kiln_migrations ORDER BY version")]
        assert versions == [number for number, _, _ in known] and versions[0] == 1 and len(known) >= 7
        for job_id, state in jobs.items():
            view = home.job(job_id)
            assert (view["name"], view["state"], view["gate_results"], view["cameras"]) == ("old", state, [], {})
            assert (view["priority"], view["labels"], view["renders_of"]) == (50, {}, None)
            assert view["gates"] == {"log_mse_rel": None, "visibility_log_mse_rel": None, "flip": {}}
        assert home.sql("SELECT kind FROM tasks") == [{"kind": "package"}]
        home.sql("UPDATE tasks SET kind = 'refine'")
        home.sql("UPDATE jobs SET state = 'gate-failed'")
        assert {job["state"] for job in home.client.get("/v1/jobs").json()["jobs"]} == {"gate-failed"}
    assert asyncio.run(migrated(dsn)) == []


async def migrated(dsn: str) -> list[str]:
    async with Database(dsn) as database:
        return await migrate(database)
