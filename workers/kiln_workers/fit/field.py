"""A part of the light map in memory: texels, which of them are neighbours, and the points half-way between them.

What a solver works on that looks at more than one texel at a time. Neighbours are texels of one chart that touch along
a side: between texels of different charts nothing is interpolated. Between points are where the screen shows the
largest interpolation error: the middles of the sides between two neighbours, and the corners where four meet.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np

from kiln_workers.fit.source import Float16, Float32, Index

SIDES: Final = ((0, -1), (0, 1), (-1, 0), (1, 0))
"""(row, column) steps to the neighbours on the left, the right, above and below."""


@dataclass(frozen=True)
class BetweenPoints:
    """B points half-way between texels; lobes there are the bilinear mix of those of up to four texels."""

    corners: Index  # [B, 4] texels; a middle of a side names each of its two texels twice
    step: Index  # [B, 2] in half texels: (0, 1) middle of a side to the right, (1, 0) downwards, (1, 1) corner
    first: Index  # [B] the texel from which the step leads to the point

    def __len__(self) -> int:
        return len(self.first)

    def take(self, chosen: Index) -> "BetweenPoints":
        """Some of the points."""
        return BetweenPoints(self.corners[chosen], self.step[chosen], self.first[chosen])


@dataclass(frozen=True)
class TracedBetween:
    """Light fields traced at B of a field's between points, one pixel of each 2 x 2 block."""

    points: Index  # [B] into `TexelField.between`
    normals: Float32  # [B, 3] unit, geometric, at the point itself
    offsets: Index  # [B, 2] row and column in the block of the pixel that was traced
    images: Float16  # [B, R / 2, R / 2, 3] in scene units

    def __len__(self) -> int:
        return len(self.points)


@dataclass(frozen=True)
class TexelField:
    """T valid texels of one function."""

    images: Float16  # [T, R, R, 3] in scene units
    normals: Float32  # [T, 3] unit, geometric
    place: Index  # [T, 2] row and column in the light map
    chart: Index  # [T]
    exposure: float
    """Factor from scene radiance to the exposure-normalised radiance of loss and metrics."""
    traced: TracedBetween | None = None
    """What a solver may learn from about the points between; never what `log_mse_between` is measured against."""

    def __len__(self) -> int:
        return len(self.images)

    @property
    def image_size(self) -> int:
        """R."""
        return int(self.images.shape[1])

    @cached_property
    def neighbours(self) -> Index:
        """[T, 4]: the neighbour in each direction of SIDES, -1 where there is none."""
        return np.stack([self._beside(step) for step in SIDES], axis=1)

    @cached_property
    def between(self) -> BetweenPoints:
        """All between points, sides to the right first, then sides downwards, then corners."""
        right, down = self._beside((0, 1)), self._beside((1, 0))
        across = self._beside((1, 1))
        here = np.arange(len(self), dtype=np.int64)
        parts = []
        for step, (b, c, d) in (
            ((0, 1), (right, here, right)),
            ((1, 0), (here, down, down)),
            ((1, 1), (right, down, across)),
        ):
            whole = (b >= 0) & (c >= 0) & (d >= 0)
            corners = np.stack([here, b, c, d], axis=1)[whole]
            steps = np.broadcast_to(np.array(step, np.int64), (len(corners), 2))
            parts.append((corners, steps, here[whole]))
        corners, steps, first = (np.concatenate(values) for values in zip(*parts, strict=True))
        return BetweenPoints(corners, steps, first)

    def take(self, chosen: Index) -> "TexelField":
        """Some of the texels, without what was traced between them."""
        return TexelField(
            self.images[chosen], self.normals[chosen], self.place[chosen], self.chart[chosen], self.exposure
        )

    def _beside(self, step: tuple[int, int]) -> Index:
        """[T]: the texel of the same chart a step away, -1 where there is none."""
        if not len(self):
            return np.empty(0, np.int64)
        low = self.place.min(axis=0) - 1
        height, width = self.place.max(axis=0) - low + 2
        grid = np.full((height, width), -1, np.int64)
        row, column = (self.place - low).T
        grid[row, column] = np.arange(len(self))
        found = grid[row + step[0], column + step[1]]
        return np.where((found >= 0) & (self.chart[found] == self.chart), found, -1)
