"""The solvers' parts against slow references: losses, pixels, starts, mixture, least squares, L-BFGS."""

import numpy as np
import pytest
import scipy.optimize
import torch

from kiln_workers.fit.field import TexelField
from kiln_workers.fit.lobes import constrain
from kiln_workers.fit.loss import reference_loss
from kiln_workers.fit.metrics import LUMINANCE
from kiln_workers.fit.network import pixel_centres, solid_angles
from kiln_workers.fit.solvers import pixels as pixels_module
from kiln_workers.fit.solvers.alignment import Neighbourhood
from kiln_workers.fit.solvers.losses import NORMALISATION, raw_losses, texel_losses
from kiln_workers.fit.solvers.mixture import Mixture, expectation, gaussians, maximisation, sharpness_of
from kiln_workers.fit.solvers.nnls import solve_nnls
from kiln_workers.fit.solvers.pixels import PixelSet, gather
from kiln_workers.fit.solvers.quasi_newton import BatchedLbfgs, Stopping
from kiln_workers.fit.solvers.starts import random_start, shared_start, unconstrain
from kiln_workers.sphere import gaussian, octahedral


def test_gathered_pixels_are_those_above_the_horizon(lobe_field: TexelField) -> None:
    tilted = np.float32([0.48, 0.6, 0.64])
    normals = lobe_field.normals.copy()
    normals[3] = tilted
    field = TexelField(lobe_field.images, normals, lobe_field.place, lobe_field.chart, lobe_field.exposure)
    gathered = gather(field, np.arange(12))
    directions = octahedral.pixel_directions(16)
    for texel in range(12):
        inside = directions @ normals[texel].astype(np.float64) > 0.0
        count = int(inside.sum())
        np.testing.assert_array_equal(gathered.index[texel, :count].numpy(), np.flatnonzero(inside))
        np.testing.assert_allclose(
            gathered.weights[texel, :count].numpy(), octahedral.pixel_solid_angles(16)[inside], rtol=1e-6
        )
        assert (gathered.weights[texel, count:] == 0.0).all()
        expected = np.log1p(field.exposure * field.images[texel][inside].astype(np.float64))
        np.testing.assert_allclose(gathered.log_targets[texel, :count].numpy(), expected, rtol=1e-5, atol=1e-6)
        np.testing.assert_allclose(gathered.centres()[texel, :count].numpy(), directions[inside], atol=1e-6)
    jittered, weights = gathered.jittered(np.random.default_rng(0))
    above = (jittered @ torch.from_numpy(normals)[:, :, None])[..., 0] > 0.0
    assert (weights[~above] == 0.0).all() and (~above).any()
    torch.testing.assert_close(weights[above], gathered.weights[above])


def test_pixels_are_the_same_where_memory_does_not_hold_them(
    lobe_field: TexelField, monkeypatch: pytest.MonkeyPatch
) -> None:
    kept = PixelSet(lobe_field, chunk=5)
    monkeypatch.setattr(pixels_module, "MEMORY_BYTES", 1000)
    fresh = PixelSet(lobe_field, chunk=5)
    assert [len(chunk) for chunk in kept.chunks] == [5, 5, 2]
    for number in range(3):
        assert kept[number] is kept[number] and fresh[number] is not fresh[number]
        assert torch.equal(kept[number].log_targets, fresh[number].log_targets)


def test_losses_and_gradients_are_the_formulas(lobe_field: TexelField) -> None:
    gathered = gather(lobe_field, np.arange(12))
    raw = 0.3 * torch.from_numpy(np.random.default_rng(5).standard_normal((12, 6, 7)).astype(np.float32))
    losses, gradient = raw_losses(raw, gathered.normals, gathered.log_targets, gathered.centres(), gathered.weights)
    variable = raw.clone().requires_grad_()
    lobes = constrain(variable, gathered.normals)
    slow = (
        torch.stack(
            [
                reference_loss(
                    lobes[t : t + 1],
                    gathered.log_targets[t : t + 1],
                    gathered.centres()[t],
                    gathered.weights[t : t + 1],
                )
                for t in range(12)
            ]
        )
        / NORMALISATION
    )
    torch.testing.assert_close(losses, slow.detach(), rtol=1e-5, atol=0.0)
    (expected,) = torch.autograd.grad(slow.sum(), variable)
    torch.testing.assert_close(gradient, expected, rtol=1e-3, atol=1e-6)
    assert expected.abs().max() > 1e-3


