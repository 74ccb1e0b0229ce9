"""Rows of the database as frozen dataclasses with the contracts' types."""

from collections.abc import Iterable
from dataclasses import dataclass, fields
from datetime import datetime
from typing import Any, Self, TypeVar

from psycopg.rows import DictRow
from pydantic import ValidationError

from kiln_schemas.base import Contract
from kiln_schemas.camera import Camera
from kiln_schemas.errors import Problem
from kiln_schemas.gates import GateResult, Gates
from kiln_schemas.settings import AUTO, BakeSettings
from kiln_schemas.states import JobState, TaskState
from kiln_schemas.tasks import Bundle, Progress, TaskKind
from kiln_service.db.lenient import (
    note_unreadable,
    readable,
    readable_outcome,
    readable_problem,
    readable_rows,
)

C = TypeVar("C", bound=Contract)


class _Row:
    @classmethod
    def _picked(cls, row: DictRow) -> dict[str, Any]:
        return {field.name: row[field.name] for field in fields(cls)}  # type: ignore[arg-type]


def picked(contract: type[C], row: DictRow) -> C:
    """A contract of those of a row's columns that it names."""
    return readable(contract, {name: row[name] for name in contract.model_fields})


@dataclass(frozen=True)
class JobRow(_Row):
    """A row of `jobs`."""

    id: str
    name: str
    method: str
    state: JobState
    settings: BakeSettings
    bundle: Bundle
    gates: Gates
    cameras: dict[str, Camera]
    gate_results: tuple[GateResult, ...]
    store_url: str
    prepared: dict[str, Any] | None
    """The result of the prepare task, without the tiles and what has one entry a mesh."""
    priority: int
    labels: dict[str, str]
    tags: tuple[str, ...]
    submitter: str | None
    renders_of: str | None
    outcome: JobState | None
    notes: tuple[str, ...]
    error: Problem | None
    created: datetime
    started: datetime | None
    finished: datetime | None

    @property
    def lightmap_side(self) -> int | None:
        """Texels along each side of the light map; None as long as it is `auto` and not chosen."""
        lightmap, chosen = self.settings.lightmap, (self.prepared or {}).get("resolution")
        return None if lightmap.resolution == AUTO and chosen is None else lightmap.side(chosen)

    @classmethod
    def of(cls, row: DictRow) -> Self:
        """Parse what psycopg returned."""
        values = cls._picked(row)
        return cls(
            **values
            | {
                "state": JobState(values["state"]),
                "settings": readable(BakeSettings, values["settings"]),
                "outcome": values["outcome"] and JobState(values["outcome"]),
                "bundle": readable(Bundle, values["bundle"]),
                "gates": readable(Gates, values["gates"]),
                "cameras": {name: readable(Camera, tree) for name, tree in values["cameras"].items()},
                "gate_results": tuple(readable_rows(GateResult, values["gate_results"])),
                "notes": tuple(values["notes"]),
                "tags": tuple(values["tags"]),
                "error": readable_problem(values["error"]),
            }
        )


def job_rows(rows: Iterable[DictRow]) -> list[JobRow]:
    """Those that can be read."""
    found = []
    for row in rows:
        try:
            found.append(JobRow.of(row))
        except (ValidationError, ValueError) as error:
            note_unreadable("job", row, error)
    return found


@dataclass(frozen=True)
class TaskRow(_Row):
    """A row of `tasks`."""

    id: str
    job_id: str
    kind: TaskKind
    label: str
    state: TaskState
    attempt: int
    strikes: int
    spec: dict[str, Any]
    result: dict[str, Any] | None
    progress: Progress | None
    worker_id: str | None
    lease_sha256: str | None
    """Of the secret that the last claim handed out."""
    checkpoint: str | None
    error: Problem | None
    created: datetime
    started: datetime | None
    finished: datetime | None

    @classmethod
    def of(cls, row: DictRow) -> Self:
        """Parse what psycopg returned."""
        values = cls._picked(row)
        return cls(
            **values
            | {
                "kind": TaskKind(values["kind"]),
                "state": TaskState(values["state"]),
            }
            | readable_outcome(values)
        )


@dataclass(frozen=True)
class WorkerRow(_Row):
    """A row of `workers`."""

    id: str
    name: str
    owner: str
    """Name of the token that registered it."""
    registrant: str
    """Owner and name: who it is for blocks and failures, also when it restarts with a new id."""
    kinds: tuple[str, ...]
    tags: tuple[str, ...]
    orders: str
    """`work`, `sleep` or `drain`."""
    asleep: bool
    """By its schedule, at the moment of looking."""

    @classmethod
    def of(cls, row: DictRow) -> Self:
        """Parse what psycopg returned."""
        values = cls._picked(row)
        return cls(**values | {"kinds": tuple(values["kinds"]), "tags": tuple(values["tags"])})
