"""Convergence of a solver (figures 6 to 8): the error over epochs, without jitter, on a probe of the texels.

A solver tells after each pass over all texels where it stands. The error is then taken on a fixed probe of texels and
between points, at epochs that are spaced logarithmically: more would cost more than the solving. Solvers stop their
clocks while they tell.
"""

from dataclasses import dataclass, field
from typing import Final

import numpy as np
import numpy.typing as npt
import torch

from kiln_workers.compare.result import CurvePoint
from kiln_workers.compare.targets import BetweenTargets
from kiln_workers.fit.field import TexelField
from kiln_workers.fit.solution import Representation
from kiln_workers.fit.solvers.evaluate import errors_at_texels, errors_between

PROBE_TEXELS: Final = 256
PROBE_POINTS: Final = 96
SPACING: Final = 1.25
"""Ratio of the epochs at which the probe is evaluated."""

TOLERANCE: Final = 0.05


@dataclass
class Recorder:
    """Listens to a solver; call it with epoch and representation."""

    texels: TexelField
    targets: BetweenTargets | None
    points: list[CurvePoint] = field(default_factory=list)
    _next: float = 1.0

    def __call__(self, epoch: int, representation: Representation) -> None:
        if epoch < self._next:
            return
        self._next = max(epoch + 1.0, epoch * SPACING)
        self._record(epoch, representation)

    def finish(self, epoch: int, representation: Representation) -> tuple[CurvePoint, ...]:
        """The curve, its last point being the outcome."""
        if self.points and self.points[-1].epoch >= epoch:
            self.points = [point for point in self.points if point.epoch < epoch]
        self._record(epoch, representation)
        return tuple(self.points)

    def _record(self, epoch: int, representation: Representation) -> None:
        at = _spread(len(self.texels), PROBE_TEXELS)
        probe = representation.take(torch.from_numpy(at))
        error = errors_at_texels(probe, self.texels.take(at)).log_mse
        between = None
        if self.targets is not None:
            some = _spread(len(self.targets), PROBE_POINTS)
            points, images = self.targets.points.take(some), self.targets.images[some]
            normals = self.targets.normals[some]
            between = errors_between(representation, points, images, normals, self.texels.exposure).log_mse
        self.points.append(CurvePoint(epoch=epoch, log_mse=error, log_mse_between=between))


def epochs_to_tolerance(curve: tuple[CurvePoint, ...]) -> int | None:
    """First recorded epoch from which log_mse stays within TOLERANCE of its last value; None without a curve."""
    reached = None
    for point in reversed(curve):
        if point.log_mse > (1.0 + TOLERANCE) * curve[-1].log_mse:
            break
        reached = point.epoch
    return reached


def _spread(count: int, most: int) -> npt.NDArray[np.int64]:
    """Up to `most` evenly spread numbers below `count`."""
    return np.unique(np.linspace(0, count - 1, min(count, most)).astype(np.int64))
