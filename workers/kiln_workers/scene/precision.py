"""How far from a triangle float32 cannot tell on which side of it a point lies: the distance that a ray keeps from it.

A point of a triangle is a weighted sum of its vertices, rounded; the next ray's intersection with the same triangle is
computed from its vertices relative to the ray's origin, rounded too. Both errors are bounded axis by axis from the
vertices' sizes and the triangle's extents, so that a wide plane that is parallel to two axes costs nothing, and neither
does anything else that is large or far away elsewhere in the scene (after Waechter and Binder 2019, "A Fast and Robust
Method for Avoiding Self-Intersection", Ray Tracing Gems, chapter 6, who take the size of the point's coordinates).
"""

from typing import Final

import numpy as np
import numpy.typing as npt

from kiln_workers.scene.geometry import Floats

UNIT_ROUNDOFF: Final = 2.0**-24
"""Of float32."""

SAFETY: Final = 3.0
"""The bound is of the first order, and hardware intersects in its own order of operations."""

MOST_PULL: Final = 1e-3


def face_clearance(positions: npt.NDArray[np.float32] | Floats, faces: npt.NDArray[np.integer]) -> Floats:
    """Metres [F] along its normal that a ray has to start off each face, so that it does not meet that face again."""
    corners = np.asarray(positions, np.float64)[faces]  # [F, 3, 3]
    first, second = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    cross = np.cross(first, second)
    area = np.maximum(np.linalg.norm(cross, axis=1, keepdims=True), 1e-300)
    normal = np.abs(cross) / area
    # A component of the cross product is a difference of two products, each of which is rounded.
    products = np.abs(np.roll(first, -1, 1) * np.roll(second, -2, 1)) + np.abs(
        np.roll(first, -2, 1) * np.roll(second, -1, 1)
    )
    largest = np.abs(corners).max(axis=1)
    extent = np.ptp(corners, axis=1)
    error = (2.0 * products / area + 4.0 * normal) * extent + 4.0 * normal * largest
    return np.asarray(UNIT_ROUNDOFF * (SAFETY * error.sum(axis=1) + extent.max(axis=1)))


def face_pull(positions: npt.NDArray[np.float32] | Floats, faces: npt.NDArray[np.integer], margin: Floats) -> Floats:
    """(x, y, z, share) [F, 4]: a face's incentre, and the share of the way to it that leads `margin` [F] off its edges.

    Moving by that share takes a point r times the share away from every edge, r the radius of the incircle. The share
    is at most `MOST_PULL`: a face that is narrower than its margin cannot give it without moving points far along it.
    """
    corners = np.asarray(positions, np.float64)[faces]
    edges = np.linalg.norm(corners[:, [2, 0, 1]] - corners[:, [1, 2, 0]], axis=2)  # opposite to each corner
    around = np.maximum(edges.sum(axis=1), 1e-300)
    centre = np.einsum("fc,fcd->fd", edges / around[:, None], corners)
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    radius = np.maximum(np.linalg.norm(cross, axis=1) / around, 1e-300)
    return np.column_stack([centre, np.minimum(margin / radius, MOST_PULL)])
