"""Submit a scene from the browser: its files are uploaded one by one, then the job is made of their hashes."""

from typing import Annotated

from fastapi import APIRouter, Depends, Header, Request
from fastapi.responses import JSONResponse, Response

from kiln_schemas.job import JobRequest
from kiln_schemas.operators import Scope
from kiln_schemas.settings import PRESETS
from kiln_service import jobs
from kiln_service.api.common import PartsHere, caller
from kiln_service.auth import Principal
from kiln_service.dashboard.pages import check_session, page
from kiln_service.problems import UPLOAD_PATH


def _checked(request: Request, x_csrf_token: Annotated[str, Header()] = "") -> None:
    check_session(request, x_csrf_token)


router = APIRouter(include_in_schema=False)

Submitter = Annotated[Principal, Depends(caller(Scope.SUBMIT))]
Checked = Depends(_checked)


@router.get("/submit")
async def submit_form(request: Request, _: Submitter) -> Response:
    """Ask for a scene and its settings."""
    return page(request, "submit.html", presets=PRESETS)


@router.put(UPLOAD_PATH, dependencies=[Checked])
async def upload(request: Request, parts: PartsHere, who: Submitter) -> Response:
    """Take a file; the answer tells its hash."""
    return JSONResponse({"sha256": await parts.blobs.take(request.stream(), who.name)}, 201)


@router.post("/submit", dependencies=[Checked])
async def submit(wanted: JobRequest, parts: PartsHere, who: Submitter) -> Response:
    """Make the job; the answer tells where its page is."""
    job = await jobs.submit(parts.database, parts.config, wanted, who)
    return JSONResponse({"location": f"/jobs/{job.id}"}, 201)
