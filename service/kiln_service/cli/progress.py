"""One progress display for a job: bars, tiles and curves on a terminal, lines elsewhere; and following a job."""

import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from types import TracebackType
from typing import Final, Protocol, Self

from rich.console import Group
from rich.live import Live
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from kiln_schemas.client import Client, TileMap
from kiln_schemas.errors import Unreachable
from kiln_schemas.job import CurveView, JobView, StageView
from kiln_schemas.states import FINAL_JOB_STATES, TaskState
from kiln_schemas.tasks import TaskKind
from kiln_service.cli.output import duration, notices
from kiln_service.cli.tile_map import draw_grid, legend, sparkline, tile_grid

POLL_S: Final = 0.5
MOST_CELLS: Final = 64
"""Of a side of the tile map."""
CURVE_WIDTH: Final = 64
LINE_S: Final = 10.0
"""Between two lines where there is no terminal."""
SETTLED_S: Final = 5.0
"""Why a job waits is shown after this: a worker that starts together with it takes a moment."""


@dataclass(frozen=True)
class Pictures:
    """What a terminal shows of a job beside its stages."""

    tiles: TileMap | None = None
    """Its tiles while they are rendered."""
    curves: Sequence[CurveView] = ()
    """The losses of its fits, once there are some."""


class Display(AbstractContextManager["Display"], Protocol):
    """Something that shows how far a job is."""

    pictures: bool
    """Whether it shows tiles; they are not asked for otherwise."""

    def show(self, job: JobView, seen: Pictures) -> None:
        """Show this state."""

    def say(self, message: str) -> None:
        """Show a notice that stays."""


def make_display(*, quiet: bool = False) -> Display:
    """Bars on a terminal, lines elsewhere; the same with --json, since it is all on standard error."""
    if quiet:
        return LineDisplay(every_s=float("inf"))
    return BarDisplay() if sys.stderr.isatty() else LineDisplay(LINE_S)


class BarDisplay:
    """A live table of bars with time left and elapsed, the light map tile by tile, and the losses over the steps."""

    pictures = True

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

    def show(self, job: JobView, seen: Pictures) -> None:
        table = Table.grid(padding=(0, 2))
        for stage in job.stages:
            bar = ProgressBar(total=1.0, completed=stage.fraction, width=32)
            table.add_row(stage.kind.value, bar, f"{stage.fraction:4.0%}", counts(stage), details(stage, seen.curves))
        head = f"{job.name}: {job.state.value}, elapsed {duration(time.monotonic() - self._began)}"
        if job.remaining_s is not None and job.state not in FINAL_JOB_STATES:
            head += f", about {duration(job.remaining_s)} left"
        self._live.update(Group(Text(head), *map(Text, waits(job, self._began)), table, *self._drawn(job, seen)))

    def _drawn(self, job: JobView, seen: Pictures) -> Iterator[Text]:
        size = self._live.console.size
        if seen.tiles is not None and seen.tiles.side:
            room = max(2 * (size.height - len(job.stages) - len(seen.curves) - 4), 2)
            grid = tile_grid(seen.tiles, min(size.width - 1, room, MOST_CELLS))
            yield draw_grid(grid)
            yield legend(grid)
        for curve in seen.curves:
            if line := sparkline(curve, min(size.width - 24, CURVE_WIDTH)):
                yield Text(f"{curve.label:12} {line} {curve.points[-1][1]:.4g}")

    def say(self, message: str) -> None:
        self._live.console.print(message, markup=False)


class LineDisplay:
    """A line whenever a stage changes its number of finished tasks, but not more often than `every_s` otherwise."""

    pictures = False

    def __init__(self, every_s: float) -> None:
        self._every_s, self._last, self._stages = every_s, float("-inf"), ""
        self._began = time.monotonic()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        return None

    def show(self, job: JobView, seen: Pictures) -> None:
        active = ",".join(stage.kind.value for stage in job.stages if 0 < stage.fraction < 1)
        now = time.monotonic()
        if self._every_s == float("inf") or (now - self._last < self._every_s and active == self._stages):
            return
        self._last, self._stages = now, active
        words = [f"{s.kind.value} {s.fraction:.0%} {counts(s)} {details(s, seen.curves)}".strip() for s in job.stages]
        left = "" if job.remaining_s is None else f", about {duration(job.remaining_s)} left"
        said = [
            f"[{duration(now - self._began)}] {job.state.value}: {'; '.join(words)}{left}",
            *waits(job, self._began),
        ]
        self.say(". ".join(said))

    def say(self, message: str) -> None:
        notices.print(message, markup=False, soft_wrap=True)


def waits(job: JobView, began: float) -> list[str]:
    """Why no task of the job runs, where that is so and it has been followed for a moment (since `began`)."""
    return [job.waits_for] if job.waits_for is not None and time.monotonic() - began >= SETTLED_S else []


def counts(stage: StageView) -> str:
    """Finished and planned tasks in their own word."""
    word = {TaskKind.RENDER: "tiles", TaskKind.REFINE: "blocks"}.get(stage.kind, "tasks")
    failed = f", {stage.failed} failed" if stage.failed else ""
    return f"{stage.completed}/{stage.total} {word}{failed}"


def details(stage: StageView, curves: Sequence[CurveView]) -> str:
    """The loss of each network that is being fitted."""
    if stage.kind is not TaskKind.FIT:
        return ""
    running = [curve for curve in curves if curve.points and curve.state is TaskState.ACTIVE]
    return ", ".join(f"{curve.label} loss {curve.points[-1][1]:.4g}" for curve in running)


def look(api: Client, job: JobView, seen: Pictures, *, tiles: bool) -> Pictures:
    """What there is to see of a job now, asked for only where something happens."""
    stages = {stage.kind: stage for stage in job.stages}
    render, fit = stages.get(TaskKind.RENDER), stages.get(TaskKind.FIT)
    if tiles and render is not None and render.completed < render.total:
        seen = replace(seen, tiles=api.tiles(job.id, seen.tiles))
    elif render is not None:
        seen = replace(seen, tiles=None)
    if fit is not None and (fit.active or (fit.completed and not seen.curves)):
        seen = replace(seen, curves=api.curves(job.id))
    return seen


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
    seen = Pictures()
    while True:
        try:
            job = api.job(job_id)
            seen = look(api, job, seen, tiles=display.pictures)
        except Unreachable:
            if between is None:
                raise
        else:
            display.show(job, seen)
            if on_change is not None and job != before:
                on_change(job)
            before = job
            if job.state in FINAL_JOB_STATES:
                return job
        if between is not None:
            between()
        time.sleep(POLL_S)
