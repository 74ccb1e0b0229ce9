"""How often one caller may ask: token buckets, in this coordinator's memory.

A bucket holds `burst` requests and is filled again with `per_s` a second; a request that finds it empty is answered 429
with the seconds to wait. Callers are access tokens; workers' routes have a bucket of their own, as a whole farm may
share one token. Whoever has not signed in is an address: only requests that fail to sign in count there. Once an
address has failed too often, each further failure is answered late and with 429; a valid token or session is never
refused for what others at its address do.
"""

import asyncio
import ipaddress
import math
import time
from collections import OrderedDict
from collections.abc import Callable
from typing import Final

from starlette.requests import Request

from kiln_schemas.errors import TooMany
from kiln_service.config import Rate, Rates

REMEMBERED: Final = 10_000
"""Callers whose buckets are kept; the one that asked the longest ago is forgotten first."""
SLOWED_S: Final = 1.0
"""So late is a failure to sign in answered at an address that failed too often."""
_WORKERS: Final = ("/v1/workers", "/v1/tasks/", "/v1/blobs/")


class Buckets:
    """One bucket a caller."""

    def __init__(self, rate: Rate, clock: Callable[[], float] = time.monotonic) -> None:
        self._rate, self._clock = rate, clock
        self._levels: OrderedDict[str, tuple[float, float]] = OrderedDict()

    def take(self, caller: str) -> None:
        """Count one request; TooMany where the bucket is empty, and nothing is counted."""
        level = self._level(caller)
        if level < 1:
            raise TooMany("too many requests", wait_s=self._wait_s(level))
        self._levels[caller] = level - 1, self._clock()
        self._levels.move_to_end(caller)
        if len(self._levels) > REMEMBERED:
            self._levels.popitem(last=False)

    def _level(self, caller: str) -> float:
        level, then = self._levels.get(caller, (self._rate.burst, 0.0))
        return min(self._rate.burst, level + (self._clock() - then) * self._rate.per_s)

    def _wait_s(self, level: float) -> int:
        return max(1, math.ceil((1 - level) / self._rate.per_s))


class RateLimits:
    """All buckets of a coordinator."""

    def __init__(self, rates: Rates) -> None:
        self._clients, self._workers = Buckets(rates.clients), Buckets(rates.workers)
        self._failures = Buckets(rates.failures)

    def count(self, token: str, path: str) -> None:
        """Count a request of a caller who has signed in; TooMany where there were too many."""
        (self._workers if path.startswith(_WORKERS) else self._clients).take(token)

    async def failed(self, address: str) -> None:
        """Count a sign-in that failed; TooMany, after a pause, where the address has failed too often."""
        try:
            self._failures.take(address)
        except TooMany:
            await asyncio.sleep(SLOWED_S)
            raise


def address_of(request: Request) -> str:
    """Where a request comes from, as far as it is counted: behind a trusted proxy, the proxy's client."""
    return network_of(request.client.host if request.client else "")


def network_of(host: str) -> str:
    """An IPv4 address as it is, of an IPv6 address the /64 network, which one customer has to himself."""
    try:
        address = ipaddress.ip_address(host)
    except ValueError:
        return host
    if isinstance(address, ipaddress.IPv4Address):
        return str(address)
    if address.ipv4_mapped is not None:
        return str(address.ipv4_mapped)
    return str(ipaddress.IPv6Network((address, 64), strict=False))
