"""Errors at the edge: whatever goes wrong reaches the client as application/problem+json and never as a traceback.

Pure ASGI middleware, so that streamed bodies pass through untouched.
"""

import logging
from collections.abc import Callable, Mapping
from typing import Any, Final
from urllib.parse import quote

import psycopg
from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse, RedirectResponse, Response
from psycopg_pool import PoolTimeout
from starlette.datastructures import MutableHeaders
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from kiln_schemas.errors import (
    AuthError,
    Conflict,
    InputError,
    InternalError,
    KilnError,
    NotFound,
    Problem,
    TooLarge,
    TooMany,
    Unreachable,
)
from kiln_schemas.text import told
from kiln_service import sessions
from kiln_service.abandoned import Abandoned
from kiln_service.auth import Principal, TokenBook
from kiln_service.config import Limits
from kiln_service.ids import new_id
from kiln_service.rates import address_of
from kiln_service.requests import Requests

log = logging.getLogger(__name__)

MEDIA_TYPE: Final = "application/problem+json"
OPEN_PATHS: Final = frozenset({"/healthz", "/readyz", "/login"})
OPEN_FOLDER: Final = "/static/"
"""What needs no token."""
UPLOAD_PATH: Final = "/submit/files"
UPLOADS: Final = ("/v1/blobs/", UPLOAD_PATH)
"""Whose PUT is bounded by the size of blobs."""
SECURITY_HEADERS: Final[Mapping[str, str]] = {
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "same-origin",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
}
API_POLICY: Final = "sandbox; default-src 'none'; img-src data:; style-src 'unsafe-inline'; frame-ancestors 'self'"
"""Content-Security-Policy under /v1: a package's report may be looked at, but nothing in it runs or loads anything."""
PAGE_POLICY: Final = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data: blob:; connect-src 'self'; "
    "frame-src 'self'; form-action 'self'; base-uri 'none'; frame-ancestors 'none'"
)
"""The same for pages; a page that needs more sets its own."""


def is_page(path: str) -> bool:
    """Whether people look at it; everything for programs is under /v1."""
    return not path.startswith("/v1/")


def is_open(path: str) -> bool:
    """Whether it needs no token."""
    return path in OPEN_PATHS or path.startswith(OPEN_FOLDER)


def problem_response(problem: Problem) -> JSONResponse:
    """The document with its status; a 401 names the scheme."""
    headers = {"WWW-Authenticate": "Bearer"} if problem.status == 401 else None
    return JSONResponse(problem.model_dump(mode="json"), problem.status, headers, media_type=MEDIA_TYPE)


def answer(request: Request, problem: Problem) -> Response:
    """The problem as a program or a person wants it: a document, or a page where a browser has asked for one."""
    if is_page(request.url.path) and "text/html" in request.headers.get("accept", ""):
        page: Response = request.app.state.error_page(request, problem)
        return page
    return problem_response(problem)


def install(
    app: FastAPI, tokens: TokenBook, limits: Limits, error_page: Callable[[Request, Problem], Response]
) -> None:
    """Handlers for every kind of error, then (outermost last) bounds, authentication, last resort, headers, log."""
    app.state.error_page = error_page
    app.add_exception_handler(KilnError, _kiln_error)
    app.add_exception_handler(RequestValidationError, _invalid_request)
    app.add_exception_handler(HTTPException, _http_error)
    app.add_exception_handler(psycopg.OperationalError, _database_away)
    app.add_exception_handler(PoolTimeout, _database_away)
    app.add_exception_handler(psycopg.errors.IdleInTransactionSessionTimeout, _database_away)
    app.add_exception_handler(psycopg.DataError, _not_storable)
    app.add_exception_handler(ClientDisconnect, _gone)
    app.add_middleware(Abandoned)
    app.add_middleware(BoundedBody, limit=limits.body_bytes)
    app.add_middleware(Authentication, tokens=tokens)
    app.add_middleware(LastResort)
    app.add_middleware(SecurityHeaders)
    app.add_middleware(Requests)


async def _kiln_error(request: Request, error: Exception) -> Response:
    assert isinstance(error, KilnError)
    response = answer(request, error.problem())
    if isinstance(error, TooMany):
        response.headers["Retry-After"] = str(error.wait_s)
    return response


async def _invalid_request(request: Request, error: Exception) -> Response:
    """422 that names the field, its value and what is wrong with it."""
    assert isinstance(error, RequestValidationError)
    first = error.errors()[0]
    place = [str(part) for part in first["loc"]]
    where = ".".join(place[1:] if len(place) > 1 and place[0] == "body" else place)
    value = first.get("input")
    # Not what the field at fault lies in: it may hold a lease.
    shown = "it" if isinstance(value, dict | list) else told(repr(value), 200)
    more = f" ({len(error.errors())} faults in all)" if len(error.errors()) > 1 else ""
    return answer(request, InputError(f"{shown} is refused: {first['msg']}{more}", where=where).problem())


async def _http_error(request: Request, error: Exception) -> Response:
    """404 and 405 of the router, and bodies that FastAPI could not read."""
    assert isinstance(error, HTTPException)
    if isinstance(error.__cause__, KilnError):  # raised while FastAPI read the body
        return answer(request, error.__cause__.problem())
    if isinstance(error.__cause__, UnicodeDecodeError | RecursionError | ValueError):
        why = _UNREADABLE.get(type(error.__cause__), "holds a number that is too long")
        return answer(request, InputError(f"the JSON {why}", where="body", remedy="Mend the request.").problem())
    about: dict[str, Any] = {"where": f"{request.method} {request.url.path}"}
    match error.status_code:
        case 404:
            return answer(request, NotFound("there is no such route", **about).problem())
        case 405:
            problem = Conflict("the route does not take this method", **about).problem()
            response = answer(request, problem.model_copy(update={"status": 405, "code": "method-not-allowed"}))
            response.headers.update(error.headers or {})
            return response
    problem = InputError(str(error.detail), **about).problem()
    return answer(request, problem.model_copy(update={"status": error.status_code}))


