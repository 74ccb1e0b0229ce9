"""The real-time algorithm (Currius et al. 2020, section 6), as the package's shaders run it, on tensors of P points.

    diffuse           E albedo (1 - metallic) T(o.n) / pi
    interreflection   sum over lobes of the mean of the lobe under K, times R(o.n)                   (steps 3 to 6)
    environment       U(z, alpha) W_E(z), over the integral of D, times R(o.n), z the mean axis of K  (eq. 8)

The paper takes D as an anisotropic Gaussian over light directions (eq. 17 and 18), and F and G at the specular
direction r. So what a surface reflects of constant light is wrong by up to a half, and of other light by more where it
is rough and seen from the side. Here light is a mean under K, two anisotropic Gaussians fitted to D G (n.i) as a whole,
and R is the single-scattering albedo of the microfacet model (Karis 2013, "split sum"), so that constant light is
reflected as it should be for any alpha and angle; T is the mean of 1 - F over the hemisphere in the place of
1 - F(o.n). All three are fits to quadrature, which the tests repeat. `paper_kernel`, `convolved` and `paper_factor`
keep the paper's own form.
Formulas that the paper misprints are the corrected ones of `sphere.anisotropic`, which is the slow reference of this
module. Letters: n normal, o to the eye, r specular direction, D, F, G the microfacet terms, nu half a lobe's sharpness.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from math import pi

import torch
from torch import Tensor

DIELECTRIC_F0 = 0.04
LEAST_COSINE = 1e-4

ALBEDO_LEAST_ALPHA = 0.04
ALBEDO_FIT = (
    (0.079654, 0.82584, 1, 1),
    (-2.112, -1.9157, -2.3351, -2.4264),
    (10.725, 0.021977, 9.5778, 10.771),
    (-5.696, 0.58532, 0.54603, -6.4866),
    (40.966, 1.088, 39.229, 18.855),
    (-8.8396, 0.14768, -8.5177, 11.302),
    (-40.58, -0.52883, -36.547, -51.571),
    (24.516, -0.68548, 28.513, 105.32),
    (-2.1546, 0.42731, 23.074, 52.019),
)
"""Numerators of A and B and their denominators, by 1, x, y, xy, xx, yy, xxy, xyy, xxyy with x = o.n and y = alpha."""

DIFFUSE_FIT = (0.95903, 0.02659)

KERNEL_FIT = (
    (3.6777, 5.49, -0.021158, 1.9791, 0.73549, -2.9924, -0.99093),
    (-19.753, -13.842, 0.30818, -22.82, -18.607, 4.7089, 2.776),
    (2.9478, -10.454, 0.091509, 8.3079, 1.2791, 5.0207, -1.9232),
    (37.346, 19.454, 6.2794, 29.596, 17.517, -17.214, 2.508),
    (-9.1963, 24.932, 6.1928, -16.878, 29.174, 15.763, -4.0843),
    (10.519, 5.7541, -1.8453, -12.738, -12.391, -12.476, 1.8806),
    (-19.014, -11.536, -3.5664, -18.206, -3.9007, 7.7688, -2.5371),
    (-3.1945, -10.719, -4.4632, 14.61, -21.17, 2.3152, 7.7452),
    (6.0982, -12.137, -6.0564, 4.2414, -7.5434, -15.977, -1.8843),
    (-10.127, -0.65908, 1.8442, 8.5499, 8.1529, 8.179, 0.41033),
)
"""Of peak and tail the tilt and the logarithms of both sharpnesses, and the logit of the tail's share, by 1, y, x, yy,
yx, xx, yyy, yyx, yxx, xxx with x = o.n and y = alpha, for F = 1; made by benchmarks/kernel.py."""

DIELECTRIC_KERNEL_FIT = (
    (3.5087, 6.1466, 0.31717, 1.3469, 2.2693, -1.3649, -0.99691),
    (-14.927, -10.617, 6.4329, -5.5116, -6.286, 15.816, -0.72569),
    (9.2442, -14.179, -1.8546, 13.53, -7.131, -4.976, -0.93423),
    (29.136, 9.8029, -9.0838, 6.6684, -9.3215, -46.173, 1.9492),
    (-31.547, 29.464, 0.10216, -60.773, 21.151, 0.14139, 0.80545),
    (29.477, 10.305, -0.10713, -8.4247, -0.30667, 3.119, 0.68347),
    (-15.734, -3.2611, 5.5563, -8.5622, 9.0538, 27.477, -0.67734),
    (15.375, -14.138, 3.72, 33.409, -6.9217, 9.3747, 3.9864),
    (16.159, -16.38, -5.3183, 29.369, -9.6045, -7.3724, -1.3311),
    (-38.25, -2.3315, 1.7695, -1.2706, 2.8032, 0.73681, 0.4454),
)
"""The same for F0 = 0.04 (`--f0 0.04`): towards grazing angles F turns the lobe away from the normal."""


@dataclass(frozen=True)
class Surface:
    """P points to shade."""

    normal: Tensor  # [P, 3] unit
    view: Tensor  # [P, 3] unit, to the eye
    base_color: Tensor  # [P, 3]
    metallic: Tensor  # [P]
    alpha: Tensor  # [P] GGX width
    dielectric: Tensor | None = None  # [P, 4] F0 of the dielectric, and its F90; 0.04 and 1
    transmission: Tensor | None = None  # [P] the part of the dielectric's base that lets light through; 0

    @property
    def ends(self) -> Tensor:
        """F0 of the dielectric, and its F90 [P, 4]."""
        if self.dielectric is not None:
            return self.dielectric
        return self.alpha.new_tensor([DIELECTRIC_F0] * 3 + [1.0]).expand(len(self.alpha), 4)

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

    @property
    def integral(self) -> Tensor:
        """Over the sphere [P], as `_cap` has it."""
        return self.amplitude * _cap(self.lx, self.ly)

    def __getitem__(self, points: Tensor) -> "Kernel":
        """Those of some of the points."""
        return Kernel(*(getattr(self, field.name)[points] for field in fields(self)))

    def __call__(self, directions: Tensor) -> Tensor:
        """Values [P, K] in directions [K, 3]."""
        across = self.lx[:, None] * (self.x @ directions.T) ** 2 + self.ly[:, None] * (self.y @ directions.T) ** 2
        return self.amplitude[:, None] * (self.z @ directions.T).clamp(min=0.0) * torch.exp(-across)


def reflection_kernels(surface: Surface) -> tuple[Kernel, Kernel]:
    """K: D G F (n.i) seen from o as two anisotropic Gaussians, its peak and its tail, whose integrals add up to 1.

    Their axes leave the specular direction for the normal as the surface gets rougher and the view lower, and they are
    wider than eq. 18 has it there. Tilts, sharpnesses and shares are polynomials in o.n and alpha, fitted to the
    normalised microfacet lobe by the Hellinger distance, whose mean square is 0.03 (one Gaussian 0.11, eq. 18 0.27).
    There is a fit for F = 1 and one for F0 = 0.04; Schlick's F of any F0 is a sum of both, and the parameters are mixed
    by what each part reflects.
    """
    x, y = surface.cosine, surface.alpha.clamp(ALBEDO_LEAST_ALPHA, 1.0)
    terms = kernel_terms(x, y)
    ends = terms @ x.new_tensor(KERNEL_FIT), terms @ x.new_tensor(DIELECTRIC_KERNEL_FIT)
    fit = torch.lerp(*ends, dielectric_share(surface)[:, None])
    across, tail = _across(surface), torch.sigmoid(fit[:, 6])
    return (
        _gaussian(surface, across, fit[:, :3], y, 1.0 - tail),
        _gaussian(surface, across, fit[:, 3:6], y, tail),
    )


def dielectric_share(surface: Surface) -> Tensor:
    """What a surface's largest F0 reflects as a dielectric of 0.04 would [P], over the whole.

    F0 + (F90 - F0) u = p + q (0.04 + 0.96 u) with q = (F90 - F0) / 0.96, u = (1 - o.h)^5.
    """
    f0, f90 = specular_f0(surface).amax(dim=-1), specular_f90(surface)[:, 0]
    a, b = albedo_terms(surface)
    share = (f90 - f0) / (1.0 - DIELECTRIC_F0) * (DIELECTRIC_F0 * a + b) / (f0 * a + f90 * b).clamp(min=1e-6)
    return share.clamp(0.0, 1.0)


def kernel_terms(cosine: Tensor, alpha: Tensor) -> Tensor:
    """1, y, x, yy, yx, xx, yyy, yyx, yxx, xxx of o.n x [P] and alpha y [P]: [P, 10]."""
    x, y = cosine, alpha
    return torch.stack([torch.ones_like(x), y, x, y * y, y * x, x * x, y**3, y * y * x, y * x * x, x**3], dim=-1)


def _gaussian(surface: Surface, across: Tensor, fit: Tensor, alpha: Tensor, integral: Tensor) -> Kernel:
    """A kernel of the given integral [P] from its tilt and the logarithms of its sharpnesses [P, 3]."""
    tilt = torch.sigmoid(fit[:, :1])
    z = torch.nn.functional.normalize(torch.lerp(surface.normal, surface.specular, tilt), dim=-1)
    lx, ly = (torch.exp(fit[:, 1:]) / (4.0 * alpha * alpha)[:, None]).unbind(-1)
    return Kernel(across, torch.linalg.cross(z, across), z, lx, ly, integral / _cap(lx, ly))


def glossy_direction(surface: Surface) -> Tensor:
    """Where a surface gathers most of its light from [P, 3]: the mean axis of its kernels by their shares.

    The specular direction of a mirror; nearer to the normal for a rough surface seen from the side. Lagarde and de
    Rousiers 2014 call it the dominant direction.
    """
    kernels = reflection_kernels(surface)
    mean = sum((kernel.z * kernel.integral[:, None] for kernel in kernels), torch.zeros_like(surface.normal))
    return torch.nn.functional.normalize(mean, dim=-1)


def mean_under(lobes: Tensor, kernels: Sequence[Kernel]) -> Tensor:
    """Mean of each point's lobes [P, N, 7] under kernels whose integrals add up to 1: [P, 3].

    The product of two Gaussians, as in eq. 24 corrected, but sound for wide ones too: distances are chords, as in a
    spherical Gaussian's own exponent, so what lies behind is far away; the cosine is taken at the product's centre;
    and what remains is integrated over the hemisphere about it instead of the plane (`_cap`).
    """
    return sum((_product(lobes, kernel) for kernel in kernels), torch.zeros_like(lobes[:, 0, 4:]))


def _product(lobes: Tensor, kernel: Kernel) -> Tensor:
    """Integral of the lobes times one kernel [P, 3]."""
    nu, lx, ly = 0.5 * lobes[..., 3], kernel.lx[:, None], kernel.ly[:, None]
    x, y, z = ((lobes[..., :3] * axis[:, None]).sum(-1) for axis in (kernel.x, kernel.y, kernel.z))
    # The chord's square, 2 (1 - z), times the sharpness in its direction; straight behind, the mean of both.
    behind = torch.where(z > 0.0, 0.0, 1e-6)
    xx, yy = x * x + behind, y * y + behind
    chord = torch.where(z > 0.0, 2.0 / (1.0 + z.clamp(min=0.0)), 2.0 * (1.0 - z) / (xx + yy).clamp(min=1e-6))
    exponent = (nu * lx / (nu + lx) * xx + nu * ly / (nu + ly) * yy) * chord
    width = 0.5 * (lx + ly) + 0.5
    centre = (nu * z + width) * torch.rsqrt((nu * nu + width * width + 2.0 * nu * width * z).clamp(min=1e-9))
    overlap = _cap(nu + lx, nu + ly) * centre.clamp(0.0, 1.0) * torch.exp(-exponent)
    return ((kernel.amplitude[:, None] * overlap)[..., None] * lobes[..., 4:]).sum(1)


def _cap(lx: Tensor, ly: Tensor) -> Tensor:
    """Integral of max(v.z, 0) exp(-lx x^2 - ly y^2): pi (1 - exp(-l)) / l, exact for lx = ly; else a geometric mean."""
    return pi * torch.sqrt(_saturated(lx) * _saturated(ly))


def _saturated(sharpness: Tensor) -> Tensor:
    """(1 - exp(-s)) / s, 1 at s = 0."""
    return torch.where(sharpness > 1e-3, -torch.expm1(-sharpness) / sharpness.clamp(min=1e-3), 1.0 - 0.5 * sharpness)


def _across(surface: Surface) -> Tensor:
    """Unit vectors [P, 3] across the plane of incidence; seen along the normal any will do."""
    z = surface.specular
    across = torch.linalg.cross(surface.normal, z)
    length = torch.linalg.norm(across, dim=-1, keepdim=True)
    other = torch.where(z[:, 1:2].abs() < 0.9, z.new_tensor([0.0, 1.0, 0.0]), z.new_tensor([1.0, 0.0, 0.0]))
    x = torch.where(length > 1e-5, across, torch.linalg.cross(other, z))
    return torch.nn.functional.normalize(x, dim=-1)


def paper_kernel(surface: Surface) -> Kernel:
    """D(h) about n seen from o (eq. 17 and 18; `sphere.anisotropic.reflected`)."""
    z, x = surface.specular, _across(surface)
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


def specular_f0(surface: Surface) -> Tensor:
    """Reflectance at normal incidence [P, 3]: the dielectric's, or a metal's base colour."""
    dielectric = surface.ends[:, :3]
    return dielectric + (surface.base_color - dielectric) * surface.metallic[:, None]


def specular_f90(surface: Surface) -> Tensor:
    """Reflectance at grazing incidence [P, 1]: the dielectric's, or 1."""
    dielectric = surface.ends[:, 3:]
    return dielectric + (1.0 - dielectric) * surface.metallic[:, None]


