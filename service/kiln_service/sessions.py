"""Signed-in browsers: a cookie with random letters stands for the token that its person has typed in.

The database holds hashes of both, so any coordinator knows the session, neither can be read from it, and a session
ends with its token. The cookie is HttpOnly and SameSite=Strict. It is good for reading anywhere (pages and GET under
/v1); what changes something is asked of pages only, from the coordinator's own origin (`check_origin`), with the
session's CSRF token in the form or in a header (`dashboard.pages`).
"""

import hashlib
import hmac
import secrets
from http.cookies import CookieError, SimpleCookie
from typing import Final
from urllib.parse import urlsplit

from starlette.datastructures import Headers

from kiln_schemas.errors import AuthError, Forbidden
from kiln_service.auth import Principal, TokenBook, digest_of
from kiln_service.db import Database

COOKIE: Final = "kiln_session"
LIFETIME_S: Final = 7 * 86400.0
SAFE_METHODS: Final = frozenset({"GET", "HEAD", "OPTIONS"})


async def begin(database: Database, tokens: TokenBook, token: str) -> str:
    """Sign in with a token: the cookie's value; AuthError where the token is unknown."""
    digest = digest_of(token)
    if await tokens.find(digest, database) is None:
        raise AuthError(
            "the token is not known here",
            where="token",
            remedy="Check it; the owner's is in the data folder's file `token`.",
        )
    value = secrets.token_urlsafe(32)
    async with database.transaction() as tx:
        await tx.run("insert_session", sha256=digest_of(value), token_sha256=digest, seconds=LIFETIME_S)
    return value


async def principal_of(database: Database, tokens: TokenBook, value: str) -> Principal:
    """Who is signed in with this cookie; AuthError where nobody is (any more)."""
    token = await tokens.session_token(value, database)
    principal = None if token is None else await tokens.find(token, database)
    if principal is None:
        raise AuthError("nobody is signed in with this cookie", where="Cookie", remedy="Sign in again.")
    return principal


async def end(database: Database, value: str) -> None:
    """Sign out."""
    async with database.transaction() as tx:
        await tx.run("delete_session", sha256=digest_of(value))


def read_cookie(headers: Headers) -> str | None:
    """The session's cookie, if the browser has sent one."""
    try:
        cookie = SimpleCookie(headers.get("cookie", "")).get(COOKIE)
    except CookieError:
        return None
    return cookie.value if cookie else None


def csrf_token(value: str) -> str:
    """What forms of this session carry: another site cannot know it, and it does not tell the cookie."""
    return hmac.new(value.encode(), b"csrf", hashlib.sha256).hexdigest()


def check_csrf(value: str, given: str) -> None:
    """Forbidden unless `given` is the session's CSRF token."""
    if not hmac.compare_digest(csrf_token(value).encode(), given.encode()):
        raise Forbidden(
            "the form does not belong to this session", where="csrf", remedy="Go back, reload the page and try again."
        )


def check_origin(headers: Headers) -> None:
    """Forbidden where a browser says that another site has sent the request (Fetch Metadata; RFC 6454, 7)."""
    site, origin = headers.get("sec-fetch-site"), headers.get("origin")
    foreign = site not in (None, "same-origin") or (
        site is None and origin is not None and _host(origin) != headers.get("host")
    )
    if foreign:
        raise Forbidden("another site has sent this request", where="Origin", remedy="Use the dashboard's own pages.")


def _host(origin: str) -> str | None:
    """The host and port of an origin, None where it is not one."""
    try:
        return urlsplit(origin).netloc
    except ValueError:
        return None
