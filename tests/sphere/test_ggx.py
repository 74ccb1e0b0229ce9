"""GGX against quadrature."""

import numpy as np
import pytest

from kiln_workers.sphere import ggx
from kiln_workers.sphere.quadrature import fibonacci_sphere

POINTS = fibonacci_sphere(1_000_000)
NORMAL = np.array([0.0, 0.0, 1.0])


def integrate(values: np.ndarray) -> float:
    return float(values.mean() * 4.0 * np.pi)


@pytest.mark.parametrize("alpha", [0.05, 0.2, 0.5, 1.0])
def test_distribution_covers_the_surface_once(alpha: float) -> None:
    cosine = POINTS @ NORMAL
    assert integrate(ggx.distribution(cosine, alpha) * np.maximum(cosine, 0.0)) == pytest.approx(1.0, rel=1e-4)


@pytest.mark.parametrize("alpha", [0.2, 0.5, 1.0])
@pytest.mark.parametrize("cos_o", [0.95, 0.5, 0.15])
def test_masking_leaves_the_projected_area(alpha: float, cos_o: float) -> None:
    """Heitz 2014, eq. 14: G1 D (o.m) integrates to n.o."""
    view = np.array([np.sqrt(1.0 - cos_o**2), 0.0, cos_o])
    facing = np.maximum(POINTS @ view, 0.0) * ggx.distribution(POINTS @ NORMAL, alpha)
    assert ggx.masking(np.array(cos_o), alpha) * integrate(facing) == pytest.approx(cos_o, rel=1e-4)


@pytest.mark.parametrize("correlated", [True, False])
@pytest.mark.parametrize("alpha", [0.2, 0.6])
def test_single_scattering_albedo(alpha: float, correlated: bool) -> None:
    cos_o = 0.6
    view = np.array([0.8, 0.0, cos_o])
    half = POINTS + view
    half /= np.maximum(np.linalg.norm(half, axis=-1, keepdims=True), 1e-12)
    cos_i = POINTS @ NORMAL
    g2 = ggx.masking_shadowing(cos_i, np.array(cos_o), alpha, correlated=correlated)
    truth = integrate(np.where(cos_i > 0.0, ggx.distribution(half @ NORMAL, alpha) * g2 / (4.0 * cos_o), 0.0))
    assert ggx.single_scattering_albedo(cos_o, alpha, correlated=correlated) == pytest.approx(truth, rel=1e-3)


def test_smooth_surfaces_lose_nothing_and_rough_ones_something() -> None:
    assert ggx.single_scattering_albedo(0.7, 0.01) == pytest.approx(1.0, abs=1e-3)
    assert 1.0 > ggx.single_scattering_albedo(0.7, 0.3) > ggx.single_scattering_albedo(0.7, 1.0) > 0.3


@pytest.mark.parametrize("alpha", [0.05, 0.2])
def test_gaussian_stands_for_the_distribution(alpha: float) -> None:
    """Eq. 17: D's peak and integral, half of its curvature."""
    sharpness, amplitude = ggx.gaussian_of_distribution(alpha)
    assert amplitude == pytest.approx(float(ggx.distribution(np.array(1.0), alpha)), rel=1e-12)
    angle = 0.01 * alpha
    drop_of_gauss = 1.0 - np.exp(sharpness * (np.cos(angle) - 1.0))
    drop_of_d = 1.0 - ggx.distribution(np.cos(angle), alpha) / amplitude
    assert drop_of_d == pytest.approx(2.0 * drop_of_gauss, rel=2.0 * alpha**2 + 1e-3)
    mass = integrate(amplitude * np.exp(sharpness * (POINTS @ NORMAL - 1.0)))
    assert mass == pytest.approx(1.0, rel=1e-3)


def test_fresnel_ends() -> None:
    np.testing.assert_allclose(ggx.fresnel_schlick(np.array([1.0, 0.0]), 0.04), [0.04, 1.0])