def reflectance(surface: Surface) -> Tensor:
    """R [P, 3]: integral over i of D G F / (4 (n.o)), the single-scattering albedo of GGX.

    F0 A + B, where A and B, the integrals with 1 - (1 - o.h)^5 and with (1 - o.h)^5, are rational functions of o.n and
    alpha, in the form that MaterialX 1.38 (`mx_ggx_dir_albedo_analytic`) uses; the coefficients are our own fit for
    alpha 0.04 to 1 and o.n from 0.02 (2 % at most against quadrature, rms 1 %).
    """
    a, b = albedo_terms(surface)
    return specular_f0(surface) * a[:, None] + specular_f90(surface) * b[:, None]


def albedo_terms(surface: Surface) -> tuple[Tensor, Tensor]:
    """A and B [P] of `reflectance`."""
    x, y = surface.cosine, surface.alpha.clamp(min=ALBEDO_LEAST_ALPHA)
    xx, yy = x * x, y * y
    terms = torch.stack([torch.ones_like(x), x, y, x * y, xx, yy, xx * y, x * yy, xx * yy], dim=-1)
    fit = terms @ terms.new_tensor(ALBEDO_FIT)
    a, b = (fit[:, :2] / fit[:, 2:]).clamp(0.0, 1.0).unbind(-1)
    return a, b


