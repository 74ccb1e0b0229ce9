"""Adam (Kingma and Ba 2015) on one flat vector, and the one-cycle schedule (Smith and Topin 2019).

Written out because all of its state then is three arrays of a checkpoint, and because element-wise updates of one
vector are the same bytes on any number of threads.
"""

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Final, Self

import torch
from torch import Tensor

BETA_1: Final = 0.9
BETA_2: Final = 0.99
EPSILON: Final = 1e-8
WARM_UP: Final = 0.15
"""Fraction of the steps in which the learning rate rises."""
START: Final = 0.04
"""Learning rate at the first step, relative to the peak."""
END: Final = 1e-3
SLICE: Final = 1 << 16
"""Parameters that are updated at once: what is touched stays in a core's cache."""

Run = Callable[[Callable[[slice], None], Iterable[slice]], Iterable[None]]
"""Such as `map`, or that of a pool."""


@dataclass
class Adam:
    """Parameters and moments [P]."""

    parameters: Tensor
    mean: Tensor
    square: Tensor

    @classmethod
    def start(cls, parameters: Tensor) -> Self:
        return cls(parameters, torch.zeros_like(parameters), torch.zeros_like(parameters))

    def to(self, device: torch.device) -> Self:
        """The same on another device."""
        return type(self)(self.parameters.to(device), self.mean.to(device), self.square.to(device))

    def update(self, gradients: Sequence[Tensor], rate: float, step: int, run: Run) -> None:
        """One update in place by the sum of `gradients`, added in order; `step` counts from 1.

        `run` maps a function over slices of the vector, on any number of threads.
        """

        def update(part: slice) -> None:
            gradient = gradients[0][part].clone()
            for other in gradients[1:]:
                gradient += other[part]
            self._update(part, gradient, rate, step)

        size = self.parameters.numel()
        for _ in run(update, [slice(start, start + SLICE) for start in range(0, size, SLICE)]):
            pass

    def _update(self, part: slice, gradient: Tensor, rate: float, step: int) -> None:
        mean, square = self.mean[part], self.square[part]
        mean.lerp_(gradient, 1.0 - BETA_1)
        square.mul_(BETA_2).addcmul_(gradient, gradient, value=1.0 - BETA_2)
        denominator = (square / (1.0 - BETA_2**step)).sqrt_().add_(EPSILON)
        self.parameters[part].addcdiv_(mean, denominator, value=-rate / (1.0 - BETA_1**step))


class Moments:
    """Adam's running means of a gradient and of its square, for a solver that moves its parameters itself."""

    def __init__(self, parameters: Tensor, epsilon: float) -> None:
        self._mean, self._square = torch.zeros_like(parameters), torch.zeros_like(parameters)
        self._epsilon = epsilon

    def update(self, gradient: Tensor, step: int) -> tuple[Tensor, Tensor, float]:
        """Mean, denominator and what corrects the mean's start; the move is -rate mean / denominator / correction.

        `step` counts from 1.
        """
        self._mean.lerp_(gradient, 1.0 - BETA_1)
        self._square.mul_(BETA_2).addcmul_(gradient, gradient, value=1.0 - BETA_2)
        denominator = (self._square / (1.0 - BETA_2**step)).sqrt_().add_(self._epsilon)
        return self._mean, denominator, 1.0 - BETA_1**step


def one_cycle(step: int, steps: int, peak: float) -> float:
    """Learning rate of a step (from 0): a cosine from START * peak up to the peak and down to END * peak."""
    warm = max(1.0, WARM_UP * steps)
    if step < warm:
        low, phase = START * peak, 1.0 - step / warm
    else:
        low, phase = END * peak, (step - warm) / max(1.0, steps - warm)
    return low + (peak - low) * 0.5 * (1.0 + math.cos(math.pi * phase))
