"""HTTP between a worker and its coordinator, patient with a coordinator that is away.

A coordinator may be killed and restarted at any moment and no finished work may be lost by it, so calls are repeated
with growing pauses while it does not answer; every call is one that may be repeated (claims are fenced by attempts,
commits of the same attempt are idempotent, blobs are addressed by their content). What it answers as
`application/problem+json` is raised as the exception of that code (`kiln_schemas.errors`).
"""

import hashlib
import math
import random
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import TracebackType
from typing import Final, Self

import httpx

from kiln_schemas.base import Contract
from kiln_schemas.errors import (
    Damaged,
    InputError,
    KilnError,
    TooMany,
    Truncated,
    Unreachable,
    error_of_answer,
    wait_asked,
)
from kiln_schemas.job import MissingReply
from kiln_schemas.proxies import is_loopback
from kiln_schemas.tasks import (
    Checkpoint,
    Claim,
    ClaimRequest,
    Commit,
    Failure,
    Heartbeat,
    HeartbeatReply,
    WorkerRegistration,
    WorkerWelcome,
)

CHUNK: Final = 1 << 20
PAUSE_S: Final = (0.1, 5.0)
"""First and longest pause between two tries."""
DEFECT_PATIENCE_S: Final = 60.0
"""A coordinator that answers 500 is asked again for so long: it may be losing its database for a moment."""
TRANSFERS: Final = 10
"""A blob whose bytes do not arrive whole and right so many times is given up: it would be transferred for ever."""
AWAY: Final = frozenset({TooMany.status, 502, 503, 504})
"""Statuses of a coordinator, or of a proxy before it, that will be back."""
WRONG_BYTES: Final = frozenset({InputError.status, Truncated.status})
"""Statuses of an upload whose bytes are not those that were sent: the hash was taken of what was read here."""


