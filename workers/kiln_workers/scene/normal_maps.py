"""Normal maps as glTF 2.0 has them (3.9.3): what a texel's colour makes of a surface's normal.

A texel in 0 ... 1 is the vector 2 c - 1, x and y times the texture's scale, in the frame of tangent, bitangent and
normal. The bitangent is w (n x t) with w the tangent's handedness: it points up in the image, the way of green.
Normals and tangents are interpolated, then made orthonormal. `lkMappedNormal` of the shaders and `kiln_gltf` do the
same.
"""

from typing import Final

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]

LEAST_HEIGHT: Final = 1e-3
"""A mapped normal leaves the surface at least by this part of its texel's length."""
LEAST_FACING: Final = 0.05
"""A mapped normal whose cosine to the eye is less is bent towards it."""


def decoded(texels: Floats, scale: Floats | float) -> Floats:
    """Vectors [P, 3] of texels [P, 3] in 0 ... 1, not of unit length; `scale` is a number or [P, 1]."""
    vector = 2.0 * texels - 1.0
    return np.concatenate([vector[:, :2] * scale, np.maximum(vector[:, 2:], LEAST_HEIGHT)], axis=1)


def placed(normal: Floats, tangent: Floats, vector: Floats) -> Floats:
    """Unit vectors [P, 3] in the world of vectors [P, 3] about unit normals [P, 3] and tangents [P, 4]."""
    along = tangent[:, :3] - np.einsum("pc,pc->p", tangent[:, :3], normal)[:, None] * normal
    along /= np.sqrt(np.maximum(np.einsum("pc,pc->p", along, along), 1e-12))[:, None]
    up = tangent[:, 3:] * np.cross(normal, along)
    return _unit(vector[:, :1] * along + vector[:, 1:2] * up + vector[:, 2:] * normal)


def mapped(normal: Floats, tangent: Floats, texels: Floats, scale: Floats | float) -> Floats:
    """Unit mapped normals [P, 3] of unit normals [P, 3] with tangents [P, 4] where the map has `texels` [P, 3]."""
    return placed(normal, tangent, decoded(texels, scale))


def facing(normal: Floats, view: Floats) -> Floats:
    """Unit normals [P, 3] that face away from the eye, or nearly so, bent towards it; `view` [P, 3] is unit."""
    missing = np.maximum(LEAST_FACING - np.einsum("pc,pc->p", normal, view), 0.0)
    return _unit(normal + missing[:, None] * view)


def _unit(vectors: Floats) -> Floats:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=1, keepdims=True))
