"""Errors at the edge: whatever goes wrong reaches the client as application/problem+json and never as a traceback.

Pure ASGI middleware, so that streamed bodies pass through untouched.
"""

import logging
from typing import Any, Final

import psycopg
from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse, Response
from psycopg_pool import PoolTimeout
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
from kiln_service.auth import Principal, TokenBook
from kiln_service.config import Limits
from kiln_service.ids import new_id
from kiln_service.rates import RateLimits
from kiln_service.requests import Requests

log = logging.getLogger(__name__)

MEDIA_TYPE: Final = "application/problem+json"
OPEN_PATHS: Final = frozenset({"/healthz", "/readyz"})
"""What needs no token."""


def problem_response(problem: Problem) -> JSONResponse:
    """The document with its status; a 401 names the scheme."""
    headers = {"WWW-Authenticate": "Bearer"} if problem.status == 401 else None
    return JSONResponse(problem.model_dump(mode="json"), problem.status, headers, media_type=MEDIA_TYPE)


def install(app: FastAPI, tokens: TokenBook, limits: Limits) -> None:
    """Handlers for every kind of error, then (outermost last) body bounds, authentication, last resort, log."""
    app.add_exception_handler(KilnError, _kiln_error)
    app.add_exception_handler(RequestValidationError, _invalid_request)
    app.add_exception_handler(HTTPException, _http_error)
    app.add_exception_handler(psycopg.OperationalError, _database_away)
    app.add_exception_handler(PoolTimeout, _database_away)
    app.add_exception_handler(psycopg.DataError, _not_storable)
    app.add_exception_handler(ClientDisconnect, _gone)
    app.add_middleware(BoundedBody, limit=limits.body_bytes)
    app.add_middleware(Authentication, tokens=tokens, rates=RateLimits(limits.rates))
    app.add_middleware(LastResort)
    app.add_middleware(Requests)


async def _kiln_error(_: Request, error: Exception) -> Response:
    assert isinstance(error, KilnError)
    return problem_response(error.problem())


async def _invalid_request(_: Request, error: Exception) -> Response:
    """422 that names the field, its value and what is wrong with it."""
    assert isinstance(error, RequestValidationError)
    first = error.errors()[0]
    place = [str(part) for part in first["loc"]]
    where = ".".join(place[1:] if len(place) > 1 and place[0] == "body" else place)
    value = repr(first.get("input"))
    shown = value if len(value) <= 200 else f"{value[:200]}…"
    more = f" ({len(error.errors())} faults in all)" if len(error.errors()) > 1 else ""
    return problem_response(InputError(f"{shown} is refused: {first['msg']}{more}", where=where).problem())


async def _http_error(request: Request, error: Exception) -> Response:
    """404 and 405 of the router, and bodies that FastAPI could not read."""
    assert isinstance(error, HTTPException)
    if isinstance(error.__cause__, KilnError):  # raised while FastAPI read the body
        return problem_response(error.__cause__.problem())
    if isinstance(error.__cause__, UnicodeDecodeError | RecursionError | ValueError):
        why = _UNREADABLE.get(type(error.__cause__), "holds a number that is too long")
        return problem_response(InputError(f"the JSON {why}", where="body", remedy="Mend the request.").problem())
    about: dict[str, Any] = {"where": f"{request.method} {request.url.path}"}
    match error.status_code:
        case 404:
            return problem_response(NotFound("there is no such route", **about).problem())
        case 405:
            problem = Conflict("the route does not take this method", **about).problem()
            response = problem_response(problem.model_copy(update={"status": 405, "code": "method-not-allowed"}))
            response.headers.update(error.headers or {})
            return response
    problem = InputError(str(error.detail), **about).problem()
    return problem_response(problem.model_copy(update={"status": error.status_code}))


async def _database_away(_: Request, error: Exception) -> Response:
    log.error("the database does not answer: %s", error)
    return problem_response(
        Unreachable("the database does not answer", where="database", remedy="Try again in a few seconds.").problem()
    )


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
    return problem_response(InputError(what, where=place, remedy="Leave it out.").problem())


async def _gone(_: Request, error: Exception) -> Response:
    """The client left in the middle of its body; nobody reads this answer."""
    return problem_response(InputError("the connection closed before the body was whole").problem())


class LastResort:
    """Answer 500 with an id that is in the log, for whatever no handler knew."""

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
        except Exception:
            defect = new_id()
            log.exception("defect %s in %s %s", defect, scope["method"], scope["path"])
            if started:
                raise
            error = InternalError(
                f"defect {defect}", remedy="Look the number up in the coordinator's log and report what it says."
            )
            await problem_response(error.problem())(scope, receive, send)


class Authentication:
    """Refuse requests without a valid token before their body is read; `scope["principal"]` is who calls."""

    def __init__(self, app: ASGIApp, tokens: TokenBook, rates: RateLimits) -> None:
        self._app, self._tokens, self._rates = app, tokens, rates

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] == "http" and scope["path"] not in OPEN_PATHS:
            try:
                scope["principal"] = await self._caller(scope)
                self._rates.count(scope["principal"].name, scope["path"])
            except KilnError as error:
                response = problem_response(error.problem())
                if isinstance(error, TooMany):
                    response.headers["Retry-After"] = str(error.wait_s)
                await response(scope, receive, send)
                return
            except (psycopg.OperationalError, PoolTimeout) as error:
                await (await _database_away(Request(scope), error))(scope, receive, send)
                return
        await self._app(scope, receive, send)

    async def _caller(self, scope: Scope) -> Principal:
        """Who calls; an address that failed too often is refused before a token is looked up in the database."""
        header = next((value for key, value in scope["headers"] if key == b"authorization"), None)
        address = scope["client"][0] if scope.get("client") else ""
        database = scope["app"].state.parts.database
        try:
            return await self._tokens.authenticate(
                header.decode("latin-1") if header else None,
                database,
                before_lookup=lambda: self._rates.may_sign_in(address),
            )
        except AuthError:
            self._rates.failed(address)
            raise


class BoundedBody:
    """Refuse bodies over the bound, except blob uploads, which have a bound of their own."""

    def __init__(self, app: ASGIApp, limit: int) -> None:
        self._app, self._limit = app, limit

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http" or (scope["method"] == "PUT" and scope["path"].startswith("/v1/blobs/")):
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