def test_gradients_are_finite_differences(lobe_field: TexelField) -> None:
    gathered = gather(lobe_field, np.arange(2))
    arguments = (gathered.log_targets.double(), gathered.centres().double(), gathered.weights.double())
    rng = np.random.default_rng(6)
    lobes = constrain(torch.from_numpy(rng.standard_normal((2, 3, 7)).astype(np.float32)), gathered.normals).double()
    towards = torch.from_numpy(rng.standard_normal(lobes.shape))
    _, gradient = texel_losses(lobes, *arguments)
    ahead, behind = (texel_losses(lobes + sign * 1e-6 * towards, *arguments)[0] for sign in (1.0, -1.0))
    torch.testing.assert_close((gradient * towards).sum(dim=(1, 2)), (ahead - behind) / 2e-6, rtol=1e-6, atol=1e-10)


def test_unconstrain_inverts_constrain(lobe_field: TexelField) -> None:
    normals = torch.from_numpy(lobe_field.normals)
    raw = torch.from_numpy(np.random.default_rng(7).standard_normal((12, 5, 7)).astype(np.float32))
    lobes = constrain(raw, normals)
    torch.testing.assert_close(constrain(unconstrain(lobes, normals), normals), lobes, rtol=1e-4, atol=1e-5)
    dark = lobes.clone()
    dark[..., 4:] = 0.0
    assert (constrain(unconstrain(dark, normals), normals)[..., 4:] < 1e-5).all()


def test_a_random_start_depends_on_the_place_alone(lobe_field: TexelField) -> None:
    whole = random_start(lobe_field, 4)
    part = random_start(lobe_field.take(np.array([7, 2])), 4)
    assert torch.equal(part, whole[[7, 2]]) and not torch.equal(whole[0], whole[1])
    lobes = constrain(whole, torch.from_numpy(lobe_field.normals))
    assert (lobes[..., 1] >= -1e-6).all()  # above the horizon of +Y
    assert not torch.equal(random_start(lobe_field, 4, seed=1), whole)
    assert (shared_start(lobe_field, 4) == 0.0).all()


def test_the_mean_of_the_neighbours_axes(lobe_field: TexelField) -> None:
    axes = torch.from_numpy(np.random.default_rng(8).standard_normal((12, 2, 3)).astype(np.float32))
    mean = Neighbourhood(lobe_field).mean_axes(axes)
    at = {(int(row), int(column)): i for i, (row, column) in enumerate(lobe_field.place)}
    for (row, column), texel in at.items():
        beside = [
            at[p] for p in ((row, column - 1), (row, column + 1), (row - 1, column), (row + 1, column)) if p in at
        ]
        assert len(beside) >= 2
        torch.testing.assert_close(mean[texel], axes[beside].mean(dim=0))
    alone = lobe_field.take(np.array([0]))
    assert torch.equal(Neighbourhood(alone).mean_axes(axes[:1]), axes[:1])


def _start(field: TexelField, lobes: int) -> Mixture:
    start = constrain(shared_start(field, lobes), torch.from_numpy(field.normals))
    return Mixture(start[..., :3], start[..., 3], torch.full(start.shape[:2], 1.0 / lobes))


def test_the_likelihood_never_decreases_and_no_energy_is_lost(lobe_field: TexelField) -> None:
    pixels = PixelSet(lobe_field)
    mixture = _start(lobe_field, 5)
    weights = solid_angles(16) * (pixel_centres(16)[:, 1] > 0.0)
    images = torch.from_numpy(lobe_field.images).flatten(1, 2).float() * lobe_field.exposure
    energy = (images * weights[:, None]).sum(dim=1)
    before = None
    for _ in range(40):
        expected = expectation(mixture, pixels)
        if before is not None:
            assert (expected.likelihood >= before - 1e-5).all()
        before = expected.likelihood
        torch.testing.assert_close(expected.mass.sum(dim=1), torch.ones(12), rtol=1e-5, atol=0.0)
        torch.testing.assert_close(expected.energy.sum(dim=1), energy, rtol=1e-4, atol=1e-4)
        mixture = maximisation(mixture, expected, 128.0, None)
    lobes = gaussians(mixture, expected.energy).parameters.double().numpy()
    whole = (lobes[..., 4:] * gaussian.integral(lobes[..., 3])[..., None]).sum(axis=1)
    np.testing.assert_allclose(whole, energy.numpy(), rtol=1e-3)


