"""glTF textures as Mitsuba bitmaps: linear values, factors multiplied in, wrap modes, KHR_texture_transform.

Mitsuba's `bitmap` given a tensor has its first row at v = 0, as glTF has it, so nothing is flipped. It knows one wrap
mode for both axes; where a glTF sampler has two, the image is unrolled over the range of coordinates that is in use.
"""

from typing import Any, Final

import numpy as np
import numpy.typing as npt

from kiln_schemas.errors import TooLarge
from kiln_workers.render.jit import mi
from kiln_workers.scene.lookup import uv_matrix, wrapped
from kiln_workers.scene.model import Float32, TextureRef

Floats = npt.NDArray[np.float64]

LARGEST_UNROLLED: Final = 1 << 26
"""Pixels of an image that is unrolled because its two wrap modes differ."""

OPACITY_OVERSAMPLING: Final = 4
"""An alpha-tested texture is magnified by this factor before the test, so that its edges are not blocky."""


def bitmap(pixels: Float32, reference: TextureRef, uv: Float32 | None, nearest: bool = False) -> dict[str, Any]:
    """A Mitsuba `bitmap` of linear `pixels` [H, W, 1 or 3] as `reference` looks it up for coordinates `uv` [V, 2]."""
    matrix = uv_matrix(reference)
    wrap = reference.wrap[0]
    if reference.wrap[0] != reference.wrap[1]:
        pixels, window = _unrolled(pixels, reference, matrix, uv)
        matrix, wrap = window @ matrix, "clamp"
    return {
        "type": "bitmap",
        "data": mi.TensorXf(np.ascontiguousarray(pixels, dtype=np.float32)),
        "raw": True,
        "wrap_mode": wrap,
        "filter_type": "nearest" if nearest else "bilinear",
        "to_uv": mi.ScalarTransform3f(matrix),
    }


def thresholded(alpha: Float32, cutoff: float, wrap: tuple[str, str]) -> Float32:
    """glTF's alpha test of a magnified image: 1 where the bilinear alpha [H, W] >= cutoff, else 0; [4H, 4W, 1]."""
    for axis, mode in ((0, wrap[1]), (1, wrap[0])):
        size = alpha.shape[axis]
        position = (np.arange(size * OPACITY_OVERSAMPLING) + 0.5) / OPACITY_OVERSAMPLING - 0.5
        lower = np.floor(position).astype(np.int64)
        weight = np.expand_dims((position - lower).astype(np.float32), 1 - axis)
        first, second = (np.take(alpha, wrapped(lower + k, size, mode), axis=axis) for k in (0, 1))
        alpha = first * (1.0 - weight) + second * weight
    return (alpha >= cutoff).astype(np.float32)[..., None]


def _unrolled(pixels: Float32, reference: TextureRef, matrix: Floats, uv: Float32 | None) -> tuple[Float32, Floats]:
    """The image repeated over the used range of both axes, and the matrix from old to new coordinates."""
    points = np.zeros((1, 2)) if uv is None else uv.astype(np.float64)
    used = points @ matrix[:2, :2].T + matrix[:2, 2]
    low, high = np.floor(used.min(axis=0)).astype(int), np.ceil(used.max(axis=0)).astype(int)
    high = np.maximum(high, low + 1)
    height, width = pixels.shape[:2]
    if (high - low).prod() * height * width > LARGEST_UNROLLED:
        raise TooLarge(
            f"texture coordinates run over {' x '.join(map(str, high - low))} repetitions with two wrap modes",
            where=f"image {reference.image}",
            remedy="Use one wrap mode for both axes, or keep the coordinates near [0, 1].",
        )
    # One more pixel on each side: within half a pixel of the border it is interpolated with its neighbour beyond.
    sizes = np.array([width, height])
    start, count = low * sizes - 1, (high - low) * sizes + 2
    columns = wrapped(np.arange(start[0], start[0] + count[0]), width, reference.wrap[0])
    rows = wrapped(np.arange(start[1], start[1] + count[1]), height, reference.wrap[1])
    scale, offset = sizes / count, -start / count
    window = np.array([[scale[0], 0.0, offset[0]], [0.0, scale[1], offset[1]], [0.0, 0.0, 1.0]])
    return pixels[rows[:, None], columns[None, :]], window
