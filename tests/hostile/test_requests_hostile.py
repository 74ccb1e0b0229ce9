"""Every hostile request gets its 4xx with a sentence that names the cause; the coordinator goes on as it was."""

import json
import re
import socket
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import httpx
import psutil
import pytest
from e2e_farm import Farm
from hostile_requests import CALLS, RAW, SCENE, SHA, Call, Raw

from kiln_schemas import __version__
from kiln_schemas.errors import Problem

GROWTH_BYTES = 192 << 20
"""Most memory that the coordinator may gain over all of them; the largest body is 17 MiB."""


@pytest.fixture(scope="module", autouse=True)
def bounded(target: Farm, owner: httpx.Client, hostile_folder: Path) -> Iterator[None]:
    """Upload the one honest blob; at the end no job is there, memory is bounded and no other file was written."""
    owner.put(f"/v1/blobs/{SHA}", content=SCENE).raise_for_status()
    process = psutil.Process(target.processes["coordinator"].pid)
    before, jobs, files = process.memory_info().rss, number_of_jobs(owner), files_under(target.folder / "data")
    yield
    grown = process.memory_info().rss - before
    print(f"the coordinator's memory grew by {grown >> 20} MiB")
    assert grown < GROWTH_BYTES
    assert number_of_jobs(owner) == jobs
    assert files_under(target.folder / "data") == files
    assert "Traceback" not in (target.folder / "coordinator.log").read_text()


def number_of_jobs(owner: httpx.Client) -> int:
    return len(owner.get("/v1/jobs", params={"limit": 200}).raise_for_status().json()["jobs"])


def files_under(data: Path) -> list[str]:
    """All files but the database's own."""
    return sorted(str(p) for p in data.rglob("*") if p.is_file() and data / "postgres" not in p.parents)


@pytest.mark.parametrize("call", CALLS, ids=lambda call: call.name)
def test_a_call(target: Farm, owner: httpx.Client, call: Call) -> None:
    token = f"Bearer {target.token}" if call.token == "owner" else call.token
    headers = dict(call.headers) | ({} if token is None else {"Authorization": token})
    body = call.body.replace(b'"VERSION"', json.dumps(__version__).encode()) if call.body else call.body
    request = httpx.Request(
        call.method, target.url, headers=[(k.encode(), v.encode("latin-1")) for k, v in headers.items()], content=body
    )
    request.url = request.url.copy_with(raw_path=call.path.replace(" ", "%20").replace("'", "%27").encode())
    with httpx.Client(timeout=20) as stranger:
        reply = stranger.send(request)
    assert reply.status_code == call.status, reply.text[:500]
    if reply.is_success:
        return
    assert reply.headers["content-type"] == "application/problem+json"
    problem = Problem.model_validate_json(reply.content)
    assert call.word in problem.sentence() and problem.detail, problem
    assert len(reply.content) < 8192, "the answer is not an echo of the request"


@pytest.mark.parametrize("raw", RAW, ids=lambda raw: raw.name)
def test_bytes_on_the_wire(target: Farm, raw: Raw) -> None:
    status, body = exchange(target, raw.data.replace(b"TOKEN", target.token.encode()), raw.cut)
    assert status in raw.statuses, body[:500]
    if raw.word:
        assert raw.word in Problem.model_validate_json(body).sentence()
    assert httpx.get(target.url + "/readyz").status_code == 200


def exchange(target: Farm, data: bytes, cut: bool) -> tuple[int, bytes]:
    """Send; the answer's status, 0 where there is none, and body."""
    answer = bytearray()
    with socket.create_connection(("127.0.0.1", target.port), timeout=20) as connection, suppress(ConnectionError):
        with suppress(ConnectionError):  # refused before all of it was read
            connection.sendall(data)
            if cut:
                connection.shutdown(socket.SHUT_WR)
        while not is_whole(answer) and (piece := connection.recv(65536)):
            answer += piece
    head, _, body = bytes(answer).partition(b"\r\n\r\n")
    return (int(head.split()[1]) if head.startswith(b"HTTP/") else 0), body


def is_whole(answer: bytes) -> bool:
    head, end, body = bytes(answer).partition(b"\r\n\r\n")
    length = re.search(rb"content-length: (\d+)", head.lower())
    return bool(end and length and len(body) >= int(length[1]))


def test_there_are_enough_of_them() -> None:
    names = [case.name for case in (*CALLS, *RAW)]
    assert len(names) == len(set(names)) >= 100
