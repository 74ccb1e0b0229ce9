"""Clients that hold connections without using them, and coordinators that may not open many descriptors."""

import json
import resource
import socket
import subprocess
import sys
import time
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

import httpx
import pytest

from kiln_service.config import ConnectionLimits, Limits

HALF = b"GET /v1/jobs HTTP/1.1\r\nHost: x\r\nX-Half"
MANY = 1100


@pytest.fixture
def descriptors():
    """Enough of them for the test itself."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (min(hard, 8192), hard))
    yield
    resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))


@contextmanager
def process(dsn, folder, descriptors, **limits):
    """A coordinator process that may open so many descriptors: its URL, its token and its log."""
    config, log = folder / "config.json", folder / "log"
    config.write_text(json.dumps({"limits": {"connections": limits}}))
    words = [sys.executable, "-m", "kiln_service", "--data", str(folder / "data"), "--port", "0", "--json"]
    words += ["--database", dsn, "--config", str(config)]
    script = f'ulimit -{descriptors} && exec "$@"'
    with log.open("wb") as output:
        running = subprocess.Popen(
            ["bash", "-c", script, "-", *words], stdout=subprocess.PIPE, stderr=output, text=True
        )
    with running:
        try:
            ready = json.loads(running.stdout.readline())
            yield running.pid, ready["url"], Path(ready["token_file"]).read_text().strip(), log
        finally:
            running.terminate()


def connect(url, words=b""):
    host, _, port = url.removeprefix("http://").partition(":")
    connection = socket.create_connection((host, int(port)), timeout=60)
    connection.sendall(words)
    return connection


def is_closed(connection):
    """Whether the other side closes it, sooner or later; fails after minutes."""
    connection.settimeout(300)
    with suppress(ConnectionError):
        while connection.recv(65536):
            pass
    return True


def test_half_sent_requests_do_not_keep_others_out(dsn, tmp_path, descriptors):
    with process(dsn, tmp_path, "n 1024", head_s=600) as (_, url, token, log), ExitStack() as stack:
        for _ in range(MANY):
            stack.enter_context(connect(url, HALF))
        with httpx.Client(base_url=url, headers={"Authorization": f"Bearer {token}"}, timeout=60) as client:
            for _ in range(20):
                assert client.get("/v1/jobs").status_code == 200
        for _ in range(50):  # each on a connection of its own
            assert httpx.get(f"{url}/healthz", timeout=60).status_code == 200
        assert log.stat().st_size < 50_000, log.read_text()[:2000]


def test_the_soft_limit_of_descriptors_is_raised(dsn, tmp_path):
    with process(dsn, tmp_path, "S -n 300") as (pid, *_):
        soft, hard = resource.prlimit(pid, resource.RLIMIT_NOFILE)
        assert soft > 300 and soft in (hard, 1 << 20)


@pytest.fixture
def hasty(start):
    limits = ConnectionLimits(of_address=20, head_s=0.3, stall_s=1, bytes_per_s=1000)
    with start(limits=Limits(reserve_bytes=0, connections=limits)) as home:
        yield home


def test_who_sends_nothing_half_a_head_or_a_byte_at_a_time_is_closed(hasty):
    silent, half, slow = connect(hasty.url), connect(hasty.url, HALF), connect(hasty.url, HALF)
    with silent, half, slow:
        with pytest.raises(ConnectionError):
            for _ in range(10_000):
                slow.sendall(b"x")
                time.sleep(0.05)
        assert is_closed(silent) and is_closed(half)


def test_an_upload_that_stalls_is_closed_and_a_slow_one_is_not(hasty):
    head = f"PUT /v1/blobs/{'0' * 64} HTTP/1.1\r\nHost: x\r\nAuthorization: Bearer {hasty.token}\r\n"
    with connect(hasty.url, f"{head}Content-Length: 1000000\r\n\r\nabc".encode()) as stalled:
        assert is_closed(stalled)

    def pieces():
        for _ in range(30):
            time.sleep(0.1)
            yield b"x" * 1000

    sha256 = hasty.upload(b"x" * 30_000)
    assert hasty.client.put(f"/v1/blobs/{sha256}", content=pieces()).is_success


def test_an_answer_that_nobody_reads_is_given_up(hasty, caplog, eventually):
    caplog.set_level("INFO", "kiln_service.connections")
    sha256 = hasty.upload(bytes(32 << 20))
    head = f"GET /v1/blobs/{sha256} HTTP/1.1\r\nHost: x\r\nAuthorization: Bearer {hasty.token}\r\n\r\n"
    with connect(hasty.url, head.encode()) as unread:
        eventually(lambda: "its answer was read too slowly" in caplog.text)
        received = 0
        with suppress(ConnectionError):
            while data := unread.recv(1 << 20):
                received += len(data)
        assert received < 32 << 20


def test_an_address_has_so_many_connections(hasty):
    with ExitStack() as stack:
        kept = [stack.enter_context(connect(hasty.url)) for _ in range(30)]
        answers = [connection.recv(100) for connection in kept[-5:]]
        assert all(answer.startswith(b"HTTP/1.1 503") and b"Retry-After: 1" in answer for answer in answers)
        assert is_closed(kept[0])  # it sent nothing
    while httpx.get(f"{hasty.url}/healthz").status_code == 503:
        time.sleep(0.1)
