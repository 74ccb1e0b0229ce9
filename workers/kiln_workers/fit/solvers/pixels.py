"""The pixels that count: per texel those above its horizon, gathered, so that no work goes into the other half.

A solver passes over all texels many times. `PixelSet` cuts the field into chunks of texels that fit into a core's
cache, and keeps what it gathered as long as that stays within MEMORY_BYTES; beyond, a chunk is gathered again each
time.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
import torch
from torch import Tensor

from kiln_workers.fit.field import TexelField
from kiln_workers.fit.loss import jittered_directions
from kiln_workers.fit.metrics import horizon_weights
from kiln_workers.fit.network import pixel_centres
from kiln_workers.fit.source import Float16, Index

MEMORY_BYTES: Final = 256 << 20
CHUNK: Final = 32
"""Texels at once: 64 x 64 images and 16 lobes make arrays of 4 MiB."""

_BYTES_PER_PIXEL: Final = 20


@dataclass(frozen=True)
class Pixels:
    """K pixels of each of T texels; texels with fewer are filled up with pixels of weight 0."""

    size: int  # R
    index: Tensor  # [T, K] int32, into the image
    weights: Tensor  # [T, K] solid angle
    log_targets: Tensor  # [T, K, 3] log(1 + exposure-normalised radiance)
    normals: Tensor  # [T, 3]

    def __len__(self) -> int:
        return len(self.index)

    def centres(self) -> Tensor:
        """Directions [T, K, 3] of the pixels' centres."""
        return self._look_up(pixel_centres(self.size))

    def jittered(self, rng: np.random.Generator) -> tuple[Tensor, Tensor]:
        """Random directions [T, K, 3] inside the pixels, the same for all texels, and their weights [T, K].

        As in `fit.loss`: a pixel counts where both its centre and the drawn direction are above the horizon.
        """
        directions = self._look_up(jittered_directions(self.size, rng))
        above = (directions @ self.normals[:, :, None])[..., 0] > 0.0
        return directions, torch.where(above, self.weights, 0.0)

    def targets(self) -> Tensor:
        """Exposure-normalised radiance [T, K, 3]."""
        return torch.expm1(self.log_targets)

    def take(self, chosen: Tensor) -> "Pixels":
        """Some of the texels."""
        return Pixels(
            self.size, self.index[chosen], self.weights[chosen], self.log_targets[chosen], self.normals[chosen]
        )

    def every(self, stride: int, first: int, factor: float = 1.0) -> "Pixels":
        """One pixel of each `stride` in a row, from `first` on, with `factor` times the weight."""
        chosen = slice(first, None, stride)
        index, weights = self.index[:, chosen].contiguous(), factor * self.weights[:, chosen]
        return Pixels(self.size, index, weights, self.log_targets[:, chosen].contiguous(), self.normals)

    def _look_up(self, table: Tensor) -> Tensor:
        return table.index_select(0, self.index.flatten()).view(*self.index.shape, 3)


def gather(field: TexelField, chosen: Index) -> Pixels:
    """The pixels of some texels whose centre is above the horizon, in the image's order."""
    size = field.image_size
    normals = torch.from_numpy(field.normals[chosen])
    weights = horizon_weights(normals, size)  # [T, R * R]
    pixel = torch.arange(size * size).expand(len(chosen), -1)
    return with_weight(size, pixel, weights, field.images[chosen], field.exposure, normals)


def with_weight(size: int, pixel: Tensor, weights: Tensor, images: Float16, exposure: float, normals: Tensor) -> Pixels:
    """Of pixels [T, K] of images of `size` those whose weight [T, K] is not 0, in order.

    `images` [T, r, r, 3] in scene units hold these K = r * r pixels.
    """
    inside = weights > 0.0
    most = int(inside.sum(dim=1).max())
    order = torch.argsort((~inside).to(torch.int8), dim=1, stable=True)[:, :most]
    flat = torch.from_numpy(images).flatten(1, 2)
    radiance = flat.gather(1, order[..., None].expand(-1, -1, 3)).float()
    log_targets = radiance.mul_(exposure).log1p_()
    return Pixels(size, pixel.gather(1, order).to(torch.int32), weights.gather(1, order), log_targets, normals)


def split(count: int, most: int) -> list[Index]:
    """0 ... count - 1 in runs of at most `most`."""
    return [np.arange(start, min(start + most, count), dtype=np.int64) for start in range(0, count, most)]


class PixelSet:
    """The pixels of all texels of a field, chunk by chunk, in order."""

    def __init__(self, field: TexelField, chunk: int = CHUNK) -> None:
        self._field = field
        self.chunks = split(len(field), chunk)
        whole = len(field) * field.image_size**2 // 2 * _BYTES_PER_PIXEL
        self._kept: dict[int, Pixels] | None = {} if whole <= MEMORY_BYTES else None

    def __len__(self) -> int:
        return len(self.chunks)

    def __getitem__(self, chunk: int) -> Pixels:
        if self._kept is None:
            return gather(self._field, self.chunks[chunk])
        if chunk not in self._kept:
            self._kept[chunk] = gather(self._field, self.chunks[chunk])
        return self._kept[chunk]
