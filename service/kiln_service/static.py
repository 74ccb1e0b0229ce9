"""Scripts and style sheets of the pages, which a browser asks about before it uses its copy, gzip'd on the wire.

Only these are compressed. They are the same for everybody, so that a compressed length tells nothing; pages hold CSRF
tokens beside what somebody may have chosen (BREACH, Gluck, Harris and Prado 2013), the files of packages are read by
range and known by their hash, and event streams must not wait in a compressor.
"""

from typing import Any, Final

from fastapi import Response
from fastapi.staticfiles import StaticFiles
from starlette.middleware.gzip import GZipMiddleware
from starlette.types import ASGIApp

LEVEL: Final = 6


class Files(StaticFiles):
    """A folder's files; a newer lightkiln has others under the same names."""

    def file_response(self, *args: Any, **kwargs: Any) -> Response:
        response = super().file_response(*args, **kwargs)
        # Weak, because the same name stands for the bytes with and without gzip (RFC 9110, 8.8.3.3).
        response.headers["ETag"] = "W/" + response.headers["ETag"]
        response.headers["Cache-Control"] = "no-cache"
        response.headers["X-Content-Type-Options"] = "nosniff"
        return response


def compressed(files: Files) -> ASGIApp:
    """The files, gzip'd for browsers that take it; parts of a file are left as they are."""
    return GZipMiddleware(files, compresslevel=LEVEL)
