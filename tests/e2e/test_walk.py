"""The README's walk through a farm, line by line as it stands there; and what it leaves behind."""

import hashlib
import json
import os
import re
import socket
import subprocess
import sys
from pathlib import Path
from xml.etree import ElementTree

import pytest
from e2e_farm import HOST

README = Path(__file__).parents[2] / "README.md"


@pytest.fixture(scope="module")
def walked(session_folder: Path) -> tuple[Path, str]:
    """The folder in which the lines ran, and what they printed."""
    (script,) = re.findall(r"```sh\n(.*?)```", README.read_text(), re.DOTALL)
    folder = session_folder / "walk"
    folder.mkdir()
    with socket.socket() as probe:
        probe.bind((HOST, 0))
        port = str(probe.getsockname()[1])
    assert script.count("8321") == 3
    path = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
    done = subprocess.run(
        ["bash", "-euo", "pipefail", "-c", script.replace("8321", port)],
        cwd=folder,
        env=os.environ | {"PATH": path},
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        timeout=3000,
    )
    assert done.returncode == 0, done.stdout[-4000:] + done.stderr[-4000:]
    return folder, done.stdout


def test_the_package_is_whole_and_its_gate_is_met(walked: tuple[Path, str]) -> None:
    folder, printed = walked
    manifest = json.loads((folder / "baked/manifest.json").read_text())
    for entry in manifest["files"]:
        data = (folder / "baked" / entry["name"]).read_bytes()
        assert hashlib.sha256(data).hexdigest() == entry["sha256"], entry["name"]
    assert f"{len(manifest['files'])} files are as the manifest says." in printed
    suite = ElementTree.parse(folder / "gates.xml").getroot()
    assert (suite.get("tests"), suite.get("failures")) == ("1", "0")


def test_the_second_bake_has_fewer_lobes_of_the_same_light(walked: tuple[Path, str]) -> None:
    folder, _ = walked
    first, second = (json.loads((folder / name / "manifest.json").read_text()) for name in ("baked", "fewer"))
    assert (first["settings"]["fit"]["lobes"], second["settings"]["fit"]["lobes"]) == (8, 6)
    assert second["stage_seconds"]["render"] == first["stage_seconds"]["render"], "rendered once"
    assert second["files"] != first["files"]
    irradiance = [next(f for f in m["files"] if f["name"] == "irradiance.exr") for m in (first, second)]
    assert irradiance[0] == irradiance[1]


def test_jobs_are_told_apart_and_nothing_is_left_running(walked: tuple[Path, str]) -> None:
    folder, printed = walked
    assert "project=demo" in printed and "gallery: paused" in printed
    assert "gallery: cancel" in printed
    assert not (folder / "farm/postgres/postmaster.pid").exists()
