"""Fixtures of the end-to-end tests: the room's files, and a farm with a coordinator.

Data folders lie outside pytest's own temporary folder: every start of pytest as root makes that one private, which
would lock the embedded database of a run that goes on at the same time out of its files.
"""

import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest
import seaweed
from e2e_farm import Farm, lightkiln, room, settings, sky

from kiln_workers.package.glb import encode_glb
from kiln_workers.scene.examples import write_exr


@pytest.fixture(scope="session")
def room_files(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """The room as GLB and its sky as EXR."""
    folder = tmp_path_factory.mktemp("room")
    (folder / "room.glb").write_bytes(encode_glb(room()))
    write_exr(folder / "sky.exr", sky())
    return folder / "room.glb", folder / "sky.exr"


@pytest.fixture(scope="session")
def session_folder() -> Iterator[Path]:
    """A folder for the whole run."""
    with tempfile.TemporaryDirectory(prefix="lightkiln-e2e-") as folder:
        yield Path(folder)


@pytest.fixture
def folder() -> Iterator[Path]:
    """A folder for one test."""
    with tempfile.TemporaryDirectory(prefix="lightkiln-e2e-") as folder:
        yield Path(folder)


@pytest.fixture(scope="session")
def baked(room_files: tuple[Path, Path], session_folder: Path) -> Path:
    """The room under its sky, baked by one command and kept."""
    out = session_folder / "baked"
    scene, environment = room_files
    done = lightkiln("bake", scene, "--env", environment, "--preset", "draft", *settings(), "--out", out, "--keep")
    assert done.returncode == 0, done.stderr
    return out


@pytest.fixture
def s3_server(folder: Path) -> Iterator[seaweed.S3Server]:
    """A real S3 endpoint."""
    (folder / "seaweedfs").mkdir()
    with seaweed.running(folder / "seaweedfs") as server:
        yield server


@pytest.fixture(scope="module")
def farm() -> Iterator[Farm]:
    """A coordinator without workers; one for each module, whose jobs reuse no light fields of another's."""
    with tempfile.TemporaryDirectory(prefix="lightkiln-e2e-") as folder:
        farm = Farm(Path(folder))
        try:
            farm.start_coordinator()
            yield farm
        finally:
            farm.stop()
