"""A lobe texture that stays in its file: what a picture looks up is read, and nothing else.

The lobes of a light map of 4096 x 4096 texels take 4 GiB in their file and 7.5 GiB as float32. A picture of the package
looks up some hundred thousand of them.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from kiln_schemas.conventions import LAYERS_PER_LOBE, LOBE_PARAMETERS
from kiln_workers.package.half import layers_to_lobes
from kiln_workers.scene.bands import release


@dataclass(frozen=True)
class LobeFile:
    """Lobes [H, W, N, 7] by rows and columns, as a tensor gives them."""

    layers: npt.NDArray[np.float16]  # [2 N, H * W, 4], mapped from a file
    height: int
    width: int
    device: torch.device
    dtype: torch.dtype = torch.float32
    ndim: int = 4

    @property
    def shape(self) -> tuple[int, ...]:
        return self.height, self.width, len(self.layers) // LAYERS_PER_LOBE, LOBE_PARAMETERS

    def __getitem__(self, place: tuple[Tensor, Tensor]) -> Tensor:
        """Lobes [..., N, 7] at rows and columns [...]."""
        row, column = (part.cpu().numpy() for part in place)
        texel, back = np.unique(row * self.width + column, return_inverse=True)
        found = np.empty((len(self.layers), 1, len(texel), 4), np.float16)
        for layer, texels in enumerate(self.layers):
            found[layer, 0] = texels[texel]
            release(texels)
        lobes = layers_to_lobes(found)[0]
        return torch.from_numpy(lobes[back.reshape(row.shape)]).to(self.device)
