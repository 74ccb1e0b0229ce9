"""Texture look-ups on the CPU: KHR_texture_transform, wrap modes, bilinear filtering with pixel centres at halves.

KHR_texture_transform scales, then rotates counter-clockwise as seen on the image (v down), then offsets:
(u', v') = offset + (cos r u + sin r v, -sin r u + cos r v) with (u, v) scaled.
"""

import math

import numpy as np
import numpy.typing as npt

from kiln_workers.scene.model import Float32, TextureRef

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]


def uv_matrix(reference: TextureRef) -> Floats:
    """KHR_texture_transform as a 3 x 3 matrix on (u, v, 1)."""
    cosine, sine = math.cos(reference.rotation), math.sin(reference.rotation)
    scale_u, scale_v = reference.scale
    return np.array(
        [
            [cosine * scale_u, sine * scale_v, reference.offset[0]],
            [-sine * scale_u, cosine * scale_v, reference.offset[1]],
            [0.0, 0.0, 1.0],
        ]
    )


def transformed(uv: npt.NDArray[np.floating], reference: TextureRef) -> Floats:
    """Coordinates [P, 2] on the image, of a mesh's coordinates [P, 2]."""
    matrix = uv_matrix(reference)
    return np.asarray(uv.astype(np.float64) @ matrix[:2, :2].T + matrix[:2, 2])


def look_up(
    pixels: npt.NDArray[np.uint8] | Float32 | Floats, reference: TextureRef, uv: npt.NDArray[np.floating]
) -> Floats:
    """Values [P, C] of an image [H, W, C] at a mesh's coordinates [P, 2], bilinear."""
    height, width = pixels.shape[:2]
    at = transformed(uv, reference) * (width, height) - 0.5
    low = np.floor(at).astype(np.int64)
    across, down = (at - low).T[:, :, None]
    columns = [wrapped(low[:, 0] + k, width, reference.wrap[0]) for k in (0, 1)]
    rows = [wrapped(low[:, 1] + k, height, reference.wrap[1]) for k in (0, 1)]
    top = pixels[rows[0], columns[0]] * (1.0 - across) + pixels[rows[0], columns[1]] * across
    bottom = pixels[rows[1], columns[0]] * (1.0 - across) + pixels[rows[1], columns[1]] * across
    return np.asarray(top * (1.0 - down) + bottom * down)


def wrapped(index: Ints, size: int, mode: str) -> Ints:
    """Pixel numbers under a wrap mode: clamp, mirror or repeat."""
    if mode == "clamp":
        return np.clip(index, 0, size - 1)
    if mode == "mirror":
        folded = index % (2 * size)
        return np.where(folded < size, folded, 2 * size - 1 - folded)
    return np.asarray(index % size)
