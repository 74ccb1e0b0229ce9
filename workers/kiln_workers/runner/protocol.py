"""What a worker's parent and its child process say to each other: one JSON object a line, over pipes.

The parent writes `Setup` once and then a `Work` per task (or `Stop`) to the child's standard input; the child answers
`Ready` once and then any number of `Report`s and one `Done` or `Failed` per task on what was its standard output when
it started. The child then points its standard output at its standard error, so what libraries print becomes log lines
and never corrupts the protocol.
"""

from typing import Annotated, Final, Literal

from pydantic import Field, TypeAdapter

from kiln_schemas.base import Contract
from kiln_schemas.errors import Problem
from kiln_schemas.tasks import Claim, Labels, Progress, Result, TaskKind

END_OF_LOG: Final = "\x1e end of the task's log"
"""The child's last line on standard error of every task."""


class Setup(Contract):
    """Parent to child, first line: everything that stays the same between tasks."""

    say: Literal["setup"] = "setup"
    url: str
    token: str
    kinds: tuple[TaskKind, ...]
    stages: str
    """Package that has one module per kind of task, each with `run(payload, context)`."""
    scratch: str
    """Folder for temporary files; emptied before every task."""
    cache: str
    """Folder of the blob cache."""
    cache_bytes: int
    memory_bytes: int
    threads: int


class Work(Contract):
    """Parent to child: run this task."""

    say: Literal["work"] = "work"
    claim: Claim


class Stop(Contract):
    """Parent to child: the running task is not wanted any more."""

    say: Literal["stop"] = "stop"


class Ready(Contract):
    """Child to parent, first line: it is up."""

    say: Literal["ready"] = "ready"
    device: str
    lacks: Problem | None = None
    """Why this machine cannot run the kinds that it offers."""


class Report(Contract):
    """Child to parent: how far the task is."""

    say: Literal["report"] = "report"
    progress: Progress


class Done(Contract):
    """Child to parent: the task's result; all its blobs are uploaded."""

    say: Literal["done"] = "done"
    result: Result


class Failed(Contract):
    """Child to parent: the task ended with an error."""

    say: Literal["failed"] = "failed"
    problem: Problem
    retryable: bool
    lost: Labels = ()
    """Labels of the render tasks whose tiles are lost."""


ToChild: Final[TypeAdapter[Setup | Work | Stop]] = TypeAdapter(
    Annotated[Setup | Work | Stop, Field(discriminator="say")]
)
ToParent: Final[TypeAdapter[Ready | Report | Done | Failed]] = TypeAdapter(
    Annotated[Ready | Report | Done | Failed, Field(discriminator="say")]
)


def encode(message: Contract) -> bytes:
    """One line."""
    return message.model_dump_json().encode() + b"\n"
