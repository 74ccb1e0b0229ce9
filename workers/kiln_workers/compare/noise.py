"""Errors of light fields against light fields: how much two traces of the same points differ, in the metrics' unit."""

from collections.abc import Iterator
from typing import Final

import torch

from kiln_workers.fit.metrics import TexelErrors, horizon_weights
from kiln_workers.fit.source import Float16, Float32

AT_ONCE: Final = 32


def image_errors(images: Float16, targets: Float16, normals: Float32, exposure: float) -> TexelErrors:
    """Errors of images [P, R, R, 3] against targets [P, R, R, 3], both in scene units, with normals [P, 3]."""
    return TexelErrors.join(_parts(images, targets, normals, exposure))


def _parts(images: Float16, targets: Float16, normals: Float32, exposure: float) -> Iterator[TexelErrors]:
    for start in range(0, len(images), AT_ONCE):
        part = slice(start, start + AT_ONCE)
        one, other = (
            torch.log1p(torch.from_numpy(a[part]).float().flatten(1, 2) * exposure) for a in (images, targets)
        )
        weight = horizon_weights(torch.from_numpy(normals[part]), images.shape[1]).double()
        error, zero = (
            (weight[..., None] * value.double() ** 2).sum(dim=(1, 2)) / 3.0 for value in (one - other, other)
        )
        yield TexelErrors(error.numpy(), zero.numpy(), weight.sum(dim=1).numpy())
