"""The error of a representation at texels and at between points, with `fit.metrics`' definitions.

Always of what the textures hold: parameters rounded to fp16, mixed in fp32 as a bilinear fetch does, axes normalised.
"""

import math
from collections.abc import Callable, Iterator
from typing import Final

import torch
from torch import Tensor

from kiln_workers.fit.field import BetweenPoints, TexelField
from kiln_workers.fit.metrics import TexelErrors, horizon_weights
from kiln_workers.fit.network import pixel_centres
from kiln_workers.fit.solution import Representation
from kiln_workers.fit.source import Float16, Float32

_TEXELS_AT_ONCE: Final = 16

Response = Callable[[Tensor], Tensor]
"""What of the radiance is compared: `torch.log1p` gives log_mse, `radiance` the plain MSE."""


def radiance(values: Tensor) -> Tensor:
    """The identity."""
    return values


def errors_at_texels(
    representation: Representation, field: TexelField, response: Response = torch.log1p
) -> TexelErrors:
    """Errors of a representation of the field's texels, in exposure-normalised units."""
    stored = representation.rounded()
    chunks = (stored.take(chosen) for chosen in _chunks(len(field)))
    return _errors(chunks, field.images, field.normals, field.exposure, response)


def errors_between(
    representation: Representation,
    points: BetweenPoints,
    images: Float16,
    normals: Float32,
    exposure: float,
    response: Response = torch.log1p,
) -> TexelErrors:
    """Errors at B points against light fields traced there: images [B, R, R, 3] in scene units, normals [B, 3]."""
    stored = representation.rounded()
    corners = torch.from_numpy(points.corners)
    quarter = torch.full((len(points), 4), 0.25)
    chunks = (stored.mixed(corners[chosen], quarter[chosen]) for chosen in _chunks(len(points)))
    return _errors(chunks, images, normals, exposure, response)


def interp_ratio(between: TexelErrors, texels: TexelErrors) -> float:
    """log_mse_between / log_mse; infinite where texels have no error at all."""
    return between.log_mse / texels.log_mse if texels.log_mse > 0.0 else math.inf


def _chunks(count: int) -> Iterator[Tensor]:
    return iter(torch.split(torch.arange(count), _TEXELS_AT_ONCE))


def _errors(
    chunks: Iterator[Representation], images: Float16, normals: Float32, exposure: float, response: Response
) -> TexelErrors:
    directions = pixel_centres(images.shape[1])
    parts = []
    for number, chunk in enumerate(chunks):
        part = slice(number * _TEXELS_AT_ONCE, (number + 1) * _TEXELS_AT_ONCE)
        target = response(torch.from_numpy(images[part]).float().flatten(1, 2) * exposure)
        weight = horizon_weights(torch.from_numpy(normals[part]), images.shape[1]).double()
        difference = (response(chunk.values(directions)) - target).double()
        error = (weight[..., None] * difference**2).sum(dim=(1, 2)) / 3.0
        zero = (weight[..., None] * target.double() ** 2).sum(dim=(1, 2)) / 3.0
        parts.append(TexelErrors(error.numpy(), zero.numpy(), weight.sum(dim=1).numpy()))
    return TexelErrors.join(parts)
