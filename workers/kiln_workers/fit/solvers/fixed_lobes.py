"""Lobes with directions and sharpness that are the same for all texels (Pettineo 2016, "SG Series", and Baking Lab).

Directions are a Fibonacci lattice on the sphere. Sharpness as Pettineo chooses it: ln(0.65) N / (m - 1), m the least
cosine between the first axis and the half vector to another one. `fixed` finds the amplitudes per channel by
non-negative least squares in radiance over the pixels above the horizon; lobes of which little is above the horizon
are held by a weak ridge. `fixed_log` starts there and descends the log loss by Adam over the amplitudes alone, which
is how Currius et al. 2020 trained their rows with fixed directions (section 7, figure 7a).
"""

import math
from dataclasses import replace
from typing import Final

import torch
from torch import Tensor

from kiln_workers.fit.field import TexelField
from kiln_workers.fit.lobes import LOG_AMPLITUDE, fibonacci_axes
from kiln_workers.fit.solution import Lobes, OnEpoch, Solution, nobody
from kiln_workers.fit.solvers.descent import AdamOptions, adam
from kiln_workers.fit.solvers.nnls import solve_nnls
from kiln_workers.fit.solvers.pixels import Pixels, PixelSet
from kiln_workers.fit.solvers.starts import unconstrain
from kiln_workers.fit.solvers.stopwatch import Stopwatch
from kiln_workers.sphere import gaussian

PETTINEO_LOBES: Final = 12
RIDGE: Final = 1e-4
"""Weight of the squared amplitudes, relative to the lobe's squared integral over the sphere."""
LEAST_AMPLITUDE: Final = 1e-3
"""Where the descent on the log loss starts at least: from 0 an exponential does not come back."""


def fixed(field: TexelField, lobes: int, on_epoch: OnEpoch = nobody, *, ridge: float = RIDGE) -> Solution:
    """N fixed lobes; one epoch."""
    watch = Stopwatch(on_epoch)
    axes, sharpness = fibonacci_axes(lobes), pettineo_sharpness(lobes)
    pixels = PixelSet(field)
    amplitude = torch.cat([_amplitudes(pixels[number], axes, sharpness, ridge) for number in range(len(pixels))])
    constant = torch.cat([axes, torch.full((lobes, 1), sharpness)], dim=1)
    solved = Lobes(torch.cat([constant.expand(len(field), -1, -1), amplitude.float()], dim=-1))
    watch.tell(1, lambda: solved)
    return Solution(solved, 1, watch.seconds)


def fixed_12(field: TexelField, lobes: int, on_epoch: OnEpoch = nobody, *, ridge: float = RIDGE) -> Solution:
    """Pettineo's 12 lobes, whatever `lobes` says."""
    return fixed(field, PETTINEO_LOBES, on_epoch, ridge=ridge)


def fixed_log(
    field: TexelField,
    lobes: int,
    on_epoch: OnEpoch = nobody,
    *,
    options: AdamOptions = AdamOptions(steps=200, rate=0.2),
) -> Solution:
    """N fixed lobes whose amplitudes minimise the log loss; one epoch more than the descent's steps."""
    start = fixed(field, lobes)
    parameters = start.representation.parameters.clone()
    parameters[..., 4:].clamp_(min=LEAST_AMPLITUDE)
    raw = unconstrain(parameters, torch.from_numpy(field.normals))
    descent = adam(field, lobes, on_epoch, start=raw, options=replace(options, trained=(4, 7)))
    return Solution(descent.representation, descent.epochs + 1, start.seconds + descent.seconds)


def pettineo_sharpness(lobes: int) -> float:
    """Sharpness of N lobes on the sphere."""
    axes = fibonacci_axes(lobes).double()
    if lobes < 2:
        return 1.0
    half = torch.nn.functional.normalize(axes[1:] + axes[0], dim=1)
    return math.log(0.65) * lobes / (float((half @ axes[0]).min()) - 1.0)


def _amplitudes(pixels: Pixels, axes: Tensor, sharpness: float, ridge: float) -> Tensor:
    """Non-negative amplitudes [T, N, 3] float64 of a chunk's texels."""
    values = torch.exp(sharpness * (pixels.centres() @ axes.T - 1.0))  # [T, K, N]
    weighted = values * pixels.weights[..., None]
    gram = torch.bmm(weighted.transpose(1, 2), values).double()
    right = torch.bmm(weighted.transpose(1, 2), pixels.targets()).double()  # [T, N, 3]
    whole = float(gaussian.integral(2.0 * sharpness))  # type: ignore[arg-type]
    gram += ridge * whole * torch.eye(len(axes), dtype=torch.float64)
    count = len(axes)
    per_channel = solve_nnls(
        gram[:, None].expand(-1, 3, -1, -1).reshape(-1, count, count), right.transpose(1, 2).reshape(-1, count)
    )
    return per_channel.view(-1, 3, count).transpose(1, 2).clamp(max=math.exp(LOG_AMPLITUDE[1]))
