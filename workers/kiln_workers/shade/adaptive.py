"""Adaptive sampling of the path-traced reference: every tile gets as many paths as a stated noise needs.

**Noise** is the standard error of a pixel's luminance as a display shows it. A display value is taken as sqrt(Y / W) up
to white, W being the luminance that shows as white, and as 1 + ln(Y / W) / 2 beyond it, so that a standard error s of
the luminance is a noise of

    s / (2 max(sqrt(Y W), Y)),    Y at least W / 256.

0.02 is a fiftieth of the way from black to white. Blender's Cycles measures the same square root in its noise threshold
(Dammertz, Hanika, Keller and Lensch 2009, "A Hierarchical Automatic Stopping Condition for Monte Carlo Global
Illumination") but knows no white. Relative error of the luminance alone would spend most paths on what is nearly black.

**Tiles** of 8 x 8 pixels are sampled alike; a tile's noise is the root mean square of its pixels'. It needs what its
own variance asks for, or the mean of its neighbours' if that is more: a light path that is rarely found is often seen
next door first.

**Two stages, so that the choice has no bias.** A mean whose number of samples depends on the samples themselves is
biased: where the first ones happen to be dark, their variance looks small, sampling ends, and dark it stays. Letting
each of two halves decide on the other's number is not enough: bright samples still reach their own half's number by
way of the other half's (a pixel that one path in 20 finds came out 16 % too dark). So scouts find out how many paths
each tile needs and are then thrown away, and the picture's paths are others. Its mean is exactly unbiased, its halves
are independent, and what the scouts misjudge is noise alone, which is stated as it is found. Scouts are traced until a
tile has an eighth of the paths that it needs, which costs about a fifth of the picture.
"""

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from scipy import ndimage

from kiln_workers.package import colour
from kiln_workers.scene.model import Float32
from kiln_workers.shade.reference import Reference, ReferenceTracer

Floats = npt.NDArray[np.float64]
Counts = npt.NDArray[np.int64]

TILE: Final = 8
"""Pixels along a side of a tile."""

FIRST: Final = 16
"""Scouts of each pixel in the first round."""

SCOUTED: Final = 8
"""A tile is scouted until it has its needed paths over this many."""

GROWTH: Final = 4
"""A round of scouts makes at most this many times the scouts of a tile out of those that it has."""

LEAST: Final = 16
"""Paths of each pixel, both halves together, at least."""

AIM: Final = 0.85
"""Paths are planned for this part of the noise: the scouts know a tile's noise within about a tenth."""

SPARED: Final = 0.01
"""Share of the tiles that may have more noise in a picture that has reached it: rare bright paths surprise."""

DARKEST: Final = 1.0 / 256.0
"""Share of white below which luminance counts no less: a sixteenth of the display's range."""

LANES: Final = 1 << 21
"""Paths of one wavefront: bounds the memory, and progress is told after each."""


@dataclass(frozen=True)
class Progress:
    """How far the sampling is."""

    noise: float  # RMS over the picture: of the scouts so far, then of the picture as planned
    paths: int
    paths_left: int  # as the variances so far say
    seconds_left: float


@dataclass(frozen=True)
class Adaptive:
    """A picture of varying numbers of paths."""

    reference: Reference
    paths: Counts  # [H, W], both halves together
    scouts: Counts  # [H, W]
    tile_noise: Floats  # [rows, columns] of tiles, by the variances of the picture's paths
    reached: bool


@dataclass
class _Sums:
    """Sums over the paths of each pixel: those of the scouts, or of one half."""

    count: Counts  # [H, W]
    radiance: Floats  # [H, W, 3]
    square: Floats  # [H, W]: of the luminance

    @classmethod
    def empty(cls, height: int, width: int) -> "_Sums":
        return cls(np.zeros((height, width), np.int64), np.zeros((height, width, 3)), np.zeros((height, width)))

    def add(self, pixels: Counts, radiance: Float32) -> None:
        """Paths [N] of flat pixel numbers and their radiance [N, 3]; summed in their order."""
        size, luminance = self.count.size, colour.luminance(radiance.astype(np.float64))
        self.count += np.bincount(pixels, minlength=size).reshape(self.count.shape)
        self.square += np.bincount(pixels, luminance**2, size).reshape(self.count.shape)
        for channel in range(3):
            self.radiance[..., channel] += np.bincount(pixels, radiance[:, channel], size).reshape(self.count.shape)

    @property
    def picture(self) -> Floats:
        """Mean radiance [H, W, 3]."""
        return self.radiance / self.count[..., None]

    def variance(self, white: float) -> Floats:
        """Squared noise [H, W] of a picture of one path a pixel."""
        mean = colour.luminance(self.picture)
        spread = np.maximum(self.square / self.count - mean**2, 0.0) * (self.count / np.maximum(self.count - 1, 1))
        return spread * noise_of_luminance(ndimage.uniform_filter(mean, 3, mode="nearest"), white) ** 2


def noise_of_luminance(luminance: Floats, white: float) -> Floats:
    """Noise per unit of standard error at a luminance Y: 1 / (2 max(sqrt(Y W), Y)); see the module."""
    y = np.maximum(luminance, DARKEST * white)
    return np.asarray(0.5 / np.maximum(np.sqrt(y * white), y))


