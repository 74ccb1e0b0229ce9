"""Expectation-maximisation of a von Mises-Fisher mixture (Currius et al. 2020, section 7; Han et al. 2007).

A texel's light field above its horizon is taken as a density over directions: pixel k has the mass solid angle times
luminance (as Herholz et al. 2019 weigh their samples). E: responsibilities r_kn of the lobes for the pixels. M: mass,
axis and mean cosine rho of each lobe; its sharpness by Banerjee et al. 2005, (3 rho - rho^3) / (1 - rho^2), brought
by Newton's method (Sra 2012) to the exact maximiser coth(kappa) - 1 / kappa = rho, so that the likelihood never
decreases. At the end a lobe's amplitude per channel is that of a spherical Gaussian with the energy that the lobe is
responsible for: E kappa / (2 pi (1 - exp(-2 kappa))).

The paper leaves open, and is decided here: the mass is luminance (it says that the amplitudes are normalised to a
mixture, not how colour enters); the start is the even picture of `fit.lobes` (shared by all texels); a lobe is at most
as narrow as a pixel, kappa <= R^2 / 2, or one bright pixel would make the likelihood infinite; the mixture is
normalised over the sphere though data exist only above the horizon. EM fits radiance: what it gives is reported in the
log loss like everybody's, which is not what it optimises.

Alignment (Han et al. 2007 as the paper uses it: "pushed towards the average of adjacent texels' axes"): in the M step
u = normalise(R + alignment m), R the lobe's mean direction (|R| = rho), m the mean axis of the same lobe in the
neighbours; the sharpness then is the maximiser given that axis, with rho = R.u.
"""

import math
from dataclasses import dataclass
from functools import partial
from typing import Final

import torch
from torch import Tensor

from kiln_workers.fit.field import TexelField
from kiln_workers.fit.lobes import LOG_AMPLITUDE, LOG_SHARPNESS, constrain
from kiln_workers.fit.metrics import LUMINANCE
from kiln_workers.fit.solution import Lobes, OnEpoch, Solution, nobody
from kiln_workers.fit.solvers.alignment import Neighbourhood
from kiln_workers.fit.solvers.pixels import Pixels, PixelSet
from kiln_workers.fit.solvers.starts import shared_start
from kiln_workers.fit.solvers.stopwatch import Stopwatch
from kiln_workers.fit.source import Index

ALIGNMENT: Final = 0.3
NEWTON_STEPS: Final = 3
WINDOW: Final = 10
"""Epochs over which the likelihood's increase is measured."""
_EMPTY: Final = 1e-8
"""Share of a texel's mass below which a lobe stays as it is."""


@dataclass(frozen=True)
class MixtureOptions:
    epochs: int = 300
    tolerance: float = 1e-3
    """Increase of the mean log likelihood within WINDOW epochs below which it has converged."""
    alignment: float = 0.0


@dataclass
class Mixture:
    """Of T texels with N lobes."""

    axes: Tensor  # [T, N, 3]
    sharpness: Tensor  # [T, N]
    shares: Tensor  # [T, N], adding up to 1


@dataclass(frozen=True)
class Expectation:
    """What the M step needs."""

    mass: Tensor  # [T, N], adding up to 1
    moment: Tensor  # [T, N, 3] sum of mass times direction
    energy: Tensor  # [T, N, 3] radiance times solid angle per channel
    likelihood: Tensor  # [T] mean log likelihood


def em(
    field: TexelField, lobes: int, on_epoch: OnEpoch = nobody, *, options: MixtureOptions = MixtureOptions()
) -> Solution:
    """An epoch is one E and one M step of every texel."""
    watch = Stopwatch(on_epoch)
    pixels = PixelSet(field)
    start = constrain(shared_start(field, lobes), torch.from_numpy(field.normals))
    mixture = Mixture(start[..., :3], start[..., 3], torch.full(start.shape[:2], 1.0 / lobes))
    neighbourhood = Neighbourhood(field)
    narrowest = field.image_size**2 / 2.0
    likelihoods: list[float] = []
    for epoch in range(1, options.epochs + 1):
        expected = expectation(mixture, pixels)
        likelihoods.append(float(expected.likelihood.double().mean()))
        towards = options.alignment * neighbourhood.mean_axes(mixture.axes) if options.alignment > 0.0 else None
        mixture = maximisation(mixture, expected, narrowest, towards)
        watch.tell(epoch, partial(gaussians, mixture, expected.energy))
        if epoch > WINDOW and likelihoods[-1] - likelihoods[-1 - WINDOW] < options.tolerance:
            break
    return Solution(gaussians(mixture, expectation(mixture, pixels).energy), epoch, watch.seconds)


