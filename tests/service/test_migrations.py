"""Databases of released versions, as pg_dump wrote them, are migrated by who starts on them, and their jobs go on."""

import hashlib
import subprocess
from pathlib import Path

import psycopg
import pytest

from kiln_service.db.migrate import migrations

RELEASED = sorted((Path(__file__).parent / "released").glob("*.sql"))
PACKAGE = b"0123456789" * 100


@pytest.mark.parametrize("file", RELEASED, ids=lambda file: file.stem)
def test_a_released_database_is_migrated_and_its_jobs_go_on(file, start, dsn, postgres, fast, eventually):
    load = ["--quiet", "--no-psqlrc", "--set=ON_ERROR_STOP=1", f"--file={file}", dsn]
    loaded = subprocess.run([postgres._bin / "psql", *load], capture_output=True, text=True)
    assert loaded.returncode == 0, loaded.stderr
    sha256 = hashlib.sha256(PACKAGE).hexdigest()
    place = start.data / "blobs" / sha256[:2] / sha256
    place.parent.mkdir(parents=True)
    place.write_bytes(PACKAGE)
    with psycopg.connect(dsn, autocommit=True) as connection:
        odd = 'UPDATE tasks SET progress = \'{"done": 1e308, "total": 1e-308, "unit": ""}\' WHERE state = \'active\''
        assert connection.execute(odd).rowcount == 1
    with start(timing=fast) as home:
        versions = [row["version"] for row in home.sql("SELECT version FROM kiln_migrations ORDER BY version")]
        assert versions == [number for number, _, _ in migrations()] and versions[-1] > int(file.stem)
        assert home.sql("SELECT to_regclass('procrastinate_jobs') AS queue") == [{"queue": None}]
        jobs = {job["name"]: job for job in home.client.get("/v1/jobs").json()["jobs"]}
        assert {name: job["state"] for name, job in jobs.items()} == {
            "done": "completed",
            "running": "active",
            "canceled": "canceled",
        }
        artifacts = f"/v1/jobs/{jobs['done']['id']}/artifacts"
        assert home.client.get(f"{artifacts}/lightfield.ktx2").content == PACKAGE
        running = jobs["running"]["id"]
        (kept,) = home.tasks(running, kind="render", state="completed")
        assert kept["worker"] and home.client.get("/v1/metrics").status_code == 200
        before = [event["id"] for event in home.events(running)]
        eventually(lambda: not home.tasks(running, kind="render", state="active"))
        worker = home.worker("new")
        while home.job(running)["state"] == "active":
            worker.finish(worker.must_claim(wait_s=10), tiles=3)
        assert home.job(running)["state"] == "completed"
        (still,) = [task for task in home.tasks(running, kind="render") if task["label"] == kept["label"]]
        assert still["attempt"] == kept["attempt"] == 1, "what was rendered is not rendered again"
        assert [event["id"] for event in home.events(running)][: len(before)] == before
        assert "a line" in "".join(home.client.get(f"/v1/tasks/{t['id']}/log").text for t in home.tasks(running))
    with start() as home:
        assert home.job(running)["state"] == "completed"
