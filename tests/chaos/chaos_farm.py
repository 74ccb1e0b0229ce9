"""A farm whose processes are restarted when they end, as systemd does, with proxies where its wires are cut."""

import contextlib
import os
import secrets
import subprocess
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from unittest.mock import patch

import httpx
import psutil
from e2e_farm import Farm
from farm_clock import FarmClock
from faulty_proxy import FaultyProxy

RESTART_S = 1.0
"""Between the end of a process and its next start (RestartSec of deploy/lightkiln-worker.service is 5 s)."""
WORKERS = ("one", "two")
MARK = "LIGHTKILN_CHAOS_FARM"
"""Variable in the environment of all processes of a farm, by which those that were left behind are found."""


class ChaosFarm(Farm):
    """A coordinator and two workers, each under a supervisor; workers reach the coordinator through `wire`."""

    wire: FaultyProxy
    clock: FarmClock
    flags: tuple[str, ...] = ()
    restarts: int = 0

    def open(self, *flags: str) -> None:
        """Start everything; `flags` are the coordinator's."""
        self.flags, self._mark = flags, secrets.token_hex(8)
        self.clock = FarmClock()
        self.start_coordinator(*flags)
        self.wire = FaultyProxy(self.port)
        for name in WORKERS:
            self.start_worker(name, "--threads", "1")
        self._closing = threading.Event()
        self._supervisor = threading.Thread(target=self._supervise)
        self._supervisor.start()

    def close(self) -> None:
        """Stop everything."""
        self._closing.set()
        self._supervisor.join()
        self.stop()
        self.wire.close()
        self.clock.close()

    def leaked(self) -> list[psutil.Process]:
        """Processes of this farm that run though it is closed."""
        found = []
        for process in psutil.process_iter():
            with contextlib.suppress(psutil.Error):
                # The database server writes its title over its environment, but stays in its folder.
                ours = process.environ().get(MARK) == self._mark or Path(process.cwd()).is_relative_to(self.folder)
                if ours and process.status() != psutil.STATUS_ZOMBIE:
                    found.append(process)
        return found

    def start_worker(self, name: str, *flags: str, preexec: Any = None) -> None:
        port, self.port = self.port, self.wire.port
        try:
            super().start_worker(name, *flags, preexec=preexec)
        finally:
            self.port = port

    def ask(self, method: str, path: str, **parameters: Any) -> Any:
        """The coordinator's answer as JSON, past the wire; None while it has none to give."""
        reply = self.send(method, path, params=parameters)
        if reply is None or reply.status_code >= 500:
            return None
        assert reply.is_success, reply.text
        return reply.json() if reply.content else {}

    def send(self, method: str, path: str, **request: Any) -> httpx.Response | None:
        """The coordinator's answer, past the wire; None where it ends the connection or does not listen."""
        headers = {"Authorization": f"Bearer {self.token}"}
        try:
            return httpx.request(method, self.url + path, headers=headers, timeout=60, **request)
        except httpx.TransportError:
            return None

    def postgres(self) -> tuple[psutil.Process, list[psutil.Process]]:
        """The postmaster and its backends; raises psutil.Error or ValueError where it is not there."""
        parent = psutil.Process(self.processes["coordinator"].pid)
        [server] = [child for child in parent.children() if child.name() == "postgres"]
        return server, [child for child in server.children() if "[local]" in " ".join(child.cmdline())]

    def signal_worker(self, name: str, number: int) -> None:
        """A signal to a worker's parent and its child."""
        process = psutil.Process(self.processes[name].pid)
        for victim in (process, *process.children()):
            victim.send_signal(number)

    def kill_everything(self) -> None:
        """kill -9 of every process of the farm, as a power cut does it."""
        victims = []
        for process in list(self.processes.values()):
            with contextlib.suppress(psutil.Error):
                started = psutil.Process(process.pid)
                victims += [started, *started.children(recursive=True)]
        for victim in victims:
            with contextlib.suppress(psutil.Error):
                victim.kill()

    def scratch(self, name: str) -> Path:
        """The folder of a worker."""
        return self.folder / f"scratch-{name}"

    def environment(self, name: str) -> dict[str, str]:
        """Of a process of the farm. Workers have the true time: they look at no wall clock, and libfaketime is slow."""
        return os.environ | {MARK: self._mark} | (self.clock.environment() if name == "coordinator" else {})

    def _start(self, name: str, arguments: list[str], preexec: Any = None) -> None:
        with patch.dict(os.environ, self.environment(name)):
            super()._start(name, arguments, preexec)

    def _supervise(self) -> None:
        ended: dict[str, float] = {}
        while not self._closing.wait(0.1):
            for name, process in list(self.processes.items()):
                if process.poll() is None:
                    continue
                since = ended.setdefault(name, time.monotonic())
                if time.monotonic() - since < RESTART_S:
                    continue
                del ended[name]
                self.restarts += 1
                if name == "coordinator":
                    where = ["--port", str(self.port), "--data", str(self.folder / "data")]
                    config = ["--config", str(self.folder / "coordinator.json")]
                    self._start(name, ["-m", "kiln_service", *where, *config, *self.flags])
                else:
                    self.start_worker(name, "--threads", "1")


@contextlib.contextmanager
def small_disk(folder: Path, size: str = "64m") -> Iterator[Path | None]:
    """A tmpfs of its own for the time of the block; None where this user may not mount one."""
    folder.mkdir()
    mounted = subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={size}", "tmpfs", folder], capture_output=True)
    try:
        yield folder if mounted.returncode == 0 else None
    finally:
        if mounted.returncode == 0:
            subprocess.run(["umount", "--lazy", folder], check=True)


def fill(folder: Path) -> Path:
    """Leave no byte free on a disk; the file that takes them."""
    ballast = folder / "ballast"
    with contextlib.suppress(OSError), ballast.open("wb", buffering=0) as file:
        while True:
            file.write(bytes(1 << 20)) or os.fsync(file.fileno())
    return ballast
