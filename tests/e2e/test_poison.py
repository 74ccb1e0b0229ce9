"""A tile that kills whoever renders it fails, with its last words; the other tiles and the other jobs go on."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from e2e_farm import Farm, lightkiln, settings, wait_until

HERE = Path(__file__).parent


@pytest.fixture
def worker(farm: Farm, folder: Path):
    environment = os.environ | {"PYTHONPATH": str(HERE)}
    command = [sys.executable, str(HERE / "poisoned_worker.py"), farm.url, farm.token, str(folder)]
    with (folder / "worker.log").open("wb") as log:
        process = subprocess.Popen(command, stdout=log, stderr=log, env=environment)
        yield process
        process.terminate()
        process.wait(600)


def test_a_poisonous_tile_fails_alone(farm: Farm, room_files: tuple[Path, Path], worker) -> None:
    scene, environment = room_files
    job = farm.submit(scene, environment, *settings("render.samples=9"), "--priority", "90")
    other = farm.submit(scene, environment, *settings("render.samples=10"))
    wait_until("the other job is rendered", lambda: _rendered(farm, other))
    wait_until("the first has failed", lambda: farm.state(job) == "failed")
    tiles = {task["label"]: task for task in farm.tasks(job, "render")}
    assert {label for label, task in tiles.items() if task["state"] != "completed"} == {"tile 8,8"}
    poison = tiles["tile 8,8"]
    assert (poison["state"], poison["attempt"]) == ("failed", 4)
    error = farm.get(f"/v1/jobs/{job}")["error"]
    assert "SIGSEGV" in error["detail"] and "about to step on a mine" in error["detail"]
    assert worker.poll() is None, "the worker itself lives on"
    assert farm.state(other) == "active"
    lightkiln("cancel", other, "--url", farm.url, "--token", farm.token)


def _rendered(farm: Farm, job: str) -> bool:
    states = [task["state"] for task in farm.tasks(job, "render")]
    return bool(states) and set(states) == {"completed"}
