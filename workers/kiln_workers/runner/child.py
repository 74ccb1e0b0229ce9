"""The process that does the work: imports the renderer and the network, runs one task after another, stays warm.

It is separate from the worker's parent so that an abort, a segmentation fault or the out-of-memory killer takes a task
and not the worker, and so that a task can be stopped at any instruction. Started as
`python -m kiln_workers.runner.child PARENT_PID` by `child_process`; the protocol is in `protocol`.
"""

import contextlib
import importlib
import logging
import os
import queue
import secrets
import shutil
import sys
import tempfile
import threading
import traceback
from pathlib import Path
from typing import Any, BinaryIO

from kiln_schemas.base import Contract
from kiln_schemas.errors import DISK_FULL, InternalError, KilnError, MachineLacks, TilesLost
from kiln_schemas.redact import redacted
from kiln_schemas.tasks import LOST_AT_ONCE, Claim, Progress, Result, TaskKind
from kiln_workers.runner.blobs import BlobCache
from kiln_workers.runner.client import CoordinatorClient
from kiln_workers.runner.context import TaskContext
from kiln_workers.runner.protocol import END_OF_LOG, Done, Failed, Ready, Report, Setup, Stop, ToChild, Work, encode
from kiln_workers.runner.tether import die_with_parent

log = logging.getLogger(__name__)


class Child:
    """One child process: its pipes, its connection and what it keeps warm."""

    def __init__(self, setup: Setup, answers: BinaryIO) -> None:
        self._setup, self._answers = setup, answers
        self._stop = threading.Event()
        self._work: queue.SimpleQueue[Claim] = queue.SimpleQueue()
        self._client = CoordinatorClient(setup.url, setup.token, stop=self._stop, on_wait=log.warning)
        self._blobs = BlobCache(Path(setup.cache), setup.cache_bytes, self._client.fetch_blob)
        self._warm: dict[str, Any] = {}

    def serve(self, requests: BinaryIO) -> None:
        """Run tasks until the parent closes the pipe or dies."""
        threading.Thread(target=self._listen, args=(requests,), name="listen", daemon=True).start()
        self._say(ready(self._setup))
        while True:
            claim = self._work.get()
            outcome = self._run(claim)
            print(END_OF_LOG, file=sys.stderr, flush=True)
            self._say(outcome)

    def _listen(self, requests: BinaryIO) -> None:
        """Take the parent's lines while a task runs; the end of them is the end of this process."""
        for line in requests:
            match ToChild.validate_json(line):
                case Work(claim=claim):
                    self._stop.clear()
                    self._work.put(claim)
                case Stop():
                    self._stop.set()
                case Setup():
                    raise InternalError("the parent sent a second setup")
        os._exit(0)

    def _run(self, claim: Claim) -> Done | Failed:
        scratch = Path(self._setup.scratch)
        try:
            shutil.rmtree(scratch, ignore_errors=True)
            scratch.mkdir(parents=True)
            tempfile.tempdir = str(scratch)  # what libraries write beside goes with it
            return Done(result=self._call_stage(claim, scratch))
        except TilesLost as error:
            return Failed(problem=error.problem(), retryable=error.retryable, lost=error.labels[:LOST_AT_ONCE])
        except KilnError as error:
            return Failed(problem=error.problem(), retryable=error.retryable)
        except Exception as error:
            known = _machine_lack(error) or self._defect(error)
            return Failed(problem=known.problem(), retryable=known.retryable)
        finally:
            shutil.rmtree(scratch, ignore_errors=True)

    def _call_stage(self, claim: Claim, scratch: Path) -> Result:
        stage = importlib.import_module(f"{self._setup.stages}.{claim.payload.kind}")
        context = TaskContext(
            claim,
            self._client,
            self._blobs,
            report=self._report,
            stop=self._stop,
            scratch=scratch,
            cache=self._warm,
            memory_bytes=self._setup.memory_bytes,
            threads=self._setup.threads,
        )
        result: Result = stage.run(claim.payload, context)
        return result

    def _defect(self, error: Exception) -> InternalError:
        """Write the traceback to the log under an id and give the id to the user."""
        name = secrets.token_hex(4)
        log.error("defect %s\n%s", name, redacted(traceback.format_exc(), [self._setup.token]))
        return InternalError(
            f"{type(error).__name__} in a worker (defect {name})",
            remedy="Please report it with the task's log.",
        )

    def _report(self, progress: Progress) -> None:
        self._say(Report(progress=progress))

    def _say(self, message: Contract) -> None:
        """Write one line; only the main thread and stages, which run on it, do."""
        self._answers.write(encode(message))
        self._answers.flush()


def ready(setup: Setup) -> Ready:
    """Name the device, and what it lacks where the kinds of this worker need it."""
    if set(setup.kinds) <= {TaskKind.FIT, TaskKind.REFINE}:
        return Ready(device=f"{setup.threads} threads")
    try:
        from kiln_workers.render.backend import select_variant

        variant = select_variant(threads=setup.threads)
    except ImportError as error:
        missing = MachineLacks(f"{error.name} is not installed", remedy="Run: pip install 'lightkiln[worker]'.")
        return Ready(device="none", lacks=missing.problem())
    except MachineLacks as lack:
        return Ready(device="none", lacks=lack.problem())
    return Ready(device=variant)


def _machine_lack(error: Exception) -> MachineLacks | None:
    """The error as something that the machine ran out of, if it is that."""
    if isinstance(error, OSError) and error.errno in DISK_FULL:
        return MachineLacks("the disk is full", where=error.filename, remedy="Free space and run the job again.")
    if isinstance(error, MemoryError):
        return MachineLacks("the task ran out of memory", remedy="Start the worker with a smaller --memory.")
    return None


def main() -> None:
    """Take over the pipes, then serve."""
    die_with_parent(int(sys.argv[1]))
    requests, answers = os.fdopen(os.dup(0), "rb"), os.fdopen(os.dup(1), "wb")
    # From here on prints of libraries are log lines, and nobody reads the protocol's input by accident.
    os.dup2(2, 1)
    with Path(os.devnull).open("rb") as nothing:
        os.dup2(nothing.fileno(), 0)
    logging.basicConfig(stream=sys.stderr, level=logging.INFO, format="%(levelname)s %(name)s: %(message)s")
    logging.getLogger("httpx").setLevel(logging.WARNING)
    setup = ToChild.validate_json(requests.readline())
    if not isinstance(setup, Setup):
        raise InternalError("the parent's first line is not a setup")
    with contextlib.suppress(BrokenPipeError, KeyboardInterrupt):
        Child(setup, answers).serve(requests)


if __name__ == "__main__":
    main()
