"""`log_mse` as docs/mathematics.md defines it, and the exposure that it and the loss are taken in.

log_mse = sum w (log(1 + T) - log(1 + P))^2 / sum w over texels, pixels whose centre is above the texel's geometric
horizon, and channels; w is the pixel's solid angle; T and P are exposure-normalised; directions are pixel centres,
no jitter. `log_mse_zero` is that of P = 0, `log_mse_rel` their ratio.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt
import torch

from kiln_schemas.conventions import EXPOSURE_KEY, LOBE_PARAMETERS
from kiln_schemas.settings import Function
from kiln_schemas.tasks import FitMetrics
from kiln_workers.fit.lobes import amplitude_scale
from kiln_workers.fit.loss import lobe_values
from kiln_workers.fit.network import pixel_centres, solid_angles
from kiln_workers.fit.source import Float16, Float32, TexelSource

Float64 = npt.NDArray[np.float64]

LUMINANCE: Final = (0.2126, 0.7152, 0.0722)
"""Rec.709 luminance of linear RGB."""

NO_SIGNAL: Final = 1e-10
"""log_mse of P = 0 below which there is nothing to fit."""

_TEXELS_AT_ONCE: Final = 16


@dataclass(frozen=True)
class TexelErrors:
    """Sums per texel [T], weighted by solid angle and averaged over channels."""

    error: Float64
    zero: Float64
    """The same of P = 0."""
    weight: Float64
    """Solid angle above the horizon."""

    @property
    def log_mse(self) -> float:
        return _ratio(self.error, self.weight)

    @property
    def log_mse_zero(self) -> float:
        return _ratio(self.zero, self.weight)

    @property
    def log_mse_rel(self) -> float:
        """log_mse / log_mse_zero; 0 where there is no signal."""
        zero = self.log_mse_zero
        return self.log_mse / zero if zero > 0.0 else 0.0

    @classmethod
    def join(cls, parts: Iterable["TexelErrors"]) -> "TexelErrors":
        listed = list(parts)
        return cls(*(np.concatenate([getattr(p, name) for p in listed]) for name in ("error", "zero", "weight")))


def texel_errors(lobes: Float32, images: Float16, normals: Float32, exposure: float) -> TexelErrors:
    """Errors of lobes [T, N, 7] in scene units against images [T, R, R, 3]; unit geometric normals [T, 3]."""
    scale = amplitude_scale(exposure)
    parts = []
    for start in range(0, len(images), _TEXELS_AT_ONCE):
        part = slice(start, start + _TEXELS_AT_ONCE)
        normalised = torch.from_numpy(lobes[part]) * scale
        parts.append(_errors(normalised, torch.from_numpy(images[part]), torch.from_numpy(normals[part]), exposure))
    return TexelErrors.join(parts)


def _errors(lobes: torch.Tensor, images: torch.Tensor, normals: torch.Tensor, exposure: float) -> TexelErrors:
    size = images.shape[1]
    with torch.inference_mode():
        _, predicted = lobe_values(lobes, pixel_centres(size))
        target = torch.log1p(images.float() * exposure).flatten(1, 2)
        weight = horizon_weights(normals, size).double()[..., None]
        error = (weight * (torch.log1p(predicted) - target).double() ** 2).sum(dim=(1, 2)) / 3.0
        zero = (weight * target.double() ** 2).sum(dim=(1, 2)) / 3.0
        return TexelErrors(error.numpy(), zero.numpy(), weight.sum(dim=(1, 2)).numpy())


def horizon_weights(normals: torch.Tensor, size: int) -> torch.Tensor:
    """Solid angle [T, R * R] of the pixels whose centre is above the horizon, 0 for the others."""
    return torch.where(normals @ pixel_centres(size).T > 0.0, solid_angles(size), 0.0)


def exposure_of(source: TexelSource, function: Function) -> float:
    """EXPOSURE_KEY / mean luminance above the horizon over all texels; 1 for the visibility, which lies in [0, 1].

    One pass, tile by tile in order, summed in float64. 1 where nothing shines.
    """
    if function is Function.VISIBILITY:
        return 1.0
    light = weight = 0.0
    for tile, count in enumerate(source.counts):
        images = torch.from_numpy(source.images(tile, np.arange(count, dtype=np.int64)))
        luminance = images.flatten(1, 2).double() @ torch.tensor(LUMINANCE, dtype=torch.float64)
        weights = horizon_weights(torch.from_numpy(source.normals(tile)), source.image_size).double()
        light += float((weights * luminance).sum())
        weight += float(weights.sum())
    return EXPOSURE_KEY * weight / light if light > 0.0 else 1.0


def has_signal(source: TexelSource, exposure: float) -> bool:
    """Whether `log_mse_zero` over all texels, with 4 pi for each solid angle, is at least NO_SIGNAL."""
    least = NO_SIGNAL * 4.0 * np.pi * sum(source.counts)
    light = 0.0
    for tile, count in enumerate(source.counts):
        images = source.images(tile, np.arange(count, dtype=np.int64))
        dark = np.zeros((count, 1, LOBE_PARAMETERS), np.float32)
        light += float(texel_errors(dark, images, source.normals(tile), exposure).zero.sum())
        if light >= least:
            return True
    return False


def metrics_of(errors: TexelErrors, *, signal: bool) -> FitMetrics:
    """The errors of all texels together, as results hold them."""
    return FitMetrics(
        log_mse=errors.log_mse,
        log_mse_zero=errors.log_mse_zero,
        log_mse_rel=errors.log_mse_rel,
        texels=len(errors.error),
        signal=signal,
    )


def _ratio(sums: Float64, weights: Float64) -> float:
    total = float(weights.sum())
    return float(sums.sum()) / total if total > 0.0 else 0.0
