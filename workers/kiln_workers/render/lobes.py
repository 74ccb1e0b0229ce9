"""Sums of radiance under GGX lobes: the one quadrature behind W_E, U and the prefiltered environment.

A lobe with n = v = w has D(h) with h half-way between w and the light's direction l, so cos^2 theta_h = (1 + w.l) / 2
and D(h) = alpha^2 / (pi t^2), t = ((1 + alpha^2) - (1 - alpha^2) w.l) / 2, on the hemisphere w.l > 0 (light-field
paper, eq. 6). Over that hemisphere D integrates to 4 / (1 + alpha^2). Every sum has w.l as a further weight, which
eq. 6 lacks: D ends at its hemisphere with a step, and a small sun that crosses it drew a hard line. Sources are pixels
of an octahedral grid; a lobe
is never taken narrower than the grid resolves. A lane sums its own targets in the order of the sources, so a result
depends neither on the number of threads nor on what else is computed; the lobe is evaluated on the fly, which needs no
table of kernels and takes every texel's own alpha.
"""

from typing import Any, Final

import numpy as np
import numpy.typing as npt

from kiln_workers.render.jit import column, dr, mi

Floats = npt.NDArray[np.float64]

RESOLVED: Final = 0.29
"""Smallest alpha in pixels (radians across): there the lobe is as wide as the pixel's own box (alpha^2 = p^2 / 12)."""

TARGETS: Final = 2
"""Targets a lane: they share every load of a source."""


def resolved_alpha(alpha: Any, grid: int) -> Any:
    """`alpha`, at least as wide as an octahedral grid of `grid` pixels a side resolves."""
    return np.maximum(alpha, RESOLVED * pixel_angle(grid))


def pixel_angle(grid: int) -> float:
    """Side in radians of a mean pixel of an octahedral grid."""
    return float(np.sqrt(4.0 * np.pi) / grid)


def ggx_integral(alpha: Any) -> Any:
    """Integral of D(h) over the hemisphere about n = v: 4 / (1 + alpha^2)."""
    return 4.0 / (1.0 + np.square(alpha))


@dr.syntax  # type: ignore[untyped-decorator, unused-ignore]
def lobe_sums(targets: list[Any], alpha: Any, first: Any, last: Any, axes: Any, values: list[Any]) -> list[list[Any]]:
    """sum of D(h) (w.l) value over sources first ... last - 1, for each target w and each array of values.

    targets: Vector3f a lane, each; alpha: Float a lane; first, last: UInt32 a lane; axes: Float [S * 4] directions of
    the sources, padded; values: Float [S * 4] each. Returns [target][values] Vector4f.
    """
    width = dr.width(first)
    sums = [[dr.zeros(mi.Vector4f, width) for _ in values] for _ in targets]
    square = dr.square(alpha)
    outside, inside = 0.5 * (1.0 + square), 0.5 * (1.0 - square)
    peak = square * dr.inv_pi
    source = mi.UInt32(first)
    while source < last:
        axis = dr.gather(mi.Vector4f, axes, source)
        weights = []
        for target in targets:
            across = target.x * axis.x + target.y * axis.y + target.z * axis.z
            t = outside - inside * across
            weights.append(dr.select(across > 0.0, peak * across * dr.rcp(t * t), 0.0))
        for k, array in enumerate(values):
            value = dr.gather(mi.Vector4f, array, source)
            for row, weight in zip(sums, weights, strict=True):
                row[k] = dr.fma(value, weight, row[k])
        source += 1
    return sums


def packed(values: Any) -> Any:
    """[S, 3 or 4] as a flat Dr.Jit Float [S * 4]."""
    rows = np.zeros((len(values), 4), np.float32)
    rows[:, : values.shape[1]] = values
    return column(mi.Float, rows.ravel())
