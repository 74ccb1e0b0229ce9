"""The processes of a local bake: restarted when killed, ended with their parent, given up when hopeless."""

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import psutil
import pytest

from kiln_schemas.client import Client
from kiln_schemas.errors import AuthError, InternalError
from kiln_service.cli.farm import RESTARTS, Managed, share


def wait_until(condition: Callable[[], bool], timeout_s: float = 20) -> None:
    deadline = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.02)


def running(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False


def managed(tmp_path: Path, code: str) -> Managed:
    return Managed("sleeper", [sys.executable, "-c", code], tmp_path / "log")


def test_a_coordinator_killed_with_9_comes_back_with_its_jobs(coordinator) -> None:
    with Client(coordinator.url, coordinator.farm.token, patience_s=60) as api:
        before = api.jobs()
        pid = coordinator.farm.coordinator.pid
        assert pid is not None
        os.kill(pid, signal.SIGKILL)
        # A killed process with several threads is a zombie some milliseconds before it can be waited for.
        wait_until(lambda: coordinator.farm.coordinator.pid is None)
        coordinator.farm.revive()
        assert api.jobs() == before
        assert coordinator.farm.coordinator.pid not in (None, pid)


def test_a_killed_database_comes_back_with_its_coordinator_and_their_jobs(coordinator) -> None:
    with Client(coordinator.url, coordinator.farm.token, patience_s=60) as api:
        before = api.jobs()
        pid = coordinator.farm.coordinator.pid
        assert pid is not None
        (database,) = [p for p in psutil.Process(pid).children() if p.name() == "postgres"]
        database.kill()
        # A killed process with several threads is a zombie some milliseconds before it can be waited for.
        wait_until(lambda: coordinator.farm.coordinator.pid is None)
        coordinator.farm.revive()
        assert api.jobs() == before


def test_a_killed_process_is_started_again_and_stopped_in_the_end(tmp_path: Path) -> None:
    process, said = managed(tmp_path, "import time; time.sleep(60)"), list[str]()
    process.start()
    first = process.pid
    assert first is not None
    process.revive(said.append)
    assert process.pid == first and not said
    os.kill(first, signal.SIGKILL)
    wait_until(lambda: not running(first))
    process.revive(said.append)
    second = process.pid
    assert second is not None and second != first and "signal 9" in said[0]
    process.stop(5)
    assert not running(second)


def test_a_process_that_does_not_listen_is_killed(tmp_path: Path) -> None:
    code = (
        "import signal, time; signal.signal(signal.SIGTERM, signal.SIG_IGN); print('deaf', flush=True); time.sleep(60)"
    )
    process = managed(tmp_path, code)
    process.start()
    wait_until(lambda: "deaf" in process.log.read_text())
    pid = process.pid
    process.stop(0.2)
    assert pid is not None and not running(pid)


def test_a_problem_that_a_restart_does_not_mend_is_raised_as_it_was_told(tmp_path: Path) -> None:
    problem = AuthError("the token is not known here", remedy="Check it.").problem()
    process = managed(tmp_path, f"import sys; print({problem.model_dump_json()!r}); sys.exit(6)")
    process.start()
    with pytest.raises(AuthError, match=r"the token is not known here\. Check it\."):
        wait_until(lambda: bool(process.revive(lambda message: None)))


def test_restarts_have_an_end(tmp_path: Path) -> None:
    process = managed(tmp_path, "raise SystemExit('out of luck')")
    process.start()
    said = list[str]()
    with pytest.raises(InternalError, match="out of luck"):
        wait_until(lambda: bool(process.revive(said.append)))
    assert len(said) == RESTARTS - 1


def test_processes_end_with_a_parent_that_is_killed(tmp_path: Path) -> None:
    code = (
        "import sys, time; from pathlib import Path; from kiln_service.cli.farm import Managed\n"
        "process = Managed('sleeper', [sys.executable, '-c', 'import time; time.sleep(60)'], Path(sys.argv[1]))\n"
        "process.start(); print(process.pid, flush=True); time.sleep(60)\n"
    )
    with subprocess.Popen(
        [sys.executable, "-c", code, str(tmp_path / "log")], stdout=subprocess.PIPE, text=True
    ) as parent:
        assert parent.stdout is not None
        child = int(parent.stdout.readline())
        wait_until(lambda: "sleep" in Path(f"/proc/{child}/cmdline").read_text() and tethered(child))
        parent.kill()
        parent.wait()
    wait_until(lambda: not running(child), 5)


def tethered(pid: int) -> bool:
    """Whether the tether has become its command."""
    return "kiln_service.cli.tether" not in Path(f"/proc/{pid}/cmdline").read_text()


def test_local_workers_share_the_cores_and_the_memory() -> None:
    cores = len(os.sched_getaffinity(0))
    physical = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    for wanted in (None, 1, 2, cores, 3 * cores):
        count, threads, memory = share(wanted)
        assert count == (wanted or count) and threads >= 1 and count * memory < physical
        assert count * threads <= max(cores, count)


def test_a_problem_line_is_found_among_other_lines(tmp_path: Path) -> None:
    problem = AuthError("no").problem().model_dump(mode="json")
    process = managed(tmp_path, "")
    process.log.write_text(f"noise\n{json.dumps(problem)}\nlightkiln: no\n")
    assert isinstance(process.last_words(6), AuthError)
