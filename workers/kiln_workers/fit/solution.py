"""What a solver hands back: a representation of the light fields of T texels, and how it got there.

`Lobes` are spherical Gaussians; `Harmonics` are real spherical harmonics. Both answer the two questions that a
comparison asks: what is stored at a mix of texels, as a texture fetch would give it, and what radiance that means in
given directions. Everything is exposure-normalised. A solver is a function

    solve(field: TexelField, lobes: int, on_epoch: OnEpoch = nobody) -> Solution

that calls `on_epoch` after each pass over all texels; the same field gives the same bytes.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import torch
from torch import Tensor

from kiln_workers.fit.loss import lobe_values
from kiln_workers.sphere import harmonics


class Representation(Protocol):
    """Stored parameters of T texels."""

    @property
    def parameters(self) -> Tensor:
        """[T, ...] as a texture holds them, before rounding to fp16."""
        ...

    @property
    def floats_per_texel(self) -> int: ...

    def rounded(self) -> "Representation":
        """The same, rounded to fp16 as textures are."""
        ...

    def mixed(self, corners: Tensor, weights: Tensor) -> "Representation":
        """What a bilinear fetch gives at B points: texels `corners` [B, 4] with `weights` [B, 4]."""
        ...

    def take(self, chosen: Tensor) -> "Representation":
        """Some of the texels."""
        ...

    def values(self, directions: Tensor) -> Tensor:
        """Radiance [T, K, 3] in directions [K, 3]."""
        ...


def mixed_lobes(lobes: Tensor, corners: Tensor, weights: Tensor) -> Tensor:
    """Bilinear mix [B, N, 7] of lobes [T, N, 7] of texels `corners` [B, 4] with `weights` [B, 4].

    Axes are normalised after mixing, as the shader does; one that vanishes becomes +Y.
    """
    mixed = (lobes[corners] * weights[:, :, None, None]).sum(1)
    axis = mixed[..., :3]
    length = torch.linalg.norm(axis, dim=-1, keepdim=True)
    unit = torch.where(length > 1e-6, axis / length.clamp(min=1e-6), axis.new_tensor([0.0, 1.0, 0.0]))
    return torch.cat([unit, mixed[..., 3:]], dim=-1)


@dataclass(frozen=True)
class Lobes:
    """Spherical Gaussians [T, N, 7]: unit axis, sharpness, amplitudes."""

    parameters: Tensor

    @property
    def floats_per_texel(self) -> int:
        return int(self.parameters.shape[1] * self.parameters.shape[2])

    def rounded(self) -> "Lobes":
        return Lobes(self.parameters.half().float())

    def mixed(self, corners: Tensor, weights: Tensor) -> "Lobes":
        return Lobes(mixed_lobes(self.parameters, corners, weights))

    def take(self, chosen: Tensor) -> "Lobes":
        return Lobes(self.parameters[chosen])

    def values(self, directions: Tensor) -> Tensor:
        return lobe_values(self.parameters, directions)[1]


@dataclass(frozen=True)
class Harmonics:
    """Coefficients [T, L^2, 3] of real spherical harmonics (`sphere.harmonics`); negative radiance counts as none."""

    parameters: Tensor

    @property
    def floats_per_texel(self) -> int:
        return int(self.parameters.shape[1] * self.parameters.shape[2])

    def rounded(self) -> "Harmonics":
        return Harmonics(self.parameters.half().float())

    def mixed(self, corners: Tensor, weights: Tensor) -> "Harmonics":
        return Harmonics((self.parameters[corners] * weights[:, :, None, None]).sum(1))

    def take(self, chosen: Tensor) -> "Harmonics":
        return Harmonics(self.parameters[chosen])

    def values(self, directions: Tensor) -> Tensor:
        bands = math.isqrt(self.parameters.shape[1])
        values = harmonics.basis(directions.double().numpy(), bands).astype(np.float32)
        return (torch.from_numpy(values) @ self.parameters).clamp(min=0.0)


@dataclass(frozen=True)
class Solution:
    """The outcome of a solver for a field of T texels."""

    representation: Representation
    epochs: int
    """Passes over all texels."""
    seconds: float
    """Busy seconds of one core for all texels together (processor time of the process)."""


OnEpoch = Callable[[int, Representation], None]
"""Told the number of epochs done and where the solution stands."""


def nobody(epoch: int, representation: Representation) -> None:
    """Nobody listens."""


Solver = Callable[..., Solution]
