"""The octahedral map between the sphere and a square image (Meyer et al. 2010, "On Floating-point Normal Vectors").

With x, y in [-1, 1], p = (x, y, 1 - |x| - |y|), the lower half (p.z < 0) folded over the diagonals,
the direction is p / |p|. The map's area element is dw = dx dy / |p|^3 (project the octahedron's face,
whose plane lies at distance 1/sqrt(3), onto the sphere). See `kiln_schemas.conventions` for the pixel grid.
"""

from functools import lru_cache

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]


def decode(xy: Floats) -> Floats:
    """Unit directions [..., 3] of square coordinates [..., 2] in [-1, 1]."""
    x, y = xy[..., 0], xy[..., 1]
    z = 1.0 - np.abs(x) - np.abs(y)
    fold = np.maximum(-z, 0.0)
    p = np.stack([x - np.copysign(fold, x), y - np.copysign(fold, y), z], axis=-1)
    return np.asarray(p / np.linalg.norm(p, axis=-1, keepdims=True))


def encode(directions: Floats) -> Floats:
    """Square coordinates [..., 2] in [-1, 1] of directions [..., 3] (need not be normalised)."""
    p = directions / np.abs(directions).sum(axis=-1, keepdims=True)
    xy = p[..., :2]
    folded = (1.0 - np.abs(xy[..., ::-1])) * np.copysign(1.0, xy)
    return np.asarray(np.where(p[..., 2:] < 0.0, folded, xy))


def jacobian(xy: Floats) -> Floats:
    """dw / (dx dy) = 1 / |p|^3 at square coordinates [..., 2]."""
    x, y = np.abs(xy[..., 0]), np.abs(xy[..., 1])
    z = 1.0 - x - y
    # Folding maps (x, y) to (1 - y, 1 - x) in absolute value, which leaves |p| as that of the folded point.
    fold = np.maximum(-z, 0.0)
    return np.asarray(((x - fold) ** 2 + (y - fold) ** 2 + z**2) ** -1.5)


def pixel_grid(size: int, offset: tuple[float, float] = (0.5, 0.5)) -> Floats:
    """Square coordinates [R, R, 2] of each pixel at `offset` (column, row) inside it; index [row, column]."""
    columns = 2.0 * (np.arange(size) + offset[0]) / size - 1.0
    rows = 2.0 * (np.arange(size) + offset[1]) / size - 1.0
    return np.stack(np.broadcast_arrays(columns[None, :], rows[:, None]), axis=-1)


def pixel_directions(size: int) -> Floats:
    """Directions [R, R, 3] of the pixel centres."""
    return decode(pixel_grid(size))


def pixel_of(directions: Floats, size: int) -> npt.NDArray[np.int64]:
    """Row-major number [...] of the pixel of an image of `size` that each direction [..., 3] lies in."""
    column, row = np.moveaxis(np.clip((0.5 * size * (encode(directions) + 1.0)).astype(np.int64), 0, size - 1), -1, 0)
    return np.asarray(row * size + column)


def padded(values: Floats) -> Floats:
    """Images [..., R, R] with a ring around them [..., R + 2, R + 2]: the pixels that lie there on the sphere.

    Beyond an edge of the square the sphere goes on at the same edge, seen in a mirror; its four corners are one point.
    """
    rows = np.concatenate([values[..., :1, ::-1], values, values[..., -1:, ::-1]], axis=-2)
    return np.concatenate([rows[..., ::-1, :1], rows, rows[..., ::-1, -1:]], axis=-1)


@lru_cache(maxsize=8)
def pixel_solid_angles(size: int) -> Floats:
    """Exact solid angles [R, R] of the pixels in steradians (R even); they sum to 4 pi. Read-only: shared.

    Straight lines on an octahedron's face are great circles on the sphere. Split along the diagonal that the fold
    |x| + |y| = 1 takes, each half of a pixel lies in one face and is a spherical triangle abc, whose solid angle
    is 2 atan2(a.(b x c), 1 + a.b + b.c + c.a) (Van Oosterom and Strackee 1983).
    """
    edges = np.linspace(-1.0, 1.0, size + 1)
    corners = decode(np.stack(np.broadcast_arrays(edges[None, :], edges[:, None]), axis=-1))
    a, b, c, d = corners[:-1, :-1], corners[:-1, 1:], corners[1:, :-1], corners[1:, 1:]
    centre = pixel_grid(size)
    same_sign = centre[..., 0] * centre[..., 1] > 0.0
    falling = _triangle_solid_angle(a, b, c) + _triangle_solid_angle(d, b, c)
    rising = _triangle_solid_angle(b, a, d) + _triangle_solid_angle(c, a, d)
    total = np.where(same_sign, falling, rising)
    total.setflags(write=False)
    return total


def _triangle_solid_angle(a: Floats, b: Floats, c: Floats) -> Floats:
    triple = np.einsum("...i,...i->...", a, np.cross(b, c))
    cosines = sum(np.einsum("...i,...i->...", u, v) for u, v in ((a, b), (b, c), (c, a)))
    return np.asarray(2.0 * np.arctan2(np.abs(triple), 1.0 + cosines))
