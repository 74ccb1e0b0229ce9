"""A small room, a farm of real processes on this machine, and the `lightkiln` command as a user types it."""

import hashlib
import json
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import psutil

from kiln_workers.scene.model import Material, Mesh, Scene

TINY = (
    *("lightmap.resolution=16", "lightmap.tile=8", "render.image_size=16", "render.samples=8"),
    *("render.irradiance_samples=64", "fit.lobes=6", "fit.start_steps=100", "fit.visibility_refine_steps=60"),
    *("fit.batch=16", "fit.refine_steps=60", "fit.block=8", "render.between_samples=8", "package.environment_size=16"),
    "package.pictures=off",
)
"""Settings of the smallest bake that still has several tiles and a fit that converges."""

HOST = "127.0.0.1"

TIMING = {"heartbeat_s": 1.0, "stale_s": 8.0, "maintenance_s": 1.0}
"""Of the farm's coordinator, in seconds: a lost worker is noticed sooner than the 30 s of a farm across a network."""


def quad(name: str, corner: tuple[float, ...], u: tuple[float, ...], v: tuple[float, ...], material: int) -> Mesh:
    """A parallelogram whose normal is u x v; its chart is the quarter of the light map that `material` numbers."""
    a, du, dv = (np.array(x, np.float32) for x in (corner, u, v))
    normal = np.cross(du, dv)
    square = np.array([[0, 1], [1, 1], [1, 0], [0, 0]], np.float32)
    quarter = np.array([material % 2, material // 2], np.float32)
    return Mesh(
        name=name,
        positions=np.stack([a, a + du, a + du + dv, a + dv]),
        normals=np.tile(normal / np.linalg.norm(normal), (4, 1)).astype(np.float32),
        faces=np.array([[0, 1, 2], [0, 2, 3]], np.int32),
        material=material,
        uv=square,
        lightmap_uv=(0.125 + 0.75 * square + quarter) / 2,
    )


def room(lamp: float = 12.0) -> Scene:
    """A floor, two walls of different colours and a lamp; open to the sky at the front."""
    materials = (
        Material("floor", (0.7, 0.7, 0.7, 1.0), roughness=0.55, metallic=1.0),
        Material("red", (0.7, 0.15, 0.1, 1.0)),
        Material("green", (0.15, 0.6, 0.2, 1.0)),
        Material("lamp", (0.0, 0.0, 0.0, 1.0), emission=(lamp, lamp, 0.8 * lamp)),
    )
    meshes = (
        quad("floor", (-1, 0, 1), (2, 0, 0), (0, 0, -2), 0),
        quad("left", (-1, 0, 1), (0, 0, -2), (0, 2, 0), 1),
        quad("back", (-1, 0, -1), (2, 0, 0), (0, 2, 0), 2),
        quad("lamp", (0.3, 1.6, -0.6), (-0.6, 0, 0), (0, 0, 0.5), 3),
    )
    return Scene(meshes, materials)


def sky() -> np.ndarray[Any, np.dtype[np.float32]]:
    """A gradient with a bright patch, [16, 32, 3]."""
    pixels = np.zeros((16, 32, 3), np.float32)
    pixels[:] = np.linspace(1.0, 0.2, 16, dtype=np.float32)[:, None, None] * np.array([0.6, 0.8, 1.0], np.float32)
    pixels[4:6, 14:17] = 25.0
    return pixels


def lightkiln(*arguments: str | Path, timeout: float = 1800) -> "subprocess.CompletedProcess[str]":
    """Run the command to its end."""
    command = [Path(sys.executable).with_name("lightkiln"), *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, timeout=timeout, stdin=subprocess.DEVNULL)


def settings(*overrides: str) -> list[str]:
    """Overrides as flags."""
    return [word for override in (*TINY, *overrides) for word in ("--set", override)]


def wait_until(what: str, check: Callable[[], Any], timeout: float = 1200.0) -> Any:
    """The first truthy answer of `check`; fails the test after `timeout` seconds."""
    deadline = time.monotonic() + timeout
    while time.monotonic() < deadline:
        found = check()
        if found:
            return found
        time.sleep(0.05)
    raise AssertionError(f"waited {timeout} s in vain: {what}")


def digests(folder: Path) -> dict[str, str]:
    """sha256 of everything in a package that must not depend on when or where it was made."""
    files = [p for p in folder.iterdir() if p.suffix in (".ktx2", ".exr", ".glb")]
    return {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


@dataclass
class Farm:
    """A coordinator and workers as an operator starts them; each can be killed and started again."""

    folder: Path
    port: int = 0
    token: str = ""
    processes: dict[str, "subprocess.Popen[bytes]"] = field(default_factory=dict)
    config: dict[str, Any] = field(default_factory=dict)
    """Of the coordinator, besides its timing."""

    @property
    def url(self) -> str:
        return f"http://{HOST}:{self.port}"

    def start_coordinator(self, *flags: str) -> None:
        if not self.port:
            with socket.socket() as probe:
                probe.bind((HOST, 0))
                self.port = probe.getsockname()[1]
        data, config = self.folder / "data", self.folder / "coordinator.json"
        config.write_text(json.dumps({"timing": TIMING} | self.config))
        where = ["--port", str(self.port), "--data", str(data), "--config", str(config)]
        self._start("coordinator", ["-m", "kiln_service", *where, *flags])
        wait_until("the coordinator is ready", self._ready)
        self.token = (data / "token").read_text().strip()

    def start_worker(self, name: str, *flags: str, preexec: Callable[[], None] | None = None) -> None:
        """Start a worker; `preexec` runs in its process first."""
        common = ["-m", "kiln_workers", "worker", "--url", self.url, "--token-file", str(self.folder / "data/token")]
        scratch = ["--name", name, "--scratch", str(self.folder / f"scratch-{name}")]
        self._start(name, [*common, *scratch, *flags], preexec)

    def end(self, name: str) -> None:
        """SIGTERM, and wait."""
        self.processes[name].terminate()
        self.processes[name].wait(600)

    def kill(self, name: str, *, children_only: bool = False) -> None:
        """kill -9 of a process, or of its children alone."""
        process = psutil.Process(self.processes[name].pid)
        for victim in process.children() if children_only else [process]:
            victim.send_signal(signal.SIGKILL)
        if not children_only:
            self.processes[name].wait()

    def get(self, path: str, **parameters: Any) -> Any:
        """GET as JSON; None while the coordinator is down."""
        try:
            reply = httpx.get(self.url + path, params=parameters, headers={"Authorization": f"Bearer {self.token}"})
        except httpx.TransportError:
            return None
        assert reply.is_success, reply.text
        return reply.json()

    def submit(self, scene: Path, environment: Path | None = None, *flags: str) -> str:
        """Submit through the command line; the job's id."""
        env = ["--env", environment] if environment else []
        where = ["--url", self.url, "--token", self.token]
        done = lightkiln("submit", scene, *env, "--preset", "draft", *flags, *where, "--json")
        assert done.returncode == 0, done.stderr + done.stdout
        return str(json.loads(done.stdout)["id"])

    def tasks(self, job: str, kind: str) -> list[dict[str, Any]]:
        return [task for task in self.get(f"/v1/jobs/{job}/tasks") or [] if task["kind"] == kind]

    def state(self, job: str) -> str:
        view = self.get(f"/v1/jobs/{job}")
        return str(view["state"]) if view else ""

    def finish(self, job: str) -> None:
        """Wait until the job has completed."""
        over = ("completed", "gate-failed", "failed", "canceled")
        state = wait_until("the job ends", lambda: (now := self.state(job)) in over and now)
        assert state == "completed", self.get(f"/v1/jobs/{job}")

    def download(self, job: str, out: Path) -> Path:
        """The job's package, through the command line."""
        done = lightkiln("download", job, "--out", out, "--url", self.url, "--token", self.token)
        assert done.returncode == 0, done.stderr
        return out

    def stop(self) -> None:
        for process in reversed(self.processes.values()):
            process.terminate()
        for process in self.processes.values():
            try:
                process.wait(600)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()

    def _start(self, name: str, arguments: list[str], preexec: Callable[[], None] | None = None) -> None:
        with (self.folder / f"{name}.log").open("ab") as log:
            self.processes[name] = subprocess.Popen(
                [sys.executable, *arguments], stdout=log, stderr=log, preexec_fn=preexec
            )

    def _ready(self) -> bool:
        assert self.processes["coordinator"].poll() is None, (self.folder / "coordinator.log").read_text()
        try:
            return httpx.get(self.url + "/readyz").is_success
        except httpx.TransportError:
            return False


def threads() -> str:
    """Flag value: all cores of this machine."""
    return str(len(os.sched_getaffinity(0)))
