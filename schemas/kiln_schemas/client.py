"""A client of the coordinator's routes for people and programs (not for workers).

Repeats a call while the coordinator does not answer, up to `patience_s`; errors that it answers with are raised as the
exceptions of their code (`kiln_schemas.errors`).
"""

import hashlib
import os
import re
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from io import BufferedReader
from pathlib import Path
from types import TracebackType
from typing import Any, Final, Literal, Self, TypeVar
from urllib.parse import quote
from urllib.request import getproxies

import httpx
from pydantic import TypeAdapter, ValidationError

from kiln_schemas.errors import (
    AuthError,
    DamagedDownload,
    InputError,
    KilnError,
    TooMany,
    Unreachable,
    error_of_answer,
    wait_asked,
)
from kiln_schemas.files import open_regular
from kiln_schemas.job import (
    CurveView,
    JobChange,
    JobPage,
    JobRequest,
    JobView,
    MissingReply,
    MissingRequest,
    RequeueRequest,
    TaskView,
)
from kiln_schemas.operators import (
    DeliveryView,
    GcReport,
    GcRequest,
    NewToken,
    NewWebhook,
    Order,
    SleepSchedule,
    TokenRequest,
    TokenView,
    WebhookRequest,
    WebhookView,
    WorkerView,
)
from kiln_schemas.options import check_key
from kiln_schemas.proxies import is_loopback
from kiln_schemas.states import JobState, TaskState
from kiln_schemas.tasks import Artifact, TaskKind

CHUNK: Final = 1 << 20
PAUSE_S: Final = (0.1, 2.0)
AWAY: Final = frozenset({TooMany.status, 502, 503, 504})
"""Statuses of an answer after which the call is repeated, not before its Retry-After."""
MISSING_AT_ONCE: Final = 4096
OnBytes = Callable[[int], None]
T = TypeVar("T")


@dataclass(frozen=True)
class TileMap:
    """Tiles of a light map, row by row."""

    side: int
    """Tiles along each side."""
    cells: bytes
    """[side * side] 0 where there is no tile, else 1 plus the place of its state in `TaskState`."""
    etag: str = ""

    def states(self) -> Iterator[TaskState | None]:
        """The state of each cell; None where there is no tile."""
        states = (None, *TaskState)
        return (states[code] for code in self.cells)


