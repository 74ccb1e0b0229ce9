"""The log loss of Currius et al. 2020, section 4, with its analytic gradient.

loss = sum over texels, pixels and channels of w (log(1 + P) - log(1 + T))^2, P the sum of lobes in a direction
drawn inside each pixel, w the pixel's solid angle where both its centre and that direction are above the texel's
horizon, else 0. One step evaluates the same directions for all texels, so lambda (v.u - 1) of all pixels and lobes is
one matrix product; the paper's appendix A gives the derivatives. `reference_loss` is the same by plain autograd.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import FunctionCtx

from kiln_workers.fit.network import pixel_centres, solid_angles
from kiln_workers.sphere import octahedral


@dataclass(frozen=True)
class Sample:
    """Where one training step evaluates the lobes; shared by all texels of the step."""

    pixels: Tensor  # [K] int64, row-major pixel index
    directions: Tensor  # [K, 3] a uniformly drawn direction inside each of them
    solid_angles: Tensor  # [K] divided by the pixel's probability of being drawn
    centres: Tensor  # [K, 3] directions of the pixels' centres

    def to(self, device: torch.device) -> "Sample":
        """The same on another device."""
        return Sample(
            *(tensor.to(device) for tensor in (self.pixels, self.directions, self.solid_angles, self.centres))
        )


def draw_sample(size: int, block: int, rng: np.random.Generator) -> Sample:
    """One random pixel of every block x block pixels (all of them with block 1), jittered inside."""
    blocks = size // block
    corner = np.stack(np.meshgrid(np.arange(blocks), np.arange(blocks), indexing="xy"), axis=-1) * block
    pixel = corner + rng.integers(block, size=(blocks, blocks, 2))  # [.., (column, row)]
    position = pixel + rng.random((blocks, blocks, 2))
    directions = octahedral.decode(2.0 * position / size - 1.0).reshape(-1, 3)
    index = torch.from_numpy((pixel[..., 1] * size + pixel[..., 0]).reshape(-1))
    weight = solid_angles(size)[index] * float(block * block)
    return Sample(index, torch.from_numpy(directions.astype(np.float32)), weight, pixel_centres(size)[index])


def sample_weights(sample: Sample, normals: Tensor) -> Tensor:
    """Weights [T, K] of texels with normals [T, 3]; a texel's weights add up to about 2 pi."""
    centre = normals @ sample.centres.T
    jittered = normals @ sample.directions.T
    return torch.where(torch.minimum(centre, jittered) > 0.0, sample.solid_angles, 0.0)


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


def lobe_values(lobes: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
    """exp(lambda (v.u - 1)) [T, K, N] and P [T, K, 3] of lobes [T, N, 7] in directions [K, 3]."""
    sharpness = lobes[..., 3:4]
    scaled = torch.cat([lobes[..., :3] * sharpness, sharpness], dim=-1)  # (lambda u, lambda) . (v, -1)
    values = (_homogeneous(directions) @ scaled.transpose(1, 2)).exp_()
    return values, values @ lobes[..., 4:]


def _homogeneous(directions: Tensor) -> Tensor:
    return torch.cat([directions, -torch.ones_like(directions[:, :1])], dim=1)


class _LogLoss(torch.autograd.Function):
    """The forward pass computes the gradient too: one pass over the [T, K, N] values while they are in cache."""

    @staticmethod
    def forward(ctx: Any, lobes: Tensor, log_targets: Tensor, directions: Tensor, weights: Tensor) -> Tensor:
        values, predicted = lobe_values(lobes, directions)
        difference = torch.log1p(predicted) - log_targets
        weighted = difference * weights[..., None]
        loss = (weighted * difference).sum()
        by_predicted = weighted.mul_(2.0).div_(predicted.add_(1.0))  # [T, K, 3]
        by_amplitude = values.transpose(1, 2) @ by_predicted
        by_exponent = (by_predicted @ lobes[..., 4:].transpose(1, 2)).mul_(values)  # [T, K, N]
        by_scaled = by_exponent.transpose(1, 2) @ _homogeneous(directions)  # [T, N, 4]
        axis, sharpness = lobes[..., :3], lobes[..., 3:4]
        by_axis = by_scaled[..., :3] * sharpness
        by_sharpness = (by_scaled[..., :3] * axis).sum(dim=-1, keepdim=True) + by_scaled[..., 3:4]
        ctx.save_for_backward(torch.cat([by_axis, by_sharpness, by_amplitude], dim=-1))
        return loss

    @staticmethod
    def backward(ctx: FunctionCtx, *outer: Any) -> tuple[Tensor, None, None, None]:
        (gradient,) = ctx.saved_tensors  # type: ignore[attr-defined]
        return outer[0] * gradient, None, None, None