def test_the_likelihood_is_that_of_the_mixture(lobe_field: TexelField) -> None:
    mixture = _start(lobe_field, 3)
    found = expectation(mixture, PixelSet(lobe_field)).likelihood
    directions = octahedral.pixel_directions(16).reshape(-1, 3)
    weights = octahedral.pixel_solid_angles(16).reshape(-1) * (directions[:, 1] > 0.0)
    for texel in range(12):
        mass = weights * (lobe_field.images[texel].reshape(-1, 3).astype(np.float64) @ LUMINANCE)
        lobes = np.concatenate(
            [mixture.axes[texel].numpy(), mixture.sharpness[texel].numpy()[:, None], np.ones((3, 3))], axis=1
        ).astype(np.float64)
        lobes[:, 4:] /= 3.0 * gaussian.integral(lobes[:, 3])[:, None]
        density = gaussian.evaluate(directions, lobes)[:, 0]
        np.testing.assert_allclose(float(found[texel]), (mass * np.log(density)).sum() / mass.sum(), rtol=1e-4)


def test_sharpness_is_that_of_the_mean_cosine() -> None:
    kappa = torch.tensor([0.3, 1.0, 5.0, 40.0, 700.0], dtype=torch.float64)
    cosine = 1.0 / torch.tanh(kappa) - 1.0 / kappa
    np.testing.assert_allclose(sharpness_of(cosine, 1e4).numpy(), kappa.numpy(), rtol=1e-3)
    assert float(sharpness_of(torch.tensor([1.0]), 128.0)) == 128.0
    assert float(sharpness_of(torch.tensor([-0.5]), 128.0)) == pytest.approx(0.25)


@pytest.mark.parametrize("count", [1, 5, 24])
def test_nnls_is_scipys(count: int) -> None:
    rng = np.random.default_rng(9)
    matrices = rng.random((60, 80, count))  # all positive: strongly dependent columns, many variables at 0
    targets = rng.standard_normal((60, 80)) + 0.3
    gram, right = matrices.swapaxes(1, 2) @ matrices, np.einsum("bkn,bk->bn", matrices, targets)
    found = solve_nnls(torch.from_numpy(gram), torch.from_numpy(right)).numpy()
    expected = np.stack([scipy.optimize.nnls(a, b)[0] for a, b in zip(matrices, targets, strict=True)])
    np.testing.assert_allclose(found, expected, atol=1e-9)
    assert count == 1 or 0.1 < (expected == 0.0).mean() < 0.95


def _rosenbrock(scales: torch.Tensor):
    """f = sum (1 - x)^2 + scale (y - x^2)^2 over pairs; a scale a problem."""

    def evaluate(problems: torch.Tensor, points: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        variable = points.detach().requires_grad_()
        x, y = variable[:, ::2], variable[:, 1::2]
        values = ((1.0 - x) ** 2 + scales[problems, None] * (y - x**2) ** 2).sum(dim=1)
        (gradient,) = torch.autograd.grad(values.sum(), variable)
        return values.detach(), gradient

    return evaluate


def test_lbfgs_finds_the_minimum_of_each_problem_as_if_it_were_alone() -> None:
    scales = torch.tensor([1.0, 10.0, 100.0], dtype=torch.float64)
    start = torch.from_numpy(np.random.default_rng(10).uniform(-1.5, 1.5, (3, 6)))
    stopping = Stopping(iterations=400, tolerance=1e-9, floor=1e-12)
    together = BatchedLbfgs(_rosenbrock(scales), start, stopping)
    while len(together.active):
        together.advance()
    np.testing.assert_allclose(together.points.numpy(), 1.0, atol=1e-3)
    for problem in range(3):
        alone = BatchedLbfgs(_rosenbrock(scales[problem : problem + 1]), start[problem : problem + 1], stopping)
        passes = 0
        while len(alone.active):
            alone.advance()
            passes += 1
        torch.testing.assert_close(alone.points[0], together.points[problem])
        assert 10 < passes < 400
