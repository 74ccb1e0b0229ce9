"""Real spherical harmonics with about as many floats as the lobes take, by least squares over the visible hemisphere.

7 N floats a texel hold floor(sqrt(7 N / 3)) bands of three channels. Over half of the sphere the harmonics are not
independent, so the coefficients are held by a weak penalty on the squared Laplacian (which also damps ringing). The
fit is in radiance; evaluation clamps at 0, as a shader would.
"""

import math
from typing import Final

import numpy as np
import torch
from torch import Tensor

from kiln_schemas.conventions import LOBE_PARAMETERS
from kiln_workers.fit.field import TexelField
from kiln_workers.fit.network import pixel_centres
from kiln_workers.fit.solution import Harmonics, OnEpoch, Solution, nobody
from kiln_workers.fit.solvers.pixels import Pixels, PixelSet
from kiln_workers.fit.solvers.stopwatch import Stopwatch
from kiln_workers.sphere import harmonics

SMOOTHNESS: Final = 1e-4
RIDGE: Final = 1e-6


def sh(field: TexelField, lobes: int, on_epoch: OnEpoch = nobody, *, smoothness: float = SMOOTHNESS) -> Solution:
    """As many bands as fit into N lobes' floats; one epoch."""
    watch = Stopwatch(on_epoch)
    bands = bands_of(lobes)
    centres = pixel_centres(field.image_size).double().numpy()
    table = torch.from_numpy(harmonics.basis(centres, bands).astype(np.float32))
    degree = torch.from_numpy(harmonics.band_of(bands)).double()
    penalty = RIDGE + smoothness * (degree * (degree + 1.0)) ** 2
    pixels = PixelSet(field)
    solved = Harmonics(torch.cat([_coefficients(pixels[number], table, penalty) for number in range(len(pixels))]))
    watch.tell(1, lambda: solved)
    return Solution(solved, 1, watch.seconds)


def bands_of(lobes: int) -> int:
    """Bands of three channels in 7 N floats."""
    return math.isqrt(LOBE_PARAMETERS * lobes // 3)


def _coefficients(pixels: Pixels, table: Tensor, penalty: Tensor) -> Tensor:
    """Coefficients [T, L^2, 3]; the basis [R * R, L^2] at the pixels' centres, the penalty [L^2]."""
    values = table.index_select(0, pixels.index.flatten()).view(*pixels.index.shape, -1)  # [T, K, L^2]
    weighted = (values * pixels.weights[..., None]).transpose(1, 2)
    gram = torch.bmm(weighted, values).double() + torch.diag(penalty)
    right = torch.bmm(weighted, pixels.targets()).double()
    solved: Tensor = torch.linalg.solve(gram, right)
    return solved.float()
