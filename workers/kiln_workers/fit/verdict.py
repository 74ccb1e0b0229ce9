"""Whether a fit has failed: what its error has to be, and what to do where it is larger."""

from typing import Final

import numpy as np

from kiln_schemas.conventions import EXPOSURE_KEY
from kiln_schemas.errors import FitFailed
from kiln_schemas.settings import Function
from kiln_workers.fit.metrics import LUMINANCE, TexelErrors
from kiln_workers.fit.source import Float32

FAILURE_RATIO: Final = 0.5
"""A fit whose error is above this fraction of the error of P = 0 has failed."""
NEGLIGIBLE: Final = 0.01
"""Of the mean radiance that a light map receives: a light field under it is left out rather than failed for."""
FEW_TEXELS: Final = 16
"""Fewer texels are no map: a network that shares what it learns between texels has nothing to share."""
DARK: Final = 1e-5
"""Mean square of the logarithmic signal below which nearly all texels are black."""


def has_failed(errors: TexelErrors) -> bool:
    """Whether the fit does not clearly beat P = 0."""
    return not errors.log_mse_rel <= FAILURE_RATIO  # also true for NaN


def is_negligible(exposure: float, irradiance: Float32) -> bool:
    """Whether a light field of an exposure is too weak to be seen beside the irradiance [T, 3] of the valid texels."""
    if not len(irradiance):
        return False
    mean = float((irradiance.astype(np.float64) @ np.array(LUMINANCE)).mean() / np.pi)
    return EXPOSURE_KEY / exposure < NEGLIGIBLE * mean


def failure(errors: TexelErrors, function: Function, setting: str, steps: int, lobes: int) -> FitFailed:
    """The error of a fit that has failed after `steps` of the setting `fit.{setting}`."""
    return FitFailed(
        f"the fit of the {function.value} ended at log_mse {errors.log_mse:.4g}, {errors.log_mse_rel:.0%} of the "
        f"{errors.log_mse_zero:.4g} that no light at all would have (at most {FAILURE_RATIO:.0%} is accepted)",
        where=f"fit {function.value}",
        remedy=_remedy(errors, f"fit.{setting} (now {steps}) or fit.lobes (now {lobes})"),
    )


def _remedy(errors: TexelErrors, settings: str) -> str:
    """What to do about a fit that failed: the light map's size, the scene's light, or the fit itself."""
    texels = len(errors.error)
    if texels < FEW_TEXELS:
        return f"Only {texels} texels of the light map can be fitted: raise lightmap.resolution."
    if errors.log_mse_zero < DARK:
        return "Hardly any light reaches the surfaces: check the lights' strength, and to which side its faces look."
    return f"Raise {settings}."
