"""What a stage sees of the outside: blobs, progress, checkpoints, its share of the machine.

A stage is `run(payload, context) -> result` and touches nothing else, so it runs the same in a worker's child
process, in a test and in a notebook.
"""

import hashlib
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any, Protocol

from kiln_schemas.errors import Canceled, NotFound
from kiln_schemas.tasks import Checkpoint, Claim, Progress
from kiln_workers.runner.blobs import BlobCache, file_sha256
from kiln_workers.runner.client import CoordinatorClient


class Context(Protocol):
    """The outside of a stage."""

    memory_bytes: int
    """Main memory that the task may use."""
    threads: int
    """Cores that the task may use."""
    scratch: Path
    """An empty folder for this task's temporary files; removed afterwards."""
    cache: dict[str, Any]
    """Kept between tasks of one child process, e.g. the loaded scene by its hash. The stage bounds its size."""

    @property
    def canceled(self) -> bool:
        """Whether the task is no longer wanted."""

    def blob(self, sha256: str) -> bytes:
        """The bytes of a blob."""

    def blob_path(self, sha256: str) -> Path:
        """A file in `scratch` with the bytes of a blob; read-only by agreement."""

    def put_blob(self, data: bytes | Path) -> str:
        """Upload bytes, or a file, as a blob; its sha256."""

    def progress(self, done: float, total: float, unit: str, message: str = "", loss: float | None = None) -> None:
        """Tell how far the task is. Raises Canceled when it is no longer wanted."""

    def checkpoint(self, data: bytes) -> None:
        """Publish a state from which another attempt can go on."""

    def last_checkpoint(self) -> bytes | None:
        """The state that the last attempt published, if there is one and its bytes are not lost."""

    def log(self, text: str) -> None:
        """A line for the task's log."""


class TaskContext:
    """The `Context` of one claimed task, over HTTP."""

    def __init__(
        self,
        claim: Claim,
        client: CoordinatorClient,
        blobs: BlobCache,
        *,
        report: Callable[[Progress], None],
        stop: threading.Event,
        scratch: Path,
        cache: dict[str, Any],
        memory_bytes: int,
        threads: int,
    ) -> None:
        self.memory_bytes, self.threads, self.scratch, self.cache = memory_bytes, threads, scratch, cache
        self._claim, self._client, self._blobs = claim, client, blobs
        self._report, self._stop = report, stop

    @property
    def canceled(self) -> bool:
        return self._stop.is_set()

    def blob(self, sha256: str) -> bytes:
        return self._blobs.get(sha256).read_bytes()

    def blob_path(self, sha256: str) -> Path:
        return self._blobs.link(sha256, self.scratch / f"blob-{sha256}")

    def put_blob(self, data: bytes | Path) -> str:
        sha256 = hashlib.sha256(data).hexdigest() if isinstance(data, bytes) else file_sha256(data)
        self._client.put_blob(sha256, data)
        return sha256

    def progress(self, done: float, total: float, unit: str, message: str = "", loss: float | None = None) -> None:
        if self.canceled:
            raise Canceled("the task is no longer wanted")
        self._report(Progress(done=done, total=total, unit=unit, message=message, loss=loss))

    def checkpoint(self, data: bytes) -> None:
        claim = self._claim
        self._client.checkpoint(
            claim.task_id, Checkpoint(attempt=claim.attempt, lease=claim.lease, sha256=self.put_blob(data))
        )

    def last_checkpoint(self) -> bytes | None:
        if self._claim.checkpoint is None:
            return None
        try:
            return self.blob(self._claim.checkpoint)
        except NotFound as error:
            self.log(f"the checkpoint is lost, so the task begins again: {error}")
            return None

    def log(self, text: str) -> None:
        print(text, file=sys.stderr, flush=True)
