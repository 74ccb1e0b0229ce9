"""Our own solver: gradient descent on the lobes of all texels at once, for the light field that the screen shows.

The screen shows lobes that were interpolated, so half of the loss is taken where interpolation errs most: half-way
between neighbouring texels, on bilinearly mixed lobes with normalised axes, against light fields that were traced there
(`TexelField.traced`), or the mean of the texels around where none were. Nothing in the papers does that. The other half
is the paper's log loss at the texels.

    sum over texels of loss(lobes_t) + sum over between points of loss(mean of lobes_c) + alignment(step) sum |u - m|^2

The last term is that of Green et al. 2006, which pulls each axis towards the mean m of the same lobe's axes in the
neighbours. It is strong at first, so that lobes move through the light field together, as one lobe of a chart, and
decays to almost nothing, so that it does not blur what they end as. Each step looks at a random subset of the pixels
above each horizon, one of `stride` in a row, which costs an eighth of all and serves as well.

Below a texel's horizon there is no light to fit, but a rough surface seen from the side is shaded with a kernel that
reaches there, and lobes that nothing holds draw speckles. So just below it the light field is continued as its own
mirror image in the tangent plane, with a small weight.

What the descent starts from is found by `solvers.coherent`. docs/design/fit.md has the measurements behind every
number here.
"""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from typing import Any, Final, TypeVar

import numpy as np
import torch
from torch import Tensor

from kiln_workers.fit.field import TexelField, TracedBetween
from kiln_workers.fit.fused import losses_and_gradient
from kiln_workers.fit.lobes import constrain, start_axes
from kiln_workers.fit.metrics import horizon_weights
from kiln_workers.fit.network import pixel_centres, solid_angles
from kiln_workers.fit.optimizer import one_cycle
from kiln_workers.fit.solvers.joint_steps import Moving, add_gathered, add_pull, mix, unmix
from kiln_workers.fit.solvers.losses import NORMALISATION
from kiln_workers.fit.solvers.pixels import Pixels, split, with_weight
from kiln_workers.fit.solvers.starts import unconstrain
from kiln_workers.fit.source import Float32, Index
from kiln_workers.fit.threads import single_threaded_pool
from kiln_workers.sphere import octahedral

RATE: Final = 0.1
ALIGNMENT: Final = (0.3, 0.01)
"""Weight of the alignment at the first and at the last step; it falls exponentially."""
TEXEL_PIXELS: Final = 512
"""Pixels of a texel that one step looks at, at least."""
BETWEEN_PIXELS: Final = 128
"""Pixels of a between point that one step looks at, at least."""
CONTINUATION: Final = 0.1
"""Weight of the pixels below a texel's horizon, where its light field is continued as its mirror image."""
CONTINUATION_DEPTH: Final = 0.5
"""Sine of how far below the horizon that goes."""
EPSILON: Final = 1e-10

_STREAM: Final = 0x636F68
_TEXELS: Final = 64
_POINTS: Final = 256

_Out = TypeVar("_Out")


OnStep = Callable[[int, Tensor, float], None]


def silent(step: int, raw: Tensor, loss: float) -> None:
    """Nobody listens."""


@dataclass(frozen=True)
class CoherentOptions:
    steps: int = 600
    rate: float = RATE
    alignment: tuple[float, float] = ALIGNMENT


def descend(
    field: TexelField,
    start: Tensor,
    options: CoherentOptions,
    seed: int,
    *,
    threads: int = 1,
    on_step: OnStep = silent,
) -> Tensor:
    """Lobes [T, N, 7] from exposure-normalised `start` [T, N, 7], exposure-normalised too.

    `on_step` gets the number of steps done, the parameters after them and the loss a texel that the last one began at.

    The same bytes on any number of threads: each chunk of texels is computed by one, with single-threaded kernels.
    """
    if not len(field):
        return start.clone()
    with single_threaded_pool(threads) as pool:
        descent = _Descent(field, start, options, seed, pool)
        for step in range(options.steps):
            descent.step(step)
            on_step(step + 1, descent.raw, descent.loss)
    return constrain(descent.raw, torch.from_numpy(field.normals))


