"""The log loss of each texel by itself, with its gradient, over the pixels above its horizon.

The same sum as `fit.loss` (Currius et al. 2020, section 4), but every texel has its own directions [T, K, 3] and its
own value [T]. It is divided by 2 pi times 3 channels, so a texel's loss is its `log_mse` as docs/mathematics.md
defines it, apart from the pixels that the horizon cuts.
"""

import math
from typing import Final

import torch
from torch import Tensor

from kiln_workers.fit.fused import losses_and_gradient
from kiln_workers.fit.lobes import constrain
from kiln_workers.fit.loss import losses_by_products

NORMALISATION: Final = 2.0 * math.pi * 3.0


def texel_losses(lobes: Tensor, log_targets: Tensor, directions: Tensor, weights: Tensor) -> tuple[Tensor, Tensor]:
    """Loss [T] and its gradient [T, N, 7] by lobes [T, N, 7]; log(1 + T) and directions [T, K, 3], weights [T, K]."""
    if lobes.dtype == torch.float32 and lobes.device.type == "cpu":
        index = torch.arange(weights.numel(), dtype=torch.int32).view(weights.shape)
        return losses_and_gradient(lobes, log_targets, directions.flatten(0, 1), index, weights, 1.0 / NORMALISATION)
    return reference_texel_losses(lobes, log_targets, directions, weights)


def reference_texel_losses(
    lobes: Tensor, log_targets: Tensor, directions: Tensor, weights: Tensor
) -> tuple[Tensor, Tensor]:
    """`texel_losses` as products of matrices, in any precision and on any device."""
    return losses_by_products(lobes, log_targets, directions, weights / NORMALISATION)


def raw_losses(
    raw: Tensor, normals: Tensor, log_targets: Tensor, directions: Tensor, weights: Tensor
) -> tuple[Tensor, Tensor]:
    """The same by unconstrained parameters [T, N, 7] (`fit.lobes`) of texels with normals [T, 3]."""
    variable = raw.detach().requires_grad_()
    lobes = constrain(variable, normals)
    losses, gradient = texel_losses(lobes.detach(), log_targets, directions, weights)
    (by_raw,) = torch.autograd.grad(lobes, variable, gradient)
    return losses, by_raw