class CoordinatorClient:
    """The worker routes and the blobs of one coordinator. `stop` ends waiting; `on_wait` hears of each outage once."""

    def __init__(
        self,
        url: str,
        token: str,
        *,
        stop: threading.Event | None = None,
        on_wait: Callable[[str], None] | None = None,
        patience_s: float = math.inf,
    ) -> None:
        self.url = url.rstrip("/")
        self._stop = stop or threading.Event()
        self._on_wait = on_wait or (lambda message: None)
        self._patience_s = patience_s
        try:
            self._http = httpx.Client(
                base_url=self.url,
                headers={"Authorization": f"Bearer {token}"},
                timeout=httpx.Timeout(60.0, connect=5.0),
                trust_env=not is_loopback(self.url),
            )
        except (httpx.InvalidURL, ValueError, ImportError) as error:  # the latter two of a proxy in the environment
            raise Unreachable(
                f"this URL, or the proxy of the environment, cannot be used: {error}",
                where=self.url,
                remedy="Check --url, HTTP_PROXY, HTTPS_PROXY and ALL_PROXY.",
            ) from None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Close the connections."""
        self._http.close()

    def register(self, registration: WorkerRegistration) -> WorkerWelcome:
        """Introduce this worker."""
        return WorkerWelcome.model_validate_json(self._post("/v1/workers", registration).content)

    def claim(self, worker_id: str, request: ClaimRequest) -> Claim | None:
        """A task, or None where there was none within `request.wait_s`."""
        response = self._post(f"/v1/workers/{worker_id}/claim", request, timeout_s=request.wait_s + 30)
        return None if response.status_code == httpx.codes.NO_CONTENT else Claim.model_validate_json(response.content)

    def heartbeat(self, worker_id: str, beat: Heartbeat) -> HeartbeatReply:
        """Tell that the task is being worked on. Tried once: the next beat is the repetition."""
        response = self._post(f"/v1/workers/{worker_id}/heartbeat", beat, timeout_s=10, patience_s=0)
        return HeartbeatReply.model_validate_json(response.content)

    def commit(self, task_id: str, commit: Commit) -> None:
        """Publish the result of an attempt."""
        self._post(f"/v1/tasks/{task_id}/commit", commit)

    def fail(self, task_id: str, failure: Failure, *, patience_s: float | None = None) -> None:
        """Give an attempt back."""
        self._post(f"/v1/tasks/{task_id}/fail", failure, patience_s=patience_s)

    def checkpoint(self, task_id: str, checkpoint: Checkpoint) -> None:
        """Name the blob from which a later attempt may go on."""
        self._post(f"/v1/tasks/{task_id}/checkpoint", checkpoint)

    def fetch_blob(self, sha256: str, target: Path) -> None:
        """Download a blob to `target`, whole and with the right hash or not at all.

        Damaged where the coordinator has lost its bytes, or they were cut off or wrong `TRANSFERS` times.
        """
        partial = target.with_name(target.name + ".partial")
        partial.unlink(missing_ok=True)  # it may be a link
        broken = 0

        def attempt() -> httpx.Response:
            nonlocal broken
            digest = hashlib.sha256()
            with self._http.stream("GET", f"/v1/blobs/{sha256}") as response, partial.open("wb") as file:
                if not response.is_success:
                    response.read()
                    return response
                try:
                    for chunk in response.iter_bytes(CHUNK):
                        digest.update(chunk)
                        file.write(chunk)
                    if digest.hexdigest() != sha256:
                        raise httpx.ReadError("its bytes have another hash")
                except httpx.TransportError as error:
                    broken += 1
                    if broken == TRANSFERS:
                        raise _never_whole(sha256, f"down, last because {error}") from None
                    raise
            return response

        try:
            self._patiently(attempt)
            partial.replace(target)
        finally:
            partial.unlink(missing_ok=True)

    def put_blob(self, sha256: str, source: bytes | Path) -> None:
        """Upload a blob, unless the coordinator has it already."""
        size = len(source) if isinstance(source, bytes) else source.stat().st_size
        broken = 0

        def attempt() -> httpx.Response:
            nonlocal broken
            # Asking also keeps the blob from being collected as garbage before the commit names it.
            known = self._http.post("/v1/blobs/missing", json={"sha256": [sha256]})
            if not known.is_success or not MissingReply.model_validate_json(known.content).missing:
                return known
            headers = {"Content-Length": str(size), "Content-Type": "application/octet-stream"}
            reply = self._http.put(f"/v1/blobs/{sha256}", content=_chunks(source), headers=headers, timeout=300)
            if reply.status_code in WRONG_BYTES:
                broken += 1
                if broken == TRANSFERS:
                    raise _never_whole(sha256, f"up, last because {self._error(reply)}")
                raise httpx.WriteError(f"blob {sha256} arrived damaged")
            return reply

        self._patiently(attempt)

    def _post(
        self, path: str, body: Contract, *, timeout_s: float = 60, patience_s: float | None = None
    ) -> httpx.Response:
        content = body.model_dump_json().encode()
        return self._patiently(
            lambda: self._http.post(
                path,
                content=content,
                headers={"Content-Type": "application/json"},
                timeout=httpx.Timeout(timeout_s, connect=5.0),
            ),
            patience_s,
        )

    def _patiently(self, attempt: Callable[[], httpx.Response], patience_s: float | None = None) -> httpx.Response:
        """The first answer that is not an outage; errors of the coordinator are raised."""
        patience = self._patience_s if patience_s is None else patience_s
        began, pause = time.monotonic(), PAUSE_S[0]
        while True:
            bound, asked_s = patience, 0.0
            try:
                response = attempt()
            except httpx.TransportError as error:
                reason = str(error) or type(error).__name__
            else:
                if response.is_success:
                    return response
                if response.status_code not in AWAY and response.status_code != httpx.codes.INTERNAL_SERVER_ERROR:
                    raise self._error(response)
                reason = f"it answers {response.status_code}"
                bound = patience if response.status_code in AWAY else min(patience, DEFECT_PATIENCE_S)
                asked_s = wait_asked(response.headers.get("retry-after"))
            if time.monotonic() - began >= bound or self._stop.is_set():
                raise Unreachable(
                    f"the coordinator does not answer ({reason})",
                    where=self.url,
                    remedy="Check the URL and whether `lightkiln serve` runs there.",
                )
            if pause == PAUSE_S[0]:
                self._on_wait(f"the coordinator at {self.url} does not answer ({reason}); trying again")
            # Up to a half of random extra keeps a farm from returning in step.
            self._stop.wait(max(pause, asked_s) * random.uniform(1.0, 1.5))
            pause = min(2 * pause, PAUSE_S[1])

    def _error(self, response: httpx.Response) -> KilnError:
        asked = f"{response.request.method} {response.request.url.path}"
        return error_of_answer(response.content, response.status_code, asked, self.url)


def _never_whole(sha256: str, how: str) -> Damaged:
    return Damaged(
        f"the blob's bytes did not arrive whole and right in {TRANSFERS} tries on their way {how}",
        where=f"blob {sha256}",
        remedy="Check the network between worker and coordinator, and the memory of both.",
    )


def _chunks(source: bytes | Path) -> Iterator[bytes]:
    if isinstance(source, bytes):
        yield from (source[start : start + CHUNK] for start in range(0, len(source), CHUNK))
        return
    with source.open("rb") as file:
        while chunk := file.read(CHUNK):
            yield chunk
