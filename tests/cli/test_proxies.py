"""Proxies that the environment names: never for this machine, and never silently."""

import contextlib
import socket
import threading
import time
from collections.abc import Iterator

import httpx
import pytest

from kiln_schemas.client import Client
from kiln_schemas.proxies import is_loopback, spare_loopback
from kiln_service.cli.farm import LocalFarm

VARIABLES = ("http_proxy", "HTTP_PROXY", "HTTPS_PROXY", "ALL_PROXY", "all_proxy")


class Proxy:
    """A proxy that never answers, and what was sent to it."""

    def __init__(self) -> None:
        self.listening = socket.create_server(("127.0.0.1", 0))
        self.url = f"http://127.0.0.1:{self.listening.getsockname()[1]}"
        self.heard: list[bytes] = []
        threading.Thread(target=self._hear, daemon=True).start()

    def _hear(self) -> None:
        with contextlib.suppress(OSError):
            while True:
                connection, _ = self.listening.accept()
                self.heard.append(connection.recv(65536))


@pytest.fixture
def proxy() -> Iterator[Proxy]:
    proxy = Proxy()
    yield proxy
    proxy.listening.close()


def test_no_command_takes_a_proxy_to_this_machine(lightkiln, coordinator, proxy: Proxy) -> None:
    variables = dict.fromkeys(VARIABLES, proxy.url)
    for url in (coordinator.url, coordinator.url.replace("127.0.0.1", "localhost")):
        ran = lightkiln("status", "--url", url, "--data", coordinator.data, "--json", **variables)
        assert ran.code == 0 and "jobs" in ran.document
    assert proxy.heard == []


def test_a_local_farm_takes_no_proxy(tmp_path, monkeypatch: pytest.MonkeyPatch, proxy: Proxy) -> None:
    """What `bake` starts: the client here, the coordinator, a worker and its child."""
    for name in (*VARIABLES, "NO_PROXY", "no_proxy"):
        monkeypatch.delenv(name, raising=False)
    for name in VARIABLES:
        monkeypatch.setenv(name, proxy.url)
    with LocalFarm(tmp_path / "data", workers=1, threads=1, memory=1 << 30, say=lambda message: None) as farm:
        farm.start()
        with Client(farm.url, farm.token, patience_s=60) as api:
            while not api.workers():
                farm.revive()
                time.sleep(0.2)
    assert proxy.heard == []


def test_other_hosts_are_reached_as_the_environment_says(monkeypatch: pytest.MonkeyPatch, proxy: Proxy) -> None:
    monkeypatch.setenv("http_proxy", proxy.url)
    with Client("http://farm.invalid", "token", patience_s=0) as api:
        assert not api.ready()  # it waits for the proxy's answer
    assert proxy.heard[0].startswith(b"GET http://farm.invalid/readyz ")


@pytest.mark.parametrize("value", ["ftp://127.0.0.1:9", "socks5://127.0.0.1:9", "quic://proxy"])
def test_a_proxy_that_cannot_be_used_is_named(lightkiln, coordinator, value: str) -> None:
    ran = lightkiln("status", "--url", "http://farm.invalid", "--token", "t", ALL_PROXY=value)
    assert ran.code == 6 and "ALL_PROXY" in ran.err
    here = lightkiln("status", "--url", coordinator.url, "--data", coordinator.data, "--json", ALL_PROXY=value)
    assert here.code == 0 and "jobs" in here.document


@pytest.mark.parametrize("host", ["127.0.0.1", "127.8.8.8", "[::1]", "localhost", "LOCALHOST.", "kiln.localhost"])
def test_loopback(host: str) -> None:
    assert is_loopback(f"http://{host}:8321/x")


@pytest.mark.parametrize("host", ["128.0.0.1", "[::2]", "localhost.example", "127.0.0.1.example", "xlocalhost", "a"])
def test_not_loopback(host: str) -> None:
    assert not is_loopback(f"http://{host}:8321/x")


def test_what_is_excepted_already_stays_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NO_PROXY", "farm.invalid, 10.0.0.0/8")
    monkeypatch.delenv("no_proxy", raising=False)
    monkeypatch.setenv("http_proxy", "http://127.0.0.1:9")
    spare_loopback()
    spare_loopback()
    with httpx.Client() as client:
        for host, direct in (
            ("farm.invalid", True),
            ("localhost", True),
            ("127.0.0.1", True),
            ("other.invalid", False),
        ):
            proxied = client._transport_for_url(httpx.URL(f"http://{host}/")) is not client._transport
            assert proxied is not direct