def em_aligned(
    field: TexelField,
    lobes: int,
    on_epoch: OnEpoch = nobody,
    *,
    options: MixtureOptions = MixtureOptions(alignment=ALIGNMENT),
) -> Solution:
    """The same with the alignment term."""
    return em(field, lobes, on_epoch, options=options)


def expectation(mixture: Mixture, pixels: PixelSet) -> Expectation:
    """The E step of all texels."""
    parts = [_expectation(mixture, pixels[number], texels) for number, texels in enumerate(pixels.chunks)]
    names = ("mass", "moment", "energy", "likelihood")
    return Expectation(*(torch.cat([getattr(part, name) for part in parts]) for name in names))


def _expectation(mixture: Mixture, pixels: Pixels, texels: Index) -> Expectation:
    axes, sharpness, shares = mixture.axes[texels], mixture.sharpness[texels], mixture.shares[texels]
    directions = pixels.centres()
    power = pixels.targets() * pixels.weights[..., None]  # [T, K, 3]
    mass = power @ torch.tensor(LUMINANCE)
    mass /= mass.sum(dim=1, keepdim=True).clamp(min=1e-30)
    exponent = torch.bmm(directions, (axes * sharpness[..., None]).transpose(1, 2))  # [T, K, N]
    exponent += (shares.clamp(min=1e-30).log() + _log_normalisation(sharpness) - sharpness)[:, None, :]
    log_density = torch.logsumexp(exponent, dim=2, keepdim=True)
    responsibility = exponent.sub_(log_density).exp_()
    right = torch.cat([mass[..., None], mass[..., None] * directions, power], dim=-1)
    sums = torch.bmm(responsibility.transpose(1, 2), right)  # [T, N, 7]
    return Expectation(sums[..., 0], sums[..., 1:4], sums[..., 4:], (mass * log_density[..., 0]).sum(dim=1))


def maximisation(mixture: Mixture, expected: Expectation, narrowest: float, towards: Tensor | None) -> Mixture:
    """The M step; `narrowest` bounds the sharpness, `towards` [T, N, 3] pulls the axes."""
    resultant = expected.moment / expected.mass[..., None].clamp(min=1e-30)
    pulled = resultant if towards is None else resultant + towards
    axes = torch.nn.functional.normalize(pulled, dim=-1)
    sharpness = sharpness_of((resultant * axes).sum(dim=-1), narrowest)
    empty = expected.mass < _EMPTY
    return Mixture(
        torch.where(empty[..., None], mixture.axes, axes),
        torch.where(empty, mixture.sharpness, sharpness),
        torch.where(expected.mass.sum(dim=1, keepdim=True) > 0.5, expected.mass, mixture.shares),
    )


def sharpness_of(cosine: Tensor, narrowest: float) -> Tensor:
    """The vMF sharpness whose mean cosine is given, at most `narrowest`: Banerjee's formula, then Newton's method."""
    low = math.exp(LOG_SHARPNESS[0])
    rho = cosine.double().clamp(0.0, 1.0 - 1e-9)
    kappa = ((3.0 * rho - rho**3) / (1.0 - rho**2)).clamp(low, narrowest)
    for _ in range(NEWTON_STEPS):
        mean = 1.0 / torch.tanh(kappa) - 1.0 / kappa
        slope = 1.0 - mean**2 - 2.0 * mean / kappa
        kappa = (kappa - (mean - rho) / slope.clamp(min=1e-12)).clamp(low, narrowest)
    return kappa.float()


def gaussians(mixture: Mixture, energy: Tensor) -> Lobes:
    """Spherical Gaussians with the energy [T, N, 3] of the mixture's lobes."""
    amplitude = energy * _log_normalisation(mixture.sharpness).exp()[..., None]
    amplitude = amplitude.clamp(0.0, math.exp(LOG_AMPLITUDE[1]))
    return Lobes(torch.cat([mixture.axes, mixture.sharpness[..., None], amplitude], dim=-1))


def _log_normalisation(sharpness: Tensor) -> Tensor:
    """log(kappa / (2 pi (1 - exp(-2 kappa))))."""
    return torch.log(sharpness / (-2.0 * math.pi * torch.expm1(-2.0 * sharpness)))