def mean_scale(surface: Surface) -> Tensor:
    """1 / integral of D over the hemisphere about r for n = o = r [P, 1]: turns U into a mean, (1 + alpha^2) / 4."""
    return 0.25 * (1.0 + surface.alpha.square())[:, None]


def paper_factor(surface: Surface) -> Tensor:
    """F G / (4 |o.n|) at the specular direction [P, 3] (step 5); its |r.n| cancels against the cosine of eq. 3.

    G is Smith's with correlated heights (Heitz 2014, eq. 99) at equal elevations, 1 / (1 + 2 Lambda).
    """
    cosine = surface.cosine
    square = cosine.square()
    masking = torch.rsqrt(1.0 + surface.alpha.square() * (1.0 - square).clamp(min=0.0) / square)
    return fresnel(specular_f0(surface), cosine) * (masking / (4.0 * cosine))[:, None]


def transmission(cosine: Tensor, f0: Tensor | float = DIELECTRIC_F0, f90: Tensor | float = 1.0) -> Tensor:
    """T [P]: mean over the cosine-weighted hemisphere of 1 - F(o.h), fitted within 0.001 for F0 = 0.04.

    It is 1 - F0 - (F90 - F0) m with m the mean of (1 - o.h)^5, which the fit tells.
    """
    fitted = DIFFUSE_FIT[0] - DIFFUSE_FIT[1] * (1.0 - cosine) ** 3
    mean = (1.0 - DIELECTRIC_F0 - fitted) / (1.0 - DIELECTRIC_F0)
    return 1.0 - f0 - (f90 - f0) * mean


def diffuse(surface: Surface, irradiance: Tensor) -> Tensor:
    """Diffusely reflected radiance [P, 3] of an irradiance [P, 3], less what the specular layer reflects."""
    f0, f90 = surface.ends[:, :3].max(dim=-1).values, surface.ends[:, 3]
    share = (1.0 - surface.metallic) * transmission(surface.cosine, f0, f90) / pi
    if surface.transmission is not None:
        share = share * (1.0 - surface.transmission)
    return irradiance * surface.base_color * share[:, None]
