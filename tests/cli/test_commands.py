"""The program from outside: exit codes, sentences, JSON, against a real coordinator."""

import hashlib
import signal
import subprocess
import time
from pathlib import Path
from xml.etree import ElementTree

import pytest

from kiln_schemas.conventions import MANIFEST_JSON
from kiln_schemas.tasks import TaskKind

DEAD = "http://127.0.0.1:9"


@pytest.mark.parametrize(
    ("arguments", "code", "words"),
    [
        ([], 2, "Usage"),
        (["bake"], 2, "--out"),
        (["fly"], 2, "fly"),
        (["bake", "nowhere.glb", "--out", "out"], 3, "nowhere.glb: there is no such scene file"),
        (["bake", "--out", "out"], 3, "SCENE: no scene is given"),
        (["bake", "nowhere.glb", "--out", "out", "--preset", "best"], 3, "preset: 'best' is not a preset"),
        (["bake", "nowhere.glb", "--out", "out", "--set", "render.sample=3"], 3, "'render.sample' is not a setting"),
        (["bake", "nowhere.glb", "--out", "out", "--set", "render.samples"], 3, "has no '='"),
        (["bake", "nowhere.glb", "--out", "out", "--set", "lightmap.resolution=0"], 3, "lightmap.resolution"),
        (["bake", "nowhere.glb", "--out", "out", "--set", "lightmap.resolution=100000"], 3, "lightmap.resolution"),
        (["bake", "nowhere.glb", "--out", "out", "--workers", "0"], 2, "--workers"),
        (["bake", "nowhere.glb", "--out", "out", "--gate", "log_mse=1"], 3, "'log_mse' is not a gate"),
        (["bake", "nowhere.glb", "--out", "out", "--gate", "flip.a=0.1"], 3, "gates.flip.a: there is no camera 'a'"),
        (["bake", "nowhere.glb", "--out", "out", "--camera", "a=none.json"], 3, "--camera a=none.json: cannot be read"),
        (["bake", "--resume", "--out", "out"], 3, "there is no interrupted bake"),
        (["status"], 6, "no token is given"),
        (["status", "--token", "t", "--url", DEAD], 6, "does not answer"),
        (["status", "--token", "t", "--url", "127.0.0.1:9"], 6, "http"),
        (["status", "--token", "a b", "--url", DEAD], 6, "characters"),
        (["status", "--data", "nowhere"], 6, "nowhere/token"),
        (["serve", "--data", "data", "--port", "70000"], 3, "port"),
    ],
)
def test_exit_codes(lightkiln, tmp_path: Path, arguments: list[str], code: int, words: str) -> None:
    ran = lightkiln(*arguments)
    assert ran.code == code and words in ran.err + ran.out
    assert not (tmp_path / "cwd" / "out").exists()


def test_a_missing_environment_is_named(lightkiln, lit_glb: Path) -> None:
    ran = lightkiln("bake", lit_glb, "--env", "sky.exr", "--out", "out")
    assert ran.code == 3 and "sky.exr: there is no such environment file" in ran.err


@pytest.mark.parametrize(
    ("flags", "words"),
    [
        (["--env-scale", "-1"], "--env-scale: -1.0 is refused"),
        (["--env-scale", "nan"], "--env-scale: nan is refused"),
        (["--env-rotation", "inf"], "--env-rotation: inf is refused"),
    ],
)
def test_an_environment_out_of_bounds(lightkiln, lit_glb: Path, flags: list[str], words: str) -> None:
    lit_glb.with_name("sky.exr").write_bytes(b"sky")
    ran = lightkiln("bake", lit_glb, "--env", lit_glb.with_name("sky.exr"), *flags, "--out", "out")
    assert ran.code == 3 and words in ran.err


def test_an_out_that_is_a_file(lightkiln, lit_glb: Path) -> None:
    ran = lightkiln("bake", lit_glb, "--out", lit_glb)
    assert ran.code == 3 and "is not a folder" in ran.err and lit_glb.is_file()


def test_errors_as_json(lightkiln) -> None:
    ran = lightkiln("bake", "nowhere.glb", "--out", "out", "--json")
    assert (ran.code, ran.err) == (3, "")
    assert ran.document["code"] == "input" and ran.document["where"] == "nowhere.glb" and ran.document["remedy"]


def test_submit_status_watch_cancel(lightkiln, coordinator, lit_glb: Path) -> None:
    at = ("--url", coordinator.url, "--data", coordinator.data)
    options = ("--preset", "draft", "--set", "render.samples=4", "--name", "lamp")
    job = lightkiln("submit", lit_glb, *options, *at, "--json").document
    assert job["state"] == "queued" and job["name"] == "lamp" and job["settings"]["render"]["samples"] == 4
    assert job["bundle"]["files"] == {"lit.glb": hashlib.sha256(lit_glb.read_bytes()).hexdigest()}

    assert lightkiln("status", job["id"], *at, "--json").document["id"] == job["id"]
    assert job["id"] in [entry["id"] for entry in lightkiln("status", *at, "--json").document["jobs"]]
    people = lightkiln("status", job["id"], *at)
    assert people.code == 0 and "lamp: queued" in people.out and "prepare" in people.out

    early = lightkiln("download", job["id"], "--out", "package", *at)
    assert early.code == 3 and "no package" in early.err

    assert lightkiln("cancel", job["id"], *at, "--json").document["state"] in ("cancel-requested", "canceled")
    watched = lightkiln("watch", job["id"], *at, "--json")
    assert watched.code == 5 and '"state": "canceled"' in watched.out.splitlines()[-1]
    assert lightkiln("watch", job["id"], *at).code == 5