@dataclass(frozen=True)
class _Part:
    """Texels or between points in a row, and the pixels that the steps look at by turns."""

    where: slice
    turns: list[Pixels]
    """Each has another one of as many pixels in a row, with that many times the weight."""

    @classmethod
    def of(cls, chosen: Index, pixels: Pixels, least: int) -> "_Part":
        stride = max(1, pixels.index.shape[1] // least)
        turns = [pixels.every(stride, first, stride) for first in range(stride)]
        return cls(slice(int(chosen[0]), int(chosen[-1]) + 1), turns)

    def turn(self, rng: np.random.Generator) -> Pixels:
        """The pixels of one step."""
        return self.turns[int(rng.integers(len(self.turns)))]


class _Descent:
    """The parameters of all texels, and what a step needs: pixels, gathered once, and running means of the gradient.

    Texels and between points are cut into parts whatever the number of threads; each part is one thread's.
    """

    def __init__(
        self, field: TexelField, start: Tensor, options: CoherentOptions, seed: int, pool: ThreadPoolExecutor
    ) -> None:
        self._options, self._seed, self._pool = options, seed, pool
        self.loss = 0.0
        """Of a texel, in the mean over all, at the lobes that the last gradient was taken at."""
        self._table = pixel_centres(field.image_size)
        normals = torch.from_numpy(field.normals)
        raw = unconstrain(start, normals).contiguous()
        self._moving = Moving.start(raw.numpy(), start_axes(raw.shape[1], normals).numpy(), EPSILON)
        texels = split(len(field), _TEXELS)
        self._texels = [
            _Part.of(part, pixels, TEXEL_PIXELS)
            for part, pixels in zip(texels, pool.map(partial(_gather_continued, field), texels), strict=True)
        ]
        targets = field.traced if field.traced is not None else mean_targets(field)
        points = split(len(targets), _POINTS)
        self._points = [
            _Part.of(part, pixels, BETWEEN_PIXELS)
            for part, pixels in zip(points, pool.map(partial(_gather_between, field, targets), points), strict=True)
        ]
        self._by_points = np.empty((len(targets), *raw.shape[1:]), np.float32)
        self._corners = np.ascontiguousarray(field.between.corners[targets.points])
        order = np.argsort(self._corners.ravel(), kind="stable")
        self._points_of = order // 4
        self._starts = np.searchsorted(self._corners.ravel()[order], np.arange(len(field) + 1))
        self._beside = np.concatenate([np.arange(len(field))[:, None], field.neighbours], axis=1)

    @property
    def raw(self) -> Tensor:
        """The parameters [T, N, 7] as they are."""
        return torch.from_numpy(self._moving.raw)

    @property
    def lobes(self) -> Tensor:
        """The lobes [T, N, 7] that the last gradient was taken at."""
        return torch.from_numpy(self._moving.lobes)

    def step(self, step: int) -> None:
        """One step from 0 on: `raw` moves."""
        options, rng = self._options, np.random.default_rng([self._seed, _STREAM, step])
        alignment = options.alignment[0] * (options.alignment[1] / options.alignment[0]) ** (step / options.steps)
        rate = one_cycle(step, options.steps, options.rate)
        gradient = self.gradient(rng, alignment)
        self._each(lambda part: self._moving.move(part.where, gradient[part.where], rate, step + 1), self._texels)

    def gradient(self, rng: np.random.Generator, alignment: float) -> Float32:
        """The gradient [T, N, 7] of the whole sum by the lobes as they are, from pixels that `rng` draws."""
        texels = [part.turn(rng) for part in self._texels]
        points = [part.turn(rng) for part in self._points]
        out = np.empty_like(self._moving.lobes)

        def learn(part: _Part, pixels: Pixels) -> float:
            losses, gradient = self._by_loss(self._moving.lobes[part.where], pixels)
            add_gathered(
                gradient, self._by_points, self._starts[part.where.start : part.where.stop + 1], self._points_of
            )
            add_pull(gradient, self._moving.lobes, self._beside[part.where], np.float32(alignment))
            out[part.where] = gradient
            return float(losses.sum(dtype=np.float64))

        self._each(lambda part: self._moving.constrain(part.where), self._texels)
        self._each(self._learn_between, self._points, points)
        self.loss = sum(self._each(learn, self._texels, texels)) / len(out)
        return out

    def _each(self, work: Callable[..., _Out], *parts: Sequence[Any]) -> list[_Out]:
        return list(self._pool.map(work, *parts))

    def _learn_between(self, part: _Part, pixels: Pixels) -> None:
        """Write the gradient of some between points by the lobes of each of their corners."""
        lobes, corners = self._moving.lobes, self._corners[part.where]
        mixed = np.empty((len(corners), *lobes.shape[1:]), np.float32)
        mix(lobes, corners, mixed)
        _, gradient = self._by_loss(mixed, pixels)
        unmix(lobes, corners, gradient)
        self._by_points[part.where] = gradient

    def _by_loss(self, lobes: Float32, pixels: Pixels) -> tuple[Float32, Float32]:
        """The log loss [M] and its gradient [M, N, 7] by lobes [M, N, 7]."""
        losses, gradient = losses_and_gradient(
            torch.from_numpy(lobes),
            *(pixels.log_targets, self._table, pixels.index, pixels.weights),
            1.0 / NORMALISATION,
        )
        return losses.numpy(), gradient.numpy()


def mean_targets(field: TexelField) -> TracedBetween:
    """What is taken for the light fields at all between points where none were traced: the mean of their corners'.

    Of those corners whose horizon a pixel's centre is above: below it an image holds nothing.
    """
    between, size = field.between, field.image_size
    half = size // 2
    images = np.empty((len(between), half, half, 3), np.float16)
    offsets = np.stack(np.divmod(np.arange(len(between)) % 4, 2), axis=1)
    centres = pixel_centres(size).numpy().reshape(size, size, 3)
    for offset in np.unique(offsets, axis=0):
        at = np.flatnonzero((offsets == offset).all(axis=1))
        directions = centres[offset[0] :: 2, offset[1] :: 2].reshape(-1, 3)
        seen = (field.normals @ directions.T > 0.0).astype(np.float32).reshape(len(field), half, half, 1)
        sparse = field.images[:, offset[0] :: 2, offset[1] :: 2]
        for part in np.array_split(at, max(1, len(at) // _POINTS)):
            corners = between.corners[part]
            weight = seen[corners]
            total = (sparse[corners].astype(np.float32) * weight).sum(axis=1)
            images[part] = (total / np.maximum(weight.sum(axis=1), 1.0)).astype(np.float16)
    normals = field.normals[between.corners].mean(axis=1)
    normals /= np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-6)
    return TracedBetween(np.arange(len(between)), normals.astype(np.float32), offsets, images)


def _gather_continued(field: TexelField, part: Index) -> Pixels:
    """The pixels of some texels above their horizon, and those just below it with the light field's mirror image."""
    size, images = field.image_size, field.images[part]
    normals = torch.from_numpy(field.normals[part])
    weights = horizon_weights(normals, size)  # [T, R * R]
    centres = pixel_centres(size)
    height = normals @ centres.T
    below = (height <= 0.0) & (height > -CONTINUATION_DEPTH)
    texel, pixel = below.nonzero(as_tuple=True)
    mirrored = centres[pixel] - 2.0 * height[texel, pixel, None] * normals[texel]
    source = octahedral.pixel_of(mirrored.numpy(), size)
    seen = weights[texel, torch.from_numpy(source)] > 0.0
    weights[texel, pixel] = CONTINUATION * seen * solid_angles(size)[pixel]
    flat = images.reshape(len(images), -1, 3).copy()
    flat[texel.numpy(), pixel.numpy()] = flat[texel.numpy(), source]
    every = torch.arange(size * size).expand(len(part), -1)
    return with_weight(size, every, weights, flat.reshape(images.shape), field.exposure, normals)


def _gather_between(field: TexelField, targets: TracedBetween, part: Index) -> Pixels:
    """The pixels of some between points that were traced and whose centre is above the horizon there."""
    size, half = field.image_size, field.image_size // 2
    normals = torch.from_numpy(targets.normals[part])
    rows = 2 * np.arange(half)[None, :, None] + targets.offsets[part, 0][:, None, None]
    columns = 2 * np.arange(half)[None, None, :] + targets.offsets[part, 1][:, None, None]
    pixel = torch.from_numpy((rows * size + columns).reshape(len(part), -1))  # [B, K] of the whole image
    weights = 4.0 * horizon_weights(normals, size).gather(1, pixel)
    return with_weight(size, pixel, weights, targets.images[part], field.exposure, normals)
