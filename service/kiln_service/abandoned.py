"""End what is done for a client that has hung up: its transaction is rolled back, its connection is free again.

Starlette calls a route to its end whether anybody waits for the answer or not. A claim looks for itself whether its
worker is there (`Work.claim`), as it has to hand on the signal that woke it; a stream that has begun does so too.
"""

import asyncio
import logging
from collections.abc import Callable, Mapping
from typing import Final

from starlette.datastructures import Headers
from starlette.responses import Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

log = logging.getLogger(__name__)

HUNG_UP: Final = 499
"""Status in logs and metrics of an answer that nobody waited for (nginx's number)."""


class Abandoned:
    """The middleware, the innermost of all."""

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http" or scope["path"].endswith("/claim"):
            await self._app(scope, receive, send)
            return
        client, task, started = _Client(receive), asyncio.current_task(), False
        assert task is not None

        async def watched(message: Message) -> None:
            nonlocal started
            started = True
            await send(message)

        def hung_up() -> None:
            if not started:
                task.cancel()

        client.on_leave = hung_up
        try:
            if not _has_body(scope):
                await client.take_body()
            await self._app(scope, client.receive, watched)
        except asyncio.CancelledError:
            if not client.gone.is_set() or task.uncancel():
                raise  # the coordinator stops
            log.info("%s %s: the client hung up", scope["method"], scope["path"])
            await Response(status_code=HUNG_UP)(scope, receive, send)
        finally:
            client.close()


class _Client:
    """Whoever has sent a request: the messages of its body, and from then on whether it is still there."""

    def __init__(self, receive: Receive) -> None:
        self._receive = receive
        self._taken: Message | None = None
        self._watch: asyncio.Task[None] | None = None
        self.gone = asyncio.Event()
        self.on_leave: Callable[[], None] = lambda: None

    async def take_body(self) -> None:
        """Take the message of an empty body now, so that its client is watched though no route reads it."""
        self._taken = await self._next()

    async def receive(self) -> Message:
        """The next message of the body, and after the last the end of the connection."""
        if self._taken is not None:
            message, self._taken = self._taken, None
            return message
        if self._watch is None:
            return await self._next()
        await self.gone.wait()
        return {"type": "http.disconnect"}

    async def _next(self) -> Message:
        message = await self._receive()
        if message["type"] == "http.request" and not message.get("more_body", False):
            self._watch = asyncio.create_task(self._wait_for_end(), name="client")
        return message

    async def _wait_for_end(self) -> None:
        await self._receive()
        self.gone.set()
        self.on_leave()

    def close(self) -> None:
        """Look no longer."""
        if self._watch is not None:
            self._watch.cancel()


def _has_body(scope: Scope) -> bool:
    headers: Mapping[str, str] = Headers(scope=scope)
    return "transfer-encoding" in headers or headers.get("content-length", "0") != "0"
