"""The dashboard: HTML pages for people, rendered here, kept fresh by htmx; nothing comes from another host.

`pages` has what every page shares; the other modules have the routes. Pages call the same functions as the routes under
/v1, so a person may do exactly what the token that they signed in with may do.
"""

from importlib import resources
from typing import Any

from fastapi import FastAPI, Response
from fastapi.staticfiles import StaticFiles

from kiln_service.dashboard import atlas, job, jobs, sign_in, submit, workers
from kiln_service.dashboard.pages import error_page

__all__ = ["error_page", "install"]


class _Files(StaticFiles):
    """Files that a browser asks about before it uses its copy: a newer lightkiln has others under the same names."""

    def file_response(self, *args: Any, **kwargs: Any) -> Response:
        response = super().file_response(*args, **kwargs)
        response.headers["Cache-Control"] = "no-cache"
        return response


def install(app: FastAPI) -> None:
    """Add the pages, their scripts and the vendored ones."""
    for module in (sign_in, jobs, job, atlas, submit, workers):
        app.include_router(module.router)
    folder = resources.files(__package__)
    app.mount("/static/vendor", _Files(directory=str(folder / "vendor")), name="vendor")
    app.mount("/static", _Files(directory=str(folder / "static")), name="static")