async def _database_away(request: Request, error: Exception) -> Response:
    log.error("the database does not answer: %s", error)
    away = Unreachable("the database does not answer", where="database", remedy="Try again in a few seconds.")
    return answer(request, away.problem())


_UNREADABLE: Final = {UnicodeDecodeError: "is not UTF-8", RecursionError: "nests too deeply"}
_NOT_STORABLE: Final = {
    psycopg.DataError: "a text holds the character U+0000",
    psycopg.errors.UntranslatableCharacter: "a text holds the character U+0000",
    psycopg.errors.NumericValueOutOfRange: "a number is too large",
}


async def _not_storable(request: Request, error: Exception) -> Response:
    """What the contracts let pass and the database does not hold; any other error in data is a defect of ours."""
    what = next((what for kind, what in _NOT_STORABLE.items() if type(error) is kind), None)
    if what is None:
        raise error
    place = f"{request.method} {request.url.path}"
    return answer(request, InputError(what, where=place, remedy="Leave it out.").problem())


async def _gone(_: Request, error: Exception) -> Response:
    """The client left in the middle of its body; nobody reads this answer."""
    return problem_response(InputError("the connection closed before the body was whole").problem())


class SecurityHeaders:
    """Tell browsers to guess, run and load nothing that is not meant to be."""

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        async def with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                policy = PAGE_POLICY if is_page(scope["path"]) else API_POLICY
                for name, value in {**SECURITY_HEADERS, "Content-Security-Policy": policy}.items():
                    headers.setdefault(name, value)
            await send(message)

        await self._app(scope, receive, with_headers if scope["type"] == "http" else send)


class LastResort:
    """Answer 500 with an id that is in the log, for whatever no handler knew; end an answer that cannot go on."""

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        started = False

        async def watched(message: Message) -> None:
            nonlocal started
            started = started or message["type"] == "http.response.start"
            await send(message)

        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        try:
            await self._app(scope, receive, watched)
        except Exception as error:
            known = error if isinstance(error, KilnError) else error.__cause__
            if started and isinstance(known, KilnError):
                # The server closes a connection whose answer is not complete.
                log.error("the answer to %s %s breaks off: %s", scope["method"], scope["path"], known)
                return
            defect = new_id()
            log.exception("defect %s in %s %s", defect, scope["method"], scope["path"])
            if started:
                raise
            remedy = "Look the number up in the coordinator's log and report what it says."
            problem = InternalError(f"defect {defect}", remedy=remedy).problem()
            await answer(Request(scope), problem)(scope, receive, send)


class Authentication:
    """Refuse requests without a valid token or session before their body is read; `scope["principal"]` is who calls.

    `scope["session"]` is the cookie's value where the caller is known by it.
    """

    def __init__(self, app: ASGIApp, tokens: TokenBook) -> None:
        self._app, self._tokens = app, tokens

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] == "http" and not is_open(scope["path"]):
            request = Request(scope)
            try:
                try:
                    scope["principal"] = await self._who(request)
                except AuthError:
                    await request.app.state.rates.failed(address_of(request))
                    raise
                request.app.state.rates.count(scope["principal"].name, scope["path"])
            except AuthError as error:
                response = _sign_in_first(request) or problem_response(error.problem())
                await response(scope, receive, send)
                return
            except KilnError as error:
                await (await _kiln_error(request, error))(scope, receive, send)
                return
            except (psycopg.OperationalError, PoolTimeout) as error:
                await (await _database_away(request, error))(scope, receive, send)
                return
        await self._app(scope, receive, send)

    async def _who(self, request: Request) -> Principal:
        """The caller by bearer token or, on pages and where nothing is changed, by the cookie of a session."""
        database, header = request.app.state.parts.database, request.headers.get("authorization")
        cookie = sessions.read_cookie(request.headers)
        safe = request.method in sessions.SAFE_METHODS
        if header is not None or cookie is None or not (safe or is_page(request.url.path)):
            return await self._tokens.authenticate(header, database)
        if not safe:
            sessions.check_origin(request.headers)
        request.scope["session"] = cookie
        return await sessions.principal_of(database, self._tokens, cookie)


def _sign_in_first(request: Request) -> Response | None:
    """Where a browser that shows a page goes to sign in; None where a program has called."""
    if not is_page(request.url.path) or "text/html" not in request.headers.get("accept", ""):
        return None
    if "hx-request" in request.headers:  # a page that is open already: reload it, which leads here again
        return Response(status_code=204, headers={"HX-Refresh": "true"})
    shown = request.url.path + (f"?{request.url.query}" if request.url.query else "")
    target = f"/login?next={quote(shown, safe='')}" if request.method == "GET" else "/login"
    return RedirectResponse(target, 303)


class BoundedBody:
    """Refuse bodies over the bound, except blob uploads, which have a bound of their own."""

    def __init__(self, app: ASGIApp, limit: int) -> None:
        self._app, self._limit = app, limit

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http" or (scope["method"] == "PUT" and scope["path"].startswith(UPLOADS)):
            await self._app(scope, receive, send)
            return
        received = 0

        async def bounded() -> Message:
            nonlocal received
            message = await receive()
            received += len(message.get("body", b""))
            if received > self._limit:
                raise TooLarge(f"the body has more than {self._limit} bytes", where="body")
            return message

        await self._app(scope, bounded, send)
