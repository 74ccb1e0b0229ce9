"""Rounding to half floats without infinities, and the layout of lobes as texture layers.

Layer 2k of a lobe texture holds (u.x, u.y, u.z, lambda), layer 2k + 1 (mu.r, mu.g, mu.b, 0) of lobe k
(`kiln_schemas.conventions`). Axes are normalised in double precision before rounding, so that a stored axis is within
half an fp16 step (2^-12 relative) of unit length; what does not fit the fp16 range is clamped and counted, never inf.
"""

import numpy as np
import numpy.typing as npt

from kiln_schemas.conventions import FP16_MAX, LAYERS_PER_LOBE, LOBE_PARAMETERS
from kiln_schemas.errors import InternalError

Half = npt.NDArray[np.float16]
Float32 = npt.NDArray[np.float32]
Bools = npt.NDArray[np.bool_]


def to_half(values: npt.NDArray[np.floating]) -> tuple[Half, int]:
    """`values` rounded to fp16 and clamped to its finite range, and how many were clamped; InternalError on NaN."""
    if np.isnan(values).any():
        raise InternalError(f"{int(np.isnan(values).sum())} values are not numbers", where="package")
    clamped = int(np.count_nonzero(np.abs(values) > FP16_MAX))
    return np.clip(values, -FP16_MAX, FP16_MAX).astype(np.float16), clamped


def normalise_axes(lobes: Float32) -> Float32:
    """A copy of lobes [..., 7] with unit axes; an axis of length 0 becomes +Y (its direction carries no meaning)."""
    out = lobes.astype(np.float32, copy=True)
    axes = lobes[..., :3].astype(np.float64)
    length = np.linalg.norm(axes, axis=-1, keepdims=True)
    out[..., :3] = np.where(length > 0.0, axes / np.where(length > 0.0, length, 1.0), (0.0, 1.0, 0.0))
    return out


def lobes_to_layers(lobes: Float32) -> tuple[Half, int]:
    """Texture layers [2N, H, W, 4] of finite lobes [H, W, N, 7], and how many values were clamped to the fp16 range."""
    height, width, count, parameters = lobes.shape
    if parameters != LOBE_PARAMETERS:
        raise InternalError(f"a lobe has {parameters} numbers instead of {LOBE_PARAMETERS}", where="package")
    values, clamped = to_half(normalise_axes(lobes))
    layers = np.zeros((count, LAYERS_PER_LOBE, height, width, 4), np.float16)
    layers[:, 0] = np.moveaxis(values[..., :4], 2, 0)
    layers[:, 1, ..., :3] = np.moveaxis(values[..., 4:], 2, 0)
    return layers.reshape(count * LAYERS_PER_LOBE, height, width, 4), clamped


def layers_to_lobes(layers: Half) -> Float32:
    """The inverse of `lobes_to_layers`: lobes [H, W, N, 7] as the textures hold them, in float32."""
    pairs = layers.reshape(-1, LAYERS_PER_LOBE, *layers.shape[1:]).astype(np.float32)
    return np.ascontiguousarray(np.moveaxis(np.concatenate([pairs[:, 0], pairs[:, 1, ..., :3]], axis=-1), 0, 2))


def as_stored(lobes: Float32) -> Float32:
    """Finite lobes [..., N, 7] as the texture will hold them: unit axes, rounded and clamped to fp16, in float32."""
    values, _ = to_half(normalise_axes(lobes))
    return values.astype(np.float32)
