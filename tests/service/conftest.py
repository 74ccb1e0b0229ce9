"""A real PostgreSQL for the session, a real coordinator on 127.0.0.1 for each test, and a worker made of HTTP calls."""

import asyncio
import hashlib
import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import httpx
import psycopg
import pytest
import uvicorn
from psycopg.rows import dict_row

from kiln_schemas import __version__
from kiln_service.app import create_app
from kiln_service.config import Limits, ServiceConfig, Timing
from kiln_service.embedded import EmbeddedPostgres
from kiln_service.serve import server_config

FAST = Timing(heartbeat_s=0.2, stale_s=0.8, poll_s=0.1, maintenance_s=0.1)
SLOW_REAPER = Timing(heartbeat_s=0.2, stale_s=600, poll_s=0.1, maintenance_s=0.3)


@pytest.fixture(scope="session")
def postgres() -> Iterator[EmbeddedPostgres]:
    # Not under pytest's folder: every pytest that starts makes that one private again, and the server is another user.
    with (
        TemporaryDirectory(prefix="kiln-test-") as folder,
        EmbeddedPostgres(Path(folder) / "postgres", {"fsync": "off", "full_page_writes": "off"}) as server,
    ):
        yield server


@pytest.fixture(scope="session")
def folder() -> Iterator[Path]:
    """A data folder for coordinators with an embedded database, one after the other: to make one takes seconds."""
    with TemporaryDirectory(prefix="kiln-test-") as folder:
        yield Path(folder)


@pytest.fixture
def dsn(postgres: EmbeddedPostgres, request: pytest.FixtureRequest) -> Iterator[str]:
    with new_database(postgres, "t" + hashlib.sha256(request.node.nodeid.encode()).hexdigest()[:16]) as dsn:
        yield dsn


@pytest.fixture
def other_dsn(dsn: str, postgres: EmbeddedPostgres) -> Iterator[str]:
    """A second, empty database."""
    with new_database(postgres, dsn.rpartition("=")[2] + "_other") as other:
        yield other


@contextmanager
def new_database(postgres: EmbeddedPostgres, name: str) -> Iterator[str]:
    with psycopg.connect(postgres.dsn, autocommit=True) as connection:
        connection.execute(f"CREATE DATABASE {name}")
        yield postgres.dsn.replace("dbname=postgres", f"dbname={name}")
        connection.execute(f"DROP DATABASE {name} WITH (FORCE)")


@dataclass
class Coordinator:
    """A coordinator that serves in a thread, and the client of its owner."""

    config: ServiceConfig
    url: str
    token: str
    client: httpx.Client
    app: Any
    loop: asyncio.AbstractEventLoop
    """On which the application runs, in its own thread."""

    def sql(self, query: str, *parameters: Any) -> list[dict[str, Any]]:
        with psycopg.connect(self.config.database or "", autocommit=True, row_factory=dict_row) as connection:
            cursor = connection.execute(query, parameters)
            return cursor.fetchall() if cursor.description else []

    def upload(self, data: bytes) -> str:
        sha256 = hashlib.sha256(data).hexdigest()
        self.client.put(f"/v1/blobs/{sha256}", content=data).raise_for_status()
        return sha256

    def request(self, **changes: Any) -> dict[str, Any]:
        bundle = {"entry": "scene.glb", "files": {"scene.glb": self.upload(b"a scene")}}
        return {"name": "test", "bundle": bundle, "preset": "draft"} | changes

    def submit(self, **changes: Any) -> dict[str, Any]:
        reply = self.client.post("/v1/jobs", json=self.request(**changes))
        assert reply.status_code == 201, reply.text
        return reply.json()

    def job(self, job_id: str) -> dict[str, Any]:
        return self.client.get(f"/v1/jobs/{job_id}").raise_for_status().json()

    def tasks(self, job_id: str, **filters: str) -> list[dict[str, Any]]:
        return self.client.get(f"/v1/jobs/{job_id}/tasks", params=filters).raise_for_status().json()

    def events(self, job_id: str) -> list[dict[str, Any]]:
        return self.client.get(f"/v1/jobs/{job_id}/events", params={"format": "json"}).raise_for_status().json()

    def kinds_of_events(self, job_id: str) -> list[str]:
        return [event["kind"] for event in self.events(job_id)]

    def worker(self, name: str = "w", **changes: Any) -> "FakeWorker":
        return FakeWorker(self, name, **changes)


