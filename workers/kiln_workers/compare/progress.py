"""Progress of a comparison on the terminal: what is being done, how much is left, and about how long that takes.

Work is measured in lobes times texels. How fast a solver gets through it is known once it has run with another number
of lobes, and solvers differ by a factor of a thousand: so the estimate covers those that were timed and says how many
were not.
"""

import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from types import TracebackType
from typing import Self

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeElapsedColumn


@dataclass
class Estimate:
    """Seconds that are left of a list of (solver, work)."""

    left: list[tuple[str, float]]
    rates: dict[str, list[float]] = field(default_factory=dict)
    """Seconds per unit of work, as measured."""

    def finished(self, solver: str, work: float, seconds: float | None) -> None:
        """Take an item off the list; `seconds` is None where it was there already."""
        self.left.remove((solver, work))
        if seconds is not None:
            self.rates.setdefault(solver, []).append(seconds / work)

    def seconds(self) -> tuple[float, int]:
        """Seconds left of the solvers that were timed, and how many others there are."""
        rate = {name: sum(values) / len(values) for name, values in self.rates.items()}
        total = sum(work * rate.get(solver, 0.0) for solver, work in self.left)
        return total, len({solver for solver, _ in self.left if solver not in rate})


class Display:
    """A bar on a terminal; a line for each item elsewhere, on standard error."""

    def __init__(self, items: Sequence[tuple[str, float]], *, quiet: bool) -> None:
        self._estimate = Estimate(list(items))
        self._total = sum(work for _, work in items)
        self._console = Console(stderr=True, quiet=quiet)
        self._bar = Progress(
            TextColumn("{task.description}"),
            BarColumn(),
            TextColumn("{task.percentage:>3.0f} %"),
            TimeElapsedColumn(),
            TextColumn("{task.fields[left]}"),
            console=self._console,
            disable=quiet or not sys.stderr.isatty(),
        )
        self._task: TaskID | None = None
        self._began = 0.0

    def __enter__(self) -> Self:
        self._bar.start()
        self._task = self._bar.add_task("starting", total=self._total, left="")
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._bar.stop()

    def say(self, message: str) -> None:
        """What is being done; without a terminal a line of its own."""
        self._update(message, 0.0)
        if self._bar.disable:
            self._console.print(message, markup=False, highlight=False)

    def begin(self, solver: str, message: str) -> None:
        """An item begins."""
        self._began = time.monotonic()
        self.say(f"{message}{self._left()}" if self._bar.disable else message)

    def finish(self, solver: str, work: float, *, fresh: bool) -> None:
        """An item is done; `fresh`: it was computed and not found."""
        self._estimate.finished(solver, work, time.monotonic() - self._began if fresh else None)
        self._update(None, work)

    def tell(self, message: str) -> None:
        """A detail of the present item, shown on a terminal only."""
        self._update(message, 0.0)

    def _update(self, message: str | None, advance: float) -> None:
        if self._task is not None:
            fields = {} if message is None else {"description": message}
            self._bar.update(self._task, advance=advance, left=self._left().lstrip(", "), **fields)  # type: ignore[arg-type]

    def _left(self) -> str:
        left, untimed = self._estimate.seconds()
        minutes, seconds = divmod(round(left), 60)
        known = f", about {minutes}:{seconds:02d} left" if left > 0.0 else ""
        others = f", {untimed} solver{'s' if untimed > 1 else ''} not timed yet" if untimed else ""
        return known + others
