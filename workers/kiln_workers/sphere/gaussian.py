"""Spherical Gaussians: evaluation, integrals and products (Currius et al. 2020, eq. 1 and appendix B, corrected).

A lobe is seven numbers (u.x, u.y, u.z, lambda, mu.r, mu.g, mu.b); G(v; u, lambda, mu) = mu exp(lambda (v.u - 1)).
"""

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]


def evaluate(directions: Floats, lobes: Floats) -> Floats:
    """Sum of lobes [..., N, 7] in unit directions [K, 3]: radiance [..., K, 3] (eq. 1)."""
    cosine = np.einsum("kd,...nd->...kn", directions, lobes[..., :3])
    values = np.exp(lobes[..., None, :, 3] * (cosine - 1.0))
    return np.asarray(values @ lobes[..., 4:7])


def integral(sharpness: Floats) -> Floats:
    """Integral over the sphere of a lobe with amplitude 1: 2 pi (1 - exp(-2 lambda)) / lambda; 4 pi at 0."""
    sharpness = np.asarray(sharpness, dtype=np.float64)
    safe = np.where(sharpness < 1e-12, 1.0, sharpness)
    return np.where(sharpness < 1e-12, 4.0 * np.pi, -2.0 * np.pi * np.expm1(-2.0 * safe) / safe)


def product_integral(axis_1: Floats, sharpness_1: Floats, axis_2: Floats, sharpness_2: Floats) -> Floats:
    """Integral over the sphere of the product of two lobes of amplitude 1 (shapes broadcast; axes [..., 3]).

    4 pi exp(-(l1 + l2)) sinh(m) / m with m = |l1 u1 + l2 u2|. The paper's eq. 23 divides m by l1 + l2, which is
    wrong (docs/mathematics.md). Written as 2 pi (1 - exp(-2m)) / m exp(m - l1 - l2) so that nothing overflows.
    """
    m = np.linalg.norm(sharpness_1[..., None] * axis_1 + sharpness_2[..., None] * axis_2, axis=-1)
    return np.asarray(integral(m) * np.exp(m - sharpness_1 - sharpness_2))
