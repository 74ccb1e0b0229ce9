"""Where the iterative solvers begin, as unconstrained parameters [T, N, 7] of `fit.lobes`: 0 is the even picture.

Currius et al. 2020 start gradient descent as they start the network: all texels independent of each other. A start
that all texels share keeps lobe k of one texel lobe k of the next; a random one does not, and it is what their
pictures show.
"""

import math
from typing import Final

import numpy as np
import torch
from torch import Tensor

from kiln_schemas.conventions import LOBE_PARAMETERS
from kiln_workers.fit.field import TexelField
from kiln_workers.fit.lobes import AMPLITUDE_RANGE, LogRange, sharpness_range, start_axes

RANDOM_SPREAD: Final = 0.5
"""Standard deviation of log sharpness and log amplitude of a random start."""

_STREAM: Final = 0x737461
_INSIDE: Final = 0.999
"""Share of the range of a bounded parameter that `unconstrain` makes use of: at its ends the gradient is 0."""


def shared_start(field: TexelField, lobes: int) -> Tensor:
    """The same for all texels up to the fold at the tangent plane: an even cover of the visible hemisphere."""
    return torch.zeros(len(field), lobes, LOBE_PARAMETERS)


def random_start(field: TexelField, lobes: int, seed: int = 0) -> Tensor:
    """Axes uniform over the visible hemisphere, drawn for each texel from (seed, its place in the light map)."""
    raw = np.empty((len(field), lobes, LOBE_PARAMETERS), np.float32)
    for texel, (row, column) in enumerate(field.place.tolist()):
        rng = np.random.default_rng([seed, _STREAM, row, column])
        axes = rng.standard_normal((lobes, 3))
        axes /= np.linalg.norm(axes, axis=1, keepdims=True)
        normal = field.normals[texel]
        axes -= 2.0 * np.minimum(axes @ normal, 0.0)[:, None] * normal
        raw[texel, :, :3] = axes
        raw[texel, :, 3:] = RANDOM_SPREAD * rng.standard_normal((lobes, LOBE_PARAMETERS - 3))
    raw[..., :3] -= start_axes(lobes, torch.from_numpy(field.normals)).numpy()
    return torch.from_numpy(raw)


def unconstrain(lobes: Tensor, normals: Tensor) -> Tensor:
    """The parameters [T, N, 7] from which `fit.lobes.constrain` makes lobes [T, N, 7]; out of bounds are moved in."""
    count = lobes.shape[1]
    axis = lobes[..., :3] - start_axes(count, normals)
    sharpness = _raw_of(lobes[..., 3:4], sharpness_range(count))
    amplitude = _raw_of(lobes[..., 4:], AMPLITUDE_RANGE)
    return torch.cat([axis, sharpness, amplitude], dim=-1)


def _raw_of(value: Tensor, bounds: LogRange) -> Tensor:
    place = ((value.clamp(min=math.exp(bounds.low)).log() - bounds.middle) / bounds.half).clamp(-_INSIDE, _INSIDE)
    return bounds.half * (torch.atanh(place) - bounds.offset)
