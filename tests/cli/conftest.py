"""The `lightkiln` program as a subprocess, and small scenes as files."""

import json
import os
import struct
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import pytest

from kiln_service.cli.farm import LocalFarm

PROGRAM = Path(sys.executable).with_name("lightkiln")


@dataclass(frozen=True)
class Ran:
    """How a command ended."""

    code: int
    out: str
    err: str

    @property
    def document(self) -> Any:
        """Standard output, which has to be one JSON document and nothing else."""
        return json.loads(self.out)


Run = Callable[..., Ran]


@pytest.fixture(scope="session")
def clean_environment() -> dict[str, str]:
    keep = {key: value for key, value in os.environ.items() if not key.startswith("LIGHTKILN_")}
    return keep | {"COLUMNS": "200", "NO_COLOR": "1"}


@pytest.fixture(scope="session")
def program() -> str:
    """The installed command."""
    return str(PROGRAM)


@pytest.fixture
def lightkiln(clean_environment: dict[str, str], tmp_path: Path) -> Run:
    """Run the installed command in an empty folder."""
    folder = tmp_path / "cwd"
    folder.mkdir()

    def run(*arguments: str | Path, **variables: str) -> Ran:
        done = subprocess.run(
            [str(PROGRAM), *map(str, arguments)],
            capture_output=True,
            text=True,
            cwd=folder,
            env=clean_environment | variables,
            timeout=120,
        )
        assert "Traceback" not in done.stdout + done.stderr
        return Ran(done.returncode, done.stdout, done.stderr)

    return run


@dataclass(frozen=True)
class Running:
    """A coordinator without workers."""

    url: str
    data: Path
    farm: LocalFarm


@pytest.fixture(scope="session")
def coordinator() -> Iterator[Running]:
    # Not in pytest's own folder: another run as root would make that private, and the database could not go on.
    with (
        TemporaryDirectory(prefix="lightkiln-cli-") as folder,
        LocalFarm(data := Path(folder), workers=0, threads=1, memory=1 << 30, say=lambda message: None) as farm,
    ):
        farm.start()
        yield Running(farm.url, data, farm)


def glb(document: dict[str, Any], binary: bytes = b"") -> bytes:
    """A GLB file: a JSON chunk and a binary chunk."""
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    binary += b"\0" * (-len(binary) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(binary), b"BIN\0") + binary
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    """A folder with a glTF file of one triangle, a buffer, a texture in a folder below, and something unrelated."""
    folder = tmp_path / "scene"
    (folder / "my textures").mkdir(parents=True)
    (folder / "triangle.bin").write_bytes(struct.pack("<9f", 0, 0, 0, 1, 0, 0, 0, 1, 0))
    (folder / "my textures" / "red.png").write_bytes(b"\x89PNG red")
    (folder / "unrelated.txt").write_text("not part of the scene")
    document = {
        "asset": {"version": "2.0"},
        "buffers": [{"uri": "triangle.bin", "byteLength": 36}],
        "images": [{"uri": "my%20textures/red.png"}, {"uri": "data:image/png;base64,AAAA"}],
    }
    (folder / "triangle.gltf").write_text(json.dumps(document))
    return folder / "triangle.gltf"


@pytest.fixture
def lit_glb(tmp_path: Path) -> Path:
    """A GLB that a coordinator accepts: one emitting triangle."""
    document = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "material": 0}]}],
        "materials": [{"emissiveFactor": [1, 1, 1]}],
        "accessors": [
            {
                "bufferView": 0,
                "componentType": 5126,
                "count": 3,
                "type": "VEC3",
                "min": [0, 0, 0],
                "max": [1, 1, 0],
            }
        ],
        "bufferViews": [{"buffer": 0, "byteLength": 36}],
        "buffers": [{"byteLength": 36}],
    }
    path = tmp_path / "lit.glb"
    path.write_bytes(glb(document, struct.pack("<9f", 0, 0, 0, 1, 0, 0, 0, 1, 0)))
    return path
