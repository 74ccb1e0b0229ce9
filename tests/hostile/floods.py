"""More of something than a coordinator should bear: connections, streams, registrations, log, blobs, bad tokens.

A flood holds where the other client is served while it lasts (rounds of it begin and end in the flood) and where what
is kept of the flood is bounded.
"""

import contextlib
import hashlib
import resource
import socket
import threading
import time
from collections.abc import Iterator
from typing import Any, Final

import httpx
from ground import LEAST_STREAMED, PATIENCE_S, Ground, Tally

from kiln_schemas import __version__

ROUNDS: Final = 2
"""Of the other client that have to end while a flood lasts."""
LOG_BYTES: Final = 65536
TAIL_BYTES: Final = 1 << 20
"""Most that the last line of a log may be."""
BLOB_BYTES: Final = 1 << 20
LISTED: Final = 300
"""Most workers that are kept of one token."""


def half_sent(ground: Ground) -> Tally:
    """Requests whose rest never comes: half a head, half a body, nothing at all."""
    tally, many = Tally(), ground.many(150, 1100)
    head = f"PUT /v1/blobs/{'0' * 64} HTTP/1.1\r\nHost: x\r\nAuthorization: Bearer {ground.tokens['submit']}\r\n"
    begun = (b"", head[:40].encode(), head.encode(), f"{head}Content-Length: 1000\r\n\r\nabc".encode())
    with open_files(many + 256), contextlib.ExitStack() as stack:
        connections = []
        for number in range(many):
            with contextlib.suppress(OSError):
                connection = stack.enter_context(socket.create_connection(("127.0.0.1", ground.farm.port), timeout=20))
                connection.sendall(begun[number % len(begun)])
                connections.append(connection)
        served = _served(ground)
        for connection in connections:
            connection.setblocking(False)
        tally.count(served, "the other client was not served", times=many)
        tally.figures["connections"] = len(connections)
        tally.figures["closed by the coordinator"] = sum(map(_is_closed, connections))
    return tally


def event_streams(ground: Ground) -> Tally:
    """Streams of the events of a paused job, which never end."""
    tally, many = Tally(), ground.many(60, 200)
    job = ground.job()
    ground.send("submit", "POST", f"/v1/jobs/{job}/pause")
    return _held_open(ground, tally, many, f"/v1/jobs/{job}/events", "read", {"Accept": "text/event-stream"})


def followed_logs(ground: Ground) -> Tally:
    """Logs that are followed of a task that runs."""
    tally, many = Tally(), ground.many(30, 200)
    robber = ground.worker()
    robber.job()
    claim = robber.must_claim()
    robber.call(claim, "heartbeat", log="a line\n")
    tally = _held_open(ground, tally, many, f"/v1/tasks/{claim['task_id']}/log?follow=true", "read", {})
    ground.cancel(claim["job_id"])
    return tally


def long_polls(ground: Ground) -> Tally:
    """Claims that wait for tasks that never come."""
    tally, many = Tally(), ground.many(60, 400)
    robber = ground.worker("poller", "package")
    body = {"kinds": ["package"], "wait_s": 30}
    answers: list[int] = []

    def claim() -> None:
        with ground.new_client("worker") as client, contextlib.suppress(httpx.TransportError):
            answers.append(client.post(f"/v1/workers/{robber.id}/claim", json=body).status_code)

    with open_files(many + 256):
        threads = [threading.Thread(target=claim) for _ in range(many)]
        for thread in threads:
            thread.start()
        served = _served(ground)
        for thread in threads:
            thread.join()
    for status in answers:
        tally.count(status < 500 and served, f"a claim that waits: {status}", status)
    return tally


