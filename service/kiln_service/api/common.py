"""What routes share: the parts of the running coordinator, the caller, the errors they document.

Dependencies are coroutines: FastAPI would run plain functions in a thread each, which costs more than what they do.
"""

from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from typing import Annotated, Any, Final

from fastapi import Depends, Path, Request, Security
from fastapi.security import HTTPBearer

from kiln_schemas.errors import Problem
from kiln_schemas.operators import Scope
from kiln_service.auth import Principal, TokenBook
from kiln_service.blobs import Blobs
from kiln_service.config import ServiceConfig
from kiln_service.db import Database
from kiln_service.events import Signals
from kiln_service.streams import Streams
from kiln_service.tile_maps import TileMaps
from kiln_service.work import Work


@dataclass(frozen=True)
class Parts:
    """What a coordinator consists of; `app.state.parts` while it runs."""

    config: ServiceConfig
    database: Database
    blobs: Blobs
    signals: Signals
    streams: Streams
    tile_maps: TileMaps
    work: Work
    tokens: TokenBook


_bearer = HTTPBearer(auto_error=False, description="An access token (the file `token` of the data folder).")


async def _parts(request: Request) -> Parts:
    parts = request.app.state.parts
    assert isinstance(parts, Parts)
    return parts


def caller(scope: Scope) -> Callable[..., Awaitable[Principal]]:
    """A dependency: the authenticated caller, who must have the scope.

    Pages use it too: a browser that is signed in is known by its cookie (`kiln_service.problems.Authentication`).
    """

    async def check(request: Request, _: Annotated[object, Security(_bearer)]) -> Principal:
        principal = request.scope["principal"]
        assert isinstance(principal, Principal)
        principal.require(scope)
        return principal

    return check


def any_caller(*scopes: Scope) -> Callable[..., Awaitable[Principal]]:
    """A dependency: the authenticated caller, who must have one of the scopes."""

    async def check(request: Request, _: Annotated[object, Security(_bearer)]) -> Principal:
        principal = request.scope["principal"]
        assert isinstance(principal, Principal)
        if not principal.scopes & set(scopes):
            principal.require(scopes[0])
        return principal

    return check


PartsHere = Annotated[Parts, Depends(_parts)]
Sha256Path = Annotated[str, Path(pattern=r"^[0-9a-f]{64}$", description="sha256 of the bytes, in lower-case hex")]

_MEANINGS: Final = {
    400: "The upload ended early",
    401: "No token, or an unknown one",
    403: "The token lacks the scope",
    404: "Not there",
    409: "The request contradicts the present state",
    413: "Too large",
    416: "The range is not in the file",
    422: "The input is not usable",
    429: "Asked too often; Retry-After says how long to wait",
    503: "The database does not answer",
    507: "No space",
}


def problems(*codes: int) -> dict[int | str, dict[str, Any]]:
    """OpenAPI responses of a route: problem documents with these codes, and those for want of a token or a scope."""
    return problem_answers(401, 403, 429, *codes)


def problem_answers(*codes: int) -> dict[int | str, dict[str, Any]]:
    """OpenAPI responses: problem documents with these codes."""
    return {
        code: {
            "description": _MEANINGS[code],
            "content": {"application/problem+json": {"schema": {"$ref": "#/components/schemas/Problem"}}},
        }
        for code in sorted(set(codes))
    }


PROBLEM_SCHEMA: Final = Problem.model_json_schema()
