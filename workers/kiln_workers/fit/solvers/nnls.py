"""Non-negative least squares on many small problems at once, in normal-equation form.

Minimise x.H x / 2 - c.x over x >= 0 by block principal pivoting (Kim and Park 2011, SIAM J. Sci. Comput. 33(6)):
guess which variables are positive, solve for them, exchange all that turn out wrong (x < 0, or gradient < 0 at
x = 0), until none is. Where that does not lessen the number of wrong ones for a while, only the last wrong one is
exchanged, which is finite by Murty's rule.
"""

from typing import Final

import torch
from torch import Tensor

PATIENCE: Final = 3
_TOLERANCE: Final = 1e-12


def solve_nnls(gram: Tensor, right: Tensor) -> Tensor:
    """x [B, N] of H [B, N, N] float64, positive definite, and c [B, N]."""
    batch, count = right.shape
    passive = torch.zeros(batch, count, dtype=torch.bool)
    solution = torch.zeros_like(right)
    fewest = torch.full((batch,), count + 1)
    patience = torch.full((batch,), PATIENCE)
    diagonal = torch.diagonal(gram, dim1=1, dim2=2)
    scale = _TOLERANCE * (right.abs().amax(dim=1, keepdim=True) + diagonal.amax(dim=1, keepdim=True))
    open_ = torch.arange(batch)
    while len(open_):
        free = passive[open_]
        values, gradient = _solve_free(gram[open_], right[open_], free)
        solution[open_] = values
        wrong = torch.where(free, values < 0.0, gradient < -scale[open_])
        number = wrong.sum(dim=1)
        better = number < fewest[open_]
        fewest[open_] = torch.where(better, number, fewest[open_])
        patience[open_] = torch.where(better, PATIENCE, patience[open_] - 1)
        last = count - 1 - wrong.flip(1).to(torch.int8).argmax(dim=1)
        single = torch.nn.functional.one_hot(last, count).bool()
        exchanged = torch.where((patience[open_] >= 0)[:, None], wrong, single & wrong)
        passive[open_] = free ^ exchanged
        open_ = open_[number > 0]
    return solution.clamp(min=0.0)


def _solve_free(gram: Tensor, right: Tensor, free: Tensor) -> tuple[Tensor, Tensor]:
    """The minimum [B, N] with all variables but the free ones at 0, and the gradient there."""
    both = free[:, :, None] & free[:, None, :]
    system = torch.where(both, gram, 0.0) + torch.diag_embed((~free).to(gram.dtype))
    values = torch.linalg.solve(system, torch.where(free, right, 0.0))
    values = torch.where(free, values, 0.0)
    return values, (gram @ values[..., None])[..., 0] - right
