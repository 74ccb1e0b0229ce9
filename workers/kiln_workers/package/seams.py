"""Makes the two sides of a light-map seam agree.

A smooth surface that is cut for the light map has its cut edge twice in the map. The texels on both sides are rendered
and filtered apart from each other, so a bilinear look-up jumps where the surface does not. As in Iwanicki 2013
("Lighting Technology of The Last of Us", SIGGRAPH courses), a linear least-squares problem changes the texels near
seams as little as needed:

    minimise   sum over seam points s of (a_s . x - b_s . x)^2
             + sum over texels i of r_i (x_i - y_i)^2

where y are the values before, a_s and b_s are the bilinear weights of the seam point on its two sides, and r_i is
larger for a texel with data than for a filled one (IRRADIANCE). So it is mostly the filled texels that change: they
come to continue the surface beyond the cut. The problem is linear in the values, so one factorisation serves all
channels.

Lobes are not continued: a line through two sharpnesses soon leaves what a lobe can be, and lobes that the descent has
made sharp came out far worse than they were. Their sharpness and amplitudes are solved for as logarithms, as in the
fit, and their weights (LOBES) hold filled texels too.
docs/results/seams.md has the figures.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt
from scipy.sparse import coo_array, csc_array, diags_array
from scipy.sparse.linalg import splu

from kiln_workers.package.dilate import Fill
from kiln_workers.scene.model import Mesh, Scene

Float32 = npt.NDArray[np.float32]
Float64 = npt.NDArray[np.float64]
Int64 = npt.NDArray[np.int64]

SMOOTH: Final = 0.95
"""Cosine of the two sides' shading normals from which on an edge is a cut through a smooth surface, not a crease."""
POINTS_A_TEXEL: Final = 2
"""Seam points along one texel of the longer side of a cut edge."""
IRRADIANCE: Final = (1.0, 0.01)
"""Weights that keep a texel with data as it is, and one that the filling has made up,"""
LOBES: Final = (10.0, 1.0)
"""and those for lobes."""
FAINTEST: Final = 2.0**-24
"""The smallest number above 0 that a texture can hold; a lobe without light stays without."""
MOST_SIDES: Final = 8
"""Triangle sides of one edge that are paired; a surface has two."""


@dataclass(frozen=True)
class SeamPoints:
    """Points on cut edges, in light-map UV on either side."""

    first: Float64  # [S, 2]
    second: Float64  # [S, 2]


def seam_points(scene: Scene, resolution: int) -> SeamPoints:
    """Points along each edge that two triangles of a smooth surface share in space and not in the light map."""
    meshes = [mesh for mesh in scene.meshes if mesh.lightmap_uv is not None]
    pairs = np.zeros((0, 2), np.int64)
    if meshes:
        edge, side = _sides(meshes)
        pairs = _pairs(edge, side)
    if not len(pairs):
        return SeamPoints(np.zeros((0, 2)), np.zeros((0, 2)))
    first, second = side.uv[pairs[:, 0]], side.uv[pairs[:, 1]]  # [P, 2 ends, 2]
    length = np.maximum(*(np.linalg.norm(uv[:, 1] - uv[:, 0], axis=1) for uv in (first, second))) * resolution
    count = np.maximum(np.ceil(length * POINTS_A_TEXEL).astype(np.int64), 1)
    owner = np.repeat(np.arange(len(pairs)), count)
    number = np.arange(len(owner)) - np.repeat(np.cumsum(count) - count, count)
    along = ((number + 0.5) / count[owner])[:, None]
    at = [uv[owner, 0] * (1.0 - along) + uv[owner, 1] * along for uv in (first, second)]
    return SeamPoints(at[0], at[1])


def bilinear(points: Float64, height: int, width: int) -> tuple[Int64, Float64]:
    """Texels [S, 4] (row * width + column) and weights [S, 4] of a clamped bilinear look-up at UV points [S, 2]."""
    x, y = points[:, 0] * width - 0.5, points[:, 1] * height - 0.5
    left, top = np.floor(x).astype(np.int64), np.floor(y).astype(np.int64)
    across, down = x - left, y - top
    texels, weights = [], []
    for dy, wy in ((0, 1.0 - down), (1, down)):
        for dx, wx in ((0, 1.0 - across), (1, across)):
            texels.append(np.clip(top + dy, 0, height - 1) * width + np.clip(left + dx, 0, width - 1))
            weights.append(wy * wx)
    return np.stack(texels, axis=1), np.stack(weights, axis=1)


