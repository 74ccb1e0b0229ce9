"""What a step of the coherent descent does besides the loss, compiled for this machine's CPU.

Lobes from parameters, mixes of four texels' lobes, and the way back of the gradient to the parameters, which then move
as Adam says. The slow, obvious twins are `fit.lobes.constrain` with autograd, `fit.solution.mixed_lobes`,
`Neighbourhood.pull` and `optimizer.Moments`; tests compare them.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np

from kiln_workers.fit.lobes import AMPLITUDE_RANGE, sharpness_range
from kiln_workers.fit.machine_code import BOXES, INDEX, INDEX_ROWS, ROWS, SINGLE, compiled
from kiln_workers.fit.optimizer import BETA_1, BETA_2
from kiln_workers.fit.source import Float32, Index

SHORTEST: Final = 1e-6
"""Length below which a mean of axes has no direction."""

f32 = np.float32


def bounds(lobes: int) -> Float32:
    """Middle, half and offset [2, 3] of the logarithms of sharpness and amplitude, as `fit.lobes.constrain` has."""
    ranges = (sharpness_range(lobes), AMPLITUDE_RANGE)
    return np.array([(one.middle, one.half, one.offset) for one in ranges], f32)


@compiled(BOXES, BOXES, ROWS, BOXES)
def constrain(raw: Float32, folded: Float32, limits: Float32, lobes: Float32) -> None:
    """Fill `lobes` [T, N, 7] from parameters [T, N, 7] and the axes' starts [T, N, 3]."""
    for texel in range(raw.shape[0]):
        for n in range(raw.shape[1]):
            x, y, z = (
                folded[texel, n, 0] + raw[texel, n, 0],
                folded[texel, n, 1] + raw[texel, n, 1],
                folded[texel, n, 2] + raw[texel, n, 2],
            )
            length = max(np.sqrt(x * x + y * y + z * z), f32(1e-6))
            lobes[texel, n, 0], lobes[texel, n, 1], lobes[texel, n, 2] = x / length, y / length, z / length
            for k in range(3, 7):
                row = 0 if k == 3 else 1
                middle, half, offset = limits[row, 0], limits[row, 1], limits[row, 2]
                lobes[texel, n, k] = np.exp(middle + half * np.tanh(offset + raw[texel, n, k] / half))


@compiled(BOXES, INDEX_ROWS, BOXES)
def mix(lobes: Float32, corners: Index, out: Float32) -> None:
    """Fill `out` [B, N, 7] with the means of lobes [T, N, 7] of texels `corners` [B, 4], axes normalised.

    An axis that vanishes becomes +Y.
    """
    for point in range(len(corners)):
        a, b, c, d = corners[point, 0], corners[point, 1], corners[point, 2], corners[point, 3]
        for n in range(lobes.shape[1]):
            for k in range(7):
                out[point, n, k] = f32(0.25) * (lobes[a, n, k] + lobes[b, n, k] + lobes[c, n, k] + lobes[d, n, k])
            x, y, z = out[point, n, 0], out[point, n, 1], out[point, n, 2]
            length = np.sqrt(x * x + y * y + z * z)
            if length > f32(SHORTEST):
                out[point, n, 0], out[point, n, 1], out[point, n, 2] = x / length, y / length, z / length
            else:
                out[point, n, 0], out[point, n, 1], out[point, n, 2] = f32(0.0), f32(1.0), f32(0.0)


@compiled(BOXES, INDEX_ROWS, BOXES)
def unmix(lobes: Float32, corners: Index, gradient: Float32) -> None:
    """Turn a gradient [B, N, 7] by what `mix` gave into that by each of the four corners' lobes, in place."""
    for point in range(len(corners)):
        a, b, c, d = corners[point, 0], corners[point, 1], corners[point, 2], corners[point, 3]
        for n in range(lobes.shape[1]):
            x = f32(0.25) * (lobes[a, n, 0] + lobes[b, n, 0] + lobes[c, n, 0] + lobes[d, n, 0])
            y = f32(0.25) * (lobes[a, n, 1] + lobes[b, n, 1] + lobes[c, n, 1] + lobes[d, n, 1])
            z = f32(0.25) * (lobes[a, n, 2] + lobes[b, n, 2] + lobes[c, n, 2] + lobes[d, n, 2])
            length = np.sqrt(x * x + y * y + z * z)
            inverse = f32(1.0) / length if length > f32(SHORTEST) else f32(0.0)
            x, y, z = x * inverse, y * inverse, z * inverse
            along = gradient[point, n, 0] * x + gradient[point, n, 1] * y + gradient[point, n, 2] * z
            gradient[point, n, 0] = (gradient[point, n, 0] - along * x) * inverse
            gradient[point, n, 1] = (gradient[point, n, 1] - along * y) * inverse
            gradient[point, n, 2] = (gradient[point, n, 2] - along * z) * inverse
            for k in range(7):
                gradient[point, n, k] *= f32(0.25)


