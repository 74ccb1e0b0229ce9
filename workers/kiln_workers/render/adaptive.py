"""How many paths each pixel of a light-field image gets.

A few bright directions hold most of an image's noise (docs/design/render.md), and lobes follow them. So half of an
image's paths are spread evenly, and the others are shared out in proportion to the standard deviation that these show
of log(1 + exposure * radiance), which is what a fit compares: the least sum of squared errors (Neyman 1934). A pixel's
deviation is that of the eight pixels around it on the sphere. Its own paths have no say in it, so all of them are kept
without bias: a pixel that got more paths because its first ones happened to be dark, or fewer because they happened to
be bright, would be off in the mean. The price: a bright spot of one pixel alone is left with its even half.
"""

from typing import Final

import numpy as np
import numpy.typing as npt

from kiln_schemas.conventions import EXPOSURE_KEY
from kiln_workers.sphere.octahedral import padded

Floats = npt.NDArray[np.float64]
Int64 = npt.NDArray[np.int64]

LEAST_SAMPLES: Final = 8
"""Images with fewer paths a pixel have them spread evenly."""

MOST_TIMES: Final = 16
"""A pixel gets no more than this many times an image's mean paths."""

ROUNDS: Final = 4
"""How often what a pixel's bound cut off is shared out again."""


def even_samples(samples: int) -> int:
    """Of `samples` paths a pixel in the mean, how many are spread evenly."""
    return samples // 2 if samples >= LEAST_SAMPLES else samples


def more_samples(mean: Floats, variance: Floats, above: npt.NDArray[np.bool_], samples: int) -> Int64:
    """Paths [T, R, R] that pixels of T images get beyond their even ones; at most the rest of `samples` in the mean.

    `mean`, `variance` [T, R, R]: of the radiance of a path, zero where a pixel is not `above` [T, R, R] the horizon.
    An image's exposure is that of its own mean, so that no image depends on another.
    """
    even = even_samples(samples)
    count = above.sum(axis=(1, 2))
    light = mean.sum(axis=(1, 2)) / np.maximum(count, 1)
    exposure = EXPOSURE_KEY / np.maximum(light, 1e-30)[:, None, None]
    pixels = np.maximum(_around(above.astype(np.float64)), 1.0)
    deviation = np.sqrt(_around(variance) / pixels) / (1.0 / exposure + _around(mean) / pixels)
    return _in_proportion(np.where(above, deviation, 0.0), (samples - even) * count, MOST_TIMES * samples - even)


def _in_proportion(deviation: Floats, budget: Int64, most: int) -> Int64:
    """Whole numbers [T, R, R] of at most `most` in proportion to `deviation`, with sums of at most `budget` [T]."""
    out = np.zeros(deviation.shape)
    free = deviation > 0.0
    left = budget.astype(np.float64)
    for _ in range(ROUNDS):
        weight = np.where(free, deviation, 0.0)
        total = weight.sum(axis=(1, 2))
        share = weight * (left / np.maximum(total, 1e-300))[:, None, None]
        out = np.where(free, share, out)
        over = free & (share >= most)
        if not over.any():
            break
        out[over] = most
        left = np.maximum(left - most * over.sum(axis=(1, 2)), 0.0)
        free &= ~over
    return np.asarray(np.minimum(out, most), dtype=np.int64)


def _around(values: Floats) -> Floats:
    """Sums [T, R, R] over the eight pixels around each of octahedral images [T, R, R]."""
    wide = padded(values)
    rows = wide[:, :-2] + wide[:, 1:-1] + wide[:, 2:]
    return np.asarray(np.maximum(rows[..., :-2] + rows[..., 1:-1] + rows[..., 2:] - values, 0.0))
