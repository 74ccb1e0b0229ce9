"""Bounds on connections: how many there are, how long each may wait, and how slowly it may go on.

uvicorn bounds the seconds of an idle keep-alive connection alone. A client that sends half of a request and stops, that
sends a body a byte at a time or that never reads its answer would keep its descriptor for ever, and at the limit of
descriptors nobody is served. So each second all connections are looked at (`Connections.sweep`), and when there are as
many as may be, the one that has waited the longest for a request makes room for a new one.
"""

import asyncio
import logging
import resource
import time
from collections import Counter
from functools import partial
from typing import Any, Final

import h11
from uvicorn.protocols.http.h11_impl import H11Protocol

from kiln_service.config import ConnectionLimits
from kiln_service.rates import network_of

log = logging.getLogger(__name__)

SWEEP_S: Final = 1.0
RESERVED: Final = 256
"""Descriptors that connections leave for the database, files and connections that are being accepted."""
MOST_DESCRIPTORS: Final = 1 << 20
ACCEPTED_AT_ONCE: Final = 32
"""asyncio accepts so many before it looks at anything else; more of them could use up RESERVED."""
FULL: Final = b"HTTP/1.1 503 Service Unavailable\r\nConnection: close\r\nRetry-After: 1\r\nContent-Length: 0\r\n\r\n"


def raise_descriptors() -> int:
    """Raise the limit of descriptors as far as this process may; the limit that holds from now on."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    most = MOST_DESCRIPTORS if hard == resource.RLIM_INFINITY else min(hard, MOST_DESCRIPTORS)
    if soft == resource.RLIM_INFINITY or soft >= most:
        return MOST_DESCRIPTORS if soft == resource.RLIM_INFINITY else soft
    resource.setrlimit(resource.RLIMIT_NOFILE, (most, hard))
    return most


class Connections:
    """The open connections of one coordinator."""

    def __init__(self, limits: ConnectionLimits, descriptors: int) -> None:
        self.limits = limits
        self._most = max(1, min(limits.all, descriptors - RESERVED))
        self._open: dict[Connection, None] = {}
        self._of_address: Counter[str] = Counter()
        self._sweeper: asyncio.TimerHandle | None = None

    def admit(self, connection: "Connection", address: str) -> bool:
        """Whether one more is taken; one that waits for its request may have to go for it."""
        if self._of_address[address] >= self.limits.of_address:
            log.warning("refused a connection of %s, which has %d", address, self._of_address[address])
            return False
        if len(self._open) >= self._most and not self._make_room():
            log.warning("refused a connection of %s: all %d are at work", address, self._most)
            return False
        self._open[connection] = None
        self._of_address[address] += 1
        if self._sweeper is None:
            self._sweeper = asyncio.get_running_loop().call_later(SWEEP_S, self.sweep)
        return True

    def forget(self, connection: "Connection", address: str) -> None:
        """A connection that was admitted is closed."""
        del self._open[connection]
        self._of_address[address] -= 1
        if not self._of_address[address]:
            del self._of_address[address]

    def wait_again(self, connection: "Connection") -> None:
        """A connection has done its request: of those that wait it is the youngest."""
        if connection in self._open:
            self._open[connection] = self._open.pop(connection)

    def sweep(self) -> None:
        """Close what has waited too long or goes on too slowly; again in a second while there is any."""
        now = time.monotonic()
        for connection in list(self._open):
            if why := connection.overdue(now, self.limits):
                connection.drop(why)
        self._sweeper = asyncio.get_running_loop().call_later(SWEEP_S, self.sweep) if self._open else None

    def _make_room(self) -> bool:
        oldest = next((connection for connection in self._open if connection.waits), None)
        if oldest is None:
            return False
        oldest.drop("another needs its place")
        return True


class Connection(H11Protocol):
    """uvicorn's HTTP/1.1, bounded."""

    def __init__(self, connections: Connections, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self._connections = connections
        self._address: str | None = None
        self._since, self._received = 0.0, 0
        self._mark: tuple[str, float, int] | None = None
        """What the connection was at (`reading`, `writing`), since when, and the bytes received or left to send."""

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        super().connection_made(transport)
        address = network_of(self.client[0] if self.client else "")
        self._since = time.monotonic()
        if self._connections.admit(self, address):
            self._address = address
        else:
            transport.write(FULL)
            transport.close()

    def connection_lost(self, exc: Exception | None) -> None:
        super().connection_lost(exc)
        if self._address is not None:
            self._connections.forget(self, self._address)
            self._address = None

    def data_received(self, data: bytes) -> None:
        self._received += len(data)
        if not self.transport.is_closing():
            super().data_received(data)

    def on_response_complete(self) -> None:
        self._since = time.monotonic()
        self._connections.wait_again(self)
        super().on_response_complete()

    @property
    def waits(self) -> bool:
        """Whether it has no request: none has begun, or the head of one is not whole."""
        return self.conn.their_state is h11.IDLE

    def overdue(self, now: float, limits: ConnectionLimits) -> str | None:
        """Why the connection is closed now, if it is."""
        if self.waits:
            return "no whole head of a request came" if now - self._since > limits.head_s else None
        if self.flow.write_paused:
            doing, at = "writing", -self.transport.get_write_buffer_size()
        elif self.conn.their_state is h11.SEND_BODY and not self.flow.read_paused:
            doing, at = "reading", self._received
        else:
            self._mark = None
            return None
        if self._mark is None or self._mark[0] != doing:
            self._mark = doing, now, at
        elif now - self._mark[1] >= limits.stall_s:
            if at - self._mark[2] < limits.stall_s * limits.bytes_per_s:
                return "its body came too slowly" if doing == "reading" else "its answer was read too slowly"
            self._mark = doing, now, at
        return None

    def drop(self, why: str) -> None:
        """Close it at once."""
        log.info("closed a connection of %s: %s", self._address, why)
        self.transport.abort()


def protocol(connections: Connections) -> Any:
    """What uvicorn calls to serve a connection."""
    return partial(Connection, connections)
