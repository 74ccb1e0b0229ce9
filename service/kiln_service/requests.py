"""What is noted of every request: an id that is answered in X-Request-Id and logged, a line in the log, its seconds.

A client's own X-Request-Id is taken over where it is short and plain, so that a line can be found by what a proxy
before us has logged. Pure ASGI middleware, outermost: it sees what any other answers.
"""

import logging
import re
import time
from typing import Final

from starlette.datastructures import Headers, MutableHeaders
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from kiln_schemas.logs import bound
from kiln_service.ids import new_id

log = logging.getLogger(__name__)

HEADER: Final = "X-Request-Id"
_PLAIN: Final = re.compile(r"[\w.:-]{1,64}")
_IDS: Final = re.compile(r"/(job|task|worker)s/([0-9a-f]{32})(?=/|$)")
_METHODS: Final = frozenset({"GET", "HEAD", "POST", "PUT", "PATCH", "DELETE"})
_QUIET: Final = frozenset(
    {
        "/healthz",
        "/readyz",
        "/v1/metrics",
        "/v1/workers/{worker_id}/claim",
        "/v1/workers/{worker_id}/heartbeat",
    }
)
"""Routes that are asked for all the time; logged at the level `debug` unless they fail."""


class Requests:
    """The middleware."""

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        asked = Headers(scope=scope).get(HEADER, "")
        request_id = asked if _PLAIN.fullmatch(asked) else new_id()
        status, began = 500, time.perf_counter()

        async def answered(message: Message) -> None:
            nonlocal status
            if message["type"] == "http.response.start":
                status = message["status"]
                MutableHeaders(scope=message)[HEADER] = request_id
            await send(message)

        ids = {f"{kind}_id": value for kind, value in _IDS.findall(scope["path"])}
        with bound(request_id=request_id, **ids):
            try:
                await self._app(scope, receive, answered)
            finally:
                seconds = time.perf_counter() - began
                route = route_of(scope)
                scope["app"].state.request_seconds.observe(_method(scope), route, status, seconds)
                _note(scope, route, status, seconds)


def route_of(scope: Scope) -> str:
    """The route's pattern, so that ids in paths make no labels; `none` where no route took the request."""
    route = scope.get("route")
    return str(getattr(route, "path", "none"))


def _method(scope: Scope) -> str:
    """The method as a label: a client that makes up names must not make up metrics."""
    return scope["method"] if scope["method"] in _METHODS else "other"


def _note(scope: Scope, route: str, status: int, seconds: float) -> None:
    principal = scope.get("principal")
    level = logging.WARNING if status >= 500 else logging.DEBUG if route in _QUIET and status < 400 else logging.INFO
    log.log(
        level,
        "%s %s %d",
        scope["method"],
        scope["path"],
        status,
        extra={
            "method": scope["method"],
            "route": route,
            "status": status,
            "ms": round(1000 * seconds, 1),
            "token": None if principal is None else principal.name,
        },
    )
