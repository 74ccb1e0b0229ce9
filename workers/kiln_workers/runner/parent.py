"""A worker: registers, claims tasks, gives them to its child process, heartbeats, commits.

The parent imports neither renderer nor network, so it stays alive and small whatever the child does. It has one
thread besides the readers of the child's pipes: while the coordinator is away the child works on and its answer waits.
An attempt that was taken away (409 `stale-attempt`, or `stop` in a heartbeat's reply) is dropped without a word.
"""

import queue
import signal
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import Any, Final

from kiln_schemas import __version__
from kiln_schemas.errors import (
    AuthError,
    Canceled,
    Drained,
    Forbidden,
    InternalError,
    KilnError,
    MachineLacks,
    NotFound,
    StaleAttempt,
    Unreachable,
)
from kiln_schemas.tasks import (
    Claim,
    ClaimRequest,
    Commit,
    Failure,
    Heartbeat,
    Progress,
    Result,
    TaskKind,
    WorkerRegistration,
    WorkerWelcome,
)
from kiln_workers.runner.child_process import ChildProcess, Ended
from kiln_workers.runner.client import CoordinatorClient
from kiln_workers.runner.protocol import Done, Failed, Ready, Report, Setup, Stop, Work

START_TIMEOUT_S: Final = 180.0
STOP_GRACE_S: Final = 2.0
"""How long a child may take to leave a task that is not wanted before it is killed and has to load all anew."""
FAREWELL_S: Final = 3.0
"""How long a worker that is told to stop tries to give its task back."""
INTERRUPT_AGAIN_S: Final = 1.0
PAUSE_MAX_S: Final = 30.0
LOG_CHARACTERS: Final = 65536
LAST_LINES: Final = 8
"""Of a dead child's, quoted in its task's error."""

Announce = Callable[[str, dict[str, Any]], None]
"""Told what happens: an event's name (`task.claimed`, `log`, ...) and its details."""


class Interrupted(BaseException):
    """Somebody wants this worker to stop; raised by the signal handler wherever the main thread is."""


@dataclass(frozen=True)
class WorkerOptions:
    """A worker as its command line describes it."""

    url: str
    token: str
    name: str
    kinds: tuple[TaskKind, ...]
    memory_bytes: int
    threads: int
    folder: Path
    """For temporary files and the blob cache; nobody else uses it."""
    tags: tuple[str, ...] = ()
    cache_bytes: int = 8 << 30
    stages: str = "kiln_workers.stages"


