"""Proxies of the environment (`http_proxy`, `HTTPS_PROXY`, `ALL_PROXY`): never on the way to this machine itself.

A proxy does not reach our loopback but its own, and would be sent the token. Other hosts are reached as the environment
says. Client libraries differ in what they understand of `NO_PROXY`, so the loopback is spared twice: its names are
added to the variable, for every library and child of a process (`spare_loopback`), and clients of our own take no proxy
for an address of it (`is_loopback`).
"""

import ipaddress
import os
from typing import Final

import httpx

LOOPBACK: Final = ("localhost", "127.0.0.1", "::1")
NO_PROXY: Final = ("no_proxy", "NO_PROXY")


def spare_loopback() -> None:
    """Have no proxy be used for this machine, by this process and those that it starts; called first in each `main`."""
    listed = next((os.environ[name] for name in NO_PROXY if os.environ.get(name)), "")
    hosts = [host.strip() for host in listed.split(",") if host.strip()]
    for name in NO_PROXY:
        os.environ[name] = ",".join(dict.fromkeys([*hosts, *LOOPBACK]))


def is_loopback(url: str) -> bool:
    """Whether the URL's host is this machine, by name (`localhost` and below) or address; InvalidURL if none."""
    host = httpx.URL(url).host.rstrip(".").lower()
    if host == "localhost" or host.endswith(".localhost"):
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False
