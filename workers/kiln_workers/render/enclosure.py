"""Which texels lie inside something: under a pillar that stands on their floor, in a wall that runs through it.

Such a texel's point is dark, and bilinear interpolation would spread its darkness over the visible surface beside the
solid; packaging fills it from its neighbours instead. Only a texel that no light reaches is asked, since light tells
the truth. A ray starts inside a solid if, somewhere on its way, it has left more solids than it has entered: the
winding number of its crossings, backs minus fronts, is positive there. Backs are told by the faces' orientation,
whether their material has two sides or not. A texel is enclosed if more than half of its hemisphere is inside and if,
along the surface, every ray ends and more than half are inside. A floor under a roof is not enclosed: along the floor
the way is free.
"""

from typing import Any, Final

import numpy as np
import numpy.typing as npt

from kiln_workers.render.jit import columns, dr, mi
from kiln_workers.render.paths import PathTracer
from kiln_workers.scene.model import Float32

AROUND: Final = 16
"""Rays along the surface."""

SLOPE: Final = 0.05
"""Of these rays, so that the surface's own unevenness does not end them."""

ABOVE: Final = 48
"""Rays over the hemisphere, distributed by the cosine."""

MOST_CROSSINGS: Final = 32
TEXELS_AT_ONCE: Final = 1 << 14


def enclosed(tracer: PathTracer, origin: Float32, normal: Float32) -> npt.NDArray[np.bool_]:
    """Which of T points [T, 3] off surfaces of unit normals [T, 3] lie inside something; the darkness is not asked."""
    out = np.zeros(len(origin), bool)
    rays = _local_rays()
    for first in range(0, len(origin), TEXELS_AT_ONCE):
        part = slice(first, first + TEXELS_AT_ONCE)
        count = len(origin[part])
        frame = mi.Frame3f(columns(mi.Vector3f, np.repeat(normal[part], len(rays), axis=0)))
        direction = frame.to_world(columns(mi.Vector3f, np.tile(rays, (count, 1))))
        start = columns(mi.Point3f, np.repeat(origin[part], len(rays), axis=0))
        inside, ends = _crossings(tracer, start, direction)
        inside, ends = (np.array(values).astype(bool).reshape(count, len(rays)) for values in (inside, ends))
        around, above = slice(0, AROUND), slice(AROUND, None)
        out[part] = (
            ends[:, around].all(axis=1) & (inside[:, around].mean(axis=1) > 0.5) & (inside[:, above].mean(axis=1) > 0.5)
        )
    return out


def _local_rays() -> Float32:
    """Unit directions [AROUND + ABOVE, 3] about +Z: along the surface, then a Fibonacci set over the hemisphere."""
    angle = 2.0 * np.pi * np.arange(AROUND) / AROUND
    around = np.stack([np.cos(angle), np.sin(angle), np.full(AROUND, SLOPE)], axis=1)
    around /= np.linalg.norm(around, axis=1, keepdims=True)
    square = (np.arange(ABOVE) + 0.5) / ABOVE
    turn = np.pi * (3.0 - np.sqrt(5.0)) * np.arange(ABOVE)
    above = np.stack([np.sqrt(square) * np.cos(turn), np.sqrt(square) * np.sin(turn), np.sqrt(1.0 - square)], axis=1)
    return np.concatenate([around, above]).astype(np.float32)


@dr.syntax  # type: ignore[untyped-decorator, unused-ignore]
def _crossings(tracer: PathTracer, origin: Any, direction: Any) -> tuple[Any, Any]:
    """Whether each ray starts inside a solid, and whether it meets anything at all."""
    width = dr.width(origin)
    inside, ends = dr.zeros(mi.Bool, width), dr.zeros(mi.Bool, width)
    balance, crossings = dr.zeros(mi.Int32, width), dr.zeros(mi.UInt32, width)
    at = mi.Point3f(origin)
    onwards = dr.full(mi.Bool, True, width)
    while onwards:
        si = tracer.closest(mi.Ray3f(at, direction), onwards)
        onwards &= si.is_valid()
        ends |= onwards
        balance += dr.select(onwards, dr.select(dr.dot(si.n, direction) > 0.0, 1, -1), 0)
        inside |= balance > 0
        crossings += 1
        onwards &= ~inside & (crossings < MOST_CROSSINGS)
        at = dr.select(onwards, tracer.beyond(si, direction), at)
    return inside, ends
