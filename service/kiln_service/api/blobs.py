"""Routes of blobs: ask which are missing, upload, download."""

from typing import Annotated, Any, Final

from fastapi import APIRouter, Depends, Request, Response

from kiln_schemas.errors import InputError
from kiln_schemas.job import MissingReply, MissingRequest
from kiln_schemas.operators import Scope
from kiln_service.api.common import PartsHere, Sha256Path, any_caller, problems
from kiln_service.api.files import serve_blob
from kiln_service.auth import Principal

router = APIRouter(prefix="/v1/blobs", tags=["blobs"])

Uploader = Annotated[Principal, Depends(any_caller(Scope.SUBMIT, Scope.WORKER, Scope.ADMIN))]
Downloader = Depends(any_caller(Scope.READ, Scope.WORKER, Scope.ADMIN))


@router.post("/missing", responses=problems(422))
async def missing(request: MissingRequest, parts: PartsHere, _: Uploader) -> MissingReply:
    """Which of these blobs have to be uploaded; the others are kept for an hour at least."""
    return MissingReply(missing=tuple(await parts.blobs.missing(request.sha256)))


@router.put(
    "/{sha256}",
    status_code=201,
    response_class=Response,
    responses=problems(400, 413, 422, 507) | {201: {"description": "Stored, in place of what was here"}},
    openapi_extra={"requestBody": {"required": True, "content": {"application/octet-stream": {}}}},
)
async def upload(sha256: Sha256Path, request: Request, parts: PartsHere, who: Uploader) -> Response:
    """Upload bytes; they are stored if, and only if, they are whole and have this hash."""
    announced = request.headers.get("content-length")
    if announced is not None and not announced.isdigit():
        raise InputError(f"'{announced}' is not a length", where="Content-Length")
    await parts.blobs.receive(sha256, request.stream(), int(announced) if announced else None, who.name)
    return Response(status_code=201, headers={"ETag": f'"{sha256}"'})


_DOWNLOAD: Final[dict[str, Any]] = {
    "dependencies": [Downloader],
    "response_class": Response,
    "responses": problems(404, 416)
    | {
        200: {"description": "The bytes", "content": {"application/octet-stream": {}}},
        206: {"description": "The range asked for"},
        304: {"description": "The client has it"},
    },
}


@router.head("/{sha256}", operation_id="download_head", **_DOWNLOAD)
@router.get("/{sha256}", **_DOWNLOAD)
async def download(sha256: Sha256Path, request: Request, parts: PartsHere) -> Response:
    """Download a blob, whole or a range of it."""
    if request.method == "HEAD":
        await parts.blobs.missing([sha256])  # who asks is about to rely on it: not collected within the grace period
    size = await parts.blobs.size(sha256)
    return await serve_blob(request, parts.blobs, sha256, size, "application/octet-stream")
