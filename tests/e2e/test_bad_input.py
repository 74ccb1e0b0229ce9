"""Bad input through the whole path, from the command to a worker and back: a sentence, the right code, no result.

What is refused before a worker sees it (settings, presets, paths, tokens, uploads) is tested where it is refused:
tests/cli/test_commands.py, tests/service/test_requests.py, test_auth.py and test_blobs.py.
"""

import json
import resource
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import psutil
import pytest
from e2e_farm import Farm, lightkiln, room, settings

from kiln_workers.package.glb import encode_glb
from kiln_workers.package.png import encode
from kiln_workers.scene.examples import write_exr
from kiln_workers.scene.model import Scene

TRIANGLE = "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"
LARGEST_FILE = 40_000
"""Bytes; smaller than a tile's shard, larger than everything else that a worker writes for the room."""


def obj(text: str) -> Callable[[Path], Path]:
    """Writes an OBJ file into a folder."""

    def write(folder: Path) -> Path:
        (folder / "scene.obj").write_text(text)
        return folder / "scene.obj"

    return write


def glb(change: Callable[[Scene], Scene]) -> Callable[[Path], Path]:
    """Writes the room, changed, as GLB."""

    def write(folder: Path) -> Path:
        (folder / "scene.glb").write_bytes(encode_glb(change(room())))
        return folder / "scene.glb"

    return write


def stacked(scene: Scene) -> Scene:
    """Every mesh in the same quarter of the light map."""
    return replace(scene, meshes=tuple(replace(m, lightmap_uv=scene.meshes[0].lightmap_uv) for m in scene.meshes))


@pytest.fixture(scope="module")
def preparing(farm: Farm) -> Iterator[Farm]:
    """The farm with a worker that prepares and does nothing else."""
    farm.start_worker("preparing", "--kinds", "prepare", "--threads", "1")
    yield farm
    farm.end("preparing")


@pytest.mark.parametrize(
    ("write", "environment", "override", "where", "words"),
    [
        pytest.param(obj("v 0 0 0\n"), "sky.exr", None, "scene.obj", "has no faces", id="no faces"),
        pytest.param(
            obj("v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\n"), "sky.exr", None, "scene.obj", "no faces", id="degenerate faces"
        ),
        pytest.param(
            obj(TRIANGLE.replace("v 1", "v nan")), "sky.exr", None, "mesh 'scene'", "vertex 1 is not", id="NaN vertex"
        ),
        pytest.param(obj(TRIANGLE), None, None, "scene", "nothing in the scene emits light", id="no light"),
        pytest.param(obj(TRIANGLE), "ldr.hdr", None, "ldr.hdr", "is PNG, not Radiance HDR", id="not HDR"),
        pytest.param(obj(TRIANGLE), "sky.bin", None, "sky.bin", "", id="environment that is no picture"),
        pytest.param(
            glb(stacked), None, "lightmap.uv=keep", "mesh 'left'", "overlaps mesh 'floor'", id="overlapping final UV"
        ),
        pytest.param(
            obj(TRIANGLE), "sky.exr", "lightmap.uv=keep", "mesh 'scene'", "is missing", id="final UV that is not there"
        ),
    ],
)
def test_a_worker_refuses_with_a_sentence(
    preparing: Farm,
    folder: Path,
    write: Callable[[Path], Path],
    environment: str | None,
    override: str | None,
    where: str,
    words: str,
) -> None:
    scene = write(folder)
    write_exr(folder / "sky.exr", np.ones((8, 16, 3), np.float32))
    (folder / "ldr.hdr").write_bytes(encode(np.full((8, 16, 3), 200, np.uint8)))
    (folder / "sky.bin").write_bytes(b"no picture")
    flags = ["--set", override] if override else []
    job = preparing.submit(scene, folder / environment if environment else None, *settings(), *flags)

    at = ("--url", preparing.url, "--token", preparing.token)
    watched = lightkiln("watch", job, "--json", *at)
    problem = json.loads(watched.stdout.splitlines()[-1])["error"]
    assert (watched.returncode, problem["code"], problem["where"]) == (3, "input", where)
    assert words in problem["detail"]
    told = lightkiln("watch", job, *at)
    assert told.returncode == 3 and where in told.stderr and "Traceback" not in told.stderr
    fetched = lightkiln("download", job, "--out", folder / "out", *at)
    assert fetched.returncode == 3 and not (folder / "out").exists()
    assert preparing.tasks(job, "prepare")[0]["attempt"] == 1, "a wrong input is not tried again"


def test_a_worker_whose_disk_is_full(farm: Farm, room_files: tuple[Path, Path], folder: Path) -> None:
    """Files that may not grow over a bound: writing a shard fails in the middle, as on a full disk."""
    limit = (LARGEST_FILE, LARGEST_FILE)
    farm.start_worker("poor", "--threads", "1", preexec=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, limit))
    job = farm.submit(*room_files, *settings())
    at = ("--url", farm.url, "--token", farm.token)
    watched = lightkiln("watch", job, *at)
    farm.end("poor")
    assert watched.returncode == 7 and "Free space" in watched.stderr
    assert lightkiln("download", job, "--out", folder / "out", *at).returncode == 7
    assert not (folder / "out").exists()


def test_a_bake_of_a_bad_scene_leaves_nothing(folder: Path) -> None:
    """One sentence and exit code 3; no process goes on, nothing stands in the next bake's way."""
    scene, out = obj(TRIANGLE)(folder), folder / "out"
    done = lightkiln("bake", scene, *settings(), "--out", out)
    *_, last = done.stderr.strip().splitlines()
    assert done.returncode == 3 and last.startswith("scene: nothing in the scene emits light. Add an environment")
    assert "Traceback" not in done.stderr and done.stdout == ""
    assert sorted(path.name for path in folder.iterdir()) == ["scene.obj"]
    assert not [p for p in psutil.process_iter(["cmdline"]) if str(out) in " ".join(p.info["cmdline"] or ())]


def test_a_bake_that_failed_begins_anew(room_files: tuple[Path, Path], folder: Path) -> None:
    """A fit that failed is exit code 4 and no package; --resume submits a new job, not the old verdict again."""
    out = folder / "out"
    few = settings("fit.start_steps=1", "fit.refine_steps=1", "fit.visibility_refine_steps=1")
    done = lightkiln("bake", room_files[0], "--preset", "draft", *few, "--out", out, "--json")
    assert (done.returncode, json.loads(done.stdout)["code"]) == (4, "fit-failed")
    assert [path.name for path in out.iterdir()] == [".lightkiln"]
    again = lightkiln("bake", room_files[0], "--preset", "draft", *few, "--out", out)
    assert again.returncode == 4 and "--resume" in again.stderr

    resumed = lightkiln("bake", "--resume", "--out", out)
    assert resumed.returncode == 4 and "begins anew" in resumed.stderr
    assert len(list((out / ".lightkiln" / "store").iterdir())) == 2
