"""What clients send to the coordinator and what it tells them."""

import re
from collections.abc import Sequence
from datetime import datetime
from pathlib import PurePosixPath
from typing import Annotated, Final, Literal

from pydantic import Field

from kiln_schemas.base import Contract, Count, Detail, Id, Magnitude, Name, Real, Seconds, Word
from kiln_schemas.errors import InputError, Problem
from kiln_schemas.gates import MOST_CAMERAS, Cameras, GateResult, Gates
from kiln_schemas.settings import LARGEST_SIDE, SMALLEST_SIDE, BakeSettings
from kiln_schemas.states import JobState, TaskState
from kiln_schemas.tasks import MOST_NOTES, MOST_POINTS, PATH_LENGTH, Bundle, Progress, Sha256, Tags, TaskKind
from kiln_schemas.text import LINE_BREAK, UNFIT, Line, Note, is_line, told

DEFAULT_PRIORITY: Final = 50

Priority = Annotated[int, Field(ge=0, le=100, description="of two jobs that wait the greater goes first")]
LABEL_KEY: Final = r"^[A-Za-z0-9][A-Za-z0-9._/-]{0,62}$"
LABEL_LENGTH: Final = 128
PART_BYTES: Final = 255
"""Longest name of a file or folder on the file systems in use."""
LabelKey = Annotated[str, Field(pattern=LABEL_KEY, max_length=63)]
LabelValue = Annotated[Line, Field(max_length=LABEL_LENGTH)]
MOST_LABELS: Final = 32
Labels = Annotated[dict[LabelKey, LabelValue], Field(max_length=MOST_LABELS)]


class JobRequest(Contract):
    """Body of `POST /v1/jobs`: a preset with overrides, or complete settings."""

    name: Line = Field(min_length=1, max_length=128)
    bundle: Bundle
    preset: Word | None = None
    set: tuple[Name, ...] = Field(default=(), max_length=256)
    settings: BakeSettings | None = None
    gates: Gates = Gates()
    cameras: Cameras = Field(default_factory=dict)
    """By name; those that a FLIP gate names are shaded and path-traced."""
    priority: Priority = DEFAULT_PRIORITY
    labels: Labels = Field(default_factory=dict)
    """Free words to find the job by: project, shot, commit, ..."""
    tags: Tags = ()
    """Its tasks go to workers that have all of these tags."""


class JobChange(Contract):
    """Body of `PATCH /v1/jobs/{id}`: what is left out stays."""

    priority: Priority | None = None
    labels: Labels | None = None
    """All labels from now on."""
    tags: Tags | None = None
    """All tags that its workers need from now on."""


TexelRange = tuple[Annotated[int, Field(ge=0, lt=2**31)], Annotated[int, Field(ge=1, lt=2**31)]]


class RequeueRequest(Contract):
    """Body of `POST /v1/jobs/{id}/requeue`: which tasks to do again, though they are done; all of the kind by default.

    What follows from them waits for them and is done again too, and the package with it.
    """

    kind: Literal[TaskKind.RENDER, TaskKind.FIT, TaskKind.REFINE, TaskKind.PACKAGE]
    rows: TexelRange | None = None
    """Only tiles or blocks with texels in these rows of the light map: the first, and the one after the last."""
    columns: TexelRange | None = None
    """The same of columns."""
    labels: tuple[Word, ...] | None = Field(default=None, max_length=4096)
    """Only tasks with these labels."""


class StageView(Contract):
    """Progress of one stage of a job, in tasks and in fractions of tasks."""

    kind: TaskKind
    total: Count
    completed: Count
    active: Count
    failed: Count
    soft_failed: Count = 0
    """Of those that are queued: after attempts that ended badly."""
    fraction: float = Field(ge=0, le=1)
    """Running tasks counted by their own progress."""
    seconds: Magnitude
    """Busy seconds of completed tasks, added up."""


class JobView(Contract):
    id: Id
    name: Name
    state: JobState
    settings: BakeSettings
    bundle: Bundle
    created: datetime
    started: datetime | None
    finished: datetime | None
    stages: tuple[StageView, ...] = Field(max_length=len(TaskKind))
    remaining_s: Seconds | None
    """Estimate from the finished tasks; None until there is something to estimate from."""
    notes: tuple[Note, ...] = Field(default=(), max_length=MOST_NOTES)
    error: Problem | None = None
    gates: Gates = Gates()
    cameras: Cameras = Field(default_factory=dict)
    gate_results: tuple[GateResult, ...] = Field(default=(), max_length=MOST_CAMERAS + 2)
    """Empty until the package has been measured."""
    priority: Priority = DEFAULT_PRIORITY
    labels: Labels = Field(default_factory=dict)
    tags: Tags = ()
    outcome: JobState | None = None
    """How it ended, also when it is archived; None before."""
    submitter: Name | None = None
    """Name of the token it was submitted with."""
    lightmap_side: int | None = Field(default=None, ge=SMALLEST_SIDE, le=LARGEST_SIDE)
    """Texels along each side of the light map; None as long as it is `auto` and not chosen."""
    renders_of: Id | None = None
    """The job whose light fields it uses, where they are the same; nothing was rendered again then."""
    waits_for: Note | None = None
    """Why no worker has a task of it, in a sentence; None while one has, or where one is about to take the next."""


