"""Real spherical harmonics with about as many floats as the lobes take, by least squares over the visible hemisphere.

7 N floats a texel hold floor(sqrt(7 N / 3)) bands of three channels. Over half of the sphere the harmonics are not
independent, so the coefficients are held by a weak ridge. A penalty on the Laplacian, which would damp ringing, makes
the error larger (docs/design/solvers.md). The fit is in radiance; evaluation clamps at 0, as a shader would.
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

RIDGE: Final = 1e-6
"""Weight of the squared coefficients, in steradians."""


def sh(field: TexelField, lobes: int, on_epoch: OnEpoch = nobody, *, ridge: float = RIDGE) -> Solution:
    """As many bands as fit into N lobes' floats; one epoch."""
    watch = Stopwatch(on_epoch)
    bands = bands_of(lobes)
    centres = pixel_centres(field.image_size).double().numpy()
    table = torch.from_numpy(harmonics.basis(centres, bands).astype(np.float32))
    pixels = PixelSet(field)
    solved = Harmonics(torch.cat([_coefficients(pixels[number], table, ridge) for number in range(len(pixels))]))
    watch.tell(1, lambda: solved)
    return Solution(solved, 1, watch.seconds)


def bands_of(lobes: int) -> int:
    """Bands of three channels in 7 N floats."""
    return math.isqrt(LOBE_PARAMETERS * lobes // 3)


def _coefficients(pixels: Pixels, table: Tensor, ridge: float) -> Tensor:
    """Coefficients [T, L^2, 3]; the basis [R * R, L^2] at the pixels' centres."""
    values = table.index_select(0, pixels.index.flatten()).view(*pixels.index.shape, -1)  # [T, K, L^2]
    weighted = (values * pixels.weights[..., None]).transpose(1, 2)
    gram = torch.bmm(weighted, values).double() + ridge * torch.eye(table.shape[1], dtype=torch.float64)
    right = torch.bmm(weighted, pixels.targets()).double()
    solved: Tensor = torch.linalg.solve(gram, right)
    return solved.float()
