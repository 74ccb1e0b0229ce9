"""One progress display for a job: a bar a stage on a terminal, a line now and then elsewhere; and following a job."""

import sys
import time
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from types import TracebackType
from typing import Final, Protocol, Self

from rich.console import Group
from rich.live import Live
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from kiln_schemas.client import Client
from kiln_schemas.errors import Unreachable
from kiln_schemas.job import JobView, StageView, TaskView
from kiln_schemas.states import FINAL_JOB_STATES
from kiln_schemas.tasks import TaskKind
from kiln_service.cli.output import duration, notices

POLL_S: Final = 0.5
LINE_S: Final = 10.0
"""Between two lines where there is no terminal."""


class Display(AbstractContextManager["Display"], Protocol):
    """Something that shows how far a job is."""

    def show(self, job: JobView, fits: Sequence[TaskView]) -> None:
        """Show this state; `fits` are the fit tasks once there are some."""

    def say(self, message: str) -> None:
        """Show a notice that stays."""


def make_display(*, quiet: bool = False) -> Display:
    """Bars on a terminal, lines elsewhere; the same with --json, since it is all on standard error."""
    if quiet:
        return LineDisplay(every_s=float("inf"))
    return BarDisplay() if sys.stderr.isatty() else LineDisplay(LINE_S)


class BarDisplay:
    """A live table of bars with tiles, loss, time left and elapsed."""

    def __init__(self) -> None:
        self._began = time.monotonic()
        self._live = Live(console=notices, refresh_per_second=4, transient=False)

    def __enter__(self) -> Self:
        self._live.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._live.stop()

    def show(self, job: JobView, fits: Sequence[TaskView]) -> None:
        table = Table.grid(padding=(0, 2))
        for stage in job.stages:
            bar = ProgressBar(total=1.0, completed=stage.fraction, width=32)
            table.add_row(stage.kind.value, bar, f"{stage.fraction:4.0%}", counts(stage), details(stage, fits))
        head = f"{job.name}: {job.state.value}, elapsed {duration(time.monotonic() - self._began)}"
        if job.remaining_s is not None and job.state not in FINAL_JOB_STATES:
            head += f", about {duration(job.remaining_s)} left"
        self._live.update(Group(Text(head), table))

    def say(self, message: str) -> None:
        self._live.console.print(message, markup=False)


class LineDisplay:
    """A line whenever a stage changes its number of finished tasks, but not more often than `every_s` otherwise."""

    def __init__(self, every_s: float) -> None:
        self._every_s, self._last, self._stages = every_s, float("-inf"), ""
        self._began = time.monotonic()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        return None

    def show(self, job: JobView, fits: Sequence[TaskView]) -> None:
        active = ",".join(stage.kind.value for stage in job.stages if 0 < stage.fraction < 1)
        now = time.monotonic()
        if self._every_s == float("inf") or (now - self._last < self._every_s and active == self._stages):
            return
        self._last, self._stages = now, active
        words = [f"{s.kind.value} {s.fraction:.0%} {counts(s)} {details(s, fits)}".strip() for s in job.stages]
        left = "" if job.remaining_s is None else f", about {duration(job.remaining_s)} left"
        self.say(f"[{duration(now - self._began)}] {job.state.value}: {'; '.join(words)}{left}")

    def say(self, message: str) -> None:
        notices.print(message, markup=False, soft_wrap=True)


def counts(stage: StageView) -> str:
    """Finished and planned tasks in their own word."""
    word = {TaskKind.RENDER: "tiles", TaskKind.REFINE: "blocks"}.get(stage.kind, "tasks")
    return f"{stage.completed}/{stage.total} {word}"


def details(stage: StageView, fits: Sequence[TaskView]) -> str:
    """The loss of each network that is being fitted."""
    if stage.kind is not TaskKind.FIT:
        return ""
    losses = [(t.label, t.progress.loss) for t in fits if t.progress is not None and t.progress.loss is not None]
    return ", ".join(f"{label} loss {loss:.4g}" for label, loss in losses)


def follow(
    api: Client,
    job_id: str,
    display: Display,
    *,
    on_change: Callable[[JobView], None] | None = None,
    between: Callable[[], None] | None = None,
) -> JobView:
    """Show a job until it is over; `between` runs at every look, and with it an outage is waited out."""
    before: JobView | None = None
    while True:
        try:
            job = api.job(job_id)
            fitting = any(stage.kind is TaskKind.FIT and stage.active for stage in job.stages)
            fits = api.tasks(job_id, TaskKind.FIT) if fitting else ()
        except Unreachable:
            if between is None:
                raise
        else:
            display.show(job, fits)
            if on_change is not None and job != before:
                on_change(job)
            before = job
            if job.state in FINAL_JOB_STATES:
                return job
        if between is not None:
            between()
        time.sleep(POLL_S)
