"""Neighbours and between points of a part of the light map."""

import numpy as np

from kiln_workers.fit.field import TexelField


def _field(chart_map: np.ndarray) -> TexelField:
    place = np.argwhere(chart_map >= 0)
    count = len(place)
    return TexelField(
        np.zeros((count, 16, 16, 3), np.float16),
        np.tile(np.float32([0, 0, 1]), (count, 1)),
        place,
        chart_map[place[:, 0], place[:, 1]],
        1.0,
    )


def test_neighbours_are_of_the_same_chart_and_valid() -> None:
    field = _field(np.array([[0, 0, 1], [0, -1, 1]]))
    assert field.neighbours.tolist() == [
        [-1, 1, -1, 3],
        [0, -1, -1, -1],
        [-1, -1, -1, 4],
        [-1, -1, 0, -1],
        [-1, -1, 2, -1],
    ]


def test_between_points_are_sides_and_corners() -> None:
    between = _field(np.zeros((2, 2), np.int64)).between
    found = {tuple(step): [] for step in between.step.tolist()}
    for step, corners, first in zip(
        between.step.tolist(), between.corners.tolist(), between.first.tolist(), strict=True
    ):
        found[tuple(step)].append((first, sorted(corners)))
    assert found == {
        (0, 1): [(0, [0, 0, 1, 1]), (2, [2, 2, 3, 3])],
        (1, 0): [(0, [0, 0, 2, 2]), (1, [1, 1, 3, 3])],
        (1, 1): [(0, [0, 1, 2, 3])],
    }


def test_no_corner_across_a_missing_texel_and_none_between_charts() -> None:
    between = _field(np.array([[0, 0], [0, -1]])).between
    assert sorted(between.step.tolist()) == [[0, 1], [1, 0]]
    assert len(_field(np.array([[0, 1], [1, 0]])).between) == 0