class Worker:
    """One worker process with one child."""

    def __init__(self, options: WorkerOptions, announce: Announce) -> None:
        self._options, self._announce = options, announce
        self._client = CoordinatorClient(
            options.url, options.token, on_wait=lambda message: announce("coordinator.away", {"message": message})
        )
        self._child: ChildProcess | None = None
        self._device = ""
        self._welcome: WorkerWelcome | None = None
        self._current: Claim | None = None
        self._lines = LineBuffer()
        self._closing = False
        self._failures = 0

    def run(self) -> None:
        """Work until SIGTERM or SIGINT, when the task at hand is given back at once for another worker.

        Or until an operator drains the worker: it is told so when it asks for its next task.
        """
        for sig in (signal.SIGTERM, signal.SIGINT, signal.SIGALRM):
            signal.signal(sig, self._interrupt)
        try:
            while True:
                self.step()
        except Interrupted:
            self._closing = True
            self._announce("worker.stopping", {})
        except Drained as error:
            self._announce("worker.drained", {"reason": error.detail})
        finally:
            self.close()

    def step(self) -> None:
        """Claim and run one task, if there is one."""
        child = self._ready_child()
        welcome = self._welcome or self._register()
        try:
            claim = self._client.claim(welcome.worker_id, ClaimRequest(kinds=self._options.kinds))
        except NotFound:
            # The coordinator started on an empty database: introduce ourselves again.
            self._welcome = None
            return
        if claim is None:
            return
        self._current = claim
        self._lines.take()
        self._announce("task.claimed", _names(claim))
        child.begin(Work(claim=claim))
        self._settle(claim, self._attend(child, claim, welcome))
        self._current = None

    def _register(self) -> WorkerWelcome:
        options = self._options
        self._welcome = self._client.register(
            WorkerRegistration(
                name=options.name,
                kinds=options.kinds,
                tags=options.tags,
                memory_bytes=options.memory_bytes,
                threads=options.threads,
                device=self._device,
                version=__version__,
            )
        )
        self._announce("worker.registered", {"worker": self._welcome.worker_id, "device": self._device})
        return self._welcome

    def _ready_child(self) -> ChildProcess:
        """The child, started anew where it is gone."""
        if self._child is not None and self._child.alive():
            return self._child
        if self._child is not None:
            self._child.kill()
        options = self._options
        child = self._child = ChildProcess(
            Setup(
                url=options.url,
                token=options.token,
                kinds=options.kinds,
                stages=options.stages,
                scratch=str(options.folder / "scratch"),
                cache=str(options.folder / "blobs"),
                cache_bytes=options.cache_bytes,
                memory_bytes=options.memory_bytes,
                threads=options.threads,
            ),
            self._hear_line,
        )
        try:
            answer = child.answers.get(timeout=START_TIMEOUT_S)
        except queue.Empty:
            answer = Ended(0)
        match answer:
            case Ready(lacks=None):
                self._device = answer.device
                return child
            case Ready(lacks=lacks) if lacks is not None:
                raise KilnError.from_problem(lacks)
            case Ended():
                reasons = filter(None, (answer.sentence(), " | ".join(list(child.tail)[-3:])))
                raise MachineLacks(
                    f"the renderer does not start: {'; '.join(reasons)}", remedy="Run `lightkiln doctor`."
                )
            case _:
                raise InternalError(f"the child's first line is {type(answer).__name__}")

    def _attend(self, child: ChildProcess, claim: Claim, welcome: WorkerWelcome) -> Done | Failed | Ended | None:
        """Heartbeat until the child has an answer; None where the attempt is not wanted any more."""
        progress: Progress | None = None
        beaten = 0.0
        while True:
            due = beaten + welcome.heartbeat_s - time.monotonic()
            try:
                answer = child.answers.get(timeout=max(0.0, due))
            except queue.Empty:
                if not self._beat(claim, welcome, progress):
                    self._stop_child(child)
                    return None
                beaten = time.monotonic()
                continue
            match answer:
                case Report(progress=progress):
                    continue
                case Done() | Failed():
                    child.hear_out()
                    return answer
                case Ended():
                    return answer
                case Ready():
                    raise InternalError("the child said it is ready twice")

    def _beat(self, claim: Claim, welcome: WorkerWelcome, progress: Progress | None) -> bool:
        """Send one heartbeat; False where the attempt is not wanted any more."""
        lines = self._lines.take()
        try:
            reply = self._client.heartbeat(
                welcome.worker_id,
                Heartbeat(
                    task_id=claim.task_id, attempt=claim.attempt, lease=claim.lease, progress=progress, log=lines
                ),
            )
        except Unreachable:
            self._lines.put_back(lines)
            return True
        except (StaleAttempt, NotFound) as error:
            self._announce("task.dropped", _names(claim) | {"reason": str(error)})
            return False
        if reply.stop:
            self._announce("task.dropped", _names(claim) | {"reason": reply.reason})
        return not reply.stop

    def _stop_child(self, child: ChildProcess) -> None:
        """Ask the child to leave its task and stay warm; kill it where it does not listen."""
        child.send(Stop())
        deadline = time.monotonic() + STOP_GRACE_S
        with suppress(queue.Empty):
            while isinstance(child.answers.get(timeout=max(0.0, deadline - time.monotonic())), Report):
                continue
            return
        child.kill()

    def _settle(self, claim: Claim, outcome: Done | Failed | Ended | None) -> None:
        """Tell the coordinator how the attempt ended; an attempt that was taken away needs no telling."""
        match outcome:
            case Done(result=result):
                self._commit(claim, result)
            case Failed(problem=problem, retryable=retryable) if problem.code != StaleAttempt.code:
                self._fail(claim, KilnError.from_problem(problem), retryable, outcome.lost)
            case Ended():
                self._fail(claim, self._death(outcome), True)
            case _:
                self._announce("task.left", _names(claim))

    def _commit(self, claim: Claim, result: Result) -> None:
        try:
            self._client.commit(claim.task_id, Commit(attempt=claim.attempt, lease=claim.lease, result=result))
        except (StaleAttempt, NotFound) as error:
            self._announce("task.dropped", _names(claim) | {"reason": str(error)})
        except (Unreachable, AuthError, Forbidden):
            raise
        except KilnError as error:
            # The coordinator refuses the result, for instance because it lost a blob: another attempt may do better.
            self._fail(claim, error, True)
        else:
            self._announce("task.completed", _names(claim) | {"seconds": result.seconds})
            self._failures = 0

    def _fail(self, claim: Claim, error: KilnError, retryable: bool, lost: tuple[str, ...] = ()) -> None:
        self._announce("task.failed", _names(claim) | {"problem": str(error), "retryable": retryable})
        with suppress(StaleAttempt, NotFound):
            self._client.fail(claim.task_id, self._failure(claim, error, retryable, lost))
        # It is settled: what follows is a pause, in which nothing has to be given back.
        self._current = None
        if retryable:
            # A machine that lacks something would otherwise use up the task's attempts in a second.
            self._failures += 1
            time.sleep(min(PAUSE_MAX_S, 0.25 * 2**self._failures))

    def _failure(self, claim: Claim, error: KilnError, retryable: bool, lost: tuple[str, ...] = ()) -> Failure:
        tail = "\n".join(self._child.tail) if self._child else ""
        return Failure(
            attempt=claim.attempt,
            lease=claim.lease,
            problem=error.problem(),
            retryable=retryable,
            log=tail[-LOG_CHARACTERS:],
            lost=lost,
        )

    def _death(self, ended: Ended) -> KilnError:
        """Why the child ended, with the last lines that it wrote."""
        lines = [line for line in (self._child.tail if self._child else ()) if line.strip()][-LAST_LINES:]
        detail = f"{ended.sentence()}. Its last lines: {' | '.join(lines)}" if lines else ended.sentence()
        if ended.status == -signal.SIGKILL:
            return MachineLacks(detail, remedy="Start the worker with a smaller --memory.")
        return InternalError(detail, remedy="Please report it with the task's log.")

    def _hear_line(self, line: str) -> None:
        self._lines.add(line)
        current = self._current
        self._announce("log", {"line": line} | (_names(current) if current else {}))

    def _interrupt(self, signum: int, frame: FrameType | None) -> None:
        """Raise Interrupted, and again each second until it is heard: what is raised in a finalizer is lost."""
        if not self._closing:
            signal.setitimer(signal.ITIMER_REAL, INTERRUPT_AGAIN_S)
            raise Interrupted

    def close(self) -> None:
        """Kill the child and give its task back, so that it is queued again at once."""
        self._closing = True
        signal.setitimer(signal.ITIMER_REAL, 0)
        if self._child is not None:
            self._child.kill()
        if self._current is not None:
            stopped = Canceled("the worker was stopped", where=self._options.name)
            with suppress(KilnError):
                self._client.fail(
                    self._current.task_id, self._failure(self._current, stopped, True), patience_s=FAREWELL_S
                )
        self._client.close()


class LineBuffer:
    """Log lines that the coordinator has not got yet, bounded; filled by a reader's thread."""

    def __init__(self) -> None:
        self._text, self._lock = "", threading.Lock()

    def __bool__(self) -> bool:
        return bool(self._text)

    def add(self, line: str) -> None:
        """Append a line; the oldest text goes where there is too much."""
        with self._lock:
            self._text = f"{self._text}{line}\n"[-LOG_CHARACTERS:]

    def put_back(self, text: str) -> None:
        """Return what could not be sent to the front."""
        with self._lock:
            self._text = (text + self._text)[-LOG_CHARACTERS:]

    def take(self) -> str:
        """All lines, leaving none."""
        with self._lock:
            text, self._text = self._text, ""
        return text


def _names(claim: Claim) -> dict[str, Any]:
    return {"task": claim.task_id, "job": claim.job_id, "kind": claim.payload.kind.value, "attempt": claim.attempt}
