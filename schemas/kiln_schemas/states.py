"""States of jobs and tasks and the only moves between them.

Tasks: waiting > queued > active > completed | failed | canceled; an attempt that is lost or fails moves
active > soft-failed, from where another worker takes it (soft-failed > active).
Jobs: queued > active > completed | gate-failed | failed, or cancel-requested > canceled; paused and back; whatever
is over may be archived. A retried job is queued again, and its failed and canceled tasks wait or queue again; so
is one of which a person has tasks done again, and what follows from those waits for them.
"""

from collections.abc import Mapping
from enum import StrEnum
from typing import Final

from kiln_schemas.errors import IllegalTransition


class JobState(StrEnum):
    """What a job is doing."""

    QUEUED = "queued"
    """Accepted; none of its tasks has been claimed."""
    ACTIVE = "active"
    """At least one task has been claimed."""
    PAUSED = "paused"
    """Running tasks go on to their end; nothing more is given to workers until it is resumed."""
    CANCEL_REQUESTED = "cancel-requested"
    """A person or program asked to stop; running tasks have not all stopped yet."""
    CANCELED = "canceled"
    """Stopped on request; no task runs. Over, unless it is retried."""
    FAILED = "failed"
    """A task failed for good, and nothing is left that goes without it; its error is the job's. Over unless retried."""
    COMPLETED = "completed"
    """All artifacts are published, and every quality gate is met. Over."""
    GATE_FAILED = "gate-failed"
    """All artifacts are published, but the package misses a quality gate; the error says which. Over."""
    ARCHIVED = "archived"
    """Over and put aside: lists leave it out unless asked for. Its error, events and artifacts stay."""


class TaskState(StrEnum):
    """What a task is doing."""

    WAITING = "waiting"
    """Planned; the tasks that it depends on have not all completed."""
    QUEUED = "queued"
    """Any worker of its kind may claim it."""
    SOFT_FAILED = "soft-failed"
    """Queued again after attempts that ended badly: first for workers that have not failed it."""
    ACTIVE = "active"
    """Claimed by one worker under the current attempt."""
    FAILED = "failed"
    """Out of attempts, or failed in a way that no other attempt mends. Over, unless it is retried."""
    CANCELED = "canceled"
    """Stopped with its job. Over, unless that is retried."""
    COMPLETED = "completed"
    """Committed under its current attempt, or its result is that of an earlier job. Over."""


JOB_TRANSITIONS: Final[Mapping[JobState, frozenset[JobState]]] = {
    JobState.QUEUED: frozenset({JobState.ACTIVE, JobState.PAUSED, JobState.CANCEL_REQUESTED, JobState.FAILED}),
    JobState.ACTIVE: frozenset(
        {JobState.PAUSED, JobState.COMPLETED, JobState.GATE_FAILED, JobState.FAILED, JobState.CANCEL_REQUESTED}
    ),
    JobState.PAUSED: frozenset(
        {
            *(JobState.QUEUED, JobState.ACTIVE, JobState.COMPLETED, JobState.GATE_FAILED, JobState.FAILED),
            JobState.CANCEL_REQUESTED,
        }
    ),
    JobState.CANCEL_REQUESTED: frozenset({JobState.CANCELED}),
    JobState.CANCELED: frozenset({JobState.QUEUED, JobState.ARCHIVED}),
    JobState.FAILED: frozenset({JobState.QUEUED, JobState.ARCHIVED}),
    JobState.COMPLETED: frozenset({JobState.QUEUED, JobState.ARCHIVED}),
    JobState.GATE_FAILED: frozenset({JobState.QUEUED, JobState.ARCHIVED}),
    JobState.ARCHIVED: frozenset(),
}

TASK_TRANSITIONS: Final[Mapping[TaskState, frozenset[TaskState]]] = {
    TaskState.WAITING: frozenset({TaskState.QUEUED, TaskState.COMPLETED, TaskState.CANCELED}),
    TaskState.QUEUED: frozenset({TaskState.ACTIVE, TaskState.CANCELED, TaskState.WAITING}),
    TaskState.SOFT_FAILED: frozenset({TaskState.ACTIVE, TaskState.QUEUED, TaskState.CANCELED, TaskState.WAITING}),
    TaskState.ACTIVE: frozenset(
        {
            *(TaskState.QUEUED, TaskState.SOFT_FAILED, TaskState.WAITING),
            *(TaskState.COMPLETED, TaskState.FAILED, TaskState.CANCELED),
        }
    ),
    TaskState.FAILED: frozenset({TaskState.QUEUED, TaskState.WAITING}),
    TaskState.CANCELED: frozenset({TaskState.WAITING, TaskState.QUEUED}),
    TaskState.COMPLETED: frozenset({TaskState.QUEUED, TaskState.WAITING}),
}

LIVE_JOB_STATES: Final = frozenset({JobState.QUEUED, JobState.ACTIVE, JobState.PAUSED})
"""Those in which what a worker has of the job is wanted."""
FINAL_JOB_STATES: Final = frozenset(JobState) - LIVE_JOB_STATES - {JobState.CANCEL_REQUESTED}
"""Those of a job that is over: nothing happens to it any more unless somebody asks."""
CLAIMABLE_TASK_STATES: Final = frozenset({TaskState.QUEUED, TaskState.SOFT_FAILED})
"""Those in which a worker may claim a task."""
OPEN_TASK_STATES: Final = CLAIMABLE_TASK_STATES | {TaskState.ACTIVE}
"""Those in which a job goes on because of a task."""
OVER_TASK_STATES: Final = frozenset({TaskState.FAILED, TaskState.CANCELED, TaskState.COMPLETED})
"""Those of a task that nobody works on unless somebody asks."""
PUBLISHED_JOB_STATES: Final = frozenset({JobState.COMPLETED, JobState.GATE_FAILED})
"""Those in which a job has artifacts; an archived one may have some."""


def check_job_move(before: JobState, after: JobState) -> None:
    """Raise IllegalTransition unless `before > after` is in the table."""
    if after not in JOB_TRANSITIONS[before]:
        raise IllegalTransition(f"a job cannot move {before} > {after}")


def check_task_move(before: TaskState, after: TaskState) -> None:
    """Raise IllegalTransition unless `before > after` is in the table."""
    if after not in TASK_TRANSITIONS[before]:
        raise IllegalTransition(f"a task cannot move {before} > {after}")
