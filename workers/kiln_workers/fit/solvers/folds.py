"""The fold detector: by how much lobes turn between neighbouring texels of flat charts.

Currius et al. 2020, section 7, see "what looks like folds in the flat plane ... when a SG changes direction quickly
over a few pixels". On a flat chart the light field changes slowly, so a lobe that carries light and turns by a large
angle from one texel to the next is a fold. Angles are weighted by the mean of the lobe's energies above the horizon in
both texels.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
import torch
from torch import Tensor

from kiln_workers.fit.field import SIDES, TexelField
from kiln_workers.fit.metrics import LUMINANCE, Float64, horizon_weights
from kiln_workers.fit.network import pixel_centres
from kiln_workers.fit.source import Index

FOLD_DEGREES: Final = 15.0
FLAT_DEGREES: Final = 1.0
"""A chart is flat where no normal leaves the chart's mean normal by more."""
PERCENTILES: Final = (50.0, 90.0, 99.0)

_QUADRATURE: Final = 64
"""Side of the image over which a lobe's visible energy is summed."""
_TEXELS_AT_ONCE: Final = 16


@dataclass(frozen=True)
class Turns:
    """M lobes across M sides between neighbours."""

    degrees: Float64  # [M]
    energy: Float64  # [M] luminance times solid angle

    def percentile(self, percent: float) -> float:
        """The angle below which that share of the energy turns; 0 where there is nothing."""
        total = float(self.energy.sum())
        if total <= 0.0:
            return 0.0
        order = np.argsort(self.degrees, kind="stable")
        cumulative = np.cumsum(self.energy[order])
        place = int(np.searchsorted(cumulative, percent / 100.0 * total))
        return float(self.degrees[order[min(place, len(order) - 1)]])

    def share_over(self, degrees: float = FOLD_DEGREES) -> float:
        """Share of the energy that turns by more."""
        total = float(self.energy.sum())
        return float(self.energy[self.degrees > degrees].sum()) / total if total > 0.0 else 0.0

    def histogram(self, edges: Float64) -> Float64:
        """Share of the energy in each of the bins between edges [E] in degrees: [E - 1]."""
        counts = np.histogram(self.degrees, edges, weights=self.energy)[0].astype(np.float64)
        return counts / max(float(self.energy.sum()), 1e-300)


def turns(lobes: Tensor, field: TexelField) -> Turns:
    """Angles between the axes of lobe k of both texels, of lobes [T, N, 7] on the field's flat charts."""
    first, second = _flat_pairs(field)
    energy = visible_energy(lobes, field)
    axes = torch.nn.functional.normalize(lobes[..., :3].double(), dim=-1)
    a, b = axes[first], axes[second]
    # The chord keeps small angles exact, where the cosine would lose them.
    angle = 2.0 * torch.asin((0.5 * torch.linalg.norm(a - b, dim=-1)).clamp(max=1.0))
    weight = 0.5 * (energy[first] + energy[second])
    return Turns(np.rad2deg(angle.numpy()).ravel(), weight.ravel())


def visible_energy(lobes: Tensor, field: TexelField) -> Float64:
    """Luminance that each lobe sends above its texel's horizon, times solid angle [T, N]."""
    directions = pixel_centres(_QUADRATURE)
    luminance = lobes[..., 4:] @ torch.tensor(LUMINANCE)
    parts = []
    for chosen in torch.split(torch.arange(len(lobes)), _TEXELS_AT_ONCE):
        some = lobes[chosen]
        weights = horizon_weights(torch.from_numpy(field.normals[chosen.numpy()]), _QUADRATURE)
        cosine = some[..., :3] @ directions.T  # [T, N, K]
        values = torch.exp(some[..., 3:4] * (cosine - 1.0))
        parts.append((values @ weights[..., None])[..., 0] * luminance[chosen])
    return torch.cat(parts).double().numpy()


def _flat_pairs(field: TexelField) -> tuple[Index, Index]:
    """Texels and their neighbours to the right and below, on flat charts."""
    flat = np.zeros(len(field), bool)
    for chart in np.unique(field.chart):
        inside = field.chart == chart
        normals = field.normals[inside].astype(np.float64)
        mean = normals.mean(axis=0)
        length = np.linalg.norm(mean)
        flat[inside] = length > 0.0 and (normals @ mean / length).min() > np.cos(np.deg2rad(FLAT_DEGREES))
    sides = [SIDES.index((0, 1)), SIDES.index((1, 0))]
    beside = field.neighbours[:, sides]
    first, side = np.nonzero((beside >= 0) & flat[:, None])
    return first.astype(np.int64), beside[first, side]
