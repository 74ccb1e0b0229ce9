"""Why a job waits: what keeps its tasks from being given to workers, as one sentence.

It goes by the conditions of a claim (the database functions `takers` and `next_task`), in the order in which a person
would mend them: the coordinator's own, then whether workers are there, of the kind, with the tags, told to work, awake,
not blocked, and at last without another task.
"""

from collections.abc import Mapping, Sequence
from typing import Final

from psycopg.rows import DictRow

from kiln_schemas import __version__
from kiln_schemas.states import JobState
from kiln_schemas.tasks import TaskKind
from kiln_service.config import ServiceConfig
from kiln_service.db import JobRow, Tx
from kiln_service.disk import Disk
from kiln_service.planner import METHODS

REFUSED_S: Final = 3600.0
"""A worker that was refused for its version is told of for so long."""
NAMED_TAGS: Final = 4
"""Of the tags that are missing, a sentence names so many."""


async def reasons(
    tx: Tx, config: ServiceConfig, jobs: Sequence[JobRow], stages: Mapping[str, Mapping[str, DictRow]]
) -> dict[str, str]:
    """By id, why jobs wait of which no task runs; `stages` has the rows of the query `stages` by job and kind.

    A job whose tasks an idle worker may take does not wait: it is about to begin.
    """
    found, waiting = dict[str, str](), dict[str, TaskKind]()
    for job in jobs:
        if job.state is JobState.PAUSED:
            found[job.id] = "The job is paused: `lightkiln resume` goes on with it."
        elif job.state in (JobState.QUEUED, JobState.ACTIVE) and (kind := _waiting_kind(job, stages[job.id])):
            waiting[job.id] = kind
    if waiting and Disk(config).shortage() is not None:
        full = "The coordinator's disk is full up to its reserve: workers get tasks once there is room again."
        found |= dict.fromkeys(waiting, full)
    elif waiting:
        kinds = [kind.value for kind in waiting.values()]
        rows = await tx.all("count_takers", job_ids=list(waiting), kinds=kinds, stale_s=config.timing.stale_s)
        refused = None
        if any(row["takers"] == 0 for row in rows):
            refused = await tx.maybe("newest_refused_worker", seconds=REFUSED_S)
        found |= {row["job_id"]: reason for row in rows if (reason := _reason(row, config, refused))}
    return found


def _waiting_kind(job: JobRow, stages: Mapping[str, DictRow]) -> TaskKind | None:
    """The kind of the tasks that workers could take of a job of which no task runs."""
    if any(row["active"] for row in stages.values()):
        return None
    order = METHODS[job.method].stages
    return next((kind for kind in reversed(order) if kind in stages and stages[kind]["claimable"]), None)


def _reason(row: DictRow, config: ServiceConfig, refused: DictRow | None) -> str | None:
    """The first condition that no worker meets, of a row of the query `count_takers`; None where one meets all."""
    kind = row["kind"]
    if not row["present"]:
        reason = f"No worker is there: none has asked for tasks in the last {config.timing.stale_s:g} s."
    elif not row["able"]:
        reason = f"None of the workers that are there ({row['present']}) does {kind} tasks: see `--kinds` of a worker."
    elif not row["tagged"] and row["missing"]:
        reason = f"No worker that is there for the {kind} tasks has the {_tags(row['missing'])}."
    elif not row["tagged"]:
        reason = f"No worker that is there for the {kind} tasks has all of the {_tags(row['tags'])}."
    elif not row["takers"]:
        apart = {
            "told to leave (drained)": row["tagged"] - row["staying"],
            "asleep, by an order or by a schedule": row["staying"] - row["awake"],
            "blocked for this job after failures (`lightkiln workers unblock`)": row["awake"] - row["takers"],
        }
        shown = "; ".join(f"{count} {words}" for words, count in apart.items() if count)
        reason = f"None of the workers that are there for the {kind} tasks ({row['tagged']}) takes one: {shown}."
    elif not row["idle"]:
        return f"Every worker that may take the {kind} tasks ({row['takers']}) is at work on another job."
    else:
        return None
    if refused is not None:
        reason += (
            f" The worker '{refused['name']}' was refused: it is lightkiln {refused['version']}, the coordinator is "
            f"{__version__}. Install the same version on both."
        )
    return reason


def _tags(tags: Sequence[str]) -> str:
    """`tag 'gpu'`, or `tags 'gpu', 'site-a' and 3 more`."""
    shown = ", ".join(f"'{tag}'" for tag in tags[:NAMED_TAGS])
    more = f" and {len(tags) - NAMED_TAGS} more" if len(tags) > NAMED_TAGS else ""
    return f"{'tag' if len(tags) == 1 else 'tags'} {shown}{more}"