class Stitcher:
    """Solves for the seams of one light map; the factorisation is shared by all of its channels."""

    def __init__(self, scene: Scene, fill: Fill, weights: tuple[float, float] = IRRADIANCE) -> None:
        """`fill` says which texels [H, W] have data of their own; `texels` are those near seams, row * W + column."""
        height, width = fill.valid.shape
        self.points = seam_points(scene, max(height, width))
        sides = [bilinear(points, height, width) for points in (self.points.first, self.points.second)]
        self.texels, unknown = np.unique(np.concatenate([texels for texels, _ in sides], axis=1), return_inverse=True)
        count = len(self.texels)
        if not count:
            return
        entries = np.concatenate([sides[0][1], -sides[1][1]], axis=1)
        places = (np.repeat(np.arange(len(entries)), 8), unknown.ravel())
        self._jump = csc_array(coo_array((entries.ravel(), places), shape=(len(entries), count)))
        anchor = np.where(fill.valid.ravel()[self.texels], *weights)
        self._factors = splu(csc_array(self._jump.T @ self._jump + diags_array(anchor)))

    def stitch(self, values: Float32) -> Float32:
        """The filled map [H, W, ...] with its seams closed; texels away from seams keep their values."""
        if not len(self.texels):
            return values
        flat = values.reshape(values.shape[0] * values.shape[1], -1).copy()
        flat[self.texels] = self.solved(flat[self.texels])
        return flat.reshape(values.shape)

    def solved(self, values: Float32 | Float64) -> Float64:
        """The closed seams' values [M, C] at `texels`, from those before."""
        before = values.astype(np.float64)
        if not len(before):
            return before
        # The change d = x - y solves (J'J + diag r) d = -J'J y.
        return np.asarray(before + self._factors.solve(-(self._jump.T @ (self._jump @ before))))

    def solved_lobes(self, lobes: Float32) -> Float64:
        """The same of lobes [M, N, 7]; their axes are not of unit length."""
        values = lobes.astype(np.float64)
        values[..., 3:] = np.log(values[..., 3:] + FAINTEST)
        closed = self.solved(values.reshape(len(values), math.prod(values.shape[1:]))).reshape(values.shape)
        closed[..., 3:] = np.maximum(np.exp(closed[..., 3:]) - FAINTEST, 0.0)
        return closed

    def within(self, rows: slice, width: int) -> tuple[slice, Int64]:
        """Which of `texels` lie in some rows, and their numbers from the first of these rows on."""
        first, last = np.searchsorted(self.texels, [rows.start * width, rows.stop * width]).tolist()
        return slice(first, last), self.texels[first:last] - rows.start * width

    def jumps(self, values: Float32) -> Float64:
        """Differences [S, ...] of the map [H, W, ...] across each seam point."""
        flat = values.reshape(values.shape[0] * values.shape[1], -1)
        out = self._jump @ flat[self.texels].astype(np.float64)
        return np.asarray(out.reshape(len(out), *values.shape[2:]))


@dataclass(frozen=True)
class _Sides:
    """Every side of a triangle, ends in the order of their keys."""

    uv: Float64  # [K, 2 ends, 2]
    normal: Float64  # [K, 2 ends, 3]


def _sides(meshes: Sequence[Mesh]) -> tuple[Int64, _Sides]:
    """The geometric edge [K] of every triangle side, and the sides: equal numbers have the same end points in space."""
    offsets = np.cumsum([0] + [len(mesh.positions) for mesh in meshes])
    positions = np.concatenate([mesh.positions for mesh in meshes]).astype(np.float32) + np.float32(0.0)
    normals = np.concatenate([mesh.normals for mesh in meshes]).astype(np.float64)
    uv = np.concatenate([mesh.lightmap_uv for mesh in meshes if mesh.lightmap_uv is not None]).astype(np.float64)
    faces = np.concatenate(
        [mesh.faces.astype(np.int64) + offset for mesh, offset in zip(meshes, offsets, strict=False)]
    )
    _, place = np.unique(np.ascontiguousarray(positions).view(np.int32).reshape(-1, 3), axis=0, return_inverse=True)
    place = place.reshape(-1)
    ends = faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    swap = place[ends[:, 0]] > place[ends[:, 1]]
    ends[swap] = ends[swap][:, ::-1]
    _, edge = np.unique(place[ends], axis=0, return_inverse=True)
    return edge.reshape(-1), _Sides(uv[ends], normals[ends])


def _pairs(edge: Int64, side: _Sides) -> Int64:
    """Pairs [P, 2] of sides of one edge that lie apart in the light map and continue each other smoothly."""
    order = np.argsort(edge, kind="stable")
    count = np.bincount(edge)
    found = []
    for gap in range(1, min(int(count.max(initial=0)), MOST_SIDES)):
        at = np.arange(len(order) - gap)
        first, second = order[at], order[at + gap]
        together = edge[first] == edge[second]
        apart = np.abs(side.uv[first] - side.uv[second]).max(axis=(1, 2), initial=0.0) > 1e-6
        smooth = (np.einsum("ked,ked->ke", side.normal[first], side.normal[second]) > SMOOTH).all(axis=1)
        keep = together & apart & smooth
        found.append(np.stack([first[keep], second[keep]], axis=1))
    return np.concatenate(found) if found else np.zeros((0, 2), np.int64)