def measured_noise(reference: Reference, white: float) -> float:
    """The picture's noise, RMS over its pixels, from the difference of its halves alone."""
    one, other = (colour.luminance(half.astype(np.float64)) for half in reference.halves)
    smooth = ndimage.uniform_filter(0.5 * (one + other), 3, mode="nearest")
    return float(np.sqrt(np.mean((0.5 * (one - other) * noise_of_luminance(smooth, white)) ** 2)))


@dataclass
class AdaptiveSampler:
    """Samples a tracer's picture until every tile's noise is at most `noise`, or has `most` paths a pixel."""

    tracer: ReferenceTracer
    noise: float
    most: int
    seed: int = 0
    on_progress: Callable[[Progress], None] = lambda _: None
    _rates: list[float] = field(default_factory=list)  # paths a second of each wavefront
    _done: int = 0

    def run(self) -> Adaptive:
        """The picture; the same bytes for the same scene, camera, noise, bound and seed on one kind of machine."""
        scouts, white, half_paths = self._scout()
        height, width = self.tracer.size
        halves = _Sums.empty(height, width), _Sums.empty(height, width)
        noise = _root_mean(scouts.variance(white) / (2 * half_paths))
        for index, half in enumerate(halves):
            left = int(half_paths.sum()) * (1 - index)
            for paths in self._sample(half, half_paths, (index, 0)):
                self._tell(noise, int(half_paths.sum()) - paths + left)
        one, other = halves
        squares = _by_tile(0.25 * (one.variance(white) / one.count + other.variance(white) / other.count))
        total = one.count + other.count
        pictures = one.picture.astype(np.float32), other.picture.astype(np.float32)
        reached = bool((squares > self.noise**2).mean() <= SPARED)
        reference = Reference(pictures, round(float(total.mean())))
        return Adaptive(reference, total, scouts.count, np.sqrt(squares), reached)

    def _scout(self) -> tuple[_Sums, float, Counts]:
        """The scouts, white by their picture, and the paths [H, W] of each pixel that each half is to have."""
        scouts = _Sums.empty(*self.tracer.size)
        wanted, number = np.full(scouts.count.shape, FIRST, np.int64), 0
        while wanted.any():
            for _ in self._sample(scouts, wanted, (2, number)):
                pass
            white = colour.white_point(scouts.picture.astype(np.float32))
            half_paths = self._needed(scouts.variance(white))
            missing = -(-2 * half_paths // SCOUTED) - scouts.count
            wanted, number = np.clip(missing, 0, (GROWTH - 1) * scouts.count), number + 1
            noise = _root_mean(scouts.variance(white) / scouts.count)
            self._tell(noise, int(np.maximum(missing, 0).sum() + 2 * half_paths.sum()))
        return scouts, white, half_paths

    def _needed(self, variance: Floats) -> Counts:
        """Paths [H, W] of each pixel of one half, alike within a tile: both halves together reach the noise."""
        own = _by_tile(variance)
        around = ndimage.uniform_filter(own, 3, mode="nearest")
        paths = np.ceil(np.minimum(np.maximum(own, around) / (2.0 * (AIM * self.noise) ** 2), self.most))
        least, most = (max(1, bound // 2) for bound in (min(LEAST, self.most), self.most))
        return _by_pixel(np.clip(paths, least, most).astype(np.int64), variance.shape)

    def _sample(self, sums: _Sums, wanted: Counts, stream: tuple[int, int]) -> Iterator[int]:
        """Trace `wanted` [H, W] more paths of each pixel; after each wavefront, how many are done."""
        order = _tile_by_tile(wanted.shape)
        ends = np.cumsum(wanted.ravel()[order])
        total = int(ends[-1])
        for number, start in enumerate(range(0, total, LANES)):
            end = min(start + LANES, total)
            pixels = order[np.searchsorted(ends, np.arange(start, end), side="right")]
            key = np.random.SeedSequence((self.seed, *stream, number)).generate_state(1)[0]
            began = time.perf_counter()
            sums.add(pixels, self.tracer.sample(pixels, int(key)))
            self._rates.append(len(pixels) / max(time.perf_counter() - began, 1e-9))
            self._done += len(pixels)
            yield end

    def _tell(self, noise: float, left: int) -> None:
        # The first wavefront compiles the kernel: its rate counts only while there is no other.
        recent = self._rates[1:][-8:] or self._rates
        self.on_progress(Progress(noise, self._done, left, left / float(np.mean(recent))))


def _root_mean(squares: Floats) -> float:
    return float(np.sqrt(squares.mean()))


def _tile_by_tile(shape: tuple[int, ...]) -> Counts:
    """All pixel numbers [H * W], those of a tile together: rays that lie side by side are faster."""
    rows, columns = (index.ravel() for index in np.indices(shape))
    return np.lexsort((columns, rows, columns // TILE, rows // TILE))


def _by_tile(values: Floats) -> Floats:
    """Means [rows, columns] over tiles of pixels [H, W]; tiles at the right and at the bottom may be cut off."""
    rows, columns = (np.arange(0, side, TILE) for side in values.shape)
    sums = np.add.reduceat(np.add.reduceat(values, rows, axis=0), columns, axis=1)
    sizes = np.outer(
        *(np.diff(np.append(edges, side)) for edges, side in zip((rows, columns), values.shape, strict=True))
    )
    return np.asarray(sums / sizes)


def _by_pixel(values: npt.NDArray[Any], shape: tuple[int, ...]) -> npt.NDArray[Any]:
    """The tile's value at each of its pixels [H, W]."""
    return np.repeat(np.repeat(values, TILE, axis=0), TILE, axis=1)[: shape[0], : shape[1]]
