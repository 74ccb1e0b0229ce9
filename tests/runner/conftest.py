"""A coordinator of a hundred lines that records every call, and workers whose stages are small programs."""

import hashlib
import json
import os
import sys
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import pytest

from kiln_schemas.errors import AuthError, KilnError, NotFound, StaleAttempt
from kiln_schemas.settings import PRESETS, Function
from kiln_schemas.tasks import Claim, FitPayload, TaskKind
from kiln_workers.runner.parent import Worker, WorkerOptions

TOKEN = "the-token-of-a-worker"
STAGES = "stages_for_tests"


@dataclass
class Coordinator:
    """State that outlives the listening socket, so that it can go away and come back."""

    claims: list[Claim] = field(default_factory=list)
    calls: list[tuple[str, dict[str, Any]]] = field(default_factory=list)
    blobs: dict[str, bytes] = field(default_factory=dict)
    damaged: set[str] = field(default_factory=set)
    """Blobs that are sent wrong once."""
    stop: bool = False
    refuse: dict[str, KilnError] = field(default_factory=dict)
    """Last part of a path to the error that it is answered with."""
    port: int = 0
    _server: ThreadingHTTPServer | None = None

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.port}"

    def up(self) -> None:
        coordinator = self

        class Handler(Routes):
            state = coordinator

        self._server = ThreadingHTTPServer(("127.0.0.1", self.port), Handler)
        self._server.daemon_threads = True
        self.port = self._server.server_address[1]
        threading.Thread(target=self._server.serve_forever, kwargs={"poll_interval": 0.02}, daemon=True).start()

    def down(self) -> None:
        if self._server is not None:
            self._server.shutdown()
            self._server.server_close()
            self._server = None

    def add(self, instruction: str, *, attempt: int = 1, checkpoint: str | None = None) -> None:
        """Queue a task whose stage does what `instruction` says (stages_for_tests/fit.py)."""
        payload = FitPayload(
            function=Function.LIGHT_FIELD,
            texel_map="0" * 64,
            renders=(),
            settings=PRESETS["draft"],
            store_url=instruction,
        )
        name = f"task-{len(self.claims)}-{len(self.calls)}"
        claim = Claim(
            task_id=name, job_id="job", attempt=attempt, lease="secret", payload=payload, checkpoint=checkpoint
        )
        self.claims.append(claim)

    def put(self, data: bytes) -> str:
        sha256 = hashlib.sha256(data).hexdigest()
        self.blobs[sha256] = data
        return sha256

    def named(self, ending: str) -> list[dict[str, Any]]:
        """Bodies of the calls whose path ends so."""
        return [body for path, body in self.calls if path.endswith(ending)]

    def wait_for(self, ending: str, count: int = 1, timeout_s: float = 20) -> list[dict[str, Any]]:
        wait_until(lambda: len(self.named(ending)) >= count, timeout_s)
        return self.named(ending)


