"""The viewer: a page that shows a package with the paper's real-time algorithm, in a browser by WebGL2.

The page is the same for a job of a coordinator (`install`) and for a folder on this machine (`local`); only where it
takes the package's files from differs. Everything comes from one origin. Scripts are ES modules under `page/`, those of
others under `vendor/`; the GLSL is the package's own.
"""

from html import escape
from importlib import resources
from string import Template
from typing import Any, Final

from fastapi import APIRouter, Depends, FastAPI
from fastapi.responses import HTMLResponse, Response

from kiln_schemas.operators import Scope
from kiln_service import views
from kiln_service.api.common import PartsHere, caller
from kiln_service.static import Files, compressed

FOLDER: Final = resources.files(__package__)
STATIC: Final = "/static/viewer"
PAGE_POLICY: Final = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob:; connect-src 'self' blob:; "
    "worker-src 'self'; form-action 'none'; base-uri 'none'; frame-ancestors 'self'"
)
"""blob: is where three.js' glTF loader puts the images that a GLB embeds."""
WORKER: Final = "page/decode.js"
WORKER_POLICY: Final = "default-src 'none'; script-src 'self' 'wasm-unsafe-eval'; connect-src 'self' data:"
"""The decoder of Zstandard is WebAssembly, which it reads from a data: URL of its own."""

router = APIRouter(include_in_schema=False)


class Scripts(Files):
    """The viewer's files."""

    def __init__(self) -> None:
        super().__init__(directory=str(FOLDER))

    async def get_response(self, path: str, scope: Any) -> Response:
        """Only pages, scripts and what they vendor; no Python."""
        if path.split("/")[0] not in ("page", "vendor"):
            return Response(status_code=404)
        response = await super().get_response(path, scope)
        if path == WORKER:
            response.headers["Content-Security-Policy"] = WORKER_POLICY
        return response


def viewer_page(title: str, package: str) -> HTMLResponse:
    """The page for the package whose files are under the URL `package`, which ends with a slash."""
    page = Template((FOLDER / "page" / "viewer.html").read_text(encoding="utf-8"))
    text = page.substitute(title=escape(title), package=escape(package), static=STATIC)
    return HTMLResponse(text, headers={"Content-Security-Policy": PAGE_POLICY, "Cache-Control": "no-store"})


@router.get("/jobs/{job_id}/view", dependencies=[Depends(caller(Scope.READ))])
async def view(job_id: str, parts: PartsHere) -> Response:
    """A job's package."""
    job = await views.job_view(parts.database, parts.config, job_id)
    return viewer_page(job.name, f"/v1/jobs/{job.id}/artifacts/")


def install(app: FastAPI) -> None:
    """Add the page and its scripts; before the dashboard, whose files are mounted above them."""
    app.include_router(router)
    app.mount(STATIC, compressed(Scripts()), name="viewer")