class FakeWorker:
    """What a worker says over HTTP, without doing the work."""

    def __init__(self, coordinator: Coordinator, name: str, **changes: Any) -> None:
        self.home, self.name = coordinator, name
        self.registration = {
            "name": name,
            "kinds": ["prepare", "render", "fit", "refine", "package"],
            "memory_bytes": 2**30,
            "threads": 1,
            "device": "none",
            "version": __version__,
        } | changes
        welcome = coordinator.client.post("/v1/workers", json=self.registration).raise_for_status().json()
        self.id = welcome["worker_id"]

    def claim(self, *kinds: str, wait_s: float = 0) -> dict[str, Any] | None:
        body = {"kinds": kinds or ("prepare", "render", "fit", "refine", "package"), "wait_s": wait_s}
        reply = self.home.client.post(f"/v1/workers/{self.id}/claim", json=body).raise_for_status()
        return None if reply.status_code == 204 else reply.json()

    def must_claim(self, *kinds: str, wait_s: float = 30) -> dict[str, Any]:
        claim = self.claim(*kinds, wait_s=wait_s)
        assert claim is not None, "no task came"
        return claim

    def beat(self, claim: dict[str, Any], log: str = "", progress: dict[str, Any] | None = None) -> dict[str, Any]:
        body = {"task_id": claim["task_id"], "log": log, "progress": progress} | held(claim)
        return self.home.client.post(f"/v1/workers/{self.id}/heartbeat", json=body).raise_for_status().json()

    def commit(self, claim: dict[str, Any], result: dict[str, Any]) -> httpx.Response:
        body = {"result": result} | held(claim)
        return self.home.client.post(f"/v1/tasks/{claim['task_id']}/commit", json=body)

    def fail(
        self, claim: dict[str, Any], *, code: str = "internal", status: int = 500, retryable: bool = True, log: str = ""
    ) -> httpx.Response:
        problem = {"title": "t", "status": status, "detail": "it broke", "code": code}
        body = {"problem": problem, "retryable": retryable, "log": log} | held(claim)
        return self.home.client.post(f"/v1/tasks/{claim['task_id']}/fail", json=body)

    def checkpoint(self, claim: dict[str, Any], data: bytes) -> httpx.Response:
        body = {"sha256": self.home.upload(data)} | held(claim)
        return self.home.client.post(f"/v1/tasks/{claim['task_id']}/checkpoint", json=body)

    def finish(self, claim: dict[str, Any], **choices: Any) -> None:
        """Commit a plausible result."""
        reply = self.commit(claim, result_of(self.home, claim, **choices))
        assert reply.status_code == 204, reply.text

    def advance(self, job_id: str, until: str, **choices: Any) -> None:
        """Finish tasks until one of the kind `until` is queued."""
        while not self.home.tasks(job_id, kind=until, state="queued"):
            self.finish(self.must_claim(), **choices)


def held(claim: dict[str, Any]) -> dict[str, Any]:
    """What every call of an attempt carries."""
    return {"attempt": claim["attempt"], "lease": claim["lease"]}


