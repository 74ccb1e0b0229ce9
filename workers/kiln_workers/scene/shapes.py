"""Parametric surfaces for the bundled examples: grids over a square that lie in a rectangle of the light map.

Every surface is the image of one rectangle, so its light-map chart is a rectangle too, which fills an atlas of 64 x 64
texels far better than any unwrapper's charts would. A full sphere is one chart by the octahedral map, a closed tube is
one chart cut open along one ring and one line.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np

from kiln_workers.scene.geometry import Floats
from kiln_workers.scene.model import Mesh
from kiln_workers.sphere.octahedral import decode

SHEET_TEXELS: Final = 64
"""Light-map texels along each side for which the examples' charts are laid out (the preset `preview`)."""
GUTTER: Final = 2
"""Texels of a chart's cell that stay empty, so that neighbouring charts have two texels between them."""
INSET: Final = 1e-3
"""Texels between a chart and its texels' outer edges: rounding must not touch the next texel."""


@dataclass(frozen=True)
class Cell:
    """A part of the light map in units of two texels of the sheet, gutter included; `turned` swaps the axes."""

    column: int
    row: int
    width: int
    height: int
    turned: bool = False

    def place(self, st: Floats) -> Floats:
        """Light-map UV of surface parameters [V, 2] in [0, 1]."""
        low = 2.0 * np.array([self.column, self.row]) + INSET
        size = 2.0 * np.array([self.width, self.height]) - GUTTER - 2.0 * INSET
        return np.asarray((low + (st[:, ::-1] if self.turned else st) * size) / SHEET_TEXELS)


Surface = Callable[[Floats], tuple[Floats, Floats]]
"""Positions and unit normals [V, 3] of parameters (s, t) [V, 2] in [0, 1]."""


def patch(name: str, surface: Surface, steps: tuple[int, int], cell: Cell, material: int) -> Mesh:
    """A surface as a grid of steps[0] by steps[1] quads, wound to agree with its normals."""
    columns, rows = steps
    s, t = np.meshgrid(np.linspace(0.0, 1.0, columns + 1), np.linspace(0.0, 1.0, rows + 1))
    st = np.stack([s.ravel(), t.ravel()], axis=1)
    positions, normals = surface(st)
    i, j = np.meshgrid(np.arange(columns), np.arange(rows))
    a = (j * (columns + 1) + i).ravel()
    b, c, d = a + 1, a + columns + 1, a + columns + 2
    # Quads are cut along the diagonal that points away from the centre, which an octahedral sphere needs at its folds.
    rising = ((i + 0.5 < columns / 2) == (j + 0.5 < rows / 2)).ravel()[:, None]
    first = np.where(rising, np.stack([a, b, c], axis=1), np.stack([a, b, d], axis=1))
    second = np.where(rising, np.stack([b, d, c], axis=1), np.stack([a, d, c], axis=1))
    faces = np.concatenate([first, second])
    corners = positions[faces]
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    inward = np.einsum("fd,fd->f", cross, normals[faces].sum(axis=1)) < 0.0
    faces[inward] = faces[inward][:, ::-1]
    faces = faces[np.linalg.norm(cross, axis=1) > 1e-12]  # at a pole, a quad is one triangle
    return Mesh(
        name=name,
        positions=positions.astype(np.float32),
        normals=normals.astype(np.float32),
        faces=faces.astype(np.int32),
        material=material,
        uv=st.astype(np.float32),
        lightmap_uv=cell.place(st).astype(np.float32),
    )


def quad(corner: Floats, side_s: Floats, side_t: Floats) -> Surface:
    """A parallelogram whose normal is side_s x side_t."""
    normal = np.cross(side_s, side_t)
    normal = normal / np.linalg.norm(normal)

    def surface(st: Floats) -> tuple[Floats, Floats]:
        return corner + st[:, :1] * side_s + st[:, 1:] * side_t, np.tile(normal, (len(st), 1))

    return surface


