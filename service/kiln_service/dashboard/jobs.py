"""The list of jobs: filter, search, progress by stage and state, time left."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Final

from fastapi import APIRouter, Depends, Query, Request
from fastapi.responses import Response

from kiln_schemas.job import JobView, StageView, read_labels
from kiln_schemas.operators import Scope
from kiln_schemas.states import JobState
from kiln_schemas.tasks import TaskKind
from kiln_service import views
from kiln_service.api.common import PartsHere, caller
from kiln_service.dashboard.pages import page

router = APIRouter(include_in_schema=False)

PAGE: Final = 50
"""Jobs on a page."""
WIDTH: Final = 100.0
"""Of a stage in a progress bar, in the bar's own units."""


@dataclass(frozen=True)
class Part:
    """A stretch of a progress bar in one colour."""

    state: str
    start: float
    width: float


@router.get("/jobs", dependencies=[Depends(caller(Scope.READ))])
async def jobs(
    request: Request,
    parts: PartsHere,
    state: Annotated[list[JobState] | None, Query()] = None,
    q: Annotated[str, Query(max_length=512)] = "",
    cursor: str | None = None,
) -> Response:
    """Jobs, newest first. In `q` words with `=` are labels, the others are searched in the name."""
    labels, text = _read_search(q)
    found = await views.job_page(
        parts.database,
        parts.config,
        states=state or (),
        labels=labels,
        text=text or None,
        cursor=views.parse_cursor(cursor),
        limit=PAGE,
    )
    async with parts.database.transaction() as tx:
        counts = {JobState(row["state"]): row["jobs"] for row in await tx.all("count_jobs")}
    return page(
        request,
        "jobs.html",
        jobs=[(job, bar(job.stages)) for job in found.jobs],
        next=found.next,
        counts=counts,
        words=stages_in_words,
        states=list(JobState),
        chosen=state or [],
        q=q,
        cursor=cursor,
        query=request.url.query,
    )


def _read_search(q: str) -> tuple[dict[str, str], str]:
    words = q.split()
    labels = read_labels([word for word in words if "=" in word], "q")
    return labels, " ".join(word for word in words if "=" not in word)


def bar(stages: Sequence[StageView]) -> list[Part]:
    """A progress bar: one stretch a stage, of the same width each, filled by states."""
    known = {stage.kind: stage for stage in stages}
    return [part for place, kind in enumerate(TaskKind) if kind in known for part in stretch(known[kind], place)]


def stretch(stage: StageView, place: int = 0) -> list[Part]:
    """The stretch of one stage."""
    shares = {
        "completed": stage.completed / stage.total,
        "active": max(stage.fraction - stage.completed / stage.total, 0.0),
        "failed": stage.failed / stage.total,
        "soft-failed": stage.soft_failed / stage.total,
    }
    parts, start = [], place * WIDTH
    for state, share in shares.items():
        if share > 0:
            parts.append(Part(state, start, share * WIDTH))
            start += share * WIDTH
    return parts


def stages_in_words(job: JobView) -> str:
    """The bar for those who do not see it."""
    return ", ".join(f"{stage.kind} {stage.completed} of {stage.total}" for stage in job.stages)
