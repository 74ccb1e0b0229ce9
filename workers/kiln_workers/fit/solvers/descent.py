"""Gradient descent on all parameters of each texel, as Currius et al. 2020, section 7, compare with.

The loss, its gradient, the parametrisation and the start are the network's; what is missing is the network. All texels
take the same number of steps, and one step looks at every texel once, so steps are epochs. The optimiser is Adam
with one cycle of the learning rate, as for the network.

With `alignment` > 0 the term of Green et al. 2006 is added, as the paper describes it ("the axes of the SGs are pushed
towards the average of adjacent texels' axes"): alignment times the mean over a texel's lobes of |u - m|^2, m the
mean of the same lobe's axes in up to four neighbours of the chart, taken from before the step and held fixed in it
(the sum over all pairs of |u_a - u_b|^2 has the same gradient but for a factor). Neither paper states its weight; the
default is the best of those tried for the error between texels (docs/design/solvers.md).
"""

from dataclasses import dataclass
from functools import partial
from typing import Final

import numpy as np
import torch
from torch import Tensor

from kiln_workers.fit.field import TexelField
from kiln_workers.fit.lobes import constrain
from kiln_workers.fit.optimizer import Moments, one_cycle
from kiln_workers.fit.solution import Lobes, OnEpoch, Solution, nobody
from kiln_workers.fit.solvers.alignment import Neighbourhood
from kiln_workers.fit.solvers.losses import texel_losses
from kiln_workers.fit.solvers.pixels import Pixels, PixelSet
from kiln_workers.fit.solvers.starts import random_start, shared_start
from kiln_workers.fit.solvers.stopwatch import Stopwatch

ALIGNMENT: Final = 0.1
EPSILON: Final = 1e-10
"""Smaller than the network's: a dark texel's gradients are tiny."""

_JITTER_STREAM: Final = 0x6A6974


@dataclass(frozen=True)
class AdamOptions:
    steps: int = 400
    rate: float = 0.05
    """Learning rate at its peak."""
    jitter: bool = False
    """Draw a direction inside each pixel, as the network's training does, instead of taking its centre."""
    alignment: float = 0.0
    trained: tuple[int, int] = (0, 7)
    """First and one past the last of a lobe's numbers that move; (4, 7) are the amplitudes."""


def adam(
    field: TexelField,
    lobes: int,
    on_epoch: OnEpoch = nobody,
    *,
    start: Tensor | None = None,
    options: AdamOptions = AdamOptions(),
) -> Solution:
    """From `start` (unconstrained parameters [T, N, 7]; the shared one by default)."""
    watch = Stopwatch(on_epoch)
    pixels = PixelSet(field)
    normals = torch.from_numpy(field.normals)
    raw = (shared_start(field, lobes) if start is None else start).clone()
    moments = Moments(raw, EPSILON)
    neighbourhood, trained = Neighbourhood(field), slice(*options.trained)
    for step in range(options.steps):
        variable = raw.detach().requires_grad_()
        constrained = constrain(variable, normals)
        now = constrained.detach()
        gradient = _gradient(now, pixels, step if options.jitter else None)
        if options.alignment > 0.0:
            gradient[..., :3] += neighbourhood.pull(now[..., :3], options.alignment)
        (by_raw,) = torch.autograd.grad(constrained, variable, gradient)
        mean, denominator, correction = moments.update(by_raw, step + 1)
        move = (mean / denominator).mul_(one_cycle(step, options.steps, options.rate) / correction)
        raw[..., trained] -= move[..., trained]
        watch.tell(step + 1, partial(_represent, raw, normals))
    return Solution(_represent(raw, normals), options.steps, watch.seconds)


def adam_random(
    field: TexelField, lobes: int, on_epoch: OnEpoch = nobody, *, options: AdamOptions = AdamOptions()
) -> Solution:
    """The same from a random start per texel."""
    return adam(field, lobes, on_epoch, start=random_start(field, lobes), options=options)


def adam_aligned(
    field: TexelField,
    lobes: int,
    on_epoch: OnEpoch = nobody,
    *,
    options: AdamOptions = AdamOptions(alignment=ALIGNMENT),
) -> Solution:
    """The same from the shared start with the alignment term."""
    return adam(field, lobes, on_epoch, options=options)


def _represent(raw: Tensor, normals: Tensor) -> Lobes:
    return Lobes(constrain(raw, normals))


def _gradient(lobes: Tensor, pixels: PixelSet, jitter_step: int | None) -> Tensor:
    """Gradient [T, N, 7] of the texels' losses by their lobes, chunk by chunk."""
    out = torch.empty_like(lobes)
    for number, texels in enumerate(pixels.chunks):
        chunk = pixels[number]
        directions, weights = _directions(chunk, jitter_step)
        part = slice(int(texels[0]), int(texels[-1]) + 1)
        out[part] = texel_losses(lobes[part], chunk.log_targets, directions, weights)[1]
    return out


def _directions(chunk: Pixels, jitter_step: int | None) -> tuple[Tensor, Tensor]:
    if jitter_step is None:
        return chunk.centres(), chunk.weights
    return chunk.jittered(np.random.default_rng([_JITTER_STREAM, jitter_step]))
