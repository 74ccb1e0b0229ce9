"""Bad input: each gets its code, a sentence and no trace of a job."""

import time

import psycopg
import pytest

from kiln_schemas.settings import PRESETS
from kiln_service.config import Limits, Timing


@pytest.mark.parametrize(
    ("changes", "status", "where", "word"),
    [
        ({"preset": "best"}, 422, "preset", "best"),
        ({"set": ["render.sampels=3"]}, 422, "--set", "render.sampels"),
        ({"set": ["render.samples"]}, 422, "--set", "="),
        ({"set": ["lightmap.resolution=0"]}, 422, "lightmap.resolution", "0"),
        ({"set": ["lightmap.resolution=100000"]}, 422, "lightmap.resolution", "100000"),
        ({"set": ["render.samples=many"]}, 422, "render.samples", "many"),
        ({"name": ""}, 422, "name", "''"),
        ({"nonsense": 1}, 422, "nonsense", "1"),
        ({"preset": "draft", "settings": "draft"}, 422, "settings", "both"),
    ],
)
def test_settings_that_are_wrong(shared, changes, status, where, word):
    if changes.get("settings"):
        changes = changes | {"settings": PRESETS["draft"].model_dump(mode="json")}
    before = shared.sql("SELECT count(*) AS jobs FROM jobs")
    reply = shared.client.post("/v1/jobs", json=shared.request(**changes))
    problem = reply.json()
    assert (reply.status_code, problem["where"]) == (status, where), problem
    assert word in problem["detail"] and reply.headers["content-type"] == "application/problem+json"
    assert shared.sql("SELECT count(*) AS jobs FROM jobs") == before


@pytest.mark.parametrize("resolution", [0, 100_000])
def test_complete_settings_with_an_impossible_light_map(shared, resolution):
    settings = PRESETS["draft"].model_dump(mode="json")
    settings["lightmap"]["resolution"] = resolution
    reply = shared.client.post("/v1/jobs", json=shared.request(preset=None, settings=settings))
    problem = reply.json()
    assert reply.status_code == 422 and problem["where"] == "settings.lightmap.resolution"
    assert str(resolution) in problem["detail"]


@pytest.mark.parametrize(
    "path", ["../scene.glb", "/etc/passwd", "a/../../b", "a//b", "./a", "C:/a", "a\\b", "a\0b", "..", "a/.."]
)
def test_paths_that_leave_the_bundle(shared, path):
    sha256 = shared.upload(b"a scene")
    before = shared.sql("SELECT count(*) AS jobs FROM jobs")
    for bundle in (
        {"entry": path, "files": {path: sha256}},
        {"entry": "scene.glb", "files": {"scene.glb": sha256, path: sha256}},
    ):
        reply = shared.client.post("/v1/jobs", json=shared.request(bundle=bundle))
        assert reply.status_code == 422 and reply.json()["code"] == "input", reply.text
        assert reply.json()["where"] == "bundle.files"
    assert shared.sql("SELECT count(*) AS jobs FROM jobs") == before


def test_entry_and_environment_must_be_in_the_bundle(shared):
    files = {"scene.glb": shared.upload(b"a scene")}
    for bundle, where in (
        ({"entry": "other.glb", "files": files}, "bundle.entry"),
        ({"entry": "scene.glb", "files": files, "environment": {"file": "sky.exr"}}, "bundle.environment.file"),
    ):
        reply = shared.client.post("/v1/jobs", json=shared.request(bundle=bundle))
        assert reply.status_code == 422 and reply.json()["where"] == where


def test_files_that_were_not_uploaded_are_named(shared):
    bundle = {"entry": "scene.glb", "files": {"scene.glb": shared.upload(b"a scene"), "wood.png": "d" * 64}}
    reply = shared.client.post("/v1/jobs", json=shared.request(bundle=bundle))
    assert reply.status_code == 409 and reply.json()["where"] == "bundle.files"
    assert "wood.png" in reply.json()["detail"] and "scene.glb" not in reply.json()["detail"]


@pytest.mark.parametrize("body", [b"", b"{", b"[]", b'"text"', b"\xff\xfe", b'{"name": NaN}'])
def test_bodies_that_are_no_request(shared, body):
    reply = shared.client.post("/v1/jobs", content=body, headers={"Content-Type": "application/json"})
    assert reply.status_code == 422 and reply.headers["content-type"] == "application/problem+json"


def test_a_body_over_the_bound(start):
    with start(limits=Limits(reserve_bytes=0, body_bytes=1000)) as home:
        reply = home.client.post("/v1/blobs/missing", json={"sha256": ["0" * 64] * 100})
        assert reply.status_code == 413 and reply.json()["code"] == "too-large"


def test_no_such_route_method_job_or_cursor(shared):
    for method, path, status, code in (
        ("GET", "/v1/nothing", 404, "not-found"),
        ("DELETE", "/v1/jobs", 405, "method-not-allowed"),
        ("GET", "/v1/jobs/none", 404, "not-found"),
        ("GET", "/v1/jobs/none/tasks", 404, "not-found"),
        ("GET", "/v1/jobs/none/events", 404, "not-found"),
        ("GET", "/v1/jobs/none/artifacts", 404, "not-found"),
        ("GET", "/v1/tasks/none/log", 404, "not-found"),
        ("GET", "/v1/jobs?cursor=zzz", 422, "input"),
        ("GET", "/v1/jobs?state=busy", 422, "input"),
        ("GET", "/v1/jobs?limit=0", 422, "input"),
    ):
        reply = shared.client.request(method, path)
        assert (reply.status_code, reply.json()["code"]) == (status, code), path


def test_a_defect_gives_an_id_that_is_in_the_log_and_no_traceback(home, caplog):
    job = home.submit()
    home.sql("UPDATE jobs SET settings = '{}'")
    reply = home.client.get(f"/v1/jobs/{job['id']}")
    assert reply.status_code == 500 and reply.json()["code"] == "internal"
    assert "Traceback" not in reply.text and "ValidationError" not in reply.text
    defect = reply.json()["detail"].removeprefix("defect ")
    assert any(defect in record.message and record.exc_info for record in caplog.records)


def test_a_database_that_is_away_is_503(start, postgres):
    with start(timing=Timing(database_s=0.5, maintenance_s=0.3)) as home:
        home.submit()
        name = home.sql("SELECT current_database() AS name")[0]["name"]
        with psycopg.connect(postgres.dsn, autocommit=True) as admin:
            admin.execute(f"ALTER DATABASE {name} WITH ALLOW_CONNECTIONS false")
            admin.execute("SELECT pg_terminate_backend(pid) FROM pg_stat_activity WHERE datname = %s", [name])
            for path in ("/v1/jobs", "/readyz"):
                reply = home.client.get(path)
                assert reply.status_code == 503 and reply.json()["code"] == "unreachable", path
            assert home.client.get("/healthz").status_code == 200
            admin.execute(f"ALTER DATABASE {name} WITH ALLOW_CONNECTIONS true")
        deadline = time.monotonic() + 300
        while home.client.get("/readyz").status_code != 200:
            assert time.monotonic() < deadline
            time.sleep(0.1)
        assert len(home.client.get("/v1/jobs").json()["jobs"]) == 1
        assert home.worker().must_claim()["payload"]["kind"] == "prepare"