@compiled(BOXES, BOXES, INDEX, INDEX)
def add_gathered(total: Float32, gradient: Float32, starts: Index, points: Index) -> None:
    """Add to `total` [M, N, 7] the gradients [B, N, 7] at points[starts[t]] ... points[starts[t + 1] - 1]."""
    for texel in range(total.shape[0]):
        for place in range(starts[texel], starts[texel + 1]):
            point = points[place]
            for n in range(total.shape[1]):
                for k in range(7):
                    total[texel, n, k] += gradient[point, n, k]


@compiled(BOXES, BOXES, INDEX_ROWS, SINGLE)
def add_pull(total: Float32, lobes: Float32, beside: Index, weight: np.float32) -> None:
    """Add to `total` [M, N, 7] the gradient of the alignment: 2 weight / N times an axis less its neighbours' mean.

    Of lobes [T, N, 7]; the first column of `beside` [M, 5] is the texel itself, the others its neighbours, -1 where
    there is none.
    """
    count = lobes.shape[1]
    factor = f32(2.0) * weight / f32(count)
    for row in range(len(beside)):
        there = f32(0.0)
        for k in range(1, 5):
            if beside[row, k] >= 0:
                there += f32(1.0)
        if there == f32(0.0):
            continue
        for n in range(count):
            for c in range(3):
                mean = f32(0.0)
                for k in range(1, 5):
                    if beside[row, k] >= 0:
                        mean += lobes[beside[row, k], n, c]
                total[row, n, c] += factor * (lobes[beside[row, 0], n, c] - mean / there)


@compiled(BOXES, BOXES, BOXES, BOXES, ROWS)
def unconstrain_gradient(gradient: Float32, raw: Float32, folded: Float32, lobes: Float32, limits: Float32) -> None:
    """Turn a gradient [T, N, 7] by lobes into that by parameters, in place."""
    for texel in range(raw.shape[0]):
        for n in range(raw.shape[1]):
            x, y, z = lobes[texel, n, 0], lobes[texel, n, 1], lobes[texel, n, 2]
            a, b, c = (
                folded[texel, n, 0] + raw[texel, n, 0],
                folded[texel, n, 1] + raw[texel, n, 1],
                folded[texel, n, 2] + raw[texel, n, 2],
            )
            length = max(np.sqrt(a * a + b * b + c * c), f32(1e-6))
            along = gradient[texel, n, 0] * x + gradient[texel, n, 1] * y + gradient[texel, n, 2] * z
            gradient[texel, n, 0] = (gradient[texel, n, 0] - along * x) / length
            gradient[texel, n, 1] = (gradient[texel, n, 1] - along * y) / length
            gradient[texel, n, 2] = (gradient[texel, n, 2] - along * z) / length
            for k in range(3, 7):
                row = 0 if k == 3 else 1
                # lobe = exp(middle + half t), t = tanh(offset + raw / half): d lobe / d raw = lobe (1 - t^2)
                t = (np.log(lobes[texel, n, k]) - limits[row, 0]) / limits[row, 1]
                gradient[texel, n, k] *= lobes[texel, n, k] * (f32(1.0) - t * t)


@compiled(BOXES, BOXES, BOXES, BOXES, SINGLE, SINGLE, SINGLE)
def adam(
    raw: Float32,
    gradient: Float32,
    mean: Float32,
    square: Float32,
    rate: np.float32,
    correction: np.float32,
    epsilon: np.float32,
) -> None:
    """One step of Adam in place on parameters and both moments [T, N, 7].

    `rate` is the learning rate over what corrects the mean's start, `correction` what corrects the square's.
    """
    for texel in range(raw.shape[0]):
        for n in range(raw.shape[1]):
            for k in range(7):
                g = gradient[texel, n, k]
                mean[texel, n, k] += f32(1.0 - BETA_1) * (g - mean[texel, n, k])
                square[texel, n, k] = f32(BETA_2) * square[texel, n, k] + f32(1.0 - BETA_2) * g * g
                raw[texel, n, k] -= rate * mean[texel, n, k] / (np.sqrt(square[texel, n, k] / correction) + epsilon)


@dataclass(frozen=True)
class Moving:
    """Parameters of all T texels [T, N, 7], what they start from, and Adam's moments."""

    raw: Float32
    folded: Float32
    """[T, N, 3]: axes at parameters of 0."""
    lobes: Float32
    mean: Float32
    square: Float32
    limits: Float32
    epsilon: float

    @classmethod
    def start(cls, raw: Float32, folded: Float32, epsilon: float) -> "Moving":
        zeros = np.zeros_like(raw)
        return cls(raw, folded, np.empty_like(raw), zeros, zeros.copy(), bounds(raw.shape[1]), epsilon)

    def constrain(self, part: slice) -> None:
        """Bring the lobes of some texels up to date."""
        constrain(self.raw[part], self.folded[part], self.limits, self.lobes[part])

    def move(self, part: slice, gradient: Float32, rate: float, step: int) -> None:
        """One step against the gradient [M, N, 7] by the lobes of some texels; `step` counts from 1."""
        unconstrain_gradient(gradient, self.raw[part], self.folded[part], self.lobes[part], self.limits)
        adam(
            self.raw[part],
            gradient,
            self.mean[part],
            self.square[part],
            f32(rate / (1.0 - BETA_1**step)),
            f32(1.0 - BETA_2**step),
            f32(self.epsilon),
        )
