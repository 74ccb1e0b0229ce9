"""What commands print: one JSON document on standard output with --json, words for people otherwise.

Progress and notices go to standard error in both cases, so that standard output can be piped.
"""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from kiln_schemas.base import Contract
from kiln_schemas.errors import KilnError
from kiln_schemas.job import JobView

notices = Console(stderr=True, highlight=False)
results = Console(highlight=False)


def print_json(document: Contract | Mapping[str, Any] | list[Any]) -> None:
    """One document on one line."""
    tree = document.model_dump(mode="json") if isinstance(document, Contract) else document
    print(json.dumps(tree, ensure_ascii=False), flush=True)


def print_error(error: KilnError, *, as_json: bool) -> None:
    """The problem document on standard output, or one red sentence on standard error."""
    if as_json:
        print_json(error.problem())
    else:
        notices.print(f"[bold red]{escape(str(error))}[/]", soft_wrap=True)


def stage_table(job: JobView, wall: Mapping[str, float] | None = None) -> Table:
    """The stages of a job: tasks, fraction, busy seconds and, where known, seconds from first start to last end."""
    table = Table("stage", "tasks", "done", "busy s", *(["wall s"] if wall is not None else []), box=None)
    for stage in job.stages:
        row = [stage.kind.value, f"{stage.completed}/{stage.total}", f"{stage.fraction:.0%}", f"{stage.seconds:.1f}"]
        table.add_row(*row, *([f"{wall.get(stage.kind.value, 0.0):.1f}"] if wall is not None else []))
    return table


def duration(seconds: float | None) -> str:
    """`1:02:03` or `2:03`; `?` where unknown."""
    if seconds is None:
        return "?"
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{rest:02}" if hours else f"{minutes}:{rest:02}"


def shown_path(path: Path) -> str:
    """A path as people type it: relative where it lies below the working folder."""
    return str(path.relative_to(Path.cwd())) if path.is_relative_to(Path.cwd()) else str(path)
