"""Dilation: every texel gets its nearest source, charts stay apart, valid texels stay untouched."""

import numpy as np
import pytest

from kiln_schemas.errors import InternalError
from kiln_workers.package.dilate import SHARP_RINGS, plan_fill


def two_charts(size: int = 32) -> tuple[np.ndarray, np.ndarray]:
    """Two charts with two texels of gutter between them, and room around."""
    chart = np.full((size, size), -1, np.int32)
    chart[4:12, 4:12], chart[4:12, 14:22] = 0, 1
    return chart >= 0, chart


def test_each_texel_takes_a_nearest_one_by_exhaustive_search() -> None:
    random = np.random.default_rng(2)
    valid = random.random((24, 31)) < 0.03
    fill = plan_fill(valid, np.where(valid, 0, -1).astype(np.int32))
    sources, (rows, columns), distance = np.argwhere(valid), fill.sources(), fill.distance()
    for row, column in np.ndindex(valid.shape):
        nearest = np.hypot(*(sources - (row, column)).T).min()
        source = rows[row, column], columns[row, column]
        assert valid[source]
        assert np.hypot(source[0] - row, source[1] - column) == pytest.approx(nearest)
        assert distance[row, column] == pytest.approx(nearest)


def test_the_gutter_continues_the_chart_that_it_touches() -> None:
    valid, chart = two_charts()
    filled = plan_fill(valid, chart).nearest(np.where(valid, chart + 10, -99))
    assert (filled[4:12, 12] == 10).all()
    assert (filled[4:12, 13] == 11).all()
    assert set(np.unique(filled)) == {10, 11}
    np.testing.assert_array_equal(filled[valid], (chart + 10)[valid])


def test_an_invalid_texel_is_filled_from_its_own_chart() -> None:
    valid, chart = two_charts()
    valid[4:12, 9:12] = False  # the nearest valid texel of column 11 lies in the other chart, three columns away
    valid[4:12, 8] = False
    filled = plan_fill(valid, chart).nearest(np.where(valid, chart + 10, -99))
    assert (filled[4:12, 8:12] == 10).all()
    assert (filled[4:12, 12] == 10).all()


def test_a_chart_without_any_valid_texel_takes_its_neighbours() -> None:
    valid, chart = two_charts()
    valid[chart == 1] = False
    filled = plan_fill(valid, chart).nearest(np.where(valid, 7, -99))
    assert (filled == 7).all()


def test_lobes_are_copied_whole() -> None:
    valid, chart = two_charts()
    lobes = np.random.default_rng(3).random((*valid.shape, 4, 7)).astype(np.float32)
    lobes[~valid] = np.nan
    filled = plan_fill(valid, chart).nearest(lobes)
    known = {lobes[row, column].tobytes() for row, column in np.argwhere(valid)}
    assert all(filled[row, column].tobytes() in known for row, column in np.ndindex(valid.shape))


def test_smoothing_keeps_charts_and_their_surroundings_and_smooths_beyond() -> None:
    valid, chart = two_charts(48)
    colours = np.where(chart == 1, 5.0, 1.0)[..., None].repeat(3, axis=-1).astype(np.float32)
    colours[~valid] = np.nan
    fill = plan_fill(valid, chart)
    sharp, smooth = fill.nearest(colours), fill.smooth(colours)
    near = fill.distance() <= SHARP_RINGS
    np.testing.assert_array_equal(smooth[near], sharp[near])
    assert set(np.unique(sharp)) == {1.0, 5.0}
    # Far below the charts the step between their cells has become a slope, and no value leaves the charts' range.
    row = smooth[40, :, 0]
    assert np.abs(np.diff(row)).max() < 1.0
    assert np.abs(np.diff(sharp[40, :, 0])).max() == 4.0
    assert smooth.min() >= 1.0
    assert smooth.max() <= 5.0


def test_an_empty_light_map_is_refused() -> None:
    with pytest.raises(InternalError, match="no texel"):
        plan_fill(np.zeros((4, 4), bool), np.full((4, 4), -1, np.int32))