def test_gates_are_submitted_and_a_job_without_results_has_a_junit_file(
    lightkiln, coordinator, lit_glb: Path, tmp_path: Path
) -> None:
    at = ("--url", coordinator.url, "--data", coordinator.data)
    (tmp_path / "side.json").write_text('{"position": [3, 0, 0], "target": [0, 0, 0], "fov_deg": 30}')
    cameras = ("--camera", "front=0,0,3:0,0,0:42", "--camera", f"side={tmp_path / 'side.json'}")
    gates = ("--gate", "log_mse_rel=0.2", "--gate", "flip.front=0.5", "--gate", "flip.front=0.08")
    job = lightkiln("submit", lit_glb, "--name", "lamp", *cameras, *gates, *at, "--json").document
    assert job["gates"] == {"log_mse_rel": 0.2, "visibility_log_mse_rel": None, "flip": {"front": 0.08}}
    assert job["cameras"]["front"]["fov_deg"] == 42 and job["cameras"]["side"]["position"] == [3, 0, 0]

    lightkiln("cancel", job["id"], *at)
    file = tmp_path / "reports" / "junit.xml"
    assert lightkiln("watch", job["id"], "--junit", file, *at).code == 5
    suite = ElementTree.parse(file).getroot()
    assert dict(suite.items()) == {"name": "lamp", "tests": "3", "failures": "0", "errors": "1", "skipped": "2"}
    assert [(case.get("name"), case[0].tag) for case in suite] == [
        ("log_mse_rel", "skipped"),
        ("flip.front", "skipped"),
        ("bake", "error"),
    ]
    assert "was canceled" in suite[2][0].get("message", "")


def test_the_environment_of_the_shell_names_the_coordinator(lightkiln, coordinator) -> None:
    token = (coordinator.data / "token").read_text().strip()
    ran = lightkiln("status", "--json", LIGHTKILN_URL=coordinator.url, LIGHTKILN_TOKEN=token)
    assert ran.code == 0 and "jobs" in ran.document


@pytest.mark.parametrize(
    "command", [["status", "JOB"], ["watch", "JOB"], ["cancel", "JOB"], ["compare", 32 * "f", "--out", "x"]]
)
def test_an_unknown_job(lightkiln, coordinator, command: list[str]) -> None:
    ran = lightkiln(*command, "--url", coordinator.url, "--data", coordinator.data, "--json")
    assert ran.code == 3 and ran.document["code"] == "not-found"


def test_a_wrong_token(lightkiln, coordinator) -> None:
    ran = lightkiln("status", "--url", coordinator.url, "--token", "wrong", "--json")
    assert ran.code == 6 and ran.document["code"] == "unauthorized"


def test_a_worker_takes_all_kinds_unless_told(lightkiln) -> None:
    ran = lightkiln("worker", "--help")
    assert ran.code == 0 and ",".join(TaskKind) in ran.out


def test_a_worker_with_a_wrong_token_ends(lightkiln, coordinator) -> None:
    ran = lightkiln("worker", "--url", coordinator.url, "--token", "wrong", "--kinds", "fit", "--json")
    assert ran.code == 6 and '"unauthorized"' in ran.out.splitlines()[-1]


def test_examples_are_written(lightkiln, tmp_path: Path) -> None:
    ran = lightkiln("examples", "write", tmp_path / "examples", "--json")
    assert ran.code == 0
    names = sorted(Path(path).name for path in ran.document["files"])
    assert names == ["courtyard.exr", "courtyard.glb", "gallery.glb"]
    assert (tmp_path / "examples" / "gallery.glb").read_bytes()[:4] == b"glTF"


def test_serve_says_where_it_is_and_stops_on_sigterm(program: str, clean_environment, tmp_path: Path) -> None:
    command = [program, "serve", "--data", str(tmp_path / "data"), "--port", "0", "--json"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, env=clean_environment) as server:
        assert server.stdout is not None
        line = server.stdout.readline()
        assert b"http://127.0.0.1:" in line and b"token" in line
        server.send_signal(signal.SIGTERM)
        assert server.wait(600) == 0


def test_an_older_package_is_not_mixed_with(lightkiln, lit_glb: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    (out / ".lightkiln").mkdir(parents=True)
    ran = lightkiln("bake", lit_glb, "--out", out)
    assert ran.code == 4 and "--resume" in ran.err
    (out / ".lightkiln").rmdir()
    (out / MANIFEST_JSON).write_text("{}")
    ran = lightkiln("bake", lit_glb, "--out", out)
    assert ran.code == 4 and "--force" in ran.err
    assert (out / MANIFEST_JSON).read_text() == "{}"


def test_doctor_tells_what_there_is(lightkiln) -> None:
    began = time.monotonic()
    ran = lightkiln("doctor", "--json")
    checks = {check["name"]: check for check in ran.document}
    assert {"python", "libLLVM", "renderer", "torch", "CUDA", "memory", "cores", "store", "disk", "database"} <= set(
        checks
    )
    failing = [check for check in checks.values() if check["status"] == "fail"]
    assert ran.code == (7 if failing else 0)
    assert all(check["remedy"] for check in failing)
    assert checks["database"]["status"] == "ok"
    assert time.monotonic() - began < 100
