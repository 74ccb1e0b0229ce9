"""The log loss of Currius et al. 2020, section 4, with its analytic gradient.

loss = sum over texels, pixels and channels of w (log(1 + P) - log(1 + T))^2, P the sum of lobes in a direction
drawn inside each pixel, w the pixel's solid angle where both its centre and that direction are above the texel's
horizon, else 0. One step evaluates the same directions for all texels, so lambda (v.u - 1) of all pixels and lobes is
one matrix product; the paper's appendix A gives the derivatives. On the CPU `fit.fused` does all of it in one pass;
`reference_loss` is the same by plain autograd.
"""

from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import FunctionCtx

from kiln_workers.fit.fused import losses_and_gradient
from kiln_workers.fit.network import pixel_centres, solid_angles
from kiln_workers.sphere import octahedral


def jittered_directions(size: int, rng: np.random.Generator) -> Tensor:
    """A uniformly drawn direction inside each pixel [R * R, 3], row-major; one step's texels share them."""
    column, row = np.meshgrid(np.arange(size), np.arange(size), indexing="xy")
    position = np.stack([column, row], axis=-1) + rng.random((size, size, 2))
    directions = octahedral.decode(2.0 * position / size - 1.0)
    return torch.from_numpy(directions.reshape(-1, 3).astype(np.float32))


def step_weights(directions: Tensor, normals: Tensor, size: int) -> Tensor:
    """Weights [T, R * R] of texels with normals [T, 3]; a texel's weights add up to about 2 pi."""
    centre = normals @ pixel_centres(size).to(normals.device).T
    jittered = normals @ directions.T
    return torch.where(torch.minimum(centre, jittered) > 0.0, solid_angles(size).to(normals.device), 0.0)


def log_loss(lobes: Tensor, log_targets: Tensor, directions: Tensor, weights: Tensor) -> Tensor:
    """Scalar loss of lobes [T, N, 7], log(1 + T) [T, K, 3], directions [K, 3], weights [T, K]."""
    loss: Tensor = _LogLoss.apply(lobes, log_targets, directions, weights)  # type: ignore[no-untyped-call]
    return loss


def reference_loss(lobes: Tensor, log_targets: Tensor, directions: Tensor, weights: Tensor) -> Tensor:
    """`log_loss` as the formula reads."""
    axis, sharpness, amplitude = lobes[..., :3], lobes[..., 3], lobes[..., 4:]
    cosine = torch.einsum("kd,tnd->tkn", directions, axis)
    predicted = torch.exp(sharpness[:, None, :] * (cosine - 1.0)) @ amplitude
    return (weights[..., None] * (torch.log1p(predicted) - log_targets) ** 2).sum()


def losses_by_products(
    lobes: Tensor, log_targets: Tensor, directions: Tensor, weights: Tensor
) -> tuple[Tensor, Tensor]:
    """The loss of each texel [T] and its gradient [T, N, 7] as products of matrices, in any precision, on any device.

    The slow twin of `fused.losses_and_gradient`. Directions are [K, 3], or each texel's own [T, K, 3].
    """
    values, predicted = lobe_values(lobes, directions)
    difference = torch.log1p(predicted).sub_(log_targets)
    weighted = difference * weights[..., None]
    losses = (weighted * difference).sum(dim=(1, 2))
    by_predicted = weighted.mul_(2.0).div_(predicted.add_(1.0))  # [T, K, 3]
    by_amplitude = values.transpose(1, 2) @ by_predicted
    by_exponent = (by_predicted @ lobes[..., 4:].transpose(1, 2)).mul_(values)  # [T, K, N]
    by_scaled = by_exponent.transpose(1, 2) @ _homogeneous(directions)  # [T, N, 4]
    axis, sharpness = lobes[..., :3], lobes[..., 3:4]
    by_axis = by_scaled[..., :3] * sharpness
    by_sharpness = (by_scaled[..., :3] * axis).sum(dim=-1, keepdim=True) + by_scaled[..., 3:4]
    return losses, torch.cat([by_axis, by_sharpness, by_amplitude], dim=-1)


def lobe_values(lobes: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
    """exp(lambda (v.u - 1)) [T, K, N] and P [T, K, 3] of lobes [T, N, 7] in directions [K, 3] or [T, K, 3]."""
    sharpness = lobes[..., 3:4]
    scaled = torch.cat([lobes[..., :3] * sharpness, sharpness], dim=-1)  # (lambda u, lambda) . (v, -1)
    values = (_homogeneous(directions) @ scaled.transpose(1, 2)).exp_()
    return values, values @ lobes[..., 4:]


def _homogeneous(directions: Tensor) -> Tensor:
    return torch.cat([directions, -torch.ones_like(directions[..., :1])], dim=-1)


class _LogLoss(torch.autograd.Function):
    """The forward pass computes the gradient too: one pass over the [T, K, N] values while they are in cache."""

    @staticmethod
    def forward(ctx: Any, lobes: Tensor, log_targets: Tensor, directions: Tensor, weights: Tensor) -> Tensor:
        if lobes.device.type == "cpu" and lobes.dtype == torch.float32:
            index = torch.arange(len(directions), dtype=torch.int32).expand(weights.shape)
            losses, gradient = losses_and_gradient(lobes, log_targets, directions, index, weights)
        else:
            losses, gradient = losses_by_products(lobes, log_targets, directions, weights)
        ctx.save_for_backward(gradient)
        return losses.sum()

    @staticmethod
    def backward(ctx: FunctionCtx, *outer: Any) -> tuple[Tensor, None, None, None]:
        (gradient,) = ctx.saved_tensors  # type: ignore[attr-defined]
        return outer[0] * gradient, None, None, None