def sphere(centre: Floats, radius: float) -> Surface:
    """A whole sphere by the octahedral map, its pole upwards (use an even number of steps)."""

    def surface(st: Floats) -> tuple[Floats, Floats]:
        z_up = decode(2.0 * st - 1.0)
        normal = z_up[:, [1, 2, 0]]
        return centre + radius * normal, normal

    return surface


def column(foot: Floats, radius: float, height: float) -> Surface:
    """A round column, flared at both ends and closed by a low dome: a profile (r, y) of t turned about +Y."""
    shaft, dome, flare = 0.85, 0.4 * radius, 0.35 * radius

    def profile(t: Floats) -> tuple[Floats, Floats]:
        up = np.minimum(t / shaft, 1.0)
        bend = 0.5 * np.pi * np.clip((t - shaft) / (1.0 - shaft), 0.0, 1.0)
        r = (radius + flare * np.abs(2.0 * up - 1.0) ** 6) * np.cos(bend)
        return r, height * up + dome * np.sin(bend)

    def surface(st: Floats) -> tuple[Floats, Floats]:
        angle, t = 2.0 * np.pi * st[:, 0], st[:, 1]
        r, y = profile(t)
        (r_low, y_low), (r_high, y_high) = profile(t - 1e-3), profile(np.minimum(t + 1e-3, 1.0))
        around = np.stack([np.cos(angle), np.zeros_like(angle), np.sin(angle)], axis=1)
        axis = np.array([0.0, 1.0, 0.0])
        normal = (y_high - y_low)[:, None] * around - (r_high - r_low)[:, None] * axis
        return foot + r[:, None] * around + y[:, None] * axis, normal / np.linalg.norm(normal, axis=1, keepdims=True)

    return surface


Curve = Callable[[Floats], tuple[Floats, Floats]]
"""Points [S, 3] of parameters [S] in [0, 1], and vectors [S, 3] across the curve from which its frame is built."""


def tube(curve: Curve, radius: float) -> Surface:
    """A tube around a curve; s runs along it, t around it."""

    def surface(st: Floats) -> tuple[Floats, Floats]:
        centre, across = curve(st[:, 0])
        tangent = curve(st[:, 0] + 1e-4)[0] - curve(st[:, 0] - 1e-4)[0]
        tangent = tangent / np.linalg.norm(tangent, axis=1, keepdims=True)
        side = np.cross(tangent, across)
        side = side / np.linalg.norm(side, axis=1, keepdims=True)
        angle = 2.0 * np.pi * st[:, 1:]
        normal = np.cos(angle) * side + np.sin(angle) * np.cross(tangent, side)
        return centre + radius * normal, normal

    return surface


def arc(centre: Floats, radius: float, turn: float = 0.0) -> Curve:
    """A half circle standing upright, turned about +Y by `turn` radians."""
    along = np.array([np.cos(turn), 0.0, -np.sin(turn)])
    across = np.array([np.sin(turn), 0.0, np.cos(turn)])

    def curve(s: Floats) -> tuple[Floats, Floats]:
        angle = np.pi * s[:, None]
        points = centre + radius * (np.cos(angle) * along + np.sin(angle) * np.array([0.0, 1.0, 0.0]))
        return points, np.broadcast_to(across, points.shape)

    return curve


def trefoil(centre: Floats, size: float, turn: float = 0.0) -> Curve:
    """A trefoil knot standing upright, `size` metres from its centre to its outermost point, turned about +Y."""
    rotate = np.array([[np.cos(turn), 0.0, np.sin(turn)], [0.0, 1.0, 0.0], [-np.sin(turn), 0.0, np.cos(turn)]])

    def curve(s: Floats) -> tuple[Floats, Floats]:
        # The knot winds on a torus; the torus's normal is never along the knot and closes with it.
        p, q = 4.0 * np.pi * s, 6.0 * np.pi * s
        normal = np.stack([np.cos(q) * np.cos(p), np.cos(q) * np.sin(p), np.sin(q)], axis=1)
        ring = np.stack([2.0 * np.cos(p), 2.0 * np.sin(p), np.zeros_like(p)], axis=1)
        return centre + size / 3.0 * (ring + normal) @ rotate.T, normal @ rotate.T

    return curve
