"""The images, without Docker: their install steps run here, their files exist, hadolint finds nothing.

`install` is what the coordinator's image does: the same script with the same arguments into an empty folder.
"""

import json
import re
import subprocess
import sys
from importlib import metadata
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).parents[2]
FILES = sorted((ROOT / "docker").glob("*.Dockerfile"))
PINNED = {
    canonicalize_name(name): version
    for name, _, version in (line.partition("==") for line in (ROOT / "constraints.txt").read_text().split())
    if version
}


def instructions(file):
    """Pairs of instruction and the rest of its line, continuations joined."""
    text = re.sub(r"\\\n", " ", file.read_text())
    lines = [line for line in text.splitlines() if line.strip() and not line.startswith("#")]
    return [(line.split(None, 1)[0], line.split(None, 1)[1]) for line in lines]


def closure(extra):
    """What `lightkiln[extra]` needs, as canonical names, by the metadata of what is installed here."""
    found, open_ = set(), [("lightkiln", frozenset({extra}))]
    while open_:
        name, extras = open_.pop()
        for text in metadata.requires(name) or ():
            need = Requirement(text)
            if need.marker is None or any(need.marker.evaluate({"extra": one}) for one in extras or {""}):
                key = (canonicalize_name(need.name), frozenset(need.extras))
                if key not in found:
                    found.add(key)
                    open_.append(key)
    return {name for name, _ in found}


def test_hadolint_finds_nothing():
    assert len(FILES) == 2
    done = subprocess.run(
        [Path(sys.executable).with_name("hadolint"), *FILES], capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stdout) == (0, "")


def test_hadolint_can_find_something(tmp_path):
    (tmp_path / "Dockerfile").write_text("FROM debian:latest\nRUN sudo apt-get install curl\n")
    done = subprocess.run(
        [Path(sys.executable).with_name("hadolint"), tmp_path / "Dockerfile"], capture_output=True, text=True
    )
    assert done.returncode == 1 and "DL3004" in done.stdout


@pytest.mark.parametrize("file", FILES, ids=lambda file: file.stem)
def test_what_an_image_copies_and_runs_is_there(file):
    steps = instructions(file)
    copied = set()
    for name, rest in steps:
        if name == "COPY" and not rest.startswith("--from"):
            *sources, target = rest.split()
            assert all((ROOT / source).exists() for source in sources), rest
            copied |= {source if target.startswith(("./", source)) else target for source in sources}
        if name == "RUN":
            for word in re.findall(r"\S+\.sh", rest):
                script = ROOT / re.sub(r"^/tmp/install/", "deploy/install/", word)
                assert script.stat().st_mode & 0o111 and any(word.startswith(one) for one in copied), word
    users = [rest for name, rest in steps if name == "USER"]
    assert len(users) == 1 and int(users[0]) > 0, "it does not run as root"
    assert [name for name, _ in steps].index("USER") > max(i for i, (name, _) in enumerate(steps) if name == "RUN")
    assert {rest.split()[0] for name, rest in steps if name == "FROM"} == {"python:3.11-slim-bookworm"}


def test_what_each_image_needs():
    coordinator, worker = closure("service"), closure("worker")
    assert {"fastapi", "psycopg", "obstore"} <= coordinator
    assert not coordinator & {"torch", "mitsuba", "drjit", "numpy", "tensorstore"}
    assert {"torch", "mitsuba", "tensorstore"} <= worker and not worker & {"psycopg", "fastapi"}
    # Of the worker's, whose installation is gigabytes, those that this platform has here are at the images' versions.
    for name in coordinator | worker:
        if name != "lightkiln" and name in PINNED:
            assert metadata.version(name).partition("+")[0] == PINNED[name], name


@pytest.fixture(scope="module")
def install():
    """What the coordinator's image installs, in a folder of its own."""
    ((_, rest),) = [step for step in instructions(ROOT / "docker/coordinator.Dockerfile") if "venv.sh" in step[1]]
    with TemporaryDirectory(prefix="kiln-test-") as folder:
        script, target, *arguments = rest.split()
        assert target == "/opt/lightkiln"
        done = subprocess.run(
            [ROOT / script, f"{folder}/venv", *arguments], capture_output=True, text=True, cwd=folder, timeout=600
        )
        assert done.returncode == 0, done.stderr
        yield Path(folder) / "venv"


def test_the_coordinators_image_has_no_renderer_and_serves(install, tmp_path):
    program = "import json, importlib.metadata as m; print(json.dumps({d.name: d.version for d in m.distributions()}))"
    listed = subprocess.run([install / "bin/python", "-c", program], capture_output=True, check=True).stdout
    installed = {canonicalize_name(name): version for name, version in json.loads(listed).items()}
    assert not installed.keys() & {"torch", "mitsuba", "drjit", "numpy"} and "lightkiln" in installed
    assert {n: v for n, v in installed.items() if n not in ("lightkiln", "pip", "setuptools") and PINNED[n] != v} == {}
    subprocess.run([install / "bin/python", "-m", "pip", "check"], capture_output=True, check=True)
    where = "import kiln_service.serve as s; print(s.__file__)"
    place = subprocess.run([install / "bin/python", "-c", where], capture_output=True, text=True, check=True, cwd="/")
    assert place.stdout.startswith(str(install)), "it does not need the folder that it was installed from"
    ((_, entry),) = [step for step in instructions(ROOT / "docker/coordinator.Dockerfile") if step[0] == "ENTRYPOINT"]
    command = [word.replace("/var/lib/lightkiln", f"{install.parent}/data") for word in json.loads(entry)]
    command = ["127.0.0.1" if word == "0.0.0.0" else "0" if word == "8321" else word for word in command]
    path = {"PATH": f"{install / 'bin'}:/usr/bin:/bin"}
    with subprocess.Popen([*command, "--json"], stdout=subprocess.PIPE, text=True, env=path) as coordinator:
        ready = json.loads(coordinator.stdout.readline())
        ((_, health),) = [s for s in instructions(ROOT / "docker/coordinator.Dockerfile") if s[0] == "HEALTHCHECK"]
        check = json.loads(health[health.index("[") :])
        check = [word.replace("http://127.0.0.1:8321", ready["url"]) for word in check]
        healthy = subprocess.run(check, env=path, capture_output=True, text=True)
        coordinator.terminate()
    assert healthy.returncode == 0, healthy.stderr
    assert coordinator.returncode == 0
