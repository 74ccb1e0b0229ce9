"""A bake that misses a gate, as a pipeline sees it: exit code 8, a JUnit file, and a package all the same."""

import json
from collections.abc import Iterator
from pathlib import Path
from subprocess import CompletedProcess
from xml.etree import ElementTree

import pytest
from e2e_farm import Farm, lightkiln, settings

MISSED = "log_mse_rel is "


def command(room_files: tuple[Path, Path], folder: Path) -> list[str | Path]:
    """A gate that no bake meets, and one that this one meets with few paths."""
    scene, environment = room_files
    gates = [
        "--gate",
        "log_mse_rel=0.000001",
        "--gate",
        "flip.front=0.6",
        "--camera",
        "front=0.3,1.1,3.6:0,0.9,-0.5:45",
    ]
    flags = ["--env", environment, "--preset", "draft", *settings(), *gates]
    return ["bake", scene, *flags, "--out", folder / "out", "--junit", folder / "junit.xml", "--keep"]


@pytest.fixture(scope="module")
def gated(room_files: tuple[Path, Path], session_folder: Path) -> tuple[Path, "CompletedProcess[str]"]:
    """A folder with a package in `out`, and how the bake ended."""
    folder = session_folder / "gated"
    folder.mkdir()
    return folder, lightkiln(*command(room_files, folder))


def test_the_package_is_there_and_the_exit_code_is_8(gated: tuple[Path, "CompletedProcess[str]"]) -> None:
    folder, done = gated
    assert done.returncode == 8, done.stdout + done.stderr
    assert MISSED in done.stderr and "flip.front" not in done.stderr.splitlines()[-1]
    assert "gate      flip.front is " in done.stdout and "report.html" in done.stdout
    manifest = json.loads((folder / "out" / "manifest.json").read_text())
    assert {gate["name"]: gate["passed"] for gate in manifest["gates"]} == {"log_mse_rel": False, "flip.front": True}
    for entry in manifest["files"]:
        assert (folder / "out" / entry["name"]).stat().st_size == entry["size"]
    assert (folder / "out" / "gates" / "front.png").read_bytes()[:4] == b"\x89PNG"


def test_the_junit_file_names_each_gate(gated: tuple[Path, "CompletedProcess[str]"]) -> None:
    folder, _ = gated
    assert (folder / "junit.xml").read_bytes() == (folder / "out" / "gates.xml").read_bytes()
    suite = ElementTree.parse(folder / "junit.xml").getroot()
    assert (suite.tag, suite.get("tests"), suite.get("failures"), suite.get("errors")) == ("testsuite", "2", "1", "0")
    missed, met = suite.findall("testcase")
    assert MISSED in missed.find("failure").get("message") and met.find("failure") is None


def test_the_same_call_again_has_nothing_to_do_and_ends_the_same(
    gated: tuple[Path, "CompletedProcess[str]"], room_files: tuple[Path, Path]
) -> None:
    folder, _ = gated
    (folder / "junit.xml").unlink()
    again = lightkiln(*command(room_files, folder), "--json")
    problem = json.loads(again.stdout)
    assert (again.returncode, problem["code"], problem["where"]) == (8, "gate-failed", "gates")
    assert (folder / "junit.xml").read_bytes() == (folder / "out" / "gates.xml").read_bytes()


@pytest.fixture(scope="module")
def coordinator(gated: tuple[Path, "CompletedProcess[str]"]) -> Iterator[Farm]:
    """A coordinator on what the bake kept."""
    farm = Farm(gated[0])
    (gated[0] / "out" / ".lightkiln").rename(gated[0] / "data")
    try:
        farm.start_coordinator()
        yield farm
    finally:
        farm.stop()


def test_watch_tells_and_download_gives(gated: tuple[Path, "CompletedProcess[str]"], coordinator: Farm) -> None:
    folder, _ = gated
    at = ("--url", coordinator.url, "--token", coordinator.token)
    (job,) = coordinator.get("/v1/jobs")["jobs"]
    assert job["state"] == "gate-failed" and job["error"]["code"] == "gate-failed"

    told = lightkiln("watch", job["id"], "--json", *at)
    assert told.returncode == 8 and json.loads(told.stdout.splitlines()[-1])["state"] == "gate-failed"
    people = lightkiln("watch", job["id"], "--junit", folder / "watched.xml", *at)
    assert people.returncode == 8 and MISSED in people.stderr
    assert "gate: flip.front is " in lightkiln("status", job["id"], *at).stdout

    fetched = lightkiln("download", job["id"], "--out", folder / "again", "--junit", folder / "fetched.xml", *at)
    assert fetched.returncode == 0 and MISSED in fetched.stderr
    original = (folder / "out" / "gates.xml").read_bytes()
    assert {(folder / name).read_bytes() for name in ("watched.xml", "fetched.xml", "again/gates.xml")} == {original}
    assert (folder / "again" / "manifest.json").read_bytes() == (folder / "out" / "manifest.json").read_bytes()
