"""Fit the glossy kernels of `shade.algorithm.reflection_kernels` to GGX and print their coefficients.

    python benchmarks/kernel.py [--gaussians 1|2] [--f0 1|0.04] [--coarse]

Minimises the mean squared Hellinger distance between the normalised D G F (n.i) of GGX (Smith's correlated G, Schlick's
F, which is 1 for F0 = 1) and one or two normalised anisotropic Gaussians, over a grid of alpha and o.n: first with
parameters of their own at each place of the grid, then with parameters that are cubic in both, which start from the
first by least squares. Takes some minutes; a quarter of them on the coarse grid, which the kernel of dielectrics is
from.
"""

import argparse
import math

import numpy as np
import torch
from scipy.stats import qmc
from torch import Tensor

from kiln_workers.shade.algorithm import kernel_terms
from kiln_workers.sphere import ggx

ALPHAS = (0.04, 0.06, 0.09, 0.12, 0.16, 0.2, 0.25, 0.3, 0.36, 0.42, 0.5, 0.6, 0.75, 1.0)
COSINES = (0.03, 0.06, 0.1, 0.15, 0.22, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 0.97, 1.0)
DIRECTIONS = 2048
COARSE = ((0.04, 0.08, 0.14, 0.22, 0.36, 0.6, 1.0), (0.05, 0.1, 0.18, 0.3, 0.45, 0.65, 0.85, 1.0), 448)
STEPS = 1000
RATE = 0.05
RIDGE = 1e-4
START = {1: (3.0, 0.5, 0.5), 2: (3.0, 0.5, 0.5, 1.0, -1.5, -1.5, -0.5)}