class Client:
    """One coordinator as a client sees it. Without a token only `ready` is answered."""

    def __init__(self, url: str, token: str | None, *, patience_s: float) -> None:
        self.url, self._patience_s = url.rstrip("/"), patience_s
        if token is not None and not re.fullmatch(r"[\x21-\x7e]+", token):
            raise AuthError("the token has characters that no token has", remedy="Pass it as it is in the token file.")
        try:
            self._http = httpx.Client(
                base_url=self.url,
                headers={"Authorization": f"Bearer {token}"} if token else {},
                timeout=httpx.Timeout(60.0, connect=5.0),
                trust_env=not is_loopback(self.url),
            )
            self._may_be_proxied = not is_loopback(self.url) and bool(getproxies())
        except httpx.InvalidURL as error:
            raise Unreachable(f"this is not a URL: {error}", where=url, remedy="Check --url.") from None
        except (ValueError, ImportError) as error:  # of a proxy that the environment names
            raise Unreachable(
                f"the proxy of the environment cannot be used: {error}",
                where="HTTP_PROXY, HTTPS_PROXY, ALL_PROXY",
                remedy="Mend the variable, or name the coordinator's host in NO_PROXY.",
            ) from None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._http.close()

    def ready(self) -> bool:
        """Whether the coordinator, its database and its storage answer, now."""
        try:
            return self._http.get("/readyz", timeout=5).is_success
        except httpx.TransportError:
            return False

    def missing(self, hashes: Iterable[str]) -> list[str]:
        """Those of these blobs that the coordinator does not have."""
        wanted, found = sorted(set(hashes)), list[str]()
        for start in range(0, len(wanted), MISSING_AT_ONCE):
            body = MissingRequest(sha256=tuple(wanted[start : start + MISSING_AT_ONCE]))
            reply = self._call("POST", "/v1/blobs/missing", json=body.model_dump(mode="json"))
            found += self._parsed(MissingReply, reply).missing
        return found

    def put_blob(self, sha256: str, source: Path | Callable[[], BufferedReader], on_bytes: OnBytes) -> None:
        """Upload a file, which is opened at every try; `on_bytes` is told each piece's size."""
        open_file = partial(open_regular, source) if isinstance(source, Path) else source

        def attempt() -> httpx.Response:
            try:
                file = open_file()
            except OSError as error:
                raise InputError(f"cannot be read: {error.strerror}", where=str(error.filename or source)) from None
            with file:
                size = os.fstat(file.fileno()).st_size
                headers = {"Content-Length": str(size), "Content-Type": "application/octet-stream"}
                pieces = _pieces(file, size, on_bytes)
                return self._http.put(f"/v1/blobs/{sha256}", content=pieces, headers=headers, timeout=300)

        self._patiently(attempt)

    def submit(self, request: JobRequest, key: str | None = None) -> JobView:
        """Submit a job whose files are uploaded; a repetition under the same `key` makes no second job."""
        headers = {} if key is None else {"Idempotency-Key": check_key(key)}
        reply = self._call("POST", "/v1/jobs", json=request.model_dump(mode="json"), headers=headers)
        return self._parsed(JobView, reply)

    def job(self, job_id: str) -> JobView:
        return self._parsed(JobView, self._call("GET", f"/v1/jobs/{quote(job_id, safe='')}"))

    def jobs(
        self, limit: int = 50, *, labels: Sequence[str] = (), text: str | None = None, states: Sequence[JobState] = ()
    ) -> JobPage:
        """The newest jobs with all these labels (KEY=VALUE), `text` in their name and one of these states."""
        params: dict[str, Any] = {"limit": limit, "label": list(labels), "state": [state.value for state in states]}
        if text is not None:
            params["q"] = text
        return self._parsed(JobPage, self._call("GET", "/v1/jobs", params=params))

    def tasks(self, job_id: str, kind: TaskKind | None = None) -> tuple[TaskView, ...]:
        """A job's tasks, all or of one kind, page by page."""
        params: dict[str, Any] = {} if kind is None else {"kind": kind.value}
        tasks: list[TaskView] = []
        while True:
            reply = self._call("GET", f"/v1/jobs/{quote(job_id, safe='')}/tasks", params=params)
            tasks += self._parsed(tuple[TaskView, ...], reply)
            if (following := reply.headers.get("X-Next-Cursor")) is None:
                return tuple(tasks)
            params["cursor"] = following

    def tiles(self, job_id: str, known: TileMap | None = None) -> TileMap:
        """The states of a job's tiles; `known` itself where nothing has changed."""
        headers = {} if known is None else {"If-None-Match": known.etag}
        reply = self._call("GET", f"/v1/jobs/{quote(job_id, safe='')}/tiles", headers=headers)
        if known is not None and reply.status_code == 304:
            return known
        side = self._parsed_text(int, reply.headers.get("X-Side", ""), reply)
        return TileMap(side, reply.content, reply.headers.get("ETag", ""))

    def curves(self, job_id: str) -> tuple[CurveView, ...]:
        """The losses of a job's fits over their steps."""
        reply = self._call("GET", f"/v1/jobs/{quote(job_id, safe='')}/curves")
        return self._parsed(tuple[CurveView, ...], reply)

    def act(self, job_id: str, action: Literal["pause", "resume", "cancel", "retry", "archive"]) -> JobView | None:
        """Ask something of a job; the job afterwards, or None where the token may not look at jobs."""
        return self._seen(self._call("POST", f"/v1/jobs/{quote(job_id, safe='')}/{action}"))

    def requeue(self, job_id: str, wanted: RequeueRequest) -> JobView | None:
        """Do tasks again that are done, and what follows from them; answers as `act` does."""
        body = wanted.model_dump(mode="json", exclude_none=True)
        path = f"/v1/jobs/{quote(job_id, safe='')}/requeue"
        return self._seen(self._call("POST", path, json=body))

    def change(self, job_id: str, wanted: JobChange) -> JobView | None:
        """Rank or label a job anew; answers as `act` does."""
        body = wanted.model_dump(mode="json", exclude_none=True)
        return self._seen(self._call("PATCH", f"/v1/jobs/{quote(job_id, safe='')}", json=body))

    def workers(self) -> tuple[WorkerView, ...]:
        """Workers that were seen within a week."""
        return self._parsed(tuple[WorkerView, ...], self._call("GET", "/v1/workers"))

    def order_worker(self, worker_id: str, order: Order) -> None:
        """Tell a worker to sleep, to wake or to leave."""
        self._call("POST", f"/v1/workers/{quote(worker_id, safe='')}/orders/{order.value}")

    def unblock_worker(self, worker_id: str) -> None:
        """Let a worker take tasks of all jobs again."""
        self._call("DELETE", f"/v1/workers/{quote(worker_id, safe='')}/blocks")

    def set_schedule(self, worker: str, schedule: SleepSchedule | None) -> None:
        """Let workers of a name sleep at given times, or only when they are told to."""
        path = f"/v1/schedules/{quote(worker, safe='')}"
        if schedule is None:
            self._call("DELETE", path)
        else:
            self._call("PUT", path, json=schedule.model_dump(mode="json"))

    def tokens(self) -> tuple[TokenView, ...]:
        """Access tokens that were made, without themselves."""
        return self._parsed(tuple[TokenView, ...], self._call("GET", "/v1/tokens"))

    def create_token(self, request: TokenRequest) -> NewToken:
        """Make an access token."""
        reply = self._call("POST", "/v1/tokens", json=request.model_dump(mode="json"))
        return self._parsed(NewToken, reply)

    def revoke_token(self, name: str) -> None:
        """Refuse a token from now on."""
        self._call("DELETE", f"/v1/tokens/{quote(name, safe='')}")

    def collect_garbage(self, request: GcRequest) -> GcReport:
        """Free what archived jobs left behind."""
        reply = self._call("POST", "/v1/gc", json=request.model_dump(mode="json"))
        return self._parsed(GcReport, reply)

    def webhooks(self) -> tuple[WebhookView, ...]:
        """All webhooks, without their secrets."""
        return self._parsed(tuple[WebhookView, ...], self._call("GET", "/v1/webhooks"))

    def add_webhook(self, request: WebhookRequest) -> NewWebhook:
        """Tell a URL of jobs' events from now on."""
        reply = self._call("POST", "/v1/webhooks", json=request.model_dump(mode="json"))
        return self._parsed(NewWebhook, reply)

    def remove_webhook(self, webhook_id: str) -> None:
        """Tell it nothing more."""
        self._call("DELETE", f"/v1/webhooks/{quote(webhook_id, safe='')}")

    def deliveries(self, webhook_id: str) -> tuple[DeliveryView, ...]:
        """What became of each telling, newest first."""
        reply = self._call("GET", f"/v1/webhooks/{quote(webhook_id, safe='')}/deliveries")
        return self._parsed(tuple[DeliveryView, ...], reply)

    def task_log(self, task_id: str, tail: int | None = None) -> str:
        """What the attempts of a task wrote, or the last `tail` lines of it."""
        params = {} if tail is None else {"tail": tail}
        return self._call("GET", f"/v1/tasks/{quote(task_id, safe='')}/log", params=params).text

    def follow_log(self, task_id: str, tail: int | None = None) -> Iterator[str]:
        """The same in pieces, and what is written until the task is over."""
        path = f"/v1/tasks/{quote(task_id, safe='')}/log"
        params: dict[str, Any] = {"follow": True} | ({} if tail is None else {"tail": tail})
        quiet = httpx.Timeout(60.0, connect=5.0, read=None)
        try:
            with self._http.stream("GET", path, params=params, timeout=quiet) as response:
                if not response.is_success:
                    raise error_of_answer(response.read(), response.status_code, f"GET {path}", self.url)
                yield from response.iter_text()
        except httpx.TransportError as error:
            reason = str(error) or type(error).__name__
            raise Unreachable(f"the log broke off ({reason})", where=self.url, remedy="Ask for it again.") from None

    def artifacts(self, job_id: str) -> tuple[Artifact, ...]:
        """What a job published."""
        reply = self._call("GET", f"/v1/jobs/{quote(job_id, safe='')}/artifacts")
        return self._parsed(tuple[Artifact, ...], reply)

    def download(self, job_id: str, artifact: Artifact, target: Path, on_bytes: OnBytes) -> None:
        """Write an artifact to `target`; whole and with the right hash, or the next try."""
        path = f"/v1/jobs/{quote(job_id, safe='')}/artifacts/{quote(artifact.name)}"
        self._save(path, artifact.sha256, artifact.name, target, on_bytes)

    def get_blob(self, sha256: str, target: Path) -> None:
        """Write a blob to `target`; whole and with the right hash, or the next try."""
        self._save(f"/v1/blobs/{sha256}", sha256, "the blob", target, lambda _: None)

    def _save(self, path: str, sha256: str, name: str, target: Path, on_bytes: OnBytes) -> None:
        """Stream what lies at `path` into a file; DamagedDownload where it has another hash, also at a second try."""
        if self._saved(path, target, on_bytes) == sha256:
            return
        # The wire may have damaged it, or a proxy on the way; what is damaged twice is so where it lies.
        found = self._saved(path, target, lambda _: None)
        if found != sha256:
            target.unlink(missing_ok=True)
            raise DamagedDownload(
                f"'{name}' arrived damaged, twice: its sha256 is {found} and should be {sha256}",
                where=self.url,
                remedy="Check the coordinator's storage; `lightkiln requeue JOB --kind package` makes a package anew.",
            )

    def _saved(self, path: str, target: Path, on_bytes: OnBytes) -> str:
        """Stream what lies at `path` into `target`, where no link is followed; the sha256 of what arrived."""
        digest = hashlib.sha256()

        def attempt() -> httpx.Response:
            nonlocal digest
            digest = hashlib.sha256()
            with self._http.stream("GET", path) as response:
                if not response.is_success:
                    response.read()
                    return response
                with open(target, "wb", opener=_without_links) as file:
                    for chunk in response.iter_bytes(CHUNK):
                        digest.update(chunk)
                        file.write(chunk)
                        on_bytes(len(chunk))
            return response

        self._patiently(attempt)
        return digest.hexdigest()

    def _call(
        self,
        method: str,
        path: str,
        *,
        json: Any = None,
        params: Mapping[str, Any] | None = None,
        headers: Mapping[str, str] | None = None,
    ) -> httpx.Response:
        return self._patiently(lambda: self._http.request(method, path, json=json, params=params, headers=headers))

    def _patiently(self, attempt: Callable[[], httpx.Response]) -> httpx.Response:
        """The first answer that is not an outage; the coordinator's errors are raised."""
        deadline, pause = time.monotonic() + self._patience_s, PAUSE_S[0]
        while True:
            response: httpx.Response | None = None
            try:
                response = attempt()
            except httpx.UnsupportedProtocol as error:
                raise Unreachable(
                    str(error), where=self.url, remedy="Write the URL with http:// or https://."
                ) from None
            except (httpx.TransportError, httpx.DecodingError) as error:
                reason = str(error) or type(error).__name__
            else:
                if response.is_success or response.status_code == 304:
                    return response
                if response.status_code not in AWAY:
                    raise self._error(response)
                reason = f"it answers {response.status_code}"
                pause = max(pause, wait_asked(response.headers.get("retry-after")))
            if time.monotonic() + pause > deadline:
                if response is not None and response.status_code == TooMany.status:
                    raise self._error(response)
                proxy = ", and the proxy that the environment names" if self._may_be_proxied else ""
                raise Unreachable(
                    f"the coordinator does not answer ({reason})",
                    where=self.url,
                    remedy=f"Check the URL and whether `lightkiln serve` runs there{proxy}.",
                )
            time.sleep(pause)
            pause = min(2 * pause, PAUSE_S[1])

    def _parsed(self, kind: type[T], response: httpx.Response) -> T:
        """The answer as what it should be; whoever else answers there, it is told and no defect."""
        return self._parsed_text(kind, response.content, response)

    def _parsed_text(self, kind: type[T], text: str | bytes, response: httpx.Response) -> T:
        """The same of a part of the answer."""
        try:
            return TypeAdapter(kind).validate_json(text)
        except ValidationError:
            raise Unreachable(
                f"unexpected answer {response.status_code} to {response.request.method} {response.request.url.path}",
                where=self.url,
                remedy="Check that this URL is a lightkiln coordinator.",
            ) from None

    def _seen(self, reply: httpx.Response) -> JobView | None:
        return None if reply.status_code == httpx.codes.NO_CONTENT else self._parsed(JobView, reply)

    def _error(self, response: httpx.Response) -> KilnError:
        asked = f"{response.request.method} {response.request.url.path}"
        return error_of_answer(response.content, response.status_code, asked, self.url)


def _without_links(path: str, flags: int) -> int:
    return os.open(path, flags | os.O_NOFOLLOW | os.O_NONBLOCK, 0o666)


def _pieces(file: BufferedReader, size: int, on_bytes: OnBytes) -> Iterator[bytes]:
    """The first `size` bytes; InputError where the file has shrunk since it was measured."""
    while size:
        chunk = file.read(min(CHUNK, size))
        if not chunk:
            raise InputError("was changed while it was uploaded", where=str(file.name), remedy="Try again.")
        size -= len(chunk)
        yield chunk
        on_bytes(len(chunk))
