"""The fused loss against the products of matrices in double precision, and its corners."""

import math

import numpy as np
import pytest
import torch
from numba.core import caching

from kiln_workers.fit.fused import PIXELS, losses_and_gradient
from kiln_workers.fit.loss import log_loss, reference_loss
from kiln_workers.fit.machine_code import SINGLE, compiled
from kiln_workers.fit.solvers.losses import NORMALISATION, reference_texel_losses, texel_losses


def problem(texels: int, lobes: int, pixels: int, seed: int = 0) -> tuple[torch.Tensor, ...]:
    """Lobes, log targets, directions [T, K, 3] and weights of which a third are 0."""
    rng = np.random.default_rng(seed)

    def unit(*shape: int) -> np.ndarray:
        vectors = rng.standard_normal((*shape, 3))
        return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)

    sharpness = np.exp(rng.uniform(-1.4, 8.0, (texels, lobes, 1)))
    amplitudes = np.exp(rng.uniform(-14.0, 5.0, (texels, lobes, 3)))
    weights = rng.uniform(0.0, 1e-3, (texels, pixels)) * (rng.random((texels, pixels)) > 1 / 3)
    weights[:, PIXELS : 2 * PIXELS] = 0.0
    targets = np.log1p(np.exp(rng.normal(0.0, 2.0, (texels, pixels, 3))))
    arrays = (
        np.concatenate([unit(texels, lobes), sharpness, amplitudes], axis=-1),
        targets,
        unit(texels, pixels),
        weights,
    )
    return tuple(torch.from_numpy(array.astype(np.float32)) for array in arrays)


def relative(found: torch.Tensor, right: torch.Tensor) -> float:
    return float((found.double() - right).norm() / right.norm())


@pytest.mark.parametrize(("texels", "lobes", "pixels"), [(5, 16, 512), (3, 1, 1), (2, 7, PIXELS + 1), (1, 24, 700)])
def test_it_is_the_formula(texels: int, lobes: int, pixels: int) -> None:
    """To the precision that products of matrices in float32 have: lambda (v.u - 1) is rounded where lambda is 3000."""
    arguments = problem(texels, lobes, pixels)
    losses, gradient = texel_losses(*arguments)
    right_losses, right_gradient = reference_texel_losses(*(argument.double() for argument in arguments))
    single_losses, single_gradient = reference_texel_losses(*arguments)
    assert relative(losses, right_losses) < 3e-7 + 2.0 * relative(single_losses, right_losses)
    for part in (slice(0, 3), slice(3, 4), slice(4, 7)):
        error, single = (relative(found[..., part], right_gradient[..., part]) for found in (gradient, single_gradient))
        assert error < 1e-6 + 2.0 * single


def test_texels_may_share_directions_and_a_scale_multiplies_the_weights() -> None:
    lobes, targets, directions, weights = problem(4, 6, 300)
    table = directions[0]
    index = torch.from_numpy(np.random.default_rng(1).integers(0, 300, (4, 300)).astype(np.int32))
    shown = table[index.long()]
    losses, gradient = losses_and_gradient(lobes, targets, table, index, weights, 0.5 / NORMALISATION)
    twice, twice_gradient = texel_losses(lobes, targets, shown, weights)
    torch.testing.assert_close(losses, 0.5 * twice, rtol=1e-6, atol=0.0)
    torch.testing.assert_close(gradient, 0.5 * twice_gradient, rtol=1e-5, atol=1e-9)


def test_strides_change_nothing() -> None:
    lobes, targets, directions, weights = problem(3, 5, 400)
    index = torch.arange(400, dtype=torch.int32).expand(3, -1)
    chosen = slice(1, None, 3)
    strided = losses_and_gradient(lobes, targets[:, chosen], directions[0], index[:, chosen], weights[:, chosen])
    plain = losses_and_gradient(
        lobes.clone(),
        *(targets[:, chosen].contiguous(), directions[0].clone(), index[:, chosen].contiguous()),
        weights[:, chosen].contiguous(),
    )
    assert all(torch.equal(one, other) for one, other in zip(strided, plain, strict=True))


def test_a_texel_is_the_same_bytes_alone_and_among_others() -> None:
    lobes, targets, directions, weights = problem(6, 16, 512)
    whole = texel_losses(lobes, targets, directions, weights)
    for texel in range(6):
        part = slice(texel, texel + 1)
        alone = texel_losses(lobes[part], targets[part], directions[part], weights[part])
        assert all(torch.equal(one, all_[part]) for one, all_ in zip(alone, whole, strict=True))


def test_what_is_not_a_number_stays_so() -> None:
    """A network that diverges has to be seen to."""
    lobes, targets, directions, weights = problem(2, 4, 100)
    lobes[0, 1, 4] = math.nan
    losses, gradient = texel_losses(lobes, targets, directions, weights)
    assert torch.isnan(losses[0]) and torch.isnan(gradient[0]).any()
    assert torch.isfinite(losses[1]) and torch.isfinite(gradient[1]).all()


def test_extremes_are_finite() -> None:
    """The sharpest and brightest lobes, exactly at, opposite to and a rounding error beyond a pixel's direction."""
    lobes = torch.tensor([[[0.0, 1.001, 0.0, 3000.0, 6e4, 6e4, 6e4], [0.0, -1.0, 0.0, 3000.0, 6e4, 1e-6, 0.0]]])
    directions = torch.tensor([[[0.0, 1.0, 0.0], [0.0, -1.0, 0.0], [1.0, 0.0, 0.0]]])
    arguments = (lobes, torch.zeros(1, 3, 3), directions, torch.ones(1, 3))
    losses, gradient = texel_losses(*arguments)
    right_losses, right_gradient = reference_texel_losses(*(argument.double() for argument in arguments))
    torch.testing.assert_close(losses.double(), right_losses, rtol=1e-4, atol=0.0)
    torch.testing.assert_close(gradient.double(), right_gradient, rtol=1e-3, atol=1e-6)


def test_the_networks_loss_is_the_same_sum() -> None:
    lobes, targets, directions, weights = problem(4, 8, 256)
    variable = lobes.clone().requires_grad_()
    loss = log_loss(variable, targets, directions[0], weights)
    (gradient,) = torch.autograd.grad(3.0 * loss, variable)
    double = lobes.double().requires_grad_()
    right = reference_loss(double, targets.double(), directions[0].double(), weights.double())
    (expected,) = torch.autograd.grad(3.0 * right, double)
    assert float(loss.detach()) == pytest.approx(float(right.detach()), rel=1e-6)
    assert relative(gradient, expected) < 1e-5


def test_it_works_where_machine_code_cannot_be_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    """Such as in a container whose files cannot be written to."""
    monkeypatch.setattr(caching.CacheImpl, "_locator_classes", [])
    out = np.zeros(1, np.float32)

    @compiled(SINGLE[::1])
    def double(values: np.ndarray) -> None:
        values[0] = 2.0 * values[0]

    out[0] = 3.0
    double(out)
    assert out[0] == 6.0