class JobPage(Contract):
    jobs: tuple[JobView, ...] = Field(max_length=1000)
    next: Id | None = None
    """Cursor of the next page."""


class TaskView(Contract):
    id: Id
    kind: TaskKind
    label: Word
    """`tile 16,32`, `light_field`, ..."""
    state: TaskState
    attempt: Count
    worker: Name | None
    progress: Progress | None
    created: datetime
    started: datetime | None
    finished: datetime | None
    error: Problem | None = None


class CurveView(Contract):
    """How the loss of a task went so far."""

    task_id: Id
    kind: TaskKind
    label: Word
    state: TaskState
    steps: Magnitude | None
    """How many there will be; None before the task has told."""
    points: tuple[tuple[Magnitude, Real], ...] = Field(max_length=MOST_POINTS)
    """(step, training loss), in the order of steps."""


class EventView(Contract):
    """One line of a job's append-only history."""

    id: Count
    at: datetime
    job_id: Id
    task_id: Id | None = None
    kind: Word
    """`job.completed`, `task.claimed`, `task.retried`, ..."""
    actor: Name
    detail: Detail = Field(default_factory=dict)


class MissingRequest(Contract):
    """Body of `POST /v1/blobs/missing`."""

    sha256: tuple[Sha256, ...] = Field(max_length=4096)


class MissingReply(Contract):
    missing: tuple[Sha256, ...] = Field(max_length=4096)


def read_labels(words: Sequence[str], where: str = "--label") -> dict[str, str]:
    """Labels of `KEY=VALUE` words; InputError where one is none."""
    labels: dict[str, str] = {}
    for word in words:
        key, equals, value = word.partition("=")
        if not equals or not re.fullmatch(LABEL_KEY, key) or len(value) > LABEL_LENGTH or not is_line(value):
            raise InputError(
                f"'{told(word, 80)}' is not a label",
                where=where,
                remedy="Write KEY=VALUE: the key of letters, digits and . _ / -, the value on one line, of "
                f"{LABEL_LENGTH} characters at most.",
            )
        labels[key] = value
    if len(labels) > MOST_LABELS:
        raise InputError(f"{len(labels)} labels are more than {MOST_LABELS}", where=where, remedy="Leave some out.")
    return labels


def check_bundle_path(path: str) -> str:
    """A relative POSIX path that stays inside its bundle and names a file anywhere, unchanged; InputError otherwise."""
    parts = path.split("/")
    if UNFIT.search(path) or LINE_BREAK.search(path):
        raise InputError(
            f"'{path}' holds a control character", where="bundle.files", remedy="Give the file another name."
        )
    if len(path) > PATH_LENGTH or any(len(part.encode()) > PART_BYTES for part in parts):
        raise InputError(
            f"'{told(path, 80)}' is longer than {PATH_LENGTH} characters, or {PART_BYTES} bytes between two slashes",
            where="bundle.files",
            remedy="Give the file a shorter name.",
        )
    if (
        path.startswith("/")
        or "\\" in path
        or any(part in ("", ".", "..") for part in parts)
        or (len(parts[0]) > 1 and parts[0][1] == ":")
    ):
        raise InputError(
            f"'{path}' leaves the bundle",
            where="bundle.files",
            remedy="Use relative paths with '/' and without '..' inside the scene's folder.",
        )
    return path


def check_bundle(bundle: Bundle) -> Bundle:
    """The bundle unchanged, if every path stays inside and entry and environment are among its files."""
    for path in bundle.files:
        check_bundle_path(path)
    folders = {parent.as_posix() for path in bundle.files for parent in PurePosixPath(path).parents}
    if both := sorted(folders & set(bundle.files)):
        raise InputError(
            f"'{both[0]}' is a file and a folder", where="bundle.files", remedy="Give the file another name."
        )
    wanted = {"bundle.entry": bundle.entry}
    if bundle.environment:
        wanted["bundle.environment.file"] = bundle.environment.file
    for where, path in wanted.items():
        if path not in bundle.files:
            raise InputError(f"'{path}' is not among the bundle's files", where=where, remedy="Add it to `files`.")
    return bundle
