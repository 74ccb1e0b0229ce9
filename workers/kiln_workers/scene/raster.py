"""Triangles on a grid of unit squares in numpy: which squares they touch, where they come closest, how they overlap.

Works on spans: each triangle's bounding box is cut into its rows, and rows are expanded to squares in batches of
bounded size, so memory stays small whatever the resolution. Coordinates are in squares: square (row, column) is
[column, column + 1] x [row, row + 1] of (x, y).
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np

from kiln_workers.scene.geometry import Floats, Ints

BATCH_SQUARES: Final = 1 << 18
OVERLAP_SQUARES: Final = 1 << 20
"""Squares at once of `touching_squares`, whose result does not depend on it, and of `interior_samples`, whose does."""
TOUCH: Final = 1e-5
"""Squares by which a triangle must reach into a square to touch it: rounding of a shared border is no touch."""


@dataclass(frozen=True)
class Touched:
    """The triangle that each touched square takes its point from; the arrays are parallel, squares ascending."""

    square: Ints  # [S] row * width + column
    face: Ints  # [S]
    barycentric: Floats  # [S, 3] of the triangle's point closest to the square's centre
    distance: Floats  # [S] from the centre to that point; 0 where the triangle contains the centre


def touched_squares(
    corners: Floats, width: int, height: int, handicap: Floats | None = None, rows: slice | None = None
) -> Touched:
    """For every square that a triangle of `corners` [F, 3, 2] touches: the nearest to its centre, and its point there.

    A triangle that contains the centre wins with distance 0; among equals the first triangle wins. `handicap` [F] is
    added to a triangle's distance when it competes with others. With `rows`, only the squares of these rows.
    """
    first, last = (0, height) if rows is None else (rows.start, rows.stop)
    added = np.zeros(len(corners)) if handicap is None else handicap
    count = width * (last - first)
    best_rank = np.full(count, np.inf)
    best_distance = np.full(count, np.inf)
    best_face = np.full(count, -1, dtype=np.int64)
    best_barycentric = np.zeros((count, 3))
    for face, column, row in touching_squares(corners, width, height, rows):
        square = (row - first) * width + column
        centre = np.stack([column + 0.5, row + 0.5], axis=1)
        barycentric, distance = closest_point(corners[face], centre)
        rank = distance + added[face]
        order = np.lexsort((face, rank, square))
        nearest = order[np.unique(square[order], return_index=True)[1]]
        better = nearest[rank[nearest] < best_rank[square[nearest]]]
        best_rank[square[better]] = rank[better]
        best_distance[square[better]] = distance[better]
        best_face[square[better]] = face[better]
        best_barycentric[square[better]] = barycentric[better]
    square = np.flatnonzero(best_face >= 0)
    return Touched(first * width + square, best_face[square], best_barycentric[square], best_distance[square])


def touching_squares(
    corners: Floats, width: int, height: int, rows: slice | None = None
) -> Iterator[tuple[Ints, Ints, Ints]]:
    """(triangle, column, row) for every square that a triangle of `corners` [F, 3, 2] touches, in batches."""
    first, last = (0, height) if rows is None else (rows.start, rows.stop)
    near = np.flatnonzero((corners[:, :, 1].min(axis=1) < last) & (corners[:, :, 1].max(axis=1) >= first))
    for number, column, row in _squares(corners[near], width, (first, last), BATCH_SQUARES):
        face = near[number]
        keep = _overlaps_square(corners[face], column, row)
        yield face[keep], column[keep], row[keep]


def closest_point(corners: Floats, point: Floats) -> tuple[Floats, Floats]:
    """Barycentrics [P, 3] of the point of each triangle [P, 3, 2] closest to `point` [P, 2], and its distance [P]."""
    inside = _signed_barycentrics(corners, point)
    best = np.zeros_like(inside)
    distance = np.full(len(point), np.inf)
    for i in range(3):
        j = (i + 1) % 3
        edge, to_point = corners[:, j] - corners[:, i], point - corners[:, i]
        length = (edge**2).sum(axis=1)
        along = np.clip(
            np.divide((to_point * edge).sum(axis=1), length, out=np.zeros_like(length), where=length > 0), 0, 1
        )
        gap = np.linalg.norm(to_point - along[:, None] * edge, axis=1)
        nearer = gap < distance
        distance[nearer] = gap[nearer]
        candidate = np.zeros_like(best)
        candidate[:, i], candidate[:, j] = 1.0 - along, along
        best[nearer] = candidate[nearer]
    contained = (inside >= 0.0).all(axis=1)
    best[contained], distance[contained] = inside[contained], 0.0
    return best, distance


def kept_inside(barycentric: Floats, heights: Floats, margin: Floats) -> Floats:
    """Barycentrics [P, 3] moved so that each point lies at least `margin` [P] from every edge of its triangle.

    `heights` [P, 3] are the triangles' heights over the edges opposite to their corners, in the unit of `margin`. Where
    a triangle is narrower than that, the margin is half the radius of its incircle. Points that have it do not move.
    """
    radius = 1.0 / np.maximum((1.0 / np.maximum(heights, 1e-300)).sum(axis=1), 1e-300)
    least = np.minimum(margin, 0.5 * radius)[:, None] / np.maximum(heights, 1e-300)
    above = np.maximum(barycentric - least, 0.0)
    total = above.sum(axis=1, keepdims=True)
    share = np.divide(above, total, out=np.full_like(above, 1.0 / 3.0), where=total > 0.0)
    return np.asarray(least + (1.0 - least.sum(axis=1, keepdims=True)) * share)


def interior_samples(corners: Floats, size: int, margin: float) -> Iterator[tuple[Ints, Ints]]:
    """(triangle, sample) for the centres of a size x size grid that lie inside by more than `margin` squares."""
    lengths = np.linalg.norm(corners[:, [2, 0, 1]] - corners[:, [1, 2, 0]], axis=2)  # edge opposite to each corner
    double_area = np.abs(_cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]))
    height = np.divide(double_area[:, None], lengths, out=np.zeros_like(lengths), where=lengths > 0.0)
    for face, column, row in _squares(corners, size, (0, size), OVERLAP_SQUARES):
        centre = np.stack([column + 0.5, row + 0.5], axis=1)
        inside = (_signed_barycentrics(corners[face], centre) * height[face] > margin).all(axis=1)
        yield face[inside], row[inside] * size + column[inside]


def _squares(corners: Floats, width: int, between: tuple[int, int], batch: int) -> Iterator[tuple[Ints, Ints, Ints]]:
    """Triangle, column and row of all squares of the triangles' bounding boxes, triangles ascending.

    Only of the rows from the first of `between` to before the second, about `batch` squares at once.
    """
    low = np.floor(corners.min(axis=1)).astype(np.int64)
    high = np.floor(corners.max(axis=1)).astype(np.int64) + 1
    least, most = (0, between[0]), (width, between[1])
    low, high = np.clip(low, least, most), np.clip(high, least, most)
    rows = np.cumsum(np.maximum(high[:, 1] - low[:, 1], 0))
    begin = 0
    while begin < len(corners):
        done = rows[begin - 1] if begin else 0
        end = max(int(np.searchsorted(rows, done + batch, side="right")), begin + 1)
        for face, column, row in _squares_of_few(low[begin:end], high[begin:end], batch):
            yield face + begin, column, row
        begin = end


def _squares_of_few(low: Ints, high: Ints, batch: int) -> Iterator[tuple[Ints, Ints, Ints]]:
    """The same of boxes [F, 2], all of whose rows are held at once."""
    rows = np.maximum(high[:, 1] - low[:, 1], 0)
    span_face = np.repeat(np.arange(len(low)), rows)
    span_row = _counters(rows) + low[span_face, 1]
    columns = np.maximum(high[:, 0] - low[:, 0], 0)[span_face]
    ends = np.cumsum(columns)
    begin = 0
    while begin < len(span_face):
        done = ends[begin - 1] if begin else 0
        end = max(int(np.searchsorted(ends, done + batch, side="right")), begin + 1)
        count = columns[begin:end]
        face = np.repeat(span_face[begin:end], count)
        yield face, _counters(count) + low[face, 0], np.repeat(span_row[begin:end], count)
        begin = end


def _counters(counts: Ints) -> Ints:
    """0 ... n-1 for each n of `counts`, joined."""
    starts = np.cumsum(counts) - counts
    return np.arange(int(counts.sum())) - np.repeat(starts, counts)


def _overlaps_square(corners: Floats, column: Ints, row: Ints) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
    """Separating axes of a triangle and a unit square: the square's two, then the normals of the three edges."""
    centre = np.stack([column + 0.5, row + 0.5], axis=1)[:, None]
    local = corners - centre
    half = 0.5 - TOUCH
    touch = ((local.min(axis=1) < half) & (local.max(axis=1) > -half)).all(axis=1)
    for i in range(3):
        edge = local[:, (i + 1) % 3] - local[:, i]
        normal = np.stack([-edge[:, 1], edge[:, 0]], axis=1)
        along = np.einsum("pcd,pd->pc", local, normal)
        reach = half * np.abs(normal).sum(axis=1)
        touch &= (along.min(axis=1) <= reach) & (along.max(axis=1) >= -reach)
    return np.asarray(touch)


def _signed_barycentrics(corners: Floats, point: Floats) -> Floats:
    """Barycentrics [P, 3]; all negative for a triangle without area."""
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    area = _cross(b - a, c - a)
    parts = np.stack([_cross(b - point, c - point), _cross(c - point, a - point), _cross(a - point, b - point)], axis=1)
    return np.asarray(np.divide(parts, area[:, None], out=np.full_like(parts, -1.0), where=area[:, None] != 0.0))


def _cross(a: Floats, b: Floats) -> Floats:
    return np.asarray(a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0])
