"""A backup is made and restored by the lines of deploy/README.md, while a job runs; the job goes on from there."""

import os
import re
import shutil
import subprocess
from pathlib import Path

import pytest

README = Path(__file__).parents[2] / "deploy/README.md"


@pytest.fixture
def lines(postgres):
    """Runs a block of the section on backups, with these variables."""
    section = README.read_text().split("## Backup")[1].split("\n## ")[0]
    blocks = re.findall(r"```sh\n(.*?)```", section, re.DOTALL)
    assert len(blocks) == 2

    def run(number, **variables):
        path = f"{postgres._bin}:{os.environ['PATH']}"
        done = subprocess.run(
            ["bash", "-euc", blocks[number]],
            env=os.environ | {"PATH": path} | variables,
            capture_output=True,
            text=True,
        )
        assert done.returncode == 0, done.stderr

    return run


def test_a_backup_of_a_running_farm_is_restored(start, other_dsn, fast, lines, tmp_path, eventually):
    backup, elsewhere = tmp_path / "backup", tmp_path / "elsewhere"
    for folder in (backup, elsewhere):
        folder.mkdir()
    with start() as home:
        (start.data / "store").mkdir()
        done, worker = home.submit(name="done")["id"], home.worker()
        while (claim := worker.claim()) is not None:
            worker.finish(claim)
        job = home.submit(name="running", set=["render.samples=9"])["id"]
        worker.finish(worker.must_claim("prepare"), tiles=4)
        worker.finish(worker.must_claim("render"))
        running = worker.must_claim("render")
        unused = home.upload(b"uploaded, and used by nobody")
        lines(0, BACKUP=str(backup), DATABASE=home.config.database, STORAGE=str(start.data))
        worker.finish(running)
        after = home.upload(b"uploaded after the dump")
        rendered = {task["label"] for task in home.tasks(job, kind="render", state="completed")}
        assert len(rendered) == 2
    lines(1, BACKUP=str(backup), DATABASE=other_dsn, STORAGE=str(elsewhere))
    shutil.copy(start.data / "token", elsewhere / "token")
    with start(database=other_dsn, data=elsewhere, timing=fast) as home:
        assert home.job(done)["state"] == "completed"
        assert home.client.get(f"/v1/jobs/{done}/artifacts/lightfield.ktx2").content == b"0123456789" * 100
        missing = home.client.post("/v1/blobs/missing", json={"sha256": [unused, after]}).json()["missing"]
        assert missing == [unused, after], "clients send them again"
        assert home.upload(b"uploaded, and used by nobody") == unused
        kept = home.tasks(job, kind="render", state="completed")
        assert len(kept) == 1 and kept[0]["label"] in rendered
        heir = home.worker("heir")
        eventually(lambda: not home.tasks(job, kind="render", state="active"))
        while home.job(job)["state"] != "completed":
            heir.finish(heir.must_claim(wait_s=10))
        labels = [event["detail"]["label"] for event in home.events(job) if event["kind"] == "task.completed"]
        assert len(labels) == len(set(labels)), "nothing that was kept is done twice"
        assert "task.lost" in home.kinds_of_events(job)