def registrations(ground: Ground) -> Tally:
    """Workers that register and are never seen again."""
    tally, many = Tally(), ground.many(400, 4000)
    with ground.new_client("worker") as client:
        for number in range(many):
            registration = {
                **{"name": f"ghost {number}", "kinds": ["render"], "tags": ["hostile"], "memory_bytes": 1 << 30},
                **{"threads": 1, "device": "none", "version": __version__},
            }
            status = client.post("/v1/workers", json=registration).status_code
            tally.count(status in (201, 409, 429), f"registration {number}: {status}", status)
    reply = ground.send("admin", "GET", "/v1/workers")
    listed = len(reply.json()) if reply is not None and reply.status_code == 200 else -1
    tally.count(0 <= listed <= LISTED, f"{listed} workers are kept")
    tally.figures["workers kept"] = listed
    return tally


def long_logs(ground: Ground) -> Tally:
    """A task that never stops talking: its log, and the farm's disk, stay bounded."""
    tally, many = Tally(), ground.many(160, 4800)
    robber = ground.worker()
    robber.job()
    claim = robber.must_claim()
    before = ground.disk_bytes()
    line = "x" * (LOG_BYTES - 1) + "\n"
    for number in range(many):
        reply = robber.call(claim, "heartbeat", log=line)
        status = 0 if reply is None else reply.status_code
        tally.count(0 < status < 500, f"beat {number}: {status}", status)
    for tail in (1, 10):
        reply = ground.send("read", "GET", f"/v1/tasks/{claim['task_id']}/log", params={"tail": tail})
        size = -1 if reply is None else len(reply.content)
        tally.count(0 < size <= tail * TAIL_BYTES, f"log?tail={tail}: {size} bytes", None)
    tally.figures["MB sent"] = many * LOG_BYTES / 1e6
    tally.figures["MB more on the disk"] = (ground.disk_bytes() - before) / 1e6
    ground.cancel(claim["job_id"])
    return tally


