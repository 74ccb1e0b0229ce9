"""A coordinator and workers on this machine, for one `lightkiln bake`: started, watched, restarted, stopped.

Every process writes to a log under the data folder and is tied to our life (`tether`). One that dies is started again:
the coordinator finds its state in its database, and a worker's task goes to the next attempt. One that
dies of something that a restart does not mend (its exit code says so), or again and again, ends the bake
with its last words.
"""

import json
import os
import socket
import subprocess
import sys
import time
from collections import deque
from collections.abc import Callable
from contextlib import closing, suppress
from pathlib import Path
from types import TracebackType
from typing import Final, Self

from pydantic import ValidationError

from kiln_schemas.client import Client
from kiln_schemas.errors import (
    AuthError,
    Conflict,
    InputError,
    InternalError,
    KilnError,
    MachineLacks,
    Problem,
)

HOST: Final = "127.0.0.1"
READY_TIMEOUT_S: Final = 180.0
RESTARTS: Final = 5
RESTART_WINDOW_S: Final = 60.0
WORKER_STOP_S: Final = 8.0
COORDINATOR_STOP_S: Final = 40.0
LOCAL_TIMING: Final = {"heartbeat_s": 2.0, "stale_s": 10.0, "maintenance_s": 2.0}
"""Seconds (`kiln_service.config.Timing`). On one machine a lost worker is noticed sooner than on a farm."""
PERMANENT: Final = frozenset({2, InputError.exit_code, Conflict.exit_code, AuthError.exit_code, MachineLacks.exit_code})
"""Exit codes after which a restart would end the same way."""
TAIL_LINES: Final = 5

OWNER_VARIABLE: Final = "LIGHTKILN_OWNER_TOKEN"
"""Names the token of another coordinator (`kiln_service.auth`); the one here makes its own."""

Say = Callable[[str], None]


class Managed:
    """One process that is kept running."""

    def __init__(self, name: str, command: list[str], log: Path) -> None:
        self.name, self.command, self.log = name, command, log
        self._process: subprocess.Popen[bytes] | None = None
        self._starts: deque[float] = deque(maxlen=RESTARTS)

    @property
    def pid(self) -> int | None:
        """Of the running process."""
        return None if self._process is None or self._process.poll() is not None else self._process.pid

    def start(self) -> None:
        """Start it, in a session of its own: a Ctrl-C at the terminal is for us."""
        self._starts.append(time.monotonic())
        with self.log.open("ab") as output:
            self._process = subprocess.Popen(
                [sys.executable, "-m", "kiln_service.cli.tether", str(os.getpid()), *self.command],
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=output,
                start_new_session=True,
                env={name: value for name, value in os.environ.items() if name != OWNER_VARIABLE},
            )

    def revive(self, say: Say) -> None:
        """Start it again if it ended; raise where that is of no use."""
        status = None if self._process is None else self._process.poll()
        if status is None:
            return
        if status in PERMANENT:
            raise self.last_words(status)
        if len(self._starts) == RESTARTS and time.monotonic() - self._starts[0] < RESTART_WINDOW_S:
            raise InternalError(
                f"the {self.name} ended {RESTARTS} times within {RESTART_WINDOW_S:.0f} s: {self._tail()}",
                remedy=f"Please report it with {self.log}.",
            )
        say(f"the {self.name} ended ({'signal' if status < 0 else 'status'} {abs(status)}) and is started again")
        self.start()

    def stop(self, grace_s: float) -> None:
        """Ask it to stop, and kill it where it does not."""
        if self._process is None:
            return
        self._process.terminate()
        try:
            self._process.wait(grace_s)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()

    def terminate(self) -> None:
        """Ask it to stop and do not wait."""
        if self._process is not None:
            self._process.terminate()

    def last_words(self, status: int) -> KilnError:
        """The problem that it wrote before it ended, or its last lines."""
        for line in reversed(self._lines()):
            with suppress(ValueError, ValidationError):
                return KilnError.from_problem(Problem.model_validate_json(line))
        return MachineLacks(f"the {self.name} ended with status {status}: {self._tail()}", remedy=f"See {self.log}.")

    def _tail(self) -> str:
        return " | ".join(self._lines()[-TAIL_LINES:])

    def _lines(self) -> list[str]:
        with self.log.open("rb") as file:
            file.seek(max(0, file.seek(0, os.SEEK_END) - 65536))
            return [line for line in file.read().decode(errors="replace").splitlines() if line.strip()]


class LocalFarm:
    """The processes of one bake; a context that always stops them."""

    def __init__(self, data: Path, *, workers: int, threads: int, memory: int, say: Say) -> None:
        self.data, self._say = data, say
        self.url = f"http://{HOST}:{free_port()}"
        self._token_file = data / "token"
        logs = data / "logs"
        port = self.url.rpartition(":")[2]
        self._config_file = data / "coordinator.json"
        self.coordinator = Managed(
            "coordinator",
            [
                *(sys.executable, "-m", "kiln_service", "--config", str(self._config_file), "--json"),
                *("--host", HOST, "--port", port, "--data", str(data)),
            ],
            logs / "coordinator.log",
        )
        self.workers = [
            Managed(
                f"worker {number}",
                [
                    *(sys.executable, "-m", "kiln_workers", "worker", "--url", self.url, "--json"),
                    *("--token-file", str(self._token_file), "--name", f"worker-{number}"),
                    *("--threads", str(threads), "--memory", str(memory), "--scratch", str(data / "workers")),
                ],
                logs / f"worker-{number}.log",
            )
            for number in range(1, workers + 1)
        ]

    def __enter__(self) -> Self:
        self.data.mkdir(parents=True, exist_ok=True, mode=0o700)
        (self.data / "logs").mkdir(exist_ok=True)
        self._config_file.write_text(json.dumps({"timing": LOCAL_TIMING}))
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.stop()

    @property
    def token(self) -> str:
        """Of the running coordinator."""
        return self._token_file.read_text().strip()

    def start(self) -> None:
        """Start the coordinator, wait until it is ready, start the workers."""
        self.coordinator.start()
        deadline = time.monotonic() + READY_TIMEOUT_S
        with Client(self.url, None, patience_s=0) as api:
            while not api.ready():
                if time.monotonic() > deadline:
                    raise MachineLacks(
                        f"the coordinator was not ready within {READY_TIMEOUT_S:.0f} s",
                        remedy=f"See {self.coordinator.log}, and run `lightkiln doctor`.",
                    )
                self.coordinator.revive(self._say)
                time.sleep(0.1)
        for worker in self.workers:
            worker.start()

    def revive(self) -> None:
        """Start again what ended."""
        for managed in (self.coordinator, *self.workers):
            managed.revive(self._say)

    def stop(self) -> None:
        """Stop all, workers first so that they can give their tasks back."""
        for worker in self.workers:
            worker.terminate()
        for worker in self.workers:
            worker.stop(WORKER_STOP_S)
        self.coordinator.stop(COORDINATOR_STOP_S)


def free_port() -> int:
    """A TCP port that nobody listens on now."""
    with closing(socket.socket(socket.AF_INET, socket.SOCK_STREAM)) as probe:
        probe.bind((HOST, 0))
        port: int = probe.getsockname()[1]
        return port


def share(workers: int | None) -> tuple[int, int, int]:
    """Workers, threads each and memory in bytes each, such that together they use this machine's cores once.

    By default a worker for every four cores: the fit's micro-batches and the renderer's wavefronts fill
    that many threads, and from eight cores on the two networks are fitted side by side.
    """
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    count = workers or max(1, cores // 4)
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    return count, max(1, cores // count), int(0.6 * memory / count)