def microfacet(alpha: float, cosine: float, f0: float, count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Directions [K, 3] in the normal's frame, roots of the normalised lobe [K], solid angles that they stand for.

    Half of the directions are reflected by half vectors from D (n.h), half are uniform.
    """
    specular = np.array([math.sqrt(1.0 - cosine**2), 0.0, cosine])
    view = specular * (-1.0, 1.0, 1.0)
    random, half = qmc.Sobol(2, seed=1).random(count), count // 2
    elevation = np.sqrt((1.0 - random[:half, 0]) / (1.0 + (alpha**2 - 1.0) * random[:half, 0]))
    normals = _polar(elevation, random[:half, 1])
    reflected = 2.0 * (normals @ view)[:, None] * normals - view
    directions = np.concatenate([reflected, _polar(random[half:, 0], random[half:, 1])])
    directions = directions[directions[:, 2] > 1e-4]
    halfway = directions + view
    halfway /= np.linalg.norm(halfway, axis=1, keepdims=True)
    distribution = ggx.distribution(halfway[:, 2], alpha)
    density = 0.25 / math.pi + 0.5 * distribution * halfway[:, 2] / (4.0 * halfway @ view)
    solid_angles = 1.0 / (density * count)
    fresnel = f0 + (1.0 - f0) * (1.0 - np.clip(halfway @ view, 0.0, 1.0)) ** 5
    lobe = fresnel * distribution * ggx.masking_shadowing(directions[:, 2], cosine, alpha)
    root = np.sqrt(lobe / (lobe * solid_angles).sum())
    missing = count - len(directions)  # below the horizon: filled up with directions that stand for nothing
    above = np.concatenate([directions, np.tile([0.0, 0.0, 1.0], (missing, 1))])
    return above, np.pad(root, (0, missing)), np.pad(solid_angles, (0, missing))


def _polar(cosines: np.ndarray, turns: np.ndarray) -> np.ndarray:
    """Unit vectors [K, 3] at cosines to +Z and turns about it."""
    sines, angles = np.sqrt(1.0 - cosines**2), 2.0 * np.pi * turns
    return np.stack([sines * np.cos(angles), sines * np.sin(angles), cosines], axis=1)


class Grid:
    """All places of the grid [G] with their microfacet lobes [G, K]."""

    def __init__(self, f0: float, coarse: bool) -> None:
        alphas, cosines, count = COARSE if coarse else (ALPHAS, COSINES, DIRECTIONS)
        places = [(alpha, cosine) for alpha in alphas for cosine in cosines]
        lobes = zip(*(microfacet(*place, f0, count) for place in places), strict=True)
        self.directions, self.root, self.solid_angles = (torch.from_numpy(np.stack(part)).float() for part in lobes)
        self.alpha, self.cosine = torch.tensor(places).unbind(-1)

    def distances(self, parameters: Tensor) -> Tensor:
        """Squared Hellinger distances, times 2, of kernels with parameters [G, 3 or 7]: [G]."""
        kernel = self._gaussian(parameters[:, :3])
        if parameters.shape[1] == 7:
            kernel = torch.lerp(kernel, self._gaussian(parameters[:, 3:6]), torch.sigmoid(parameters[:, 6:]))
        kernel = kernel / (kernel * self.solid_angles).sum(dim=1, keepdim=True)
        return ((torch.sqrt(kernel + 1e-12) - self.root).square() * self.solid_angles).sum(dim=1)

    def _gaussian(self, parameters: Tensor) -> Tensor:
        """[G, K] from tilt and logarithms of both sharpnesses; its integral is 1, as `shade.algorithm` has it."""
        zero, sine = torch.zeros_like(self.cosine), torch.sqrt(1.0 - self.cosine.square())
        specular = torch.stack([sine, zero, self.cosine], dim=-1)
        normal = torch.tensor([0.0, 0.0, 1.0]).expand_as(specular)
        z = torch.nn.functional.normalize(torch.lerp(normal, specular, torch.sigmoid(parameters[:, :1])), dim=-1)
        y = torch.stack([z[:, 2], zero, -z[:, 0]], dim=-1)
        lx, ly = (torch.exp(parameters[:, 1:]) / (4.0 * self.alpha.square())[:, None]).unbind(-1)
        along = (self.directions * y[:, None]).sum(-1)
        exponent = lx[:, None] * self.directions[..., 1].square() + ly[:, None] * along.square()
        cap = torch.sqrt(torch.expm1(-lx) / lx * torch.expm1(-ly) / ly)
        front = (self.directions * z[:, None]).sum(-1).clamp(min=0.0)
        return front * torch.exp(-exponent.clamp(max=60.0)) / (math.pi * cap)[:, None]


def descend(grid: Grid, start: Tensor, terms: Tensor | None, name: str) -> Tensor:
    """Minimise the mean distance from `start`; with `terms` it is what they are multiplied by."""
    parameters = start.clone().requires_grad_()
    optimizer = torch.optim.Adam([parameters], lr=RATE)
    schedule = torch.optim.lr_scheduler.MultiStepLR(optimizer, [STEPS // 2, STEPS * 4 // 5], gamma=0.3)
    for step in range(STEPS):
        at = parameters if terms is None else terms @ parameters
        distance = grid.distances(at).mean()
        optimizer.zero_grad()
        (distance + RIDGE * at.square().mean()).backward()
        optimizer.step()
        schedule.step()
        if step % 250 == 249:
            print(f"{name}, step {step + 1}: {distance.item():.5f}", flush=True)
    return parameters.detach()


def main() -> None:
    """Fit and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--gaussians", type=int, choices=sorted(START), default=2)
    parser.add_argument("--f0", type=float, default=1.0)
    parser.add_argument("--coarse", action="store_true")
    options = parser.parse_args()
    start = torch.tensor(START[options.gaussians])
    grid = Grid(options.f0, options.coarse)
    free = descend(grid, start.repeat(len(grid.alpha), 1), None, "at each place")
    terms = kernel_terms(grid.cosine, grid.alpha)
    first = torch.linalg.lstsq(terms, free.clamp(-6.0, 6.0)).solution
    # Descend in orthonormal terms: the powers are nearly dependent.
    orthonormal, upper = torch.linalg.qr(terms)
    size = math.sqrt(len(terms))
    found = descend(grid, upper @ first / size, orthonormal * size, "polynomials")
    for row in torch.linalg.solve(upper, found * size).tolist():
        print("(" + ", ".join(f"{value:.5g}" for value in row) + "),")


if __name__ == "__main__":
    main()
