"""The dashboard: HTML pages for people, rendered here, kept fresh by htmx; nothing comes from another host.

`pages` has what every page shares; the other modules have the routes. Pages call the same functions as the routes under
/v1, so a person may do exactly what the token that they signed in with may do.
"""

from importlib import resources

from fastapi import FastAPI

from kiln_service.dashboard import atlas, job, jobs, sign_in, submit, workers
from kiln_service.dashboard.pages import compile_templates, error_page
from kiln_service.static import Files, compressed

__all__ = ["error_page", "install"]


def install(app: FastAPI) -> None:
    """Add the pages, their scripts and the vendored ones."""
    compile_templates()
    for module in (sign_in, jobs, job, atlas, submit, workers):
        app.include_router(module.router)
    folder = resources.files(__package__)
    app.mount("/static/vendor", compressed(Files(directory=str(folder / "vendor"))), name="vendor")
    app.mount("/static", compressed(Files(directory=str(folder / "static"))), name="static")
