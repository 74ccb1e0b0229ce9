"""L-BFGS (Nocedal and Wright 2006, algorithm 7.4) on many small problems at once, each with a history of its own.

One pass evaluates every problem that has not converged at its trial point. A problem whose trial satisfies Armijo's
condition takes it, extends its history and draws its next direction; the others halve their step (or go where a
parabola has its minimum) and are tried again in the next pass. So no problem waits for another's line search, and no
evaluation is thrown away. Pairs whose curvature is not positive are left out of the history.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import torch
from torch import Tensor

Evaluate = Callable[[Tensor, Tensor], tuple[Tensor, Tensor]]
"""(problems [A], points [A, D]) -> values [A] and gradients [A, D]."""

ARMIJO: Final = 1e-4
ROUNDING: Final = 2e-7
"""Relative increase of the value that counts as rounding."""
LARGEST_STEP: Final = 1.0
FIRST_STEP: Final = 0.05
"""Bounds on the largest change of any variable, in general and of a step without history."""
SHORTEST: Final = 1e-7
"""Change of every variable below which a line search gives up."""


@dataclass(frozen=True)
class Stopping:
    iterations: int = 1500
    window: int = 20
    """Iterations over which the decrease is measured."""
    tolerance: float = 1e-4
    """Relative decrease within the window below which a problem has converged."""
    floor: float = 1e-8
    """Value below which nothing is left to minimise."""


class BatchedLbfgs:
    """T problems of D variables, from the points [T, D]."""

    def __init__(self, evaluate: Evaluate, start: Tensor, stopping: Stopping, history: int = 10) -> None:
        self._evaluate, self._stopping = evaluate, stopping
        self.points = start.clone()
        every = torch.arange(len(start))
        self.values, self._gradients = evaluate(every, self.points)
        self.evaluations = len(start)
        self.active = every
        self._steps = start.new_zeros(len(start), history, start.shape[1])  # s, newest last
        self._changes = torch.zeros_like(self._steps)  # y
        self._inverse = start.new_zeros(len(start), history)  # 1 / s.y; 0 where there is no pair
        self._iterations = torch.zeros(len(start), dtype=torch.int64)
        self._earlier = self.values.clone()  # at the window's start
        self._directions = torch.empty_like(start)
        self._slopes = torch.empty_like(self.values)
        self._lengths = torch.empty_like(self.values)
        self._turn(every)

    def advance(self) -> None:
        """One pass over the active problems."""
        at = self.active
        length = self._lengths[at]
        trial = self.points[at] + length[:, None] * self._directions[at]
        value, gradient = self._evaluate(at, trial)
        self.evaluations += len(at)
        before, slope = self.values[at], self._slopes[at]
        taken = value <= before + ARMIJO * length * slope + ROUNDING * before
        self._accept(at[taken], trial[taken], value[taken], gradient[taken])
        self._shorten(at[~taken], value[~taken])
        self._retire(taken)

    def _accept(self, at: Tensor, point: Tensor, value: Tensor, gradient: Tensor) -> None:
        step, change = point - self.points[at], gradient - self._gradients[at]
        curvature = (step * change).sum(dim=1)
        useful = curvature > 1e-8 * step.norm(dim=1) * change.norm(dim=1)
        kept = at[useful]
        for held, new in ((self._steps, step), (self._changes, change), (self._inverse, 1.0 / curvature)):
            held[kept] = torch.cat([held[kept, 1:], new[useful, None]], dim=1)
        self.points[at], self.values[at], self._gradients[at] = point, value, gradient
        self._iterations[at] += 1
        self._turn(at)

    def _turn(self, at: Tensor) -> None:
        """New directions by the two-loop recursion, and the length of their first trial."""
        gradient = self._gradients[at]
        steps, changes, inverse = self._steps[at], self._changes[at], self._inverse[at]
        vector = gradient.clone()
        shares = []
        for pair in reversed(range(inverse.shape[1])):
            share = inverse[:, pair] * (steps[:, pair] * vector).sum(dim=1)
            vector -= share[:, None] * changes[:, pair]
            shares.append(share)
        square = (changes[:, -1] ** 2).sum(dim=1)
        known = inverse[:, -1] > 0.0
        scale = torch.where(known, 1.0 / (inverse[:, -1] * square).clamp(min=1e-30), 1.0)
        vector *= scale[:, None]
        for pair in range(inverse.shape[1]):
            share = inverse[:, pair] * (changes[:, pair] * vector).sum(dim=1)
            vector += (shares.pop() - share)[:, None] * steps[:, pair]
        slope = -(vector * gradient).sum(dim=1)
        downhill = slope < 0.0
        vector = torch.where(downhill[:, None], vector, gradient)
        self._slopes[at] = torch.where(downhill, slope, -(gradient**2).sum(dim=1))
        self._directions[at] = -vector
        largest = vector.abs().amax(dim=1).clamp(min=1e-30)
        tentative = FIRST_STEP / largest
        self._lengths[at] = torch.where(known & downhill, (LARGEST_STEP / largest).clamp(max=1.0), tentative)

    def _shorten(self, at: Tensor, value: Tensor) -> None:
        """Where the parabola through value and slope has its minimum, within [0.1, 0.5] of the step."""
        length, slope = self._lengths[at], self._slopes[at]
        excess = (value - self.values[at] - length * slope).clamp(min=1e-30)
        best = -slope * length**2 / (2.0 * excess)
        best = torch.where(torch.isfinite(best), best, 0.1 * length)
        self._lengths[at] = torch.maximum(torch.minimum(best, 0.5 * length), 0.1 * length)

    def _retire(self, taken: Tensor) -> None:
        """Drop the active problems that have converged or may not iterate further; start stuck ones afresh once."""
        at, stopping = self.active, self._stopping
        count = self._iterations[at]
        due = taken & (count % stopping.window == 0)
        slow = due & (self._earlier[at] - self.values[at] <= stopping.tolerance * self._earlier[at])
        self._earlier[at[due]] = self.values[at[due]]
        moves = self._lengths[at] * self._directions[at].abs().amax(dim=1)
        stuck = ~taken & (moves < SHORTEST)
        informed = (self._inverse[at] > 0.0).any(dim=1)
        again = at[stuck & informed]
        self._inverse[again] = 0.0
        self._turn(again)
        done = slow | (self.values[at] < stopping.floor)
        self.active = at[~(done | (stuck & ~informed) | (count >= stopping.iterations))]
