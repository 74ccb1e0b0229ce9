"""Anisotropic spherical Gaussians (Xu et al. 2013) as the light-field paper uses them, with its misprints put right.

An ASG has an orthonormal frame x, y, z and sharpnesses lx, ly:
ASG(v) = max(v.z, 0) exp(-lx (v.x)^2 - ly (v.y)^2). The paper's eq. 20 prints the dot products without squares, and
its eq. 24 evaluates the ASG with its own sharpnesses where they have to be those of the convolution.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Anisotropic:
    """An ASG of amplitude 1."""

    x: Floats  # [3] unit
    y: Floats  # [3] unit
    z: Floats  # [3] unit, the axis
    lx: float
    ly: float

    def __call__(self, directions: Floats) -> Floats:
        """Values [...] in unit directions [..., 3] (eq. 20, squared)."""
        across = self.lx * (directions @ self.x) ** 2 + self.ly * (directions @ self.y) ** 2
        return np.asarray(np.maximum(directions @ self.z, 0.0) * np.exp(-across))


def integral(lx: float, ly: float) -> float:
    """Integral over the sphere, pi / sqrt(lx ly).

    (v.z) dw = dx dy, so the integral is that of a planar Gaussian over the unit disc; what lies outside the disc is
    counted too much, a relative error below exp(-min(lx, ly)).
    """
    return float(np.pi / np.sqrt(lx * ly))


def product_integral(asg: Anisotropic, axis: Floats, sharpness: float) -> float:
    """Integral over the sphere of the ASG times a spherical Gaussian of amplitude 1 about `axis` [3] (eq. 24).

    With nu = sharpness / 2 the Gaussian is exp(-nu |v - axis|^2); in the plane across z a product of planar Gaussians
    integrates to pi / sqrt((nu + lx) (nu + ly)) times the ASG at the axis with reduced sharpnesses nu l / (nu + l)
    (Xu et al. 2013, eq. 11). Approximate: some per cent for lobes sharper than 10 and tilts below half a radian.
    """
    nu = 0.5 * sharpness
    reduced = Anisotropic(asg.x, asg.y, asg.z, nu * asg.lx / (nu + asg.lx), nu * asg.ly / (nu + asg.ly))
    return float(np.pi / np.sqrt((nu + asg.lx) * (nu + asg.ly)) * reduced(axis))


def reflected(half_axis: Floats, sharpness: float, view: Floats) -> Anisotropic:
    """The ASG over light directions of a Gaussian over half vectors, for a view direction o [3] (eq. 18).

    Axis 2 (o.m) m - o. A half vector that moves by an angle e in the plane of o and m moves the light by 2 e, and one
    that moves across it by 2 e (o.m); the Gaussian falls as exp(-l e^2 / 2). So ly = l / 8 in the plane and
    lx = l / (8 (o.m)^2) across it; (o.m) is kept above 1e-4.
    """
    cosine = float(half_axis @ view)
    z = 2.0 * cosine * half_axis - view
    across = np.cross(view, half_axis)
    length = float(np.linalg.norm(across))
    if length > 1e-9:
        x = across / length
    else:
        # Seen along its axis the lobe is round: any frame serves.
        x = np.cross(z, np.eye(3)[int(np.argmin(np.abs(z)))])
        x /= np.linalg.norm(x)
    return Anisotropic(x, np.cross(z, x), z, sharpness / (8.0 * max(cosine, 1e-4) ** 2), sharpness / 8.0)
