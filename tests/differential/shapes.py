"""Triangles of random shapes, and transforms, in NumPy."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]
Float32 = npt.NDArray[np.float32]


@dataclass(frozen=True)
class Shape:
    """Triangles as a file has them; `normals` only where the surface is meant to be smooth."""

    positions: Float32  # [V, 3]
    faces: npt.NDArray[np.int64]  # [F, 3] counter-clockwise seen from outside
    uv: Floats  # [V, 2] from which the file's sets are made
    normals: Float32 | None = None  # [V, 3]
    uv_sets: tuple[npt.NDArray[Any], ...] = ()  # [V, 2] each: floats, or uint16 for 0 ... 1
    corners: int = 0
    """Vertices of each flat piece, which nothing else uses; 0 where `uv` itself is unique."""
    colours: npt.NDArray[Any] | None = None  # [V, 3 or 4]
    strip: bool = False
    """The file has them as a strip: `faces` are those of the strip of all vertices in order."""

    @property
    def smooth(self) -> bool:
        return self.normals is not None


def quaternion(random: np.random.Generator) -> Floats:
    """A random rotation (x, y, z, w)."""
    q = random.normal(size=4)
    return np.asarray(q / np.linalg.norm(q))


def trs(translation: Floats, rotation: Floats, scale: Floats) -> Floats:
    """Matrix [4, 4] of a node: v' = translation + rotation (scale v), rotation by a quaternion (x, y, z, w)."""
    axis, w = rotation[:3], rotation[3]
    cross = np.array([[0.0, -axis[2], axis[1]], [axis[2], 0.0, -axis[0]], [-axis[1], axis[0], 0.0]])
    # Rodrigues' formula in terms of the quaternion.
    turn = np.eye(3) + 2.0 * (w * cross + cross @ cross) / (rotation @ rotation)
    out = np.eye(4)
    out[:3, :3] = turn @ np.diag(scale)
    out[:3, 3] = translation
    return out


def quads(corners: Sequence[Sequence[Floats]]) -> Shape:
    """Quads of four corners each, counter-clockwise, on vertices of their own."""
    points = np.array(corners, dtype=np.float64)
    first = 4 * np.arange(len(points))[:, None, None]
    faces = (first + np.array([[0, 1, 2], [0, 2, 3]])).reshape(-1, 3)
    uv = np.tile([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]], (len(points), 1))
    return Shape(points.reshape(-1, 3).astype(np.float32), faces, uv, corners=4)


def box(half: Floats) -> Shape:
    """A box about the origin that faces outwards."""
    sides = []
    for axis in range(3):
        for sign in (1.0, -1.0):
            n, a, b = np.zeros((3, 3))
            n[axis], a[(axis + 1) % 3], b[(axis + 2) % 3] = sign, sign, 1.0
            n, a, b = (v * half for v in (n, a, b))
            sides.append([n - a - b, n + a - b, n + a + b, n - a + b])
    return quads(sides)


def room(half: Floats, walls: Sequence[int] = range(6)) -> Shape:
    """The walls of a box (+X, -X, +Y, -Y, +Z, -Z) that face inwards."""
    sides = box(half).positions.astype(np.float64).reshape(6, 4, 3)[:, ::-1]
    return quads([list(sides[wall]) for wall in walls])


def ground(half: Floats) -> Shape:
    x, y, z = half
    return quads([[np.array(p) for p in ((-x, -y, -z), (-x, -y, z), (x, -y, z), (x, -y, -z))]])


def joined(first: Shape, second: Shape) -> Shape:
    return Shape(
        np.concatenate([first.positions, second.positions]),
        np.concatenate([first.faces, second.faces + len(first.positions)]),
        np.concatenate([first.uv, second.uv]),
        corners=first.corners,
    )


def panel(random: np.random.Generator) -> Shape:
    """A flat quad about the origin."""
    x, z = random.uniform(0.3, 0.9, 2)
    return quads([[np.array(p) for p in ((-x, 0, -z), (-x, 0, z), (x, 0, z), (x, 0, -z))]])


def crate(random: np.random.Generator) -> Shape:
    return box(random.uniform(0.2, 0.7, 3))


def tetrahedron(random: np.random.Generator) -> Shape:
    corners = np.array([(1.0, 1, 1), (1, -1, -1), (-1, 1, -1), (-1, -1, 1)]) * random.uniform(0.3, 0.7, 3)
    return faceted(corners, [(0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3)], random)


