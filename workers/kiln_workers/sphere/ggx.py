"""The GGX microfacet terms (Walter et al. 2007; Heitz 2014), isotropic, and the Gaussian that stands for D.

alpha is roughness squared. m is the half vector, i and o the directions of light and view, n the normal; arguments are
cosines, which broadcast. The reflected radiance is D G2 F / (4 |n.i| |n.o|), times n.i.
"""

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]


def distribution(cos_h: Floats, alpha: Floats | float) -> Floats:
    """D(m) = alpha^2 / (pi ((n.m)^2 (alpha^2 - 1) + 1)^2), 0 below the surface; D (n.m) integrates to 1."""
    square = np.square(alpha)
    cos_h = np.asarray(cos_h, np.float64)
    return np.where(cos_h > 0.0, square / (np.pi * (cos_h * cos_h * (square - 1.0) + 1.0) ** 2), 0.0)


def smith_lambda(cos_v: Floats, alpha: Floats | float) -> Floats:
    """Smith's Lambda for GGX: (sqrt(1 + alpha^2 tan^2) - 1) / 2 (Heitz 2014, eq. 72)."""
    square = np.square(np.maximum(np.abs(cos_v), 1e-9))
    return np.asarray(0.5 * (np.sqrt(1.0 + np.square(alpha) * (1.0 - np.minimum(square, 1.0)) / square) - 1.0))


def masking(cos_v: Floats, alpha: Floats | float) -> Floats:
    """G1: the fraction of the microsurface seen from v."""
    return np.where(np.asarray(cos_v) > 0.0, 1.0 / (1.0 + smith_lambda(cos_v, alpha)), 0.0)


def masking_shadowing(cos_i: Floats, cos_o: Floats, alpha: Floats | float, *, correlated: bool = True) -> Floats:
    """G2: height-correlated (Heitz 2014, eq. 99), or the separable product of two G1 as in Walter et al. 2007."""
    if not correlated:
        return np.asarray(masking(cos_i, alpha) * masking(cos_o, alpha))
    both = (np.asarray(cos_i) > 0.0) & (np.asarray(cos_o) > 0.0)
    return np.where(both, 1.0 / (1.0 + smith_lambda(cos_i, alpha) + smith_lambda(cos_o, alpha)), 0.0)


def fresnel_schlick(cos_d: Floats, f0: Floats | float) -> Floats:
    """F0 + (1 - F0) (1 - cos)^5 (Schlick 1994)."""
    return np.asarray(f0 + (1.0 - np.asarray(f0)) * (1.0 - np.clip(cos_d, 0.0, 1.0)) ** 5)


def gaussian_of_distribution(alpha: Floats | float) -> tuple[Floats, Floats]:
    """Sharpness 2 / alpha^2 and amplitude 1 / (pi alpha^2) of the Gaussian about n that stands for D (eq. 17).

    It has D's peak and integral; D has twice the curvature at the peak and falls off as a power in the tail.
    """
    square = np.square(np.asarray(alpha, np.float64))
    return 2.0 / square, 1.0 / (np.pi * square)


def single_scattering_albedo(cos_o: float, alpha: float, points: int = 512, *, correlated: bool = True) -> float:
    """Integral over i of D G2 / (4 n.o), F = 1: the energy that one bounce off the microsurface reflects.

    Quadrature on `points`^2 half vectors of equal probability D (n.m): the density of i is D (n.m) / (4 o.m), hence
    each contributes G2 (o.m) / ((n.m) (n.o)).
    """
    u = (np.arange(points) + 0.5) / points
    cos_h = np.sqrt((1.0 - u) / (1.0 + (alpha * alpha - 1.0) * u))[:, None]
    sin_h = np.sqrt(1.0 - cos_h * cos_h)
    phi = 2.0 * np.pi * u[None, :]
    sin_o = np.sqrt(1.0 - cos_o * cos_o)
    o_m = sin_o * sin_h * np.cos(phi) + cos_o * cos_h
    cos_i = 2.0 * o_m * cos_h - cos_o
    g2 = masking_shadowing(cos_i, np.asarray(cos_o), alpha, correlated=correlated)
    return float(np.mean(np.where(o_m > 0.0, g2 * o_m / (cos_h * cos_o), 0.0)))