class Routes(BaseHTTPRequestHandler):
    """The worker routes of docs/design/modules.md."""

    state: Coordinator
    protocol_version = "HTTP/1.1"
    # Close connections after each answer, so that nobody talks to a server that is down.
    close_connection = True

    def do_POST(self) -> None:
        body = json.loads(self._body())
        self.state.calls.append((self.path, body))
        ending = self.path.rpartition("/")[2]
        if self.headers["Authorization"] != f"Bearer {TOKEN}":
            self._refuse(AuthError("wrong token"))
        elif ending in self.state.refuse:
            self._refuse(self.state.refuse[ending])
        elif self.path == "/v1/workers":
            self._answer(201, {"worker_id": "w1", "heartbeat_s": 0.1})
        elif ending == "claim" and self.state.claims:
            self._answer(200, self.state.claims.pop(0).model_dump(mode="json"))
        elif ending == "claim":
            time.sleep(0.02)
            self._answer(204, None)
        elif ending == "heartbeat":
            # Stop a stage only once it has reported progress, so that it has certainly begun.
            self._answer(200, {"stop": self.state.stop and bool(body.get("progress")), "reason": "canceled"})
        elif ending == "missing":
            self._answer(200, {"missing": [sha for sha in body["sha256"] if sha not in self.state.blobs]})
        else:
            self._answer(204, None)

    def do_PUT(self) -> None:
        self.state.blobs[self.path.rpartition("/")[2]] = self._body()
        self._answer(201, None)

    def do_GET(self) -> None:
        sha256 = self.path.rpartition("/")[2]
        self.state.calls.append((self.path, {}))
        if sha256 not in self.state.blobs:
            return self._refuse(NotFound("no such blob"))
        data = self.state.blobs[sha256]
        if sha256 in self.state.damaged:
            self.state.damaged.remove(sha256)
            data = data[:-1] + b"!"
        self._send(200, data)

    def _body(self) -> bytes:
        return self.rfile.read(int(self.headers["Content-Length"]))

    def _refuse(self, error: KilnError) -> None:
        self._answer(error.status, error.problem().model_dump(mode="json"))

    def _answer(self, status: int, document: Any) -> None:
        self._send(status, b"" if document is None else json.dumps(document).encode())

    def _send(self, status: int, data: bytes) -> None:
        self.send_response(status)
        if status != 204:
            self.send_header("Content-Length", str(len(data)))
        self.send_header("Connection", "close")
        self.end_headers()
        self.wfile.write(data)

    def log_message(self, format: str, *args: Any) -> None:
        """Say nothing."""


def wait_until(condition: Callable[[], bool], timeout_s: float = 20) -> None:
    deadline = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < deadline, "waited in vain"
        time.sleep(0.02)


@pytest.fixture
def running() -> Callable[[int], bool]:
    """Whether a process runs (a zombie does not)."""

    def runs(pid: int) -> bool:
        try:
            return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
        except FileNotFoundError:
            return False

    return runs


@pytest.fixture
def coordinator() -> Iterator[Coordinator]:
    state = Coordinator()
    state.up()
    yield state
    state.down()


@pytest.fixture
def stages_path(monkeypatch: pytest.MonkeyPatch) -> str:
    """Let child processes import the stages of the tests."""
    path = os.pathsep.join([str(Path(__file__).parent), *filter(None, [os.environ.get("PYTHONPATH")])])
    monkeypatch.setenv("PYTHONPATH", path)
    return path


@pytest.fixture
def worker(coordinator: Coordinator, stages_path: str, tmp_path: Path) -> Iterator[Worker]:
    """A worker in this process, driven step by step."""
    made = Worker(options_for(coordinator.url, tmp_path / "worker"), lambda event, detail: None)
    yield made
    made.close()


def options_for(url: str, folder: Path) -> WorkerOptions:
    folder.mkdir(parents=True, exist_ok=True)
    return WorkerOptions(
        url=url,
        token=TOKEN,
        name="tester",
        kinds=(TaskKind.FIT, TaskKind.REFINE),
        memory_bytes=1 << 30,
        threads=1,
        folder=folder,
        stages=STAGES,
    )


@pytest.fixture
def worker_program(coordinator: Coordinator, tmp_path: Path) -> list[str]:
    """The command line of the same worker as a process of its own."""
    code = (
        "import sys; from pathlib import Path\n"
        "from kiln_schemas.tasks import TaskKind\n"
        "from kiln_workers.runner.parent import Worker, WorkerOptions\n"
        "folder = Path(sys.argv[2]); folder.mkdir(parents=True)\n"
        f"options = WorkerOptions(url=sys.argv[1], token={TOKEN!r}, name='tester', kinds=(TaskKind.FIT,),\n"
        f"    memory_bytes=1 << 30, threads=1, folder=folder, stages={STAGES!r})\n"
        "Worker(options, lambda event, detail: None).run()\n"
    )
    return [sys.executable, "-c", code, coordinator.url, str(tmp_path / "program")]


@pytest.fixture
def stale() -> StaleAttempt:
    return StaleAttempt("attempt 1 is over")
