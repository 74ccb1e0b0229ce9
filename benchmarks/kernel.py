"""Fit the glossy kernel of `shade.algorithm.reflection_kernel` to GGX and print its coefficients.

    python benchmarks/kernel.py

Minimises the mean squared Hellinger distance between the normalised D G (n.i) of GGX (Smith's correlated G) and a
normalised anisotropic Gaussian, over a grid of alpha and o.n; its tilt and sharpnesses are cubic in both.
"""

import math

import numpy as np
import torch
from torch import Tensor

from kiln_workers.sphere import ggx
from kiln_workers.sphere.quadrature import fibonacci_sphere

ALPHAS = (0.05, 0.08, 0.12, 0.16, 0.2, 0.25, 0.3, 0.36, 0.42, 0.5, 0.6, 0.75, 1.0)
COSINES = (0.04, 0.08, 0.15, 0.22, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 0.97, 1.0)
STEPS = 700


def microfacet(alpha: float, cosine: float) -> tuple[Tensor, Tensor, float]:
    """Directions [K, 3] in the normal's frame, roots of the normalised lobe [K], solid angle of each."""
    count = 60_000 if alpha < 0.1 else 16_000 if alpha < 0.2 else 6_000
    directions = fibonacci_sphere(count)
    directions = directions[directions[:, 2] > 0.0]
    half = directions + np.array([-math.sqrt(1.0 - cosine**2), 0.0, cosine])
    half /= np.linalg.norm(half, axis=1, keepdims=True)
    lobe = ggx.distribution(half[:, 2], alpha) * ggx.masking_shadowing(directions[:, 2], cosine, alpha)
    lobe /= lobe.sum() * 4.0 * np.pi / count
    kept = lobe > lobe.max() * 1e-6
    to_tensor = torch.tensor
    return (
        to_tensor(directions[kept], dtype=torch.float32),
        to_tensor(np.sqrt(lobe[kept]), dtype=torch.float32),
        4.0 * np.pi / count,
    )


def terms(y: Tensor, x: Tensor) -> Tensor:
    """1, y, x, yy, yx, xx, yyy, yyx, yxx, xxx of alpha y and o.n x."""
    return torch.stack([torch.ones_like(x), y, x, y * y, y * x, x * x, y**3, y * y * x, y * x * x, x**3], dim=-1)


def distance(alpha: float, cosine: float, parameters: Tensor, target: tuple[Tensor, Tensor, float]) -> Tensor:
    """Squared Hellinger distance (times 2) of the kernel with `parameters` [3] from the target."""
    directions, root, solid_angle = target
    normal, specular = torch.tensor([0.0, 0.0, 1.0]), torch.tensor([math.sqrt(1.0 - cosine**2), 0.0, cosine])
    z = torch.nn.functional.normalize(torch.lerp(normal, specular, torch.sigmoid(parameters[0])), dim=0)
    y = torch.stack([z[2], torch.zeros(()), -z[0]])
    lx, ly = (torch.exp(value) / (4.0 * alpha**2) for value in parameters[1:])
    exponent = (-lx * directions[:, 1] ** 2 - ly * (directions @ y) ** 2).clamp(min=-60.0)
    kernel = (directions @ z).clamp(min=1e-6) * torch.exp(exponent)
    kernel = kernel / (kernel.sum() * solid_angle)
    return ((torch.sqrt(kernel + 1e-12) - root) ** 2).sum() * solid_angle


def main() -> None:
    """Fit and print."""
    torch.set_num_threads(1)
    grid = [(alpha, cosine) for alpha in ALPHAS for cosine in COSINES]
    targets = [microfacet(*place) for place in grid]
    at = terms(torch.tensor([alpha for alpha, _ in grid]), torch.tensor([cosine for _, cosine in grid]))
    fit = torch.zeros(10, 3)
    fit[0, 0] = 3.0
    fit.requires_grad_()
    optimizer = torch.optim.Adam([fit], lr=0.05)
    schedule = torch.optim.lr_scheduler.MultiStepLR(optimizer, [400, 600], gamma=0.3)
    for step in range(STEPS):
        parameters = at @ fit
        pairs = zip(grid, parameters, targets, strict=True)
        loss = torch.stack([distance(*place, one, target) for place, one, target in pairs]).mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
        if step % 100 == 99:
            print(f"step {step + 1}: {loss.item():.5f}")
    for row in fit.detach().tolist():
        print("(" + ", ".join(f"{value:.5g}" for value in row) + "),")


if __name__ == "__main__":
    main()
