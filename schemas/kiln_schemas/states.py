"""States of jobs and tasks and the only moves between them.

Tasks: waiting > queued > active > completed | failed | canceled; a lost or failed attempt moves
active > queued (retry). Jobs: queued > active > completed | gate-failed | failed, or
cancel-requested > canceled.
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
    CANCEL_REQUESTED = "cancel-requested"
    """A person or program asked to stop; running tasks have not all stopped yet."""
    CANCELED = "canceled"
    """Stopped on request; no task runs. Final."""
    FAILED = "failed"
    """A task failed for good; its error is the job's. Final."""
    COMPLETED = "completed"
    """All artifacts are published, and every quality gate is met. Final."""
    GATE_FAILED = "gate-failed"
    """All artifacts are published, but the package misses a quality gate; the error says which. Final."""


class TaskState(StrEnum):
    """What a task is doing."""

    WAITING = "waiting"
    """Planned; the tasks that it depends on have not all completed."""
    QUEUED = "queued"
    """Any worker of its kind may claim it."""
    ACTIVE = "active"
    """Claimed by one worker under the current attempt."""
    FAILED = "failed"
    """Out of attempts, or failed in a way that no retry mends. Final."""
    CANCELED = "canceled"
    """Stopped with its job. Final."""
    COMPLETED = "completed"
    """Committed under its current attempt. Final."""


JOB_TRANSITIONS: Final[Mapping[JobState, frozenset[JobState]]] = {
    JobState.QUEUED: frozenset({JobState.ACTIVE, JobState.CANCEL_REQUESTED, JobState.FAILED}),
    JobState.ACTIVE: frozenset({JobState.COMPLETED, JobState.GATE_FAILED, JobState.FAILED, JobState.CANCEL_REQUESTED}),
    JobState.CANCEL_REQUESTED: frozenset({JobState.CANCELED}),
    JobState.CANCELED: frozenset(),
    JobState.FAILED: frozenset(),
    JobState.COMPLETED: frozenset(),
    JobState.GATE_FAILED: frozenset(),
}

TASK_TRANSITIONS: Final[Mapping[TaskState, frozenset[TaskState]]] = {
    TaskState.WAITING: frozenset({TaskState.QUEUED, TaskState.CANCELED}),
    TaskState.QUEUED: frozenset({TaskState.ACTIVE, TaskState.CANCELED}),
    TaskState.ACTIVE: frozenset({TaskState.QUEUED, TaskState.COMPLETED, TaskState.FAILED, TaskState.CANCELED}),
    TaskState.FAILED: frozenset(),
    TaskState.CANCELED: frozenset(),
    TaskState.COMPLETED: frozenset(),
}

FINAL_JOB_STATES: Final = frozenset(s for s, moves in JOB_TRANSITIONS.items() if not moves)
PUBLISHED_JOB_STATES: Final = frozenset({JobState.COMPLETED, JobState.GATE_FAILED})
"""Those in which a job has artifacts."""
FINAL_TASK_STATES: Final = frozenset(s for s, moves in TASK_TRANSITIONS.items() if not moves)


def check_job_move(before: JobState, after: JobState) -> None:
    """Raise IllegalTransition unless `before > after` is in the table."""
    if after not in JOB_TRANSITIONS[before]:
        raise IllegalTransition(f"a job cannot move {before} > {after}")


def check_task_move(before: TaskState, after: TaskState) -> None:
    """Raise IllegalTransition unless `before > after` is in the table."""
    if after not in TASK_TRANSITIONS[before]:
        raise IllegalTransition(f"a task cannot move {before} > {after}")
