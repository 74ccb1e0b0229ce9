"""Routes for supervisors: does the process live, can it work. They need no token and tell nothing else."""

from fastapi import APIRouter, Response

from kiln_schemas.errors import KilnError, Unreachable
from kiln_service.api.common import PartsHere
from kiln_service.problems import problem_response

router = APIRouter(tags=["health"])


@router.get("/healthz")
async def healthz() -> dict[str, str]:
    """The process answers."""
    return {"status": "ok"}


@router.get("/readyz", response_model=dict[str, str])
async def readyz(parts: PartsHere) -> Response | dict[str, str]:
    """The database and the blob storage answer too; 503 says which does not."""
    async with parts.database.transaction() as tx:
        await tx.one("ping")
    try:
        await parts.blobs.check()
    except KilnError as error:
        return problem_response(Unreachable(error.detail, where=error.where, remedy=error.remedy).problem())
    return {"database": "ok", "storage": "ok"}