def faceted(corners: Floats, faces: Sequence[Sequence[int]], random: np.random.Generator) -> Shape:
    """Convex triangles about the origin on vertices of their own, turned outwards."""
    points = corners[np.array(faces)]
    inward = (
        np.einsum("fd,fd->f", np.cross(points[:, 1] - points[:, 0], points[:, 2] - points[:, 0]), points.mean(1)) < 0
    )
    points[inward] = points[inward][:, ::-1]
    positions = points.reshape(-1, 3).astype(np.float32)
    uv = random.uniform(0.0, 1.0, (len(positions), 2))
    return Shape(positions, np.arange(len(positions)).reshape(-1, 3), uv, corners=3)


def grid(random: np.random.Generator) -> Shape:
    """A wavy sheet, flat-shaded."""
    count = int(random.integers(3, 6))
    u, v = np.meshgrid(np.linspace(0.0, 1.0, count), np.linspace(0.0, 1.0, count))
    height = 0.25 * random.uniform(-1.0, 1.0, u.shape)
    points = np.stack([1.6 * (u - 0.5), height, 1.6 * (v - 0.5)], axis=-1).reshape(-1, 3)
    return Shape(points.astype(np.float32), _cells(count, count), np.stack([u, v], axis=-1).reshape(-1, 2))


def ball(random: np.random.Generator) -> Shape:
    """A sphere of 20 x 10 quads with smooth normals."""
    columns, rows, radius = 21, 11, float(random.uniform(0.3, 0.6))
    u, v = np.meshgrid(np.linspace(0.0, 1.0, columns), np.linspace(0.0, 1.0, rows))
    theta, phi = np.pi * v, 2.0 * np.pi * u
    normals = np.stack([np.sin(theta) * np.sin(phi), np.cos(theta), np.sin(theta) * np.cos(phi)], axis=-1).reshape(
        -1, 3
    )
    faces = _cells(columns, rows)
    # The poles' cells are triangles.
    corners = normals[faces].round(9)
    whole = np.array([len(np.unique(c, axis=0)) == 3 for c in corners])
    uv = np.stack([u, v], axis=-1).reshape(-1, 2)
    return Shape((radius * normals).astype(np.float32), faces[whole], uv, normals.astype(np.float32))


def ribbon(random: np.random.Generator) -> Shape:
    """A folded strip, as a strip of the file."""
    count = int(random.integers(3, 7))
    along = np.repeat(np.linspace(-0.8, 0.8, count), 2)
    across = np.tile([-0.4, 0.4], count)
    points = np.stack([along, np.repeat(random.uniform(-0.3, 0.3, count), 2), across], axis=-1)
    order = np.arange(2 * count - 2)
    odd = order % 2
    faces = np.stack([order, order + 1 + odd, order + 2 - odd], axis=1)
    uv = np.stack([np.repeat(np.linspace(0.0, 1.0, count), 2), np.tile([0.0, 1.0], count)], axis=-1)
    return Shape(points.astype(np.float32), faces, uv, strip=True)


def unique_uv(shape: Shape) -> Floats:
    """Coordinates [V, 2] in 0 ... 1 that no two places of the surface share: a cell of a grid for each flat piece."""
    if not shape.corners:
        return shape.uv
    square = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])[: shape.corners]
    count = len(shape.positions) // shape.corners
    across = int(np.ceil(np.sqrt(count)))
    cell = np.stack([np.arange(count) % across, np.arange(count) // across], axis=1)
    return np.asarray(((cell[:, None] + 0.06 + 0.88 * square) / across).reshape(-1, 2))


def _cells(columns: int, rows: int) -> npt.NDArray[np.int64]:
    """Two triangles for each cell of a grid of vertices, row by row; counter-clockwise seen along -(du x dv)."""
    first = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)).reshape(-1, 1)
    a, b, c, d = (first + step for step in (0, columns, columns + 1, 1))
    return np.concatenate([np.hstack([a, b, c]), np.hstack([a, c, d])])


OBJECTS: Final[tuple[Callable[[np.random.Generator], Shape], ...]] = (
    crate,
    crate,
    panel,
    tetrahedron,
    grid,
    ball,
    ribbon,
)
