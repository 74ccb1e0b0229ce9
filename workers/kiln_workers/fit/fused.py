"""The log loss of each texel and its gradient in one pass over its pixels, compiled for this machine's CPU.

The slow, obvious twin is `fit.loss.losses_by_products`; tests compare them. As products of matrices, the
loss spends most of its time on arrays [T, K, N] that are written and read again. Here PIXELS pixels at a time stay in
the first-level cache from the exponential to the gradient, and pixels of no weight are skipped.

A texel is computed by one thread, in an order that does not depend on the others: the same bytes on any number of
threads.
"""

from collections.abc import Callable
from typing import Any, Final

import numba
import numpy as np
import numpy.typing as npt
import torch
from numba import types
from numba.extending import intrinsic
from torch import Tensor

from kiln_workers.fit.machine_code import BOXES, ROWS, SINGLE, compiled
from kiln_workers.fit.source import Float32

PIXELS: Final = 64
"""Pixels at once: with 16 lobes their exponentials take 4 KiB."""

f32, i32 = np.float32, np.int32


def losses_and_gradient(
    lobes: Tensor, log_targets: Tensor, table: Tensor, index: Tensor, weights: Tensor, scale: float = 1.0
) -> tuple[Tensor, Tensor]:
    """Sum of w (log(1 + P) - log(1 + T))^2 over pixels and channels [T], and its gradient [T, N, 7] by lobes [T, N, 7].

    float32 on the CPU. Pixel k of texel t is seen in the unit direction `index` [T, K] (int32) of `table` [D, 3]; its
    log(1 + T) is `log_targets` [T, K, 3], its w is `scale` times `weights` [T, K]. Strides may be any, so what texels
    share may be expanded. The relative error is about 1e-7 of the loss and 2e-6 of the gradient.
    """
    losses = np.empty(len(lobes), f32)
    gradient = np.empty(lobes.shape, f32)
    tensors = (lobes.contiguous(), log_targets, table.contiguous(), index, weights)
    arrays: list[Any] = [tensor.detach().numpy() for tensor in tensors]
    _fill(arrays[0], arrays[1], arrays[2], arrays[3], arrays[4], f32(scale), losses, gradient)
    return torch.from_numpy(losses), torch.from_numpy(gradient)


def _inlined(function: Callable[[Any], Any]) -> Any:
    return numba.njit(inline="always")(function)


def _typed(function: Callable[[Any, Any], Any]) -> Any:
    return intrinsic(function)


@_typed
def _float_of_bits(typing: Any, bits: Any) -> Any:
    """The float32 that an int32 is in memory."""
    return types.float32(types.int32), lambda context, builder, signature, arguments: builder.bitcast(
        arguments[0], context.get_value_type(types.float32)
    )


@_typed
def _bits_of_float(typing: Any, value: Any) -> Any:
    """The int32 that a float32 is in memory."""
    return types.int32(types.float32), lambda context, builder, signature, arguments: builder.bitcast(
        arguments[0], context.get_value_type(types.int32)
    )


@_inlined
def _exp(x: Any) -> Any:
    """exp(x) to 1e-7 for x below 88: 2^n times a polynomial (Chebyshev) in [-1/2, 1/2]; no less than 2^-126."""
    y = max(x * f32(1.4426950408889634), f32(-126.0))
    n = np.floor(y + f32(0.5))
    t = y - n
    p = f32(0.00133909)
    p = p * t + f32(0.00967603)
    p = p * t + f32(0.05550357)
    p = p * t + f32(0.24022107)
    p = p * t + f32(0.69314719)
    p = p * t + f32(1.00000008)
    return p * _float_of_bits((i32(n) + i32(127)) << i32(23))


@_inlined
def _log1p(x: Any) -> Any:
    """log(1 + x) of x >= 0 to 1e-7: the exponent, and the series of 2 artanh of the mantissa in [1/sqrt 2, sqrt 2].

    What is not a number or not finite stays so.
    """
    u = f32(1.0) + x
    bits = _bits_of_float(u)
    exponent = (bits - i32(0x3F3504F3)) >> i32(23)
    t = _float_of_bits(bits - (exponent << i32(23))) - f32(1.0)
    s = t / (f32(2.0) + t)
    z = s * s
    p = f32(0.2222222222) * z + f32(0.2857142857)
    p = p * z + f32(0.4)
    p = p * z + f32(0.6666666667)
    p = p * z + f32(2.0)
    return f32(exponent) * f32(0.6931471805599453) + s * p if x < f32(np.inf) else x


