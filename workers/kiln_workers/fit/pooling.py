"""Smaller images of a light field, for what needs no fine detail."""

from typing import Final

import numpy as np

from kiln_workers.fit.source import Float16, Float32, Index, TexelSource

LARGEST: Final = 32
"""Pixels along each side of the images that `pooled_size` ends at, unless 16 does not divide the half."""


def pooled_size(size: int) -> int:
    """The side of an image of `size` pixels after halving it while it is larger than LARGEST; a multiple of 16."""
    while size > LARGEST and size % 32 == 0:
        size //= 2
    return size


def pooled(images: Float16, size: int) -> Float16:
    """Images [T, R, R, 3] as [T, size, size, 3]: the mean of each square of pixels. `size` divides R."""
    side = images.shape[1] // size
    if side == 1:
        return images
    squares = images.reshape(len(images), size, side, size, side, 3)
    return np.asarray(squares.mean(axis=(2, 4), dtype=np.float32), np.float16)


class PooledSource:
    """A source whose images are `pooled`."""

    def __init__(self, source: TexelSource) -> None:
        self._source = source
        self.image_size = pooled_size(source.image_size)
        self.counts = source.counts

    def normals(self, tile: int) -> Float32:
        return self._source.normals(tile)

    def images(self, tile: int, texels: Index) -> Float16:
        return pooled(self._source.images(tile, texels), self.image_size)
