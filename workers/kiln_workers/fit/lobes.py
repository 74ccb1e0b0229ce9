"""From the network's unconstrained outputs to lobes: unit axes, bounded positive sharpness and amplitudes.

Currius et al. 2020 leave the parametrisation open; it decides whether the fit works (docs/mathematics.md, "first
experiments"): softplus amplitudes collapse to P = 0, exponentials do not. Each output is an offset, so that zero
outputs are a sensible picture: axes start on a Fibonacci sphere, folded at the texel's tangent plane into its upper
half (a reflection, so the start is continuous in the normal and no lobe is wasted below the horizon), with the
sharpness at which N such lobes cover a hemisphere evenly.
"""

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
import torch
from torch import Tensor

from kiln_schemas.conventions import FP16_MAX, LOBE_PARAMETERS

LOG_SHARPNESS: Final = (math.log(0.25), math.log(3000.0))
"""Range of log lambda: from nearly constant to one pixel of a 128 x 128 image; well inside fp16."""

LOG_AMPLITUDE: Final = (-14.0, 11.0)
"""Range of log mu in exposure-normalised radiance (the scene's mean is 0.18)."""

START_AMPLITUDE: Final = 0.05


@dataclass(frozen=True)
class LogRange:
    """A positive parameter's logarithm is middle + half tanh(offset + raw / half): between bounds, at `start` for 0."""

    low: float
    high: float
    start: float

    @property
    def middle(self) -> float:
        return (self.low + self.high) / 2.0

    @property
    def half(self) -> float:
        return (self.high - self.low) / 2.0

    @property
    def offset(self) -> float:
        return math.atanh((self.start - self.middle) / self.half)


AMPLITUDE_RANGE: Final = LogRange(*LOG_AMPLITUDE, math.log(START_AMPLITUDE))


def sharpness_range(lobes: int) -> LogRange:
    """N lobes start as sharp as N that cover a hemisphere evenly."""
    return LogRange(*LOG_SHARPNESS, math.log(max(lobes, 2)))


def fibonacci_axes(count: int) -> Tensor:
    """Unit axes [N, 3] spread evenly over the sphere (spherical Fibonacci lattice, Keinert et al. 2015)."""
    index = np.arange(count, dtype=np.float64)
    z = 1.0 - (2.0 * index + 1.0) / count
    phi = index * np.pi * (3.0 - np.sqrt(5.0))
    r = np.sqrt(1.0 - z * z)
    return torch.from_numpy(np.stack([r * np.cos(phi), r * np.sin(phi), z], axis=-1).astype(np.float32))


def amplitude_scale(factor: float) -> Tensor:
    """[7] by which lobes are multiplied so that their radiance is `factor` times as much."""
    return torch.tensor([1.0] * (LOBE_PARAMETERS - 3) + [factor] * 3)


def in_scene_units(lobes: Tensor, exposure: float, signal: bool) -> Tensor:
    """Exposure-normalised lobes [T, N, 7] as the store has radiance, amplitudes within fp16; dark without a signal."""
    scale = 1.0 / exposure if signal else 0.0
    return torch.cat([lobes[..., :4], (lobes[..., 4:] * scale).clamp(max=FP16_MAX)], dim=-1)


def constrain(raw: Tensor, normals: Tensor) -> Tensor:
    """Lobes [T, N, 7] in exposure-normalised radiance from outputs [T, N, 7] and unit normals [T, 3]."""
    count = raw.shape[1]
    axis = torch.nn.functional.normalize(start_axes(count, normals) + raw[..., :3], dim=-1, eps=1e-6)
    sharpness = _bounded_exp(raw[..., 3:4], sharpness_range(count))
    amplitude = _bounded_exp(raw[..., 4:LOBE_PARAMETERS], AMPLITUDE_RANGE)
    return torch.cat([axis, sharpness, amplitude], dim=-1)


def start_axes(count: int, normals: Tensor) -> Tensor:
    """The axes [T, N, 3] at parameters of 0: spread over the sphere, folded at the tangent plane of normals [T, 3]."""
    start = fibonacci_axes(count).to(normals.device)
    below = (normals @ start.T).clamp(max=0.0)  # [T, N]
    return start - 2.0 * below[..., None] * normals[:, None, :]


def _bounded_exp(raw: Tensor, bounds: LogRange) -> Tensor:
    """exp(start + raw) near raw = 0, saturating smoothly towards the bounds, so that no output is ever stuck."""
    return torch.exp(bounds.middle + bounds.half * torch.tanh(bounds.offset + raw / bounds.half))
