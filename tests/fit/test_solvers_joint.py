"""The coherent descent: its loss against plain autograd, what it learns from between texels, blocks with a halo."""

import math
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest
import torch

from kiln_workers.fit.field import TexelField, TracedBetween
from kiln_workers.fit.lobes import constrain
from kiln_workers.fit.loss import reference_loss
from kiln_workers.fit.metrics import horizon_weights
from kiln_workers.fit.network import pixel_centres, solid_angles
from kiln_workers.fit.optimizer import Moments, one_cycle
from kiln_workers.fit.solution import Lobes, mixed_lobes
from kiln_workers.fit.solvers import joint as module
from kiln_workers.fit.solvers.alignment import Neighbourhood
from kiln_workers.fit.solvers.evaluate import errors_at_texels, errors_between
from kiln_workers.fit.solvers.joint import CoherentOptions, descend, mean_targets
from kiln_workers.fit.solvers.starts import shared_start, unconstrain
from kiln_workers.sphere import gaussian, octahedral

SIZE = 16
LOBES = 3


def lights(rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """Radiance [T, R, R, 3] at places in texels, over a floor: a light that turns by 17 degrees a texel, and a glow."""
    axis = np.stack([-0.6 + 0.3 * columns, np.ones_like(columns), 0.2 + 0.3 * rows], axis=1)
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    shape = np.tile([40.0, 6.0, 4.0, 2.0], (len(rows), 1))
    glow = np.tile([0.0, 1.0, 0.0, 2.0, 0.2, 0.3, 0.4], (len(rows), 1))
    lobes = np.stack([np.concatenate([axis, shape], axis=1), glow], axis=1)
    directions = octahedral.pixel_directions(SIZE).reshape(-1, 3)
    images = gaussian.evaluate(directions, lobes) * (directions[:, 1] > 0.0)[None, :, None]
    return images.reshape(-1, SIZE, SIZE, 3)


def floor(height: int, width: int) -> tuple[TexelField, np.ndarray]:
    """Texels of a floor with what was traced between them, and the whole images [B, R, R, 3] there."""
    place = np.argwhere(np.ones((height, width), bool))
    images = lights(*place.T.astype(np.float64)).astype(np.float16)
    normals = np.tile(np.float32([0.0, 1.0, 0.0]), (len(place), 1))
    field = TexelField(images, normals, place, np.zeros(len(place), np.int64), 0.8)
    points = field.between
    at = field.place[points.first] + 0.5 * points.step
    whole = lights(*at.T).astype(np.float16)
    offsets = np.stack(np.divmod(np.arange(len(points)) % 4, 2), axis=1)
    half = SIZE // 2
    sparse = np.empty((len(points), half, half, 3), np.float16)
    for image, whole_image, (a, b) in zip(sparse, whole, offsets, strict=True):
        image[:] = whole_image[a::2, b::2]
    traced = TracedBetween(np.arange(len(points)), np.tile(normals[:1], (len(points), 1)), offsets, sparse)
    return replace(field, traced=traced), whole


def start_of(field: TexelField) -> torch.Tensor:
    return constrain(shared_start(field, LOBES), torch.from_numpy(field.normals))


def slow_loss(field: TexelField, lobes: torch.Tensor) -> torch.Tensor:
    """The sums of the module's docstring, pixel by pixel, from the formulas; a floor's mirror image turns rows over."""
    directions = pixel_centres(SIZE)

    def log_targets(images: np.ndarray) -> torch.Tensor:
        return torch.log1p(torch.from_numpy(images.astype(np.float32)) * field.exposure).flatten(1, 2)

    weights = horizon_weights(torch.from_numpy(field.normals), SIZE)
    total = reference_loss(lobes, log_targets(field.images), directions, weights)
    height = directions[:, 1]
    below = ((height <= 0.0) & (height > -0.5)).expand(len(field), -1)
    continued = 0.1 * torch.where(below, solid_angles(SIZE), 0.0)
    total = total + reference_loss(lobes, log_targets(field.images[:, ::-1].copy()), directions, continued)
    assert field.traced is not None
    mixed = mixed_lobes(lobes, torch.from_numpy(field.between.corners), torch.full((len(field.between), 4), 0.25))
    for point in range(len(field.traced)):
        a, b = field.traced.offsets[point]
        grid = np.arange(SIZE * SIZE).reshape(SIZE, SIZE)[a::2, b::2].ravel()
        weight = 4.0 * horizon_weights(torch.from_numpy(field.traced.normals[point : point + 1]), SIZE)[:, grid]
        image = log_targets(field.traced.images[point : point + 1])
        total = total + reference_loss(mixed[point : point + 1], image, directions[grid], weight)
    return total / (2.0 * math.pi * 3.0)


def test_gradient_is_that_of_the_formulas(monkeypatch: pytest.MonkeyPatch) -> None:
    """With every pixel in each step; chunks smaller than the field."""
    monkeypatch.setattr(module, "_TEXELS", 5)
    monkeypatch.setattr(module, "_POINTS", 7)
    field, _ = floor(3, 4)
    with ThreadPoolExecutor(2) as pool:
        descent = module._Descent(field, anywhere(field), CoherentOptions(), 0, pool)
        found = torch.from_numpy(descent.gradient(np.random.default_rng(1), 0.0))
    torch.testing.assert_close(descent.lobes, anywhere(field), rtol=1e-4, atol=1e-5)
    variable = descent.lobes.clone().requires_grad_()
    (expected,) = torch.autograd.grad(slow_loss(field, variable), variable)
    torch.testing.assert_close(found, expected, rtol=1e-4, atol=1e-6)


def anywhere(field: TexelField) -> torch.Tensor:
    """Lobes [T, N, 7] off the start by random numbers."""
    raw = shared_start(field, LOBES)
    raw += 0.3 * torch.from_numpy(np.random.default_rng(0).standard_normal(raw.shape).astype(np.float32))
    return constrain(raw, torch.from_numpy(field.normals))


def test_steps_are_those_of_adam_by_autograd(monkeypatch: pytest.MonkeyPatch) -> None:
    """With every pixel in each step: parameters, alignment, schedule and moments as they are written elsewhere."""
    monkeypatch.setattr(module, "_TEXELS", 5)
    field, _ = floor(3, 4)
    options = CoherentOptions(steps=6, rate=0.05)
    normals = torch.from_numpy(field.normals)
    raw = unconstrain(anywhere(field), normals)
    moments = Moments(raw, module.EPSILON)
    for step in range(options.steps):
        variable = raw.clone().requires_grad_()
        lobes = constrain(variable, normals)
        alignment = 0.3 * (0.01 / 0.3) ** (step / options.steps)
        leaf = lobes.detach().requires_grad_()
        (gradient,) = torch.autograd.grad(slow_loss(field, leaf), leaf)
        gradient[..., :3] += Neighbourhood(field).pull(leaf.detach()[..., :3], alignment)
        (by_raw,) = torch.autograd.grad(lobes, variable, gradient)
        mean, denominator, correction = moments.update(by_raw, step + 1)
        raw -= one_cycle(step, options.steps, options.rate) / correction * mean / denominator
    found = descend(field, anywhere(field), options, 0)
    moved = (constrain(raw, normals) - anywhere(field)).abs().mean()
    assert (found - constrain(raw, normals)).abs().mean() < 2e-3 * moved


def test_random_subsets_have_the_whole_gradient_as_their_mean(monkeypatch: pytest.MonkeyPatch) -> None:
    field, _ = floor(2, 2)
    lobes = start_of(field)
    with ThreadPoolExecutor(1) as pool:
        descent = module._Descent(field, lobes, CoherentOptions(), 0, pool)
        whole = torch.from_numpy(descent.gradient(np.random.default_rng(0), 0.0))
        monkeypatch.setattr(module, "TEXEL_PIXELS", 32)
        monkeypatch.setattr(module, "BETWEEN_PIXELS", 8)
        descent = module._Descent(field, lobes, CoherentOptions(), 0, pool)
        rngs = (np.random.default_rng([1, k]) for k in range(400))
        drawn = torch.stack([torch.from_numpy(descent.gradient(rng, 0.0)) for rng in rngs])
    error = drawn.std(dim=0) / math.sqrt(len(drawn))
    assert (drawn.std(dim=0) > 0.0).any()
    z = ((drawn.mean(dim=0) - whole) / error.clamp(min=1e-9)).abs()
    assert float(z.max()) < 5.0, "112 components: a false alarm in 15,000 runs"


def test_alignment_pulls_towards_the_neighbours_mean() -> None:
    field, _ = floor(1, 3)
    lobes = start_of(field)
    lobes[1, 0, :3] = torch.tensor([1.0, 0.0, 0.0])
    gradient = Neighbourhood(field).pull(lobes[..., :3], 0.5)
    mean = 0.5 * (lobes[0, 0, :3] + lobes[2, 0, :3])
    torch.testing.assert_close(gradient[1, 0], (2.0 * 0.5 / LOBES) * (lobes[1, 0, :3] - mean))
    assert not gradient[:, 1:].any()


@pytest.fixture(scope="module")
def descended() -> tuple[TexelField, np.ndarray, dict[str, torch.Tensor]]:
    """A floor solved with the traced light fields, with their corners' mean, and at texels alone."""
    field, whole = floor(5, 6)
    options = CoherentOptions(steps=250)
    alone = replace(field, chart=np.arange(len(field)), traced=None)
    fields = {"traced": field, "mean": replace(field, traced=None), "alone": alone}
    return field, whole, {name: descend(one, start_of(one), options, 0) for name, one in fields.items()}


def test_what_is_traced_between_texels_pays_there(
    descended: tuple[TexelField, np.ndarray, dict[str, torch.Tensor]],
) -> None:
    field, whole, found = descended
    normals = np.tile(np.float32([0.0, 1.0, 0.0]), (len(whole), 1))
    at = {name: errors_at_texels(Lobes(lobes), field).log_mse_rel for name, lobes in found.items()}
    between = {
        name: errors_between(Lobes(lobes), field.between, whole, normals, field.exposure).log_mse_rel
        for name, lobes in found.items()
    }
    assert max(at.values()) < 0.02
    assert between["traced"] < 0.5 * between["mean"]
    assert between["traced"] < 0.5 * between["alone"]
    assert between["traced"] < 0.02


def test_the_same_bytes_on_any_number_of_threads(
    descended: tuple[TexelField, np.ndarray, dict[str, torch.Tensor]], monkeypatch: pytest.MonkeyPatch
) -> None:
    field, _, _ = descended
    monkeypatch.setattr(module, "_TEXELS", 8)
    monkeypatch.setattr(module, "_POINTS", 16)
    one, two = (descend(field, start_of(field), CoherentOptions(steps=5), 3, threads=n) for n in (1, 2))
    assert one.numpy().tobytes() == two.numpy().tobytes()
    other = descend(field, start_of(field), CoherentOptions(steps=5), 4)
    assert not torch.equal(one, start_of(field)) and other.shape == one.shape


def test_mean_targets_are_of_the_corners_that_see_the_direction() -> None:
    """Two texels that face away from each other: each direction above either horizon keeps that texel's light."""
    images = np.stack([np.full((SIZE, SIZE, 3), value, np.float16) for value in (1.0, 3.0)])
    normals = np.float32([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0]])
    directions = octahedral.pixel_directions(SIZE)
    for image, normal in zip(images, normals, strict=True):
        image[directions @ normal <= 0.0] = 0.0
    field = TexelField(images, normals, np.array([[0, 0], [0, 1]]), np.zeros(2, np.int64), 1.0)
    targets = mean_targets(field)
    (a, b), (first, second) = targets.offsets[0], (directions[..., 1] > 0.0, directions[..., 0] > 0.0)
    expected = np.where(first & second, 2.0, np.where(first, 1.0, np.where(second, 3.0, 0.0)))
    assert len(targets) == 1
    np.testing.assert_array_equal(targets.images[0, ..., 0], expected[a::2, b::2])
    np.testing.assert_allclose(targets.normals[0], np.float32([1.0, 1.0, 0.0]) / math.sqrt(2.0), rtol=1e-6)


def test_a_field_without_texels_and_one_without_neighbours() -> None:
    field, _ = floor(1, 1)
    nothing = field.take(np.empty(0, np.int64))
    assert descend(nothing, torch.empty(0, LOBES, 7), CoherentOptions(steps=2), 0).shape == (0, LOBES, 7)
    lonely = descend(replace(field, traced=None), start_of(field), CoherentOptions(steps=100), 0)
    assert errors_at_texels(Lobes(lonely), field).log_mse_rel < 0.1
