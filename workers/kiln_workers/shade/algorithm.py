"""The real-time algorithm (Currius et al. 2020, section 6), as the package's shaders run it, on tensors of P points.

    diffuse           E albedo (1 - metallic) (1 - F) / pi
    interreflection   sum over lobes of (lobe * D), times F G / (4 |o.n|)                            (steps 3 to 6)
    environment       U(r, alpha) W_E(r), times F G / (4 |o.n|)                                       (eq. 8)

D becomes an anisotropic Gaussian over light directions (eq. 17 and 18); F and G are taken at the specular direction r.
Formulas that the paper misprints are the corrected ones of `sphere.anisotropic`, which is the slow reference of this
module. Letters: n normal, o to the eye, r specular direction, D, F, G the microfacet terms, nu half a lobe's sharpness.
"""

from dataclasses import dataclass
from math import pi

import torch
from torch import Tensor

DIELECTRIC_F0 = 0.04
LEAST_COSINE = 1e-4


@dataclass(frozen=True)
class Surface:
    """P points to shade."""

    normal: Tensor  # [P, 3] unit
    view: Tensor  # [P, 3] unit, to the eye
    base_color: Tensor  # [P, 3]
    metallic: Tensor  # [P]
    alpha: Tensor  # [P] GGX width

    @property
    def cosine(self) -> Tensor:
        """o.n [P], at least LEAST_COSINE."""
        return (self.normal * self.view).sum(-1).clamp(min=LEAST_COSINE)

    @property
    def specular(self) -> Tensor:
        """The specular direction r [P, 3]."""
        return 2.0 * (self.normal * self.view).sum(-1, keepdim=True) * self.normal - self.view


@dataclass(frozen=True)
class Kernel:
    """D of P points as anisotropic Gaussians over light directions."""

    x: Tensor  # [P, 3] across the plane of incidence
    y: Tensor  # [P, 3]
    z: Tensor  # [P, 3] the specular direction
    lx: Tensor  # [P]
    ly: Tensor  # [P]
    amplitude: Tensor  # [P]

    def __call__(self, directions: Tensor) -> Tensor:
        """Values [P, K] in directions [K, 3]."""
        across = self.lx[:, None] * (self.x @ directions.T) ** 2 + self.ly[:, None] * (self.y @ directions.T) ** 2
        return self.amplitude[:, None] * (self.z @ directions.T).clamp(min=0.0) * torch.exp(-across)


def reflection_kernel(surface: Surface) -> Kernel:
    """D(h) about n seen from o (eq. 17 and 18; `sphere.anisotropic.reflected`)."""
    z = surface.specular
    across = torch.linalg.cross(surface.normal, z)
    length = torch.linalg.norm(across, dim=-1, keepdim=True)
    # Seen along the normal the lobe is round: any frame serves.
    other = torch.where(z[:, 1:2].abs() < 0.9, z.new_tensor([0.0, 1.0, 0.0]), z.new_tensor([1.0, 0.0, 0.0]))
    fallback = torch.linalg.cross(other, z)
    x = torch.where(length > 1e-5, across, fallback)
    x = x / torch.linalg.norm(x, dim=-1, keepdim=True)
    width = surface.alpha.square().clamp(min=1e-6)
    ly = 2.0 / width / 8.0
    return Kernel(x, torch.linalg.cross(z, x), z, ly / surface.cosine.square(), ly, 1.0 / (pi * width))


def unit_lobes(lobes: Tensor) -> Tensor:
    """Interpolated lobes [P, N, 7] with their axes at unit length again; a vanished axis becomes +Y."""
    axis = lobes[..., :3]
    length = torch.linalg.norm(axis, dim=-1, keepdim=True)
    axis = torch.where(length > 1e-6, axis / length.clamp(min=1e-6), axis.new_tensor([0.0, 1.0, 0.0]))
    return torch.cat([axis, lobes[..., 3:].clamp(min=0.0)], dim=-1)


def lobe_sum(lobes: Tensor, directions: Tensor) -> Tensor:
    """Sum of each point's lobes [P, N, 7] in one direction a point [P, 3]: [P, 3] (eq. 1)."""
    cosine = (lobes[..., :3] * directions[:, None]).sum(-1)
    return (torch.exp(lobes[..., 3] * (cosine - 1.0))[..., None] * lobes[..., 4:]).sum(1)


def convolved(lobes: Tensor, kernel: Kernel) -> Tensor:
    """Integral over the sphere of each point's lobes [P, N, 7] times its kernel: [P, 3] (eq. 24, corrected)."""
    nu = 0.5 * lobes[..., 3]
    sum_x, sum_y = nu + kernel.lx[:, None], nu + kernel.ly[:, None]
    x, y, z = ((lobes[..., :3] * axis[:, None]).sum(-1) for axis in (kernel.x, kernel.y, kernel.z))
    exponent = nu * kernel.lx[:, None] / sum_x * x * x + nu * kernel.ly[:, None] / sum_y * y * y
    overlap = pi * torch.rsqrt(sum_x * sum_y) * z.clamp(min=0.0) * torch.exp(-exponent)
    return ((kernel.amplitude[:, None] * overlap)[..., None] * lobes[..., 4:]).sum(1)


def fresnel(f0: Tensor | float, cosine: Tensor) -> Tensor:
    """Schlick 1994; f0 [P, 3] or a number, cosine [P]: [P, 3] or [P, 1]."""
    return f0 + (1.0 - f0) * (1.0 - cosine.clamp(0.0, 1.0))[:, None] ** 5


def specular_factor(surface: Surface) -> Tensor:
    """F G / (4 |o.n|) at the specular direction [P, 3] (step 5); its |r.n| cancels against the cosine of eq. 3.

    G is Smith's with correlated heights (Heitz 2014, eq. 99) at equal elevations, 1 / (1 + 2 Lambda).
    """
    cosine = surface.cosine
    f0 = DIELECTRIC_F0 + (surface.base_color - DIELECTRIC_F0) * surface.metallic[:, None]
    square = cosine.square()
    masking = torch.rsqrt(1.0 + surface.alpha.square() * (1.0 - square).clamp(min=0.0) / square)
    return fresnel(f0, cosine) * (masking / (4.0 * cosine))[:, None]


def diffuse(surface: Surface, irradiance: Tensor) -> Tensor:
    """Diffusely reflected radiance [P, 3] of an irradiance [P, 3], less what the specular layer reflects."""
    transmitted = 1.0 - fresnel(DIELECTRIC_F0, surface.cosine)
    return irradiance * surface.base_color * ((1.0 - surface.metallic)[:, None] * transmitted / pi)
