"""The light map and the losses as a terminal shows them."""

import pytest
from rich.console import Console

from kiln_schemas.client import TileMap
from kiln_schemas.job import CurveView
from kiln_schemas.states import TaskState
from kiln_schemas.tasks import TaskKind
from kiln_service.cli.tile_map import BARS, COLOURS, draw_grid, legend, sparkline, tile_grid

S = TaskState


def tiles(side: int, states: dict[tuple[int, int], TaskState]) -> TileMap:
    """A map of tiles by row and column."""
    cells = bytearray(side * side)
    for (row, column), state in states.items():
        cells[row * side + column] = 1 + list(TaskState).index(state)
    return TileMap(side, bytes(cells))


def curve(points, steps=None) -> CurveView:
    return CurveView(task_id="t", kind=TaskKind.FIT, label="light_field", state=S.ACTIVE, steps=steps, points=points)


def test_a_tile_is_a_cell_at_its_place() -> None:
    found = tiles(2, {(0, 0): S.COMPLETED, (0, 1): S.ACTIVE, (1, 0): S.FAILED})
    assert tile_grid(found, 64) == [[S.COMPLETED, S.ACTIVE], [S.FAILED, None]]


def test_the_worst_state_wins_where_tiles_share_a_cell() -> None:
    states = {(0, 0): S.COMPLETED, (0, 1): S.WAITING, (1, 0): S.SOFT_FAILED, (1, 1): S.ACTIVE, (3, 3): S.COMPLETED}
    assert tile_grid(tiles(4, states), 2) == [[S.SOFT_FAILED, None], [None, S.COMPLETED]]
    assert set(COLOURS) == set(TaskState)


@pytest.mark.parametrize("side", [1, 2, 5])
def test_two_rows_are_a_line(side: int) -> None:
    everywhere = {(row, column): S.QUEUED for row in range(side) for column in range(side)}
    drawn = draw_grid(tile_grid(tiles(side, everywhere), 64))
    lines = drawn.plain.splitlines()
    assert len(lines) == (side + 1) // 2 and {len(line) for line in lines} == {side}
    last = str(drawn.spans[-1].style)
    assert last == ("grey42 on grey42" if side % 2 == 0 else "grey42 on black")


def test_the_legend_names_what_is_there() -> None:
    assert legend([[S.COMPLETED, None], [S.FAILED, S.FAILED]]).plain == "■ completed  ■ failed  "


def test_a_curve_falls_from_left_to_right_over_all_its_steps() -> None:
    halves = [(float(step), 2.0 ** (-step / 100)) for step in range(0, 800, 10)]
    assert sparkline(curve(halves, steps=800.0), 8) == BARS[::-1]
    assert sparkline(curve(halves[:40], steps=800.0), 8) == "█▆▃▁", "the second half is to come"
    assert sparkline(curve([(1.0, 5.0)]), 10) == BARS[0] * 10, "where the end is unknown, it is now"
    assert sparkline(curve([(1.0, 0.0), (2.0, 0.0)]), 10) == ""


def test_gaps_keep_the_height_before_them() -> None:
    assert sparkline(curve([(0.0, 8.0), (9.0, 1.0)], steps=10.0), 10) == "█████████▁"


def test_every_colour_is_one_that_a_terminal_knows() -> None:
    console = Console(width=80, force_terminal=True, color_system="truecolor")
    with console.capture() as captured:
        console.print(legend([list(COLOURS)]), draw_grid([list(COLOURS)]))
    coloured = captured.get()
    assert all(state.value in coloured for state in COLOURS) and coloured.count("▀") == len(COLOURS)
