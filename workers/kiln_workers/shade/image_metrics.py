"""How far a picture is from its reference: HDR-FLIP on radiance, PSNR and SSIM on what a display shows.

HDR-FLIP (Andersson et al. 2021, "Visualizing Errors in Rendered High Dynamic Range Images") is NVIDIA's own program,
which takes the exposures from the reference: 0 is equal, 1 as different as black and white. SSIM is that of Wang et
al. 2004, "Image Quality Assessment", on the luma of the tone-mapped picture. Both pictures have to be tone-mapped with
the same `white`; a reference of several cameras should keep one.
"""

from dataclasses import dataclass
from typing import Final

import flip_evaluator
import numpy as np
import numpy.typing as npt
from scipy import ndimage

from kiln_schemas.errors import InputError
from kiln_workers.package import colour
from kiln_workers.scene.model import Float32

Floats = npt.NDArray[np.float64]
Bools = npt.NDArray[np.bool_]

PIXELS_PER_DEGREE: Final = 67.0
"""FLIP's default observer: a 0.7 m wide display of 3840 pixels seen from 0.7 m."""

SSIM_SIGMA, SSIM_RADIUS = 1.5, 5
"""The window of Wang et al. 2004: a Gaussian cut off at 11 x 11 pixels."""

DARKEST: Final = 1e-12
"""A reference of no more luminance than this has no exposure."""


@dataclass(frozen=True)
class ImageMetrics:
    """A picture against its reference."""

    psnr: float  # dB, infinite where the displayed pictures are equal
    ssim: float  # 1 where they are equal
    flip: float  # mean HDR-FLIP, 0 where they are equal

    def rounded(self) -> dict[str, float | None]:
        """For JSON, which has no infinity: the PSNR of equal pictures is None."""
        values = {"psnr": self.psnr, "ssim": self.ssim, "flip": self.flip}
        return {key: round(value, 5) if np.isfinite(value) else None for key, value in values.items()}


def compare_pictures(reference: Float32, test: Float32, white: float) -> ImageMetrics:
    """All metrics of linear pictures [H, W, 3]; `white` is the luminance that a display shows as white."""
    return ImageMetrics(psnr(reference, test, white), ssim(reference, test, white), flip(reference, test))


def flip(reference: Float32, test: Float32) -> float:
    """Mean HDR-FLIP of two linear Rec.709 pictures [H, W, 3], in [0, 1]."""
    return float(flip_map(reference, test).mean(dtype=np.float64))


def flip_map(reference: Float32, test: Float32) -> Float32:
    """HDR-FLIP of every pixel [H, W] of two linear Rec.709 pictures [H, W, 3]."""
    _check(reference, test)
    if colour.luminance(reference).max() <= DARKEST:
        # Without light in the reference there are no exposures: equal is 0, anything else as wrong as can be.
        return np.asarray((test > DARKEST).any(axis=-1), np.float32)
    error, _, _ = flip_evaluator.evaluate(
        np.ascontiguousarray(reference, np.float32),
        np.ascontiguousarray(test, np.float32),
        "HDR",
        applyMagma=False,
        computeMeanError=False,
        parameters={"ppd": PIXELS_PER_DEGREE},
    )
    return np.asarray(error, np.float32).reshape(reference.shape[:2])


def flip_noise_floor(halves: tuple[Float32, Float32]) -> Float32:
    """The FLIP map [H, W] that the mean of two independent halves would show against the truth, from its noise alone.

    With noises a and b the mean is off by (a + b) / 2. Each half is off the mean by (a - b) / 2, which is distributed
    alike for symmetrical noise: so FLIP between the mean and a half, averaged over both, estimates it. No assumption
    about how FLIP grows with the noise is made.
    """
    mean = np.asarray(0.5 * (halves[0] + halves[1]), np.float32)
    return np.asarray(0.5 * (flip_map(mean, halves[0]) + flip_map(mean, halves[1])), np.float32)


def mean_by_alpha(error: Float32, alpha: Float32, wanted: tuple[float, ...]) -> dict[float, float]:
    """Mean of an error map [H, W] over the pixels of each GGX width in `wanted` (of those that are there).

    `alpha` [H, W] is `GBuffer.pixel_alpha()`: NaN where a pixel shows more than one width, or none.
    """
    out = {}
    for value in wanted:
        mask = np.abs(alpha - value) < 0.02 * value
        if mask.any():
            out[value] = float(error[mask].mean(dtype=np.float64))
    return out


def psnr(reference: Float32, test: Float32, white: float) -> float:
    """Peak signal-to-noise ratio in dB of the display-mapped pictures [H, W, 3]; infinite where they are equal."""
    _check(reference, test)
    difference = colour.tone_map(reference, white).astype(np.float64) - colour.tone_map(test, white)
    error = float(np.mean(np.square(difference / 255.0)))
    return float("inf") if error == 0.0 else -10.0 * float(np.log10(error))


def ssim(reference: Float32, test: Float32, white: float) -> float:
    """Structural similarity of the luma (Rec.709 weights) of the display-mapped pictures [H, W, 3], at most 1."""
    _check(reference, test)
    x, y = (colour.luminance(colour.tone_map(picture, white).astype(np.float64)) for picture in (reference, test))
    mean_x, mean_y = _window(x), _window(y)
    variance_x = _window(x * x) - mean_x * mean_x
    variance_y = _window(y * y) - mean_y * mean_y
    covariance = _window(x * y) - mean_x * mean_y
    c1, c2 = (0.01 * 255.0) ** 2, (0.03 * 255.0) ** 2
    similar = (2.0 * mean_x * mean_y + c1) * (2.0 * covariance + c2)
    similar /= (mean_x * mean_x + mean_y * mean_y + c1) * (variance_x + variance_y + c2)
    return float(similar.mean())


def _window(values: npt.NDArray[np.floating]) -> Floats:
    """Means under the Gaussian window [H, W]; pictures are continued by reflection at their edges."""
    return np.asarray(ndimage.gaussian_filter(values, SSIM_SIGMA, mode="reflect", radius=SSIM_RADIUS))


def _check(reference: Float32, test: Float32) -> None:
    if reference.shape != test.shape or reference.ndim != 3 or reference.shape[-1] != 3:
        raise InputError(
            f"pictures of shapes {list(reference.shape)} and {list(test.shape)} cannot be compared",
            where="picture",
            remedy="Render both with the same --size.",
        )
    for name, picture in (("reference", reference), ("picture", test)):
        if not np.isfinite(picture).all():
            raise InputError("has pixels that are not finite", where=name, remedy="Render it again.")
