"""Every hostile bundle ends as a failed job with an input error that names the cause; one worker takes them all.

The bundles go through a real coordinator to a real worker whose prepare task is watched (`hostile_stages`): its child
process is the same from the first to the last, its memory's peak is bounded for every single one, and it opens nothing
but what is its own. The kernel tells of anybody who opens a file in the folder of secrets.
"""

import hashlib
import json
import os
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import httpx
import psutil
import pytest
from e2e_farm import Farm, wait_until
from hostile_scenes import GOOD, SCENES, SECRETS, Bad
from watched_folder import WatchedFolder, watched

from kiln_schemas.errors import InputError, Problem
from kiln_service.cli.bundle import collect
from kiln_workers.stages.prepare import few_notes

GROWTH_BYTES = 320 << 20
"""Most by which the peak of the worker's memory may rise over one bundle; the largest file has 29 MiB."""
OVER = {"completed", "failed", "canceled"}
SETTINGS = ["lightmap.resolution=8", "lightmap.tile=8", "render.image_size=16"]


@dataclass(frozen=True)
class Range:
    """Where it all happens."""

    owner: httpx.Client
    jobs: dict[str, str]  # by the bundle's name
    worker: psutil.Process
    child: int
    outside: Path
    watch: WatchedFolder
    grown: dict[str, int] = field(default_factory=dict)  # by the bundle's name
    seconds: dict[str, float] = field(default_factory=dict)


