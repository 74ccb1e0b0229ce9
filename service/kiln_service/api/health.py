"""Routes for supervisors: does the process live, can it work. They need no token and tell nothing else."""

import asyncio
import time
from typing import Final

import psycopg
from fastapi import APIRouter, Request, Response
from psycopg_pool import PoolTimeout

from kiln_schemas.errors import KilnError, Problem, Unreachable
from kiln_service.api.common import PartsHere
from kiln_service.problems import problem_response

router = APIRouter(tags=["health"])

FRESH_S: Final = 1.0
"""An answer of `/readyz` is given again for so long: anybody may ask, and each probe writes to the storage."""


class Readiness:
    """What the last probe found; one runs at a time, and whoever asks meanwhile gets its answer."""

    def __init__(self) -> None:
        self._lock = asyncio.Lock()
        self._until = 0.0
        self._problem: Problem | None = None

    async def problem(self, parts: PartsHere) -> Problem | None:
        """What keeps the coordinator from working; None where nothing does."""
        async with self._lock:
            if time.monotonic() >= self._until:
                self._problem = await _probe(parts)
                self._until = time.monotonic() + FRESH_S
            return self._problem


async def _probe(parts: PartsHere) -> Problem | None:
    """Ask the database, then write to the storage."""
    try:
        await parts.database.ping(parts.config.timing.ready_s)
        await parts.blobs.check()
    except (psycopg.OperationalError, PoolTimeout):
        return Unreachable("the database does not answer", where="database", remedy="Try again soon.").problem()
    except KilnError as error:
        return Unreachable(error.detail, where=error.where, remedy=error.remedy).problem()
    return None


@router.get("/healthz")
async def healthz() -> dict[str, str]:
    """The process answers."""
    return {"status": "ok"}


@router.get("/readyz", response_model=dict[str, str])
async def readyz(parts: PartsHere, request: Request) -> Response | dict[str, str]:
    """The database and the blob storage answer too, as of a second ago; 503 says which does not."""
    readiness: Readiness = request.app.state.readiness
    problem = await readiness.problem(parts)
    return {"database": "ok", "storage": "ok"} if problem is None else problem_response(problem)
