"""Polygons of any shape as triangles: fans where they are convex, mapbox' earcut (in the polygon's plane) where not.

The plane is Newell's (Sutherland et al. 1974): its normal is the sum of the cross products of neighbouring corners,
which a concave corner does not turn round. A hole that a bridge of two coinciding edges joins to the outline is a
concave polygon too. Corners are given polygon after polygon, as files have them.
"""

from typing import Final

import mapbox_earcut
import numpy as np

from kiln_workers.scene.geometry import Floats, Ints

TRIANGLES, STRIP, FAN = 4, 5, 6
"""How a list of vertices makes faces, as glTF numbers it."""
CONCAVE: Final = -1e-9
"""A corner turns back if its turn is below this part of the polygon's own size squared."""


def triangulated(positions: Floats, sizes: Ints) -> Ints:
    """Triangles [T, 3] as numbers of the corners, whose `positions` [C, 3] come in polygons of `sizes` [K] >= 3."""
    starts = np.cumsum(sizes) - sizes
    parts: list[Ints] = []
    owners: list[Ints] = []
    for size in np.unique(sizes):
        which = np.flatnonzero(sizes == size)
        corners = starts[which, None] + np.arange(size)  # [K, size]
        fan = np.stack([np.broadcast_to(corners[:, :1], (len(which), size - 2)), corners[:, 1:-1], corners[:, 2:]], 2)
        concave = _concave(positions[corners]) if size > 3 else np.zeros(len(which), np.bool_)
        parts.append(fan[~concave].reshape(-1, 3))
        owners.append(np.repeat(which[~concave], size - 2))
        for polygon in np.flatnonzero(concave):
            inner = cut(positions[corners[polygon]])
            parts.append(corners[polygon][inner] if len(inner) else fan[polygon])
            owners.append(np.full(len(parts[-1]), which[polygon]))
    if not parts:
        return np.zeros((0, 3), np.int64)
    # Faces come in the order of their polygons.
    return np.concatenate(parts)[np.argsort(np.concatenate(owners), kind="stable")]


def listed_faces(order: Ints, mode: int) -> Ints:
    """Faces [F, 3] of a list, strip or fan of vertices (glTF 2.0, 3.7.2.1)."""
    if mode == TRIANGLES:
        return order[: len(order) // 3 * 3].reshape(-1, 3)
    count = max(len(order) - 2, 0)
    i = np.arange(count)
    if mode == FAN:
        return np.stack([order[i + 1], order[i + 2], np.broadcast_to(order[:1], count)], axis=1).reshape(-1, 3)
    odd = i % 2
    return np.stack([order[i], order[i + 1 + odd], order[i + 2 - odd]], axis=1).reshape(-1, 3)


def _normals(points: Floats) -> Floats:
    """Newell's normals [K, 3] of polygons [K, N, 3], twice the area long."""
    moved = points - points[:, :1]
    return np.asarray(np.cross(moved, np.roll(moved, -1, axis=1)).sum(axis=1))


def _concave(points: Floats) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
    """Whether some corner of each polygon [K, N, 3] turns back."""
    normal = _normals(points)
    edge = np.roll(points, -1, axis=1) - points
    turn = np.einsum("knd,kd->kn", np.cross(edge, np.roll(edge, -1, axis=1)), normal)
    return np.asarray(turn.min(axis=1) < CONCAVE * np.einsum("kd,kd->k", normal, normal))


def cut(points: Floats, ends: Ints | None = None) -> Ints:
    """Triangles [T, 3] of one polygon [N, 3]; none if it has no area.

    Where it has holes, its outline and then each hole end before the corners `ends` [R].
    """
    outline = len(points) if ends is None else int(ends[0])
    normal = _normals(points[None, :outline])[0]
    length = float(np.linalg.norm(normal))
    if length == 0.0 or not np.isfinite(length):
        return np.zeros((0, 3), np.int64)
    normal /= length
    across = np.cross(normal, np.eye(3)[int(np.argmin(np.abs(normal)))])
    across /= np.linalg.norm(across)
    flat = (points - points[0]) @ np.stack([across, np.cross(normal, across)], axis=1)
    rings = np.array([len(points)] if ends is None else ends, np.uint32)
    found = mapbox_earcut.triangulate_float64(np.ascontiguousarray(flat), rings).reshape(-1, 3).astype(np.int64)
    a, b, c = (flat[found[:, corner]] for corner in range(3))
    area = (b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]
    return np.asarray(np.where((area < 0.0)[:, None], found[:, ::-1], found))