@pytest.fixture(scope="module")
def outside(hostile_folder: Path) -> Path:
    """A folder beside those of the farm, with files that a scene might want."""
    folder = hostile_folder / "outside"
    folder.mkdir()
    for name in SECRETS:
        (folder / name).write_bytes(b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    return folder


@pytest.fixture(scope="module")
def bundles(hostile_folder: Path, outside: Path) -> Path:
    """All bundles as folders, each in a folder of its number, as `scene`."""
    for number, bad in enumerate((GOOD, *SCENES)):
        for name, data in bad.build(outside).items():
            file = hostile_folder / "bundles" / str(number) / name
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_bytes(data)
    return hostile_folder / "bundles"


@pytest.fixture(scope="module")
def fired(target: Farm, owner: httpx.Client, hostile_folder: Path, outside: Path, bundles: Path) -> Iterator[Range]:
    """Submit all of them; the worker goes through them while the tests wait."""
    folder = hostile_folder / "worker"
    command = [
        sys.executable,
        str(Path(__file__).with_name("hostile_worker.py")),
        target.url,
        target.token,
        str(folder),
    ]
    with (
        (hostile_folder / "worker.log").open("wb") as log,
        subprocess.Popen(
            command, stdout=log, stderr=log, env=os.environ | {"PYTHONPATH": str(Path(__file__).parent)}
        ) as started,
        watched(outside) as watch,
    ):
        try:
            jobs = {bad.name: submit(owner, bundles / str(i), bad, outside) for i, bad in enumerate((GOOD, *SCENES))}
            wait_until("the good scene is prepared", lambda: "package" in kinds(owner, jobs[GOOD.name]))
            worker = psutil.Process(started.pid)
            (child,) = worker.children()
            watch.acts()  # of the building
            fired = Range(owner, jobs, worker, child.pid, outside, watch)
            yield fired
            for what, values, unit in (("memory", fired.grown, 1 << 20), ("time", fired.seconds, 1)):
                name = max(values, key=lambda name: values[name], default=None)
                if name is None:
                    continue
                print(f"most {what}: {values[name] / unit:.1f} {'MiB' if unit > 1 else 's'} for {name}")
        finally:
            started.terminate()
            started.wait(30)
    left = {path.relative_to(folder).parts[0] for path in folder.rglob("*") if path.is_file()}
    assert left <= {"blobs"}, "what a task leaves behind"


def kinds(owner: httpx.Client, job: str) -> set[str]:
    return {task["kind"] for task in owner.get(f"/v1/jobs/{job}/tasks").raise_for_status().json()}


def submit(owner: httpx.Client, folder: Path, bad: Bad, outside: Path) -> str:
    files = {}
    for path in sorted(p for p in folder.rglob("*") if p.is_file()):
        data = path.read_bytes()
        files[path.relative_to(folder).as_posix()] = digest = hashlib.sha256(data).hexdigest()
        owner.put(f"/v1/blobs/{digest}", content=data).raise_for_status()
    entry = next(iter(bad.build(outside)))
    environment = {"environment": {"file": bad.environment}} if bad.environment else {}
    request = {
        "name": bad.name[:100],
        "preset": "draft",
        "set": SETTINGS,
        "bundle": {"entry": entry, "files": files, **environment},
    }
    return str(owner.post("/v1/jobs", json=request).raise_for_status().json()["id"])


@pytest.mark.parametrize("bad", SCENES, ids=lambda bad: bad.name)
def test_a_bundle_is_refused(fired: Range, bad: Bad) -> None:
    job = fired.jobs[bad.name]
    view: dict[str, Any] = wait_until("the job ends", lambda: ended(fired.owner, job), 120)
    assert view["state"] == "failed", view
    problem = Problem.model_validate(view["error"])
    assert problem.code in ("input", "too-large") and 400 <= problem.status < 500, problem
    assert bad.word in problem.sentence() and problem.detail
    assert len(problem.model_dump_json()) < 8192 and "\x1b" not in problem.sentence()

    (task,) = fired.owner.get(f"/v1/jobs/{job}/tasks", params={"kind": "prepare"}).json()
    assert task["attempt"] == 1, "a wrong input is not tried again"
    log = fired.owner.get(f"/v1/tasks/{task['id']}/log").text
    assert "Traceback" not in log
    (line,) = {line for line in log.splitlines() if line.startswith("WATCHED")}
    told = json.loads(line.removeprefix("WATCHED "))
    assert told["strays"] == [] and told["acts"] > 0
    assert told["grown"] < GROWTH_BYTES, told
    fired.grown[bad.name], fired.seconds[bad.name] = told["grown"], told["seconds"]
    assert fired.watch.acts() == [], "a file outside was touched"
    assert [child.pid for child in fired.worker.children()] == [fired.child], "the worker's process died"


def ended(owner: httpx.Client, job: str) -> dict[str, Any] | None:
    view: dict[str, Any] = owner.get(f"/v1/jobs/{job}").raise_for_status().json()
    return view if view["state"] in OVER else None


def test_the_command_line_collects_or_refuses(outside: Path, bundles: Path) -> None:
    """The same bundles where they are put together: only names are read, and none outside is opened or taken."""
    refused = 0
    with watched(outside) as watch:
        for number, bad in enumerate((GOOD, *SCENES)):
            folder = bundles / str(number)
            entry = next(iter(bad.build(outside)))
            sky = folder / bad.environment if bad.environment else None
            try:
                collected = collect(folder / entry, sky)
            except InputError as error:
                refused += 1
                assert error.detail and "\x1b" not in str(error), bad.name
            else:
                assert all(path.is_relative_to(folder) for path in collected.sources.values()), bad.name
        assert watch.acts() == []
    assert refused > 50


def test_links_are_not_followed_out_of_a_folder(outside: Path, tmp_path: Path) -> None:
    """A bundle holds no links, but the folder that it is collected from may."""
    (tmp_path / "lib.mtl").symlink_to(outside / "secret.mtl")
    (tmp_path / "folder").symlink_to(outside, target_is_directory=True)
    for text in ("mtllib lib.mtl\n", "mtllib folder/secret.mtl\n"):
        (tmp_path / "scene.obj").write_text(text + "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
        with watched(outside) as watch:
            with pytest.raises(InputError, match="link that leaves"):
                collect(tmp_path / "scene.obj")
            assert not [act for act in watch.acts() if "secret" in act]
    with watched(outside) as watch:
        (outside / "secret.mtl").read_bytes()
        assert [act for act in watch.acts() if "secret.mtl" in act], "the watch sees nothing"
    (tmp_path / "loop").symlink_to(tmp_path / "loop")
    (tmp_path / "scene.obj").write_text("mtllib loop\nusemtl a\nv 0 0 0\n")
    assert list(collect(tmp_path / "scene.obj").sources) == ["scene.obj"]


def test_there_are_enough_of_them() -> None:
    names = [bad.name for bad in SCENES]
    assert len(names) == len(set(names)) >= 100


def test_notes_of_a_large_scene_are_few() -> None:
    notes = few_notes([f"Mesh '{i}': unwrapped." for i in range(5000)])
    assert len(notes) == 1001 and notes[-1] == "4000 more notes are left out."
