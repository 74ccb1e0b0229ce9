"""Per-texel L-BFGS on all parameters, run to convergence: the strongest reference for the attainable error.

The problem is not convex, so where it ends depends on where it starts. It is run from each of several starts, and each
texel keeps its best end: the shared even picture, what expectation-maximisation finds, whatever lobes are given
(another solver's, say), and random ones. It is a reference for the error at texels, not between them.
"""

from collections.abc import Sequence
from functools import partial

import torch
from torch import Tensor

from kiln_workers.fit.field import TexelField
from kiln_workers.fit.lobes import constrain
from kiln_workers.fit.solution import Lobes, OnEpoch, Solution, nobody
from kiln_workers.fit.solvers.losses import raw_losses
from kiln_workers.fit.solvers.mixture import em
from kiln_workers.fit.solvers.pixels import PixelSet
from kiln_workers.fit.solvers.quasi_newton import BatchedLbfgs, Stopping
from kiln_workers.fit.solvers.starts import random_start, shared_start, unconstrain
from kiln_workers.fit.solvers.stopwatch import Stopwatch


def lbfgs(
    field: TexelField,
    lobes: int,
    on_epoch: OnEpoch = nobody,
    *,
    mixture_start: bool = True,
    given: Sequence[Tensor] = (),
    random_starts: int = 0,
    stopping: Stopping = Stopping(),
) -> Solution:
    """From the shared start, EM's outcome, `given` lobes [T, N, 7] and random ones. An epoch is T evaluations."""
    watch = Stopwatch(on_epoch)
    pixels = PixelSet(field)
    normals = torch.from_numpy(field.normals)
    starts = [shared_start(field, lobes)]
    evaluations = 0
    if mixture_start:
        mixture = em(field, lobes)
        evaluations += mixture.epochs * len(field)
        starts.append(unconstrain(mixture.representation.parameters, normals))
    starts += [unconstrain(start, normals) for start in given]
    starts += [random_start(field, lobes, seed) for seed in range(random_starts)]
    best = torch.full((len(field),), torch.inf)
    raw = starts[0]
    epochs = evaluations // len(field)
    for start in starts:
        problem = BatchedLbfgs(_Evaluation(pixels, normals, lobes), start.flatten(1), stopping)
        while len(problem.active):
            problem.advance()
            if (evaluations + problem.evaluations) // len(field) > epochs:
                epochs = (evaluations + problem.evaluations) // len(field)
                better = _better(raw, best, problem)[0]
                watch.tell(epochs, partial(_represent, better, normals))
        raw, best = _better(raw, best, problem)
        evaluations += problem.evaluations
    return Solution(_represent(raw, normals), evaluations // len(field), watch.seconds)


def _represent(raw: Tensor, normals: Tensor) -> Lobes:
    return Lobes(constrain(raw, normals))


def _better(raw: Tensor, value: Tensor, problem: BatchedLbfgs) -> tuple[Tensor, Tensor]:
    """Per texel the better of parameters [T, N, 7] with values [T] and the problem's."""
    wins = problem.values < value
    points = problem.points.view_as(raw)
    return torch.where(wins[:, None, None], points, raw), torch.where(wins, problem.values, value)


class _Evaluation:
    """Loss and gradient of some texels by their flat parameters [A, 7 N]."""

    def __init__(self, pixels: PixelSet, normals: Tensor, lobes: int) -> None:
        self._pixels, self._normals, self._shape = pixels, normals, (-1, lobes, 7)

    def __call__(self, texels: Tensor, points: Tensor) -> tuple[Tensor, Tensor]:
        losses, gradients = points.new_empty(len(points)), torch.empty_like(points)
        ends = torch.tensor([int(chunk[-1]) + 1 for chunk in self._pixels.chunks])
        places = torch.searchsorted(texels, ends).tolist()  # `texels` ascend
        for number, (first, last) in enumerate(zip([0, *places], places, strict=False)):
            if first == last:
                continue
            part = slice(first, last)
            chunk, texel = self._pixels[number], texels[part]
            if len(texel) < len(chunk):
                chunk = chunk.take(texel - int(self._pixels.chunks[number][0]))
            losses[part], gradient = raw_losses(
                points[part].view(self._shape), self._normals[texel], chunk.log_targets, chunk.centres(), chunk.weights
            )
            gradients[part] = gradient.flatten(1)
        return losses, gradients
