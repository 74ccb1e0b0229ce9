"""What every page shares: templates, forms with their CSRF token, and errors as pages.

Pages need no script to be read or to act: forms are sent by the browser and answered with a redirect. Scripts add
what HTML cannot do (fresh numbers, the atlas, curves).
"""

from datetime import UTC, datetime
from typing import Annotated, Any, Final
from urllib.parse import parse_qs, parse_qsl, urlencode

from fastapi import Depends, Request
from fastapi.responses import HTMLResponse, RedirectResponse
from jinja2 import Environment, PackageLoader, StrictUndefined

from kiln_schemas import __version__
from kiln_schemas.errors import InputError, Problem
from kiln_schemas.operators import Scope
from kiln_service import sessions
from kiln_service.auth import Principal

MOST_FIELDS: Final = 8192
"""Fields of a form: a bundle may have 4096 files."""


def page(request: Request, template: str, status: int = 200, **values: Any) -> HTMLResponse:
    """A template, filled; it knows who is signed in and what they may do."""
    who = request.scope.get("principal")
    session = request.scope.get("session")
    common = {
        "who": who,
        "may_submit": may(who, Scope.SUBMIT),
        "may_rule": may(who, Scope.ADMIN),
        "csrf": sessions.csrf_token(session) if session else "",
        "path": request.url.path,
        "version": __version__,
    }
    text = _templates.get_template(template).render(common | values)
    return HTMLResponse(text, status, headers={"Cache-Control": "no-store"})


def error_page(request: Request, problem: Problem) -> HTMLResponse:
    """What went wrong, where, and what to do about it."""
    return page(request, "error.html", problem.status, problem=problem)


def see(path: str) -> RedirectResponse:
    """Where to go after a form was taken."""
    return RedirectResponse(path, 303)


def may(who: Principal | None, scope: Scope) -> bool:
    """Whether somebody is signed in whose token has the scope."""
    return who is not None and bool(who.scopes & {scope, Scope.ADMIN})


async def read_form(request: Request) -> dict[str, str]:
    """The fields of a form (the last of those with one name)."""
    body = (await request.body()).decode("utf-8", "replace")
    try:
        return dict(parse_qsl(body, keep_blank_values=True, max_num_fields=MOST_FIELDS))
    except ValueError:
        raise InputError(f"the form has more than {MOST_FIELDS} fields", where="body") from None


async def checked_form(request: Request) -> dict[str, str]:
    """The fields of a form that this session's page has sent; Forbidden for any other."""
    form = await read_form(request)
    check_session(request, form.get("csrf", ""))
    return form


def check_session(request: Request, token: str) -> None:
    """Forbidden where a session's request lacks its CSRF token; a caller with a bearer token needs none."""
    session = request.scope.get("session")
    if session is not None:
        sessions.check_csrf(session, token)


Form = Annotated[dict[str, str], Depends(checked_form)]


def _duration(seconds: float | None) -> str:
    """`42 s`, `3 min 20 s`, `2 h 5 min`, `3 d 4 h`."""
    if seconds is None:
        return "–"
    total = round(seconds)
    for unit, size, lesser, part in (("d", 86400, "h", 3600), ("h", 3600, "min", 60), ("min", 60, "s", 1)):
        if total >= size:
            rest = total % size // part
            return f"{total // size} {unit} {rest} {lesser}" if rest else f"{total // size} {unit}"
    return f"{total} s"


def _bytes(size: int) -> str:
    """In the unit in which it has one to four digits."""
    value, units = float(size), ["bytes", "KiB", "MiB", "GiB", "TiB"]
    while value >= 1024 and len(units) > 1:
        value, _ = value / 1024, units.pop(0)
    return f"{value:.0f} {units[0]}" if units[0] == "bytes" or value >= 100 else f"{value:.1f} {units[0]}"


def _ago(at: datetime | None) -> str:
    """How long since, in the greatest unit."""
    if at is None:
        return "–"
    seconds = max((datetime.now(UTC) - at).total_seconds(), 0.0)
    return "just now" if seconds < 5 else f"{_duration(seconds).split(' ')[0]} {_duration(seconds).split(' ')[1]} ago"


def _sentence(text: str) -> str:
    """With a capital letter and a full stop."""
    return text[:1].upper() + text[1:] + ("" if text.endswith((".", "!", "?")) else ".")


def _told(value: object) -> str:
    """What an event tells, in few words."""
    if isinstance(value, float):
        return f"{value:.3g}"
    if isinstance(value, dict):
        return str(value.get("detail") or ", ".join(f"{key} {_told(part)}" for key, part in value.items()))
    if isinstance(value, list):
        return "; ".join(_told(part) for part in value[:4]) + (" …" if len(value) > 4 else "")
    return "–" if value is None else str(value)


def _with_query(query: str, **changes: str | None) -> str:
    """A query string with fields replaced, or left out where None."""
    fields = {key: values for key, values in parse_qs(query).items() if key not in changes}
    fields |= {key: [value] for key, value in changes.items() if value is not None}
    return "?" + urlencode(fields, doseq=True)


_templates = Environment(
    loader=PackageLoader("kiln_service.dashboard"),
    autoescape=True,
    undefined=StrictUndefined,
    trim_blocks=True,
    lstrip_blocks=True,
)
_templates.filters |= {"duration": _duration, "bytes": _bytes, "ago": _ago, "told": _told, "sentence": _sentence}
_templates.globals |= {"with_query": _with_query}


def compile_templates() -> None:
    """Compile them all: done at the first drawing of a page, it would hold up everybody else."""
    for name in _templates.list_templates():
        _templates.get_template(name)
