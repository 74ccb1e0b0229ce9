"""Colours for people: the sRGB transfer function (IEC 61966-2-1), a tone map, and a perceptually uniform colour map."""

from typing import Final

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.floating]
UInt8 = npt.NDArray[np.uint8]

# Viridis (van der Walt and Smith 2015), every 16th of its 256 entries and the last, as sRGB hexadecimal.
_VIRIDIS: Final = (
    *("440154", "48186a", "472d7b", "424086", "3b528b", "33638d", "2c728e", "26828e", "21918c"),
    *("1fa088", "28ae80", "3fbc73", "5ec962", "84d44b", "addc30", "d8e219", "fde725"),
)
VIRIDIS: Final = np.array([[int(c[i : i + 2], 16) for i in (0, 2, 4)] for c in _VIRIDIS], np.float64)


def srgb_encode(linear: Floats) -> Floats:
    """Display values in [0, 1] of linear values, clipped to [0, 1]."""
    x = np.clip(linear, 0.0, 1.0)
    return np.where(x <= 0.0031308, 12.92 * x, 1.055 * np.maximum(x, 0.0031308) ** (1.0 / 2.4) - 0.055)


def srgb_decode(display: Floats) -> Floats:
    """Linear values of display values in [0, 1]."""
    return np.where(display <= 0.04045, display / 12.92, ((display + 0.055) / 1.055) ** 2.4)


def quantise(values: Floats) -> UInt8:
    """8-bit codes of values in [0, 1], rounded to nearest."""
    codes: UInt8 = np.rint(np.clip(values, 0.0, 1.0) * 255.0).astype(np.uint8)
    return codes


def luminance(rgb: Floats) -> Floats:
    """Relative luminance [...] of linear Rec.709 colours [..., 3]."""
    return np.asarray(rgb @ np.array([0.2126, 0.7152, 0.0722]))


def white_point(rgb: Floats, quantile: float = 0.99) -> float:
    """A luminance that should show as white: a high quantile of the positive luminances of colours [..., 3], or 1."""
    values = luminance(rgb)
    lit = values[values > 0.0]
    return float(np.quantile(lit, quantile)) if lit.size else 1.0


def tone_map(rgb: Floats, white: float) -> UInt8:
    """8-bit sRGB of linear colours [..., 3]; `white` maps to 1 (Reinhard et al. 2002, eq. 4, on luminance).

    Luminance is scaled so that `white` is 2 in Reinhard's units: bright texels are compressed gently and the middle
    tones of a picture with a few very bright texels stay visible.
    """
    scaled = np.maximum(rgb, 0.0) * (2.0 / white)
    light = luminance(scaled)[..., None]
    return quantise(srgb_encode(scaled * (1.0 + light / 4.0) / (1.0 + light)))


def viridis(values: Floats) -> UInt8:
    """8-bit sRGB [..., 3] of values in [0, 1], dark violet to yellow."""
    at = np.clip(values, 0.0, 1.0) * (len(VIRIDIS) - 1)
    colours = [np.interp(at, np.arange(len(VIRIDIS)), VIRIDIS[:, channel]) for channel in range(3)]
    return quantise(np.stack(colours, axis=-1) / 255.0)
