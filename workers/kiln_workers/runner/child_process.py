"""The child process as its parent holds it: start, send work, hear answers and log lines, kill."""

import os
import queue
import signal
import subprocess
import sys
import threading
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from typing import IO, Final

from pydantic import ValidationError

from kiln_schemas.base import Contract
from kiln_workers.runner.protocol import END_OF_LOG, Done, Failed, Ready, Report, Setup, ToParent, Work, encode

READER_JOIN_S: Final = 2.0
LOG_LINES: Final = 200
"""Last lines of the child that go with a failure."""
TOKEN_VARIABLE: Final = "LIGHTKILN_TOKEN"
THREAD_VARIABLES: Final = (
    "OMP_NUM_THREADS",
    "MKL_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
    "NUMEXPR_NUM_THREADS",
    "VECLIB_MAXIMUM_THREADS",
)


@dataclass(frozen=True)
class Ended:
    """The child is gone; its exit status as Popen has it (negative: the signal)."""

    status: int

    def sentence(self) -> str:
        """What happened, for people."""
        if self.status >= 0:
            return f"the worker's process exited with status {self.status}"
        name = signal.Signals(-self.status).name
        hint = ", as when the machine runs out of memory" if self.status == -signal.SIGKILL else ""
        return f"the worker's process was ended by {name}{hint}"


Answer = Ready | Report | Done | Failed | Ended


class ChildProcess:
    """A running child. Start it from the main thread: its life is tied to the thread that forks it (`tether`)."""

    def __init__(self, setup: Setup, on_line: Callable[[str], None]) -> None:
        self.answers: queue.Queue[Answer] = queue.Queue()
        self.tail: deque[str] = deque(maxlen=LOG_LINES)
        self._on_line = on_line
        self._told_all = threading.Event()
        self._process = subprocess.Popen(
            [sys.executable, "-m", "kiln_workers.runner.child", str(os.getpid())],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            # The token goes by the pipe: no process that the child starts has it.
            env={name: value for name, value in os.environ.items() if name != TOKEN_VARIABLE}
            | dict.fromkeys(THREAD_VARIABLES, str(setup.threads))
            | {"PYTHONUNBUFFERED": "1"},
            # A Ctrl-C at the terminal is the parent's business.
            start_new_session=True,
        )
        self._readers = [
            threading.Thread(target=self._read_log, args=(self._process.stderr,), daemon=True),
            threading.Thread(target=self._read_answers, args=(self._process.stdout,), daemon=True),
        ]
        for reader in self._readers:
            reader.start()
        self.send(setup)

    @property
    def pid(self) -> int:
        return self._process.pid

    def alive(self) -> bool:
        """Whether the process runs."""
        return self._process.poll() is None

    def send(self, message: Contract) -> None:
        """Write one line to the child; a child that is gone tells so by `Ended`, not here."""
        assert self._process.stdin is not None
        try:
            self._process.stdin.write(encode(message))
            self._process.stdin.flush()
        except BrokenPipeError:
            self.kill()

    def begin(self, work: Work) -> None:
        """Send a task; what the tasks before it printed is theirs."""
        self.tail.clear()
        self._told_all.clear()
        self.send(work)

    def hear_out(self) -> None:
        """Wait for the last line that the task printed: it comes by another pipe than the task's outcome."""
        self._told_all.wait(READER_JOIN_S)

    def kill(self) -> None:
        """End the child and all that it started, and wait until it is gone."""
        with suppress(ProcessLookupError):
            os.killpg(self._process.pid, signal.SIGKILL)
        self._process.wait()
        for reader in self._readers:
            reader.join(timeout=READER_JOIN_S)
        # A half-written line to a dead child cannot be flushed.
        with suppress(BrokenPipeError):
            if self._process.stdin is not None:
                self._process.stdin.close()

    def _read_log(self, pipe: IO[bytes]) -> None:
        with pipe:
            for raw in pipe:
                line = raw.decode(errors="replace").rstrip()
                if line == END_OF_LOG:
                    self._told_all.set()
                    continue
                self.tail.append(line)
                self._on_line(line)

    def _read_answers(self, pipe: IO[bytes]) -> None:
        with pipe:
            for line in pipe:
                try:
                    self.answers.put(ToParent.validate_json(line))
                except ValidationError:
                    # Cut off by a kill in the middle of a line, or written before the child moved its output.
                    self._on_line(line.decode(errors="replace").rstrip())
        status = self._process.wait()
        # Let the last words come in, so that they go with the failure.
        self._readers[0].join(timeout=READER_JOIN_S)
        self.answers.put(Ended(status))
