"""Neighbouring texels' axes: what the aligned solvers pull towards."""

import numpy as np
import torch
from torch import Tensor

from kiln_workers.fit.field import TexelField


class Neighbourhood:
    """Who is next to whom, as index arrays for gathering."""

    def __init__(self, field: TexelField) -> None:
        beside = field.neighbours
        self._there = torch.from_numpy((beside >= 0).astype(np.float32))  # [T, 4]
        self._beside = torch.from_numpy(np.maximum(beside, 0))
        self.has_any = self._there.sum(dim=1) > 0.0  # [T]

    def pull(self, axes: Tensor, weight: float) -> Tensor:
        """Gradient [T, N, 3] of weight / N times the sum of |u - m|^2 by axes u, the neighbours' means m held fixed."""
        return (2.0 * weight / axes.shape[1]) * (axes - self.mean_axes(axes))

    def mean_axes(self, axes: Tensor) -> Tensor:
        """[T, N, 3]: the mean of the neighbours' axes [T, N, 3], not normalised; a texel's own where it has none."""
        total = (axes[self._beside] * self._there[:, :, None, None]).sum(dim=1)
        mean = total / self._there.sum(dim=1).clamp(min=1.0)[:, None, None]
        return torch.where(self.has_any[:, None, None], mean, axes)
