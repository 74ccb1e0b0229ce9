"""`lightkiln view DIR`: the viewer for a package on this machine, served to this machine alone, without a network."""

import socket
from pathlib import Path
from typing import Any, Final

import uvicorn
from starlette.applications import Starlette
from starlette.middleware import Middleware
from starlette.middleware.trustedhost import TrustedHostMiddleware
from starlette.requests import Request
from starlette.responses import Response
from starlette.routing import Mount, Route
from starlette.staticfiles import StaticFiles

from kiln_schemas.conventions import MANIFEST_JSON
from kiln_schemas.errors import Conflict, NotFound
from kiln_service.viewer import STATIC, Scripts, viewer_page

HOST: Final = "127.0.0.1"
PACKAGE: Final = "/package/"


def create_local_app(folder: Path) -> Starlette:
    """The page at `/` and the package's files; names that lead out of the folder are not found."""
    if not (folder / MANIFEST_JSON).is_file():
        raise NotFound("there is no package", where=str(folder), remedy=f"Name a folder with a {MANIFEST_JSON}.")

    async def page(_: Request) -> Response:
        return viewer_page(folder.resolve().name, PACKAGE)

    return Starlette(
        routes=[
            Route("/", page),
            Mount(PACKAGE.rstrip("/"), _PackageFiles(directory=folder.resolve())),
            Mount(STATIC, Scripts()),
        ],
        # A page of another site that has its name resolved to this machine is refused.
        middleware=[Middleware(TrustedHostMiddleware, allowed_hosts=[HOST, "localhost"])],
    )


class _PackageFiles(StaticFiles):
    """Data for the page; nothing of a package runs here, whoever made it."""

    def file_response(self, *args: Any, **kwargs: Any) -> Response:
        response = super().file_response(*args, **kwargs)
        response.headers["Content-Security-Policy"] = "sandbox; default-src 'none'"
        response.headers["X-Content-Type-Options"] = "nosniff"
        response.headers["Cache-Control"] = "no-cache"
        return response


class _Server(uvicorn.Server):
    """uvicorn's server, which says where it is once it can be asked."""

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        await super().startup(sockets=sockets)
        for listening in sockets or ():
            print(f"http://{HOST}:{listening.getsockname()[1]}/", flush=True)


def view_folder(folder: Path, port: int) -> None:
    """Serve until interrupted; port 0 takes a free one. Conflict where the port is taken."""
    app = create_local_app(folder)
    with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as listening:
        listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            listening.bind((HOST, port))
        except OSError as error:
            raise Conflict(
                f"the port cannot be taken: {error.strerror}", where=f"{HOST}:{port}", remedy="Choose another --port."
            ) from None
        server = _Server(uvicorn.Config(app, log_level="warning", access_log=False))
        try:
            server.run(sockets=[listening])
        except KeyboardInterrupt:
            return