def useless_blobs(ground: Ground) -> Tally:
    """Blobs that nothing needs, until the token may upload no more: that is the attempt that has to be refused."""
    tally, refused, uploaded = Tally(), 0, 0
    for number in range(ground.many(96, 384)):
        data = f"{ground.seed:07d} {number:07d} ".encode() * (BLOB_BYTES // 16)
        reply = ground.send("submit", "PUT", f"/v1/blobs/{hashlib.sha256(data).hexdigest()}", content=data)
        status = 0 if reply is None else reply.status_code
        refused, uploaded = refused + (status >= 400), uploaded + (status < 400) * len(data)
        tally.count(status in (201, 409, 413, 429, 507), f"blob {number}: {status}", status)
        if refused > 8:
            break
    tally.count(refused > 0, f"{uploaded / 1e6:.0f} MB of useless blobs were taken, and none was refused")
    tally.figures["MB taken"] = uploaded / 1e6
    return tally


def bad_tokens(ground: Ground) -> Tally:
    """Tokens that are none, with an address of each one's own in X-Forwarded-For in every second request."""
    tally, many = Tally(), ground.many(1200, 3000)
    with httpx.Client(base_url=ground.farm.url, timeout=PATIENCE_S) as client:
        for number in range(many):
            headers = {"Authorization": f"Bearer {number:043d}"}
            if number % 2:
                headers["X-Forwarded-For"] = f"203.0.113.{number % 250}, 198.51.{number % 256}.{number // 256}"
            status = client.get("/v1/jobs", headers=headers).status_code
            tally.count(status in (401, 429), f"bad token {number}: {status}", status)
    for scope in ("read", "submit", "worker"):
        reply = ground.clients[scope].request("GET" if scope == "read" else "POST", *_plain(scope))
        status = reply.status_code
        tally.count(status not in (401, 403, 429), f"a valid token afterwards: {status}", status)
    return tally


def unasked(ground: Ground) -> Tally:
    """/readyz, /healthz and the page to sign in, by nobody."""
    tally = Tally()
    with httpx.Client(base_url=ground.farm.url, timeout=PATIENCE_S) as client:
        for number in range(ground.many(300, 3000)):
            path = ("/readyz", "/healthz", "/login")[number % 3]
            status = client.get(path).status_code
            tally.count(status in (200, 429), f"{path}: {status}", status)
    return tally


def slow_readers(ground: Ground) -> Tally:
    """Answers that nobody reads to their end."""
    tally, many = Tally(), ground.many(20, 200)
    data = bytes(8 << 20)
    sha256 = hashlib.sha256(data).hexdigest()
    ground.owner.put(f"/v1/blobs/{sha256}", content=data)
    request = f"GET /v1/blobs/{sha256} HTTP/1.1\r\nHost: x\r\nAuthorization: Bearer {ground.tokens['read']}\r\n\r\n"
    with open_files(many + 256), contextlib.ExitStack() as stack:
        for _ in range(many):
            connection = stack.enter_context(socket.create_connection(("127.0.0.1", ground.farm.port), timeout=20))
            connection.sendall(request.encode())
            with contextlib.suppress(OSError):
                connection.recv(LEAST_STREAMED)
        tally.count(_served(ground), "the other client was not served", times=many)
    return tally


def many_jobs(ground: Ground) -> Tally:
    """Jobs with as many labels and cameras as there may be, submitted and canceled."""
    tally = Tally()
    labels = {f"k{i}": "v" * 128 for i in range(32)}
    for number in range(ground.many(40, 400)):
        job = ground.job(labels=labels, priority=number % 101)
        for path in ("pause", "resume", "cancel"):
            reply = ground.send("submit", "POST", f"/v1/jobs/{job}/{path}")
            status = 0 if reply is None else reply.status_code
            tally.count(status in (200, 204, 409), f"{path}: {status}", status)
    return tally


@contextlib.contextmanager
def open_files(count: int) -> Iterator[None]:
    """Let this process open so many files."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (max(soft, min(hard, count + 512)), hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))


def _held_open(ground: Ground, tally: Tally, many: int, path: str, scope: str, headers: dict[str, str]) -> Tally:
    """So many answers that are begun and not ended while the other client goes on."""
    request = "\r\n".join(
        [f"GET {path} HTTP/1.1", "Host: x", f"Authorization: Bearer {ground.tokens[scope]}"]
        + [f"{name}: {value}" for name, value in headers.items()]
        + ["", ""]
    )
    with open_files(many + 256), contextlib.ExitStack() as stack:
        connections = []
        for _ in range(many):
            connection = stack.enter_context(socket.create_connection(("127.0.0.1", ground.farm.port), timeout=20))
            connection.sendall(request.encode())
            connections.append(connection)
        served = _served(ground)
        for connection in connections:
            status = _status(connection)
            tally.count(served and status < 500, f"{path}: {status}, the others served: {served}", status)
    return tally


def _status(connection: socket.socket) -> int:
    """Of what has come, 0 where nothing has or the connection is closed."""
    with contextlib.suppress(OSError):
        head = connection.recv(LEAST_STREAMED).split(b" ", 2)
        return int(head[1]) if len(head) > 2 else 0
    return 0


def _is_closed(connection: socket.socket) -> bool:
    """Whether the coordinator has ended a connection, with an answer or without; it is not blocking."""
    with contextlib.suppress(BlockingIOError):
        with contextlib.suppress(ConnectionError):
            connection.recv(1)
        return True
    return False


def _served(ground: Ground) -> bool:
    """Whether the other client ends rounds that begin now; waits for it as long as the last resort allows."""
    target, deadline = ground.rounds() + ROUNDS + 1, time.monotonic() + PATIENCE_S
    while ground.rounds() < target:
        if time.monotonic() > deadline:
            return False
        time.sleep(0.1)
    return True


def _plain(scope: str) -> tuple[Any, ...]:
    return {"read": ("/v1/jobs",), "submit": ("/v1/blobs/missing",), "worker": ("/v1/workers",)}[scope]
