"""Errors of representations against the metrics' own code and slow sums; the fold detector on known turns."""

import numpy as np
import pytest
import torch

from kiln_workers.fit.field import TexelField
from kiln_workers.fit.metrics import texel_errors
from kiln_workers.fit.solution import Harmonics, Lobes
from kiln_workers.fit.solvers.evaluate import errors_at_texels, errors_between, interp_ratio, radiance
from kiln_workers.fit.solvers.folds import turns, visible_energy
from kiln_workers.sphere import gaussian, harmonics, octahedral


def _lobes(field: TexelField, count: int = 3) -> torch.Tensor:
    rng = np.random.default_rng(11)
    axes = rng.standard_normal((len(field), count, 3))
    axes /= np.linalg.norm(axes, axis=-1, keepdims=True)
    rest = rng.uniform(0.5, 20.0, (len(field), count, 4))
    return torch.from_numpy(np.concatenate([axes, rest], axis=2).astype(np.float32))


def test_errors_at_texels_are_the_metrics(lobe_field: TexelField) -> None:
    lobes = _lobes(lobe_field)
    found = errors_at_texels(Lobes(lobes), lobe_field)
    scale = np.float32([1.0] * 4 + [1.0 / lobe_field.exposure] * 3)
    rounded = lobes.half().float().numpy() * scale
    expected = texel_errors(rounded, lobe_field.images, lobe_field.normals, lobe_field.exposure)
    for name in ("error", "zero", "weight"):
        np.testing.assert_allclose(getattr(found, name), getattr(expected, name), rtol=1e-4)
    assert found.log_mse_rel > 0.1


def test_plain_errors_are_sums_over_pixels(lobe_field: TexelField) -> None:
    coefficients = torch.from_numpy(np.random.default_rng(12).standard_normal((12, 9, 3)).astype(np.float32))
    found = errors_at_texels(Harmonics(coefficients), lobe_field, radiance)
    directions = octahedral.pixel_directions(16).reshape(-1, 3)
    weights = octahedral.pixel_solid_angles(16).reshape(-1) * (directions[:, 1] > 0.0)
    values = np.maximum(harmonics.basis(directions, 3) @ coefficients.half().double().numpy(), 0.0)
    target = lobe_field.exposure * lobe_field.images.reshape(12, -1, 3).astype(np.float64)
    expected = (weights[:, None] * (values - target) ** 2).sum() / weights.sum() / 3.0 / 12.0
    assert found.log_mse == pytest.approx(expected, rel=1e-4)
    assert (harmonics.basis(directions, 3) @ coefficients.double().numpy()).min() < 0.0  # so the clamp was compared


def test_errors_between_mix_the_rounded_lobes_of_the_corners(lobe_field: TexelField) -> None:
    lobes = _lobes(lobe_field)
    points = lobe_field.between
    rng = np.random.default_rng(13)
    images = rng.random((len(points), 16, 16, 3)).astype(np.float16)
    normals = lobe_field.normals[points.first]
    found = errors_between(Lobes(lobes), points, images, normals, lobe_field.exposure)
    directions = octahedral.pixel_directions(16).reshape(-1, 3)
    weights = octahedral.pixel_solid_angles(16).reshape(-1) * (directions[:, 1] > 0.0)
    stored = lobes.half().double().numpy()
    for point in range(len(points)):
        mixed = stored[points.corners[point]].mean(axis=0)
        mixed[:, :3] /= np.linalg.norm(mixed[:, :3], axis=1, keepdims=True)
        target = np.log1p(lobe_field.exposure * images[point].reshape(-1, 3).astype(np.float64))
        difference = np.log1p(gaussian.evaluate(directions, mixed)) - target
        assert found.error[point] == pytest.approx((weights[:, None] * difference**2).sum() / 3.0, rel=1e-3)
    assert len(points) == 3 * 3 + 2 * 4 + 2 * 3
    at_texels = errors_at_texels(Lobes(lobes), lobe_field)
    assert interp_ratio(found, at_texels) == pytest.approx(found.log_mse / at_texels.log_mse)


def _turning(field: TexelField, degrees: float) -> torch.Tensor:
    """A lobe of three times the other's amplitude that stays, and one whose axis turns by `degrees` a column."""
    angle = np.deg2rad(degrees) * field.place[:, 1]
    still = np.tile([0.0, 1.0, 0.0, 30.0, 3.0, 3.0, 3.0], (len(field), 1))
    moving = np.stack(
        [np.sin(angle), np.cos(angle), 0.0 * angle, *np.tile([30.0, 1.0, 1.0, 1.0], (len(field), 1)).T], 1
    )
    return torch.from_numpy(np.stack([still, moving], axis=1).astype(np.float32))


def test_folds_are_turns_weighted_by_energy(lobe_field: TexelField) -> None:
    found = turns(_turning(lobe_field, 20.0), lobe_field)
    sides = 3 * 3 + 2 * 4
    assert len(found.degrees) == 2 * sides
    np.testing.assert_allclose(np.unique(found.degrees.round(3)), [0.0, 20.0])
    # A quarter of the light turns, across 9 of the 17 sides, less what of it sinks below the horizon.
    assert found.share_over(15.0) == pytest.approx(0.25 * 9 / 17, rel=0.1)
    assert found.share_over(25.0) == 0.0
    assert found.percentile(50) == pytest.approx(0.0, abs=1e-3) and found.percentile(99) == pytest.approx(20.0)
    histogram = found.histogram(np.array([0.0, 10.0, 30.0]))
    np.testing.assert_allclose(histogram, [1.0 - found.share_over(), found.share_over()], rtol=1e-9)


def test_only_flat_charts_are_looked_at(lobe_field: TexelField) -> None:
    normals = lobe_field.normals.copy()
    normals[0] = [0.6, 0.8, 0.0]
    chart = np.where(lobe_field.place[:, 1] < 2, 0, 1)
    field = TexelField(lobe_field.images, normals, lobe_field.place, chart, 1.0)
    assert len(turns(_turning(field, 5.0), field).degrees) == 2 * (3 * 1 + 2 * 2)
    nothing = field.take(np.array([0]))
    assert turns(_turning(nothing, 5.0), nothing).percentile(50) == 0.0


def test_visible_energy_is_the_integral_above_the_horizon(lobe_field: TexelField) -> None:
    lobes = _turning(lobe_field, 90.0)[:2]
    energy = visible_energy(lobes, lobe_field.take(np.arange(2)))
    whole = float(gaussian.integral(np.array(30.0)))
    np.testing.assert_allclose(energy[0], [3.0 * whole, whole], rtol=2e-3)
    np.testing.assert_allclose(energy[1], [3.0 * whole, 0.5 * whole], rtol=0.05)  # the axis lies on the horizon
