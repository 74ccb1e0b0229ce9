"""Sign in with a token, sign out."""

from fastapi import APIRouter, Request
from fastapi.responses import Response

from kiln_schemas.errors import AuthError
from kiln_service import sessions
from kiln_service.api.common import PartsHere
from kiln_service.dashboard.pages import Form, page, read_form, see
from kiln_service.rates import address_of

router = APIRouter(include_in_schema=False)

START = "/jobs"


@router.get("/")
async def start() -> Response:
    """Jobs are what people come for."""
    return see(START)


@router.get("/login")
async def sign_in_form(request: Request, next: str = START) -> Response:
    """Ask for a token."""
    return page(request, "login.html", next=_own_path(next), wrong=None)


@router.post("/login")
async def sign_in(request: Request, parts: PartsHere) -> Response:
    """Exchange the token for a cookie."""
    sessions.check_origin(request.headers)
    form = await read_form(request)
    target = _own_path(form.get("next", START))
    try:
        value = await sessions.begin(parts.database, parts.tokens, form.get("token", "").strip())
    except AuthError as error:
        await request.app.state.rates.failed(address_of(request))
        return page(request, "login.html", 401, next=target, wrong=error.problem())
    response = see(target)
    response.set_cookie(
        sessions.COOKIE,
        value,
        max_age=int(sessions.LIFETIME_S),
        httponly=True,
        samesite="strict",
        secure=request.url.scheme == "https",
    )
    return response


@router.post("/logout")
async def sign_out(request: Request, parts: PartsHere, _: Form) -> Response:
    """End the session."""
    if session := request.scope.get("session"):
        await sessions.end(parts.database, session)
    response = see("/login")
    response.delete_cookie(sessions.COOKIE, httponly=True, samesite="strict")
    return response


def _own_path(path: str) -> str:
    """The path if it is one of this coordinator; never another site."""
    own = path.startswith("/") and not path.startswith(("//", "/\\", "/login")) and path.isprintable()
    return path if own else START
