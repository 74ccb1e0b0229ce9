"""Serve bytes by hash over HTTP: validators, conditional requests and single ranges (RFC 9110, 13 and 14)."""

import re
from typing import Final

from fastapi import Request
from fastapi.responses import Response, StreamingResponse

from kiln_schemas.errors import InputError
from kiln_service.blobs import Blobs
from kiln_service.problems import problem_response

_RANGE: Final = re.compile(r"bytes=([0-9]{0,18})-([0-9]{0,18})")


def parse_range(header: str, size: int) -> tuple[int, int] | None:
    """First and past-the-end byte of a Range header's one range.

    None where the header is to be ignored (malformed, several ranges); InputError (416) where it lies outside.
    """
    match = _RANGE.fullmatch(header.replace(" ", ""))
    if match is None or match.group(1) == match.group(2) == "":
        return None
    first, last = match.groups()
    if first == "":
        start, end = max(size - int(last), 0), size
    else:
        start, end = int(first), min(int(last) + 1, size) if last else size
        if last and int(last) < start:
            return None
    if start >= end:
        raise InputError(f"'{header}' is not within {size} bytes", where="Range")
    return start, end


def matches(header: str | None, etag: str) -> bool:
    """Whether an If-None-Match list names the entity (weak comparison)."""
    names = [name.strip().removeprefix("W/") for name in (header or "").split(",")]
    return etag in names or names == ["*"]


async def serve_blob(request: Request, blobs: Blobs, sha256: str, size: int, media_type: str) -> Response:
    """The answer to GET or HEAD of a blob."""
    etag = f'"{sha256}"'
    headers = {"ETag": etag, "Accept-Ranges": "bytes", "Cache-Control": "private, no-cache"}
    if matches(request.headers.get("if-none-match"), etag):
        return Response(status_code=304, headers=headers)
    wanted = request.headers.get("range")
    if request.headers.get("if-range", etag) != etag or request.method == "HEAD":
        wanted = None
    try:
        part = parse_range(wanted, size) if wanted else None
    except InputError as error:
        response = problem_response(error.problem().model_copy(update={"status": 416, "code": "range"}))
        response.headers["Content-Range"] = f"bytes */{size}"
        return response
    start, end = part or (0, size)
    headers["Content-Length"] = str(end - start)
    if part:
        headers["Content-Range"] = f"bytes {start}-{end - 1}/{size}"
    if request.method == "HEAD":
        return Response(headers=headers, media_type=media_type)
    pieces = await blobs.read(sha256, start, end)
    return StreamingResponse(pieces, status_code=206 if part else 200, headers=headers, media_type=media_type)