def result_of(home: Coordinator, claim: dict[str, Any], tiles: int = 2, **changes: Any) -> dict[str, Any]:
    """A result that fits the claimed task."""
    payload = claim["payload"]
    match payload["kind"]:
        case "prepare":
            places = [{"row": 8 * (i // 4), "column": 8 * (i % 4), "size": 8, "texels": 5} for i in range(tiles)]
            result = {
                "scene": home.upload(b"packed scene"),
                "texel_map": home.upload(b"texel map"),
                "between": [home.upload(f"points {kind}".encode()) for kind in range(3)],
                "scene_hash": "0" * 64,
                "resolution": 32,
                "tiles": places,
                "has_environment": False,
                "has_light": True,
                "triangles": 12,
                "notes": ["unwrapped"],
            }
        case "render":
            result = {"tile": payload["tile"], "paths": 10, "overflows": 0, "invalid": 0}
        case "fit":
            metrics = {"log_mse": 0.1, "log_mse_zero": 1.0, "log_mse_rel": 0.1, "texels": 10, "signal": True}
            result = {
                "function": payload["function"],
                "weights": home.upload(payload["function"].encode()),
                "exposure": 1.0,
                "metrics": metrics,
                "curve": [],
                "steps": 1,
            }
        case "refine":
            result = {"block": payload["block"], "lobes": home.upload(b"lobes"), "texels": 10, "steps": 1}
        case _:
            data = b"0123456789" * 100
            files = {"lightfield.ktx2": "image/ktx2", "shaders/light.glsl": "text/plain"}
            result = {
                "artifacts": [
                    {"name": name, "sha256": home.upload(data), "size": len(data), "media_type": kind}
                    for name, kind in files.items()
                ]
            }
    return {"kind": payload["kind"], "seconds": 0.5} | result | {k: v for k, v in changes.items() if k in result}


@contextmanager
def serving(config: ServiceConfig) -> Iterator[Coordinator]:
    """Run a coordinator in a thread for the time of the block."""
    app = create_app(config)
    server = uvicorn.Server(server_config(app, config))
    with socket.socket(proto=socket.IPPROTO_TCP) as listening:
        listening.bind(("127.0.0.1", 0))
        listening.listen(128)
        loop = asyncio.new_event_loop()
        thread = threading.Thread(target=loop.run_until_complete, args=[server.serve(sockets=[listening])])
        thread.start()
        try:
            deadline = time.monotonic() + 300
            while not server.started and thread.is_alive() and time.monotonic() < deadline:
                time.sleep(0.005)
            assert server.started
            url = f"http://127.0.0.1:{listening.getsockname()[1]}"
            token = (config.data / "token").read_text().strip()
            headers = {"Authorization": f"Bearer {token}"}
            with httpx.Client(base_url=url, headers=headers, timeout=300) as client:
                yield Coordinator(config, url, token, client, app, loop)
        finally:
            parts = getattr(app.state, "parts", None)
            if parts is not None:
                parts.signals.stop()
            server.should_exit = True
            thread.join()
            loop.close()


@dataclass
class Starter:
    """Starts coordinators on the test's database and data folder."""

    data: Path
    dsn: str
    changes: dict[str, Any] = field(default_factory=dict)

    def config(self, **changes: Any) -> ServiceConfig:
        defaults = {"data": self.data, "database": self.dsn, "timing": SLOW_REAPER, "limits": Limits(reserve_bytes=0)}
        return ServiceConfig(**defaults | changes)

    @contextmanager
    def __call__(self, **changes: Any) -> Iterator[Coordinator]:
        with serving(self.config(**changes)) as coordinator:
            yield coordinator


@pytest.fixture
def start(dsn: str, tmp_path: Path) -> Starter:
    return Starter(tmp_path / "data", dsn)


@pytest.fixture
def home(start: Starter) -> Iterator[Coordinator]:
    with start() as coordinator:
        yield coordinator


@pytest.fixture(scope="session")
def shared(postgres: EmbeddedPostgres) -> Iterator[Coordinator]:
    """One coordinator for all tests that leave nothing behind which another would notice."""
    with (
        new_database(postgres, "shared") as dsn,
        TemporaryDirectory(prefix="kiln-test-") as folder,
        serving(Starter(Path(folder), dsn).config()) as coordinator,
    ):
        yield coordinator


@pytest.fixture
def eventually() -> Callable[..., Any]:
    """Ask until the answer is true; fails after minutes, which a loaded machine may take."""

    def ask(question: Callable[[], Any], seconds: float = 300) -> Any:
        deadline = time.monotonic() + seconds
        while not (answer := question()):
            assert time.monotonic() < deadline, "it did not happen"
            time.sleep(0.02)
        return answer

    return ask


@pytest.fixture
def make_worker() -> type[FakeWorker]:
    return FakeWorker


@pytest.fixture
def fast() -> Timing:
    return FAST


@pytest.fixture
def result() -> Callable[..., dict[str, Any]]:
    return result_of
