"""A worker as a process: signals, kill -9, command line, doctor."""

import json
import os
import platform
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from kiln_schemas.errors import AuthError, Drained, InputError, MachineLacks


def children(pid: int) -> list[int]:
    return [int(child) for child in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]


def test_sigterm_gives_the_task_back_and_leaves_no_child(
    coordinator, stages_path, worker_program: list[str], running
) -> None:
    coordinator.add("hang", attempt=2)
    with subprocess.Popen(worker_program) as worker:
        coordinator.wait_for("/heartbeat")
        (child,) = children(worker.pid)
        worker.send_signal(signal.SIGTERM)
        assert worker.wait(600) == 0
    (failure,) = coordinator.named("/fail")
    assert failure["attempt"] == 2 and failure["retryable"] and failure["problem"]["code"] == "canceled"
    assert not running(child)


def test_a_drained_worker_leaves_by_itself(coordinator, stages_path, worker_program: list[str]) -> None:
    """Told so when it asks for its next task: nothing has to be given back."""
    coordinator.refuse["claim"] = Drained("an operator told the worker to leave")
    done = subprocess.run(worker_program, timeout=600)
    assert done.returncode == 0 and coordinator.named("/fail") == []


def test_a_worker_has_the_name_of_the_one_that_it_follows(coordinator, tmp_path: Path) -> None:
    """Blocks and schedules go by names: a worker that was started again is still the same."""
    coordinator.refuse["claim"] = Drained("an operator told the worker to leave")
    command = [sys.executable, "-m", "kiln_workers", "worker", "--url", coordinator.url, "--scratch", str(tmp_path)]
    for _ in range(2):
        environment = os.environ | {"LIGHTKILN_TOKEN": "the-token-of-a-worker"}
        done = subprocess.run(command, timeout=120, env=environment, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
    first, second = (registration["name"] for registration in coordinator.named("/workers"))
    assert first == second == f"{platform.node()}-0"


def test_a_killed_worker_takes_its_child_along(coordinator, stages_path, worker_program: list[str], running) -> None:
    coordinator.add("hang")
    with subprocess.Popen(worker_program) as worker:
        coordinator.wait_for("/heartbeat")
        (child,) = children(worker.pid)
        assert running(child)
        worker.kill()
        worker.wait(600)
    deadline = time.monotonic() + 300
    while running(child):
        assert time.monotonic() < deadline
        time.sleep(0.02)


def test_a_child_whose_parent_is_already_gone_ends_at_once() -> None:
    command = [sys.executable, "-m", "kiln_workers.runner.child", str(os.getppid())]
    done = subprocess.run(command, stdin=subprocess.PIPE, capture_output=True, timeout=600)
    assert (done.returncode, done.stdout) == (0, b"")


def test_the_parent_imports_neither_renderer_nor_network() -> None:
    code = "import sys, kiln_workers.__main__, kiln_workers.runner.parent; print(*sys.modules)"
    modules = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split()
    assert "kiln_workers.runner.parent" in modules
    assert not {"mitsuba", "drjit", "torch", "numpy"} & set(modules)


@pytest.mark.parametrize(
    ("arguments", "code"),
    [
        (["--url", "http://127.0.0.1:9"], AuthError.exit_code),
        (["--url", "http://127.0.0.1:9", "--token", "a b"], AuthError.exit_code),
        (["--token", "t"], InputError.exit_code),
        (["--url", "u", "--token", "t", "--kinds", "bake"], InputError.exit_code),
        (["--url", "u", "--token", "t", "--memory", "lots"], InputError.exit_code),
        (["--url", "u", "--token", "t", "--threads", "-1"], InputError.exit_code),
        (["--url", "u", "--token-file", "/does/not/exist"], InputError.exit_code),
    ],
)
def test_wrong_arguments_are_problems(arguments: list[str], code: int) -> None:
    clean = {key: value for key, value in os.environ.items() if not key.startswith("LIGHTKILN_")}
    command = [sys.executable, "-m", "kiln_workers", "worker", *arguments, "--json"]
    done = subprocess.run(command, capture_output=True, text=True, env=clean, timeout=600)
    assert (done.returncode, done.stderr) == (code, "")
    assert json.loads(done.stdout)["detail"]


def test_wrong_usage_is_exit_code_2() -> None:
    done = subprocess.run([sys.executable, "-m", "kiln_workers", "worker", "--colour"], capture_output=True, text=True)
    assert done.returncode == 2 and "--colour" in done.stderr


def test_a_renderer_that_aborts_is_a_sentence(tmp_path: Path) -> None:
    (tmp_path / "drjit.py").write_text("import os\nos.abort()\n")
    command = [sys.executable, "-m", "kiln_workers", "doctor", "--json"]
    env = os.environ | {"PYTHONPATH": str(tmp_path)}
    done = subprocess.run(command, capture_output=True, text=True, env=env, timeout=600)
    assert done.returncode == MachineLacks.exit_code
    checks = {check["name"]: check for check in json.loads(done.stdout)}
    assert checks["renderer"]["status"] == "fail" and "SIGABRT" in checks["renderer"]["detail"]
    assert "libLLVM" in checks["renderer"]["remedy"]
    assert checks["torch"]["status"] == "ok"
