"""Real spherical harmonics, orthonormal over the sphere, by recurrence over the associated Legendre functions.

Y_l^m = K_lm P_l^|m|(z) times sqrt(2) cos(m phi) for m > 0, 1 for m = 0, sqrt(2) sin(|m| phi) for m < 0, without the
Condon-Shortley phase (Sloan 2008, "Stupid Spherical Harmonics Tricks", appendix A1). Coefficient l, m lies at
l (l + 1) + m.
"""

import math

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]


def basis(directions: Floats, bands: int) -> Floats:
    """Values [..., bands^2] in unit directions [..., 3]."""
    x, y, z = (directions[..., i].astype(np.float64) for i in range(3))
    out = np.empty((*directions.shape[:-1], bands * bands))
    cosine, sine = np.ones_like(x), np.zeros_like(x)  # sin^m(theta) times cos(m phi), sin(m phi)
    diagonal = 1.0  # P_m^m / sin^m(theta)
    for m in range(bands):
        below, here = np.zeros_like(z), np.full_like(z, diagonal)
        for degree in range(m, bands):
            scale = math.sqrt(
                (2 * degree + 1) / (4.0 * math.pi) * math.factorial(degree - m) / math.factorial(degree + m)
            )
            if m == 0:
                out[..., degree * (degree + 1)] = scale * here
            else:
                out[..., degree * (degree + 1) + m] = math.sqrt(2.0) * scale * here * cosine
                out[..., degree * (degree + 1) - m] = math.sqrt(2.0) * scale * here * sine
            below, here = here, ((2 * degree + 1) * z * here - (degree + m) * below) / (degree + 1 - m)
        cosine, sine = x * cosine - y * sine, x * sine + y * cosine
        diagonal *= 2 * m + 1
    return out