@compiled(
    *(BOXES, SINGLE[:, :, :], ROWS, numba.int32[:, :], SINGLE[:, :], SINGLE),
    *(SINGLE[::1], BOXES),
)
def _fill(
    lobes: Float32,
    log_targets: Float32,
    table: Float32,
    index: npt.NDArray[np.int32],
    weights: Float32,
    scale: np.float32,
    losses: Float32,
    gradient: Float32,
) -> None:
    """Fill `losses` [T] and `gradient` [T, N, 7]; one loop over the lobes to the loss, one back."""
    texels, count, _ = lobes.shape
    pixels = weights.shape[1]
    x, y, z, w = np.empty(PIXELS, f32), np.empty(PIXELS, f32), np.empty(PIXELS, f32), np.empty(PIXELS, f32)
    target0, target1, target2 = np.empty(PIXELS, f32), np.empty(PIXELS, f32), np.empty(PIXELS, f32)
    p0, p1, p2 = np.empty(PIXELS, f32), np.empty(PIXELS, f32), np.empty(PIXELS, f32)
    values = np.empty((count, PIXELS), f32)
    sums = np.empty((count, 7), f32)
    for texel in range(texels):
        loss = f32(0.0)
        sums[:] = f32(0.0)
        for first in range(0, pixels, PIXELS):
            some = min(PIXELS, pixels - first)
            heaviest = f32(0.0)
            for i in range(some):
                w[i] = scale * weights[texel, first + i]
                heaviest = max(heaviest, w[i])
            if heaviest == f32(0.0):
                continue
            for i in range(some):
                direction = index[texel, first + i]
                x[i], y[i], z[i] = table[direction, 0], table[direction, 1], table[direction, 2]
                target0[i] = log_targets[texel, first + i, 0]
                target1[i] = log_targets[texel, first + i, 1]
                target2[i] = log_targets[texel, first + i, 2]
            for i in range(some, PIXELS):
                x[i] = y[i] = z[i] = w[i] = target0[i] = target1[i] = target2[i] = f32(0.0)
            for i in range(PIXELS):
                p0[i] = p1[i] = p2[i] = f32(0.0)
            for n in range(count):
                s = lobes[texel, n, 3]
                ax, ay, az = lobes[texel, n, 0] * s, lobes[texel, n, 1] * s, lobes[texel, n, 2] * s
                mu0, mu1, mu2 = lobes[texel, n, 4], lobes[texel, n, 5], lobes[texel, n, 6]
                value = values[n]
                for i in range(PIXELS):
                    e = _exp(ax * x[i] + ay * y[i] + az * z[i] - s)
                    value[i] = e
                    p0[i] += mu0 * e
                    p1[i] += mu1 * e
                    p2[i] += mu2 * e
            for i in range(PIXELS):
                d0, d1, d2 = _log1p(p0[i]) - target0[i], _log1p(p1[i]) - target1[i], _log1p(p2[i]) - target2[i]
                loss += w[i] * (d0 * d0 + d1 * d1 + d2 * d2)
                twice = f32(2.0) * w[i]
                p0[i] = twice * d0 / (f32(1.0) + p0[i])
                p1[i] = twice * d1 / (f32(1.0) + p1[i])
                p2[i] = twice * d2 / (f32(1.0) + p2[i])
            for n in range(count):
                mu0, mu1, mu2 = lobes[texel, n, 4], lobes[texel, n, 5], lobes[texel, n, 6]
                value = values[n]
                by0 = by1 = by2 = by_x = by_y = by_z = by_s = f32(0.0)
                for i in range(PIXELS):
                    e = value[i]
                    q0, q1, q2 = p0[i] * e, p1[i] * e, p2[i] * e
                    c = mu0 * q0 + mu1 * q1 + mu2 * q2
                    by0 += q0
                    by1 += q1
                    by2 += q2
                    by_x += c * x[i]
                    by_y += c * y[i]
                    by_z += c * z[i]
                    by_s += c
                sums[n, 0] += by_x
                sums[n, 1] += by_y
                sums[n, 2] += by_z
                sums[n, 3] += by_s
                sums[n, 4] += by0
                sums[n, 5] += by1
                sums[n, 6] += by2
        losses[texel] = loss
        for n in range(count):
            s = lobes[texel, n, 3]
            along = sums[n, 0] * lobes[texel, n, 0] + sums[n, 1] * lobes[texel, n, 1] + sums[n, 2] * lobes[texel, n, 2]
            gradient[texel, n, 0] = s * sums[n, 0]
            gradient[texel, n, 1] = s * sums[n, 1]
            gradient[texel, n, 2] = s * sums[n, 2]
            gradient[texel, n, 3] = along - sums[n, 3]
            gradient[texel, n, 4] = sums[n, 4]
            gradient[texel, n, 5] = sums[n, 5]
            gradient[texel, n, 6] = sums[n, 6]
