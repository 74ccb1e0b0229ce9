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

The start is the network's output, which is coherent over the whole light map; so blocks that are solved apart from each
other, with a margin of their neighbours' texels that is dropped afterwards, agree where they meet.
docs/design/fit.md has the measurements behind every number here.
"""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Final

import numpy as np
import torch
from torch import Tensor

from kiln_schemas.settings import FitSettings
from kiln_workers.fit.field import TexelField, TracedBetween
from kiln_workers.fit.lobes import constrain
from kiln_workers.fit.metrics import horizon_weights
from kiln_workers.fit.network import pixel_centres, solid_angles
from kiln_workers.fit.optimizer import Moments, one_cycle
from kiln_workers.fit.solution import Lobes, OnEpoch, Solution, mixed_lobes, nobody
from kiln_workers.fit.solvers.alignment import Neighbourhood
from kiln_workers.fit.solvers.encoder import SETTINGS, cnn
from kiln_workers.fit.solvers.losses import texel_losses
from kiln_workers.fit.solvers.pixels import Pixels, split, with_weight
from kiln_workers.fit.solvers.starts import unconstrain
from kiln_workers.fit.solvers.stopwatch import Stopwatch
from kiln_workers.fit.source import Index
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


@dataclass(frozen=True)
class CoherentOptions:
    steps: int = 600
    rate: float = RATE
    alignment: tuple[float, float] = ALIGNMENT


def coherent(
    field: TexelField,
    lobes: int,
    on_epoch: OnEpoch = nobody,
    *,
    settings: FitSettings = SETTINGS,
    seed: int = 0,
) -> Solution:
    """The network after `settings.start_steps`, then `refine_steps` of the descent; epochs and seconds of both."""
    start_settings = settings.model_copy(update={"steps": settings.start_steps})
    trained = cnn(field, lobes, on_epoch, settings=start_settings, seed=seed)
    watch = Stopwatch(on_epoch)
    normals = torch.from_numpy(field.normals)

    def tell(step: int, raw: Tensor) -> None:
        watch.tell(trained.epochs + step, lambda: Lobes(constrain(raw, normals)))

    options = CoherentOptions(steps=settings.refine_steps)
    start = trained.representation.parameters
    found = descend(field, start, options, seed, threads=torch.get_num_threads(), on_step=tell)
    return Solution(Lobes(found), trained.epochs + options.steps, trained.seconds + watch.seconds)


def descend(
    field: TexelField,
    start: Tensor,
    options: CoherentOptions,
    seed: int,
    *,
    threads: int = 1,
    on_step: Callable[[int, Tensor], None] = lambda step, raw: None,
) -> Tensor:
    """Lobes [T, N, 7] from exposure-normalised `start` [T, N, 7]; `on_step` gets the steps done and the parameters.

    The same bytes on any number of threads: each chunk of texels is computed by one, with single-threaded kernels.
    """
    if not len(field):
        return start.clone()
    normals = torch.from_numpy(field.normals)
    with single_threaded_pool(threads) as pool:
        problem, neighbourhood = _Problem(field, pool), Neighbourhood(field)
        raw = unconstrain(start, normals)
        moments = Moments(raw, EPSILON)
        for step in range(options.steps):
            rng = np.random.default_rng([seed, _STREAM, step])
            fraction = step / options.steps
            alignment = options.alignment[0] * (options.alignment[1] / options.alignment[0]) ** fraction
            variable = raw.detach().requires_grad_()
            lobes = constrain(variable, normals)
            gradient = problem.gradient(lobes.detach(), rng)
            gradient[..., :3] += neighbourhood.pull(lobes.detach()[..., :3], alignment)
            (by_raw,) = torch.autograd.grad(lobes, variable, gradient)
            mean, denominator, correction = moments.update(by_raw, step + 1)
            raw.addcdiv_(mean, denominator, value=-one_cycle(step, options.steps, options.rate) / correction)
            on_step(step + 1, raw)
        return constrain(raw, normals)


class _Problem:
    """The loss of a field: its pixels, gathered once, and its gradient by lobes."""

    def __init__(self, field: TexelField, pool: ThreadPoolExecutor) -> None:
        self._pool = pool
        texels = split(len(field), _TEXELS)
        self._texels = list(zip(texels, pool.map(lambda part: _gather_continued(field, part), texels), strict=True))
        targets = field.traced if field.traced is not None else mean_targets(field)
        self._corners = torch.from_numpy(field.between.corners[targets.points])
        points = split(len(targets), _POINTS)
        found = pool.map(lambda part: _gather_between(field, targets, part), points)
        self._points = list(zip(points, found, strict=True))

    def gradient(self, lobes: Tensor, rng: np.random.Generator) -> Tensor:
        """[T, N, 7] of both losses by lobes [T, N, 7], from a random subset of the pixels."""
        out = torch.empty_like(lobes)
        self._add_up(out, lobes, self._texels, TEXEL_PIXELS, rng)
        if self._points:
            variable = lobes.detach().requires_grad_()
            mixed = mixed_lobes(variable, self._corners, lobes.new_full((len(self._corners), 4), 0.25))
            by_mixed = torch.empty_like(mixed)
            self._add_up(by_mixed, mixed.detach(), self._points, BETWEEN_PIXELS, rng)
            out += torch.autograd.grad(mixed, variable, by_mixed)[0]
        return out

    def _add_up(
        self,
        out: Tensor,
        lobes: Tensor,
        parts: list[tuple[Index, Pixels]],
        pixels: int,
        rng: np.random.Generator,
    ) -> None:
        """Fill `out` [M, N, 7] with the gradients by `lobes` [M, N, 7], chunk by chunk."""
        strides = [max(1, part.index.shape[1] // pixels) for _, part in parts]
        firsts = [int(rng.integers(stride)) for stride in strides]

        def work(number: int) -> None:
            (where, part), stride, first = parts[number], strides[number], firsts[number]
            chosen = part.every(stride, first)
            at = slice(int(where[0]), int(where[-1]) + 1)
            out[at] = texel_losses(lobes[at], chosen.log_targets, chosen.centres(), chosen.weights * stride)[1]

        for _ in self._pool.map(work, range(len(parts))):
            pass


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
