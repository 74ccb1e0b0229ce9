"""Pictures of a job for a terminal: the light map tile by tile, and the losses of its fits.

The same as on the dashboard in characters: two rows of tiles a line, as the upper and the lower half of a block.
"""

import math
from collections.abc import Sequence
from typing import Final

from rich.text import Text

from kiln_schemas.client import TileMap
from kiln_schemas.job import CurveView
from kiln_schemas.states import TaskState

COLOURS: Final[dict[TaskState, str]] = {
    TaskState.WAITING: "grey23",
    TaskState.QUEUED: "grey42",
    TaskState.CANCELED: "grey30",
    TaskState.COMPLETED: "green4",
    TaskState.ACTIVE: "dodger_blue1",
    TaskState.SOFT_FAILED: "orange1",
    TaskState.FAILED: "red",
}
"""In the order of what wins where several tiles share half a character: later ones do."""
EMPTY: Final = "black"
"""Where the light map has no tile, for no surface lies there."""
BARS: Final = "▁▂▃▄▅▆▇█"

Grid = list[list[TaskState | None]]


def tile_grid(tiles: TileMap, most: int) -> Grid:
    """States of tiles by place, at most `most` columns and rows; None where no tile is.

    Where there are more tiles than that, one cell stands for several and shows what matters most among them.
    """
    step = math.ceil(tiles.side / most)
    cells = math.ceil(tiles.side / step)
    grid: Grid = [[None] * cells for _ in range(cells)]
    order = {state: place for place, state in enumerate(COLOURS)}
    for number, state in enumerate(tiles.states()):
        if state is None:
            continue
        row, column = number // tiles.side // step, number % tiles.side // step
        before = grid[row][column]
        if before is None or order[state] > order[before]:
            grid[row][column] = state
    return grid


def draw_grid(grid: Grid) -> Text:
    """The grid in half blocks, two rows a line."""
    text = Text()
    for y in range(0, len(grid), 2):
        upper, lower = grid[y], grid[y + 1] if y + 1 < len(grid) else [None] * len(grid[y])
        for above, below in zip(upper, lower, strict=True):
            text.append("▀", f"{_colour(above)} on {_colour(below)}")
        text.append("\n")
    return text


def legend(grid: Grid) -> Text:
    """What the colours of a grid mean."""
    there = {state for row in grid for state in row if state is not None}
    text = Text()
    for state in COLOURS:
        if state in there:
            text.append("■ ", COLOURS[state]).append(f"{state.value}  ")
    return text


def sparkline(curve: CurveView, width: int) -> str:
    """The loss over the steps on a logarithmic scale, `width` characters for all of its steps."""
    points = [(step, loss) for step, loss in curve.points if loss > 0]
    if not points:
        return ""
    steps = max(curve.steps or 0.0, points[-1][0], 1.0)
    columns: dict[int, float] = {}
    for step, loss in points:
        columns[min(int(width * step / steps), width - 1)] = math.log(loss)
    low, high = min(columns.values()), max(columns.values())
    span = (high - low) or 1.0
    return "".join(_bars(columns, low, span))


def _bars(columns: dict[int, float], low: float, span: float) -> Sequence[str]:
    """A bar a column up to the last one that is known; gaps keep the height before them."""
    bars, height = [], next(iter(columns.values()))
    for column in range(max(columns) + 1):
        height = columns.get(column, height)
        bars.append(BARS[round((height - low) / span * (len(BARS) - 1))])
    return bars


def _colour(state: TaskState | None) -> str:
    return EMPTY if state is None else COLOURS[state]
