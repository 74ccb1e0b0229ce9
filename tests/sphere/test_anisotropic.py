"""Anisotropic spherical Gaussians: approximations against quadrature, and the misprints."""

import numpy as np
import pytest

from kiln_workers.sphere import anisotropic
from kiln_workers.sphere.anisotropic import Anisotropic
from kiln_workers.sphere.quadrature import fibonacci_sphere, frame

POINTS = fibonacci_sphere(1_000_000)
X, Y, Z = np.eye(3)


def integrate(values: np.ndarray) -> float:
    return float(values.mean() * 4.0 * np.pi)


def test_printed_evaluation_is_not_a_lobe() -> None:
    """Eq. 20 without squares grows without bound away from the axis; squared it peaks there."""
    asg = Anisotropic(X, Y, Z, 30.0, 10.0)
    printed = np.maximum(POINTS @ Z, 0.0) * np.exp(-30.0 * (POINTS @ X) - 10.0 * (POINTS @ Y))
    assert asg(POINTS).max() <= 1.0 < printed.max()
    assert POINTS[np.argmax(asg(POINTS))] @ Z > 0.999


@pytest.mark.parametrize(("lx", "ly"), [(30.0, 10.0), (200.0, 5.0), (8.0, 8.0)])
def test_integral(lx: float, ly: float) -> None:
    truth = integrate(Anisotropic(X, Y, Z, lx, ly)(POINTS))
    assert anisotropic.integral(lx, ly) == pytest.approx(truth, rel=np.exp(-min(lx, ly)) + 1e-5)


def test_product_with_a_gaussian() -> None:
    """Eq. 24 with reduced sharpnesses: 0.0245 where quadrature gives 0.0255; as printed 0.0010."""
    asg = Anisotropic(X, Y, Z, 30.0, 10.0)
    axis, sharpness = np.array([np.sin(0.4), 0.0, np.cos(0.4)]), 25.0
    truth = integrate(asg(POINTS) * np.exp(sharpness * (POINTS @ axis - 1.0)))
    assert anisotropic.product_integral(asg, axis, sharpness) == pytest.approx(truth, rel=0.05)
    nu = 0.5 * sharpness
    printed = np.pi / np.sqrt((nu + 30.0) * (nu + 10.0)) * float(asg(axis))
    assert printed < 0.1 * truth


@pytest.mark.parametrize("tilt", [0.0, 0.4, 0.8, 1.1])
def test_reflected_lobe_follows_the_warped_gaussian(tilt: float) -> None:
    """Eq. 18 against the half-vector Gaussian evaluated at h(i): near the axis they agree in both directions."""
    half, sharpness = np.array([0.36, 0.48, 0.8]), 400.0
    x, _ = frame(half)
    view = np.cos(tilt) * half + np.sin(tilt) * x
    asg = anisotropic.reflected(half, sharpness, view)
    np.testing.assert_allclose([asg.x @ asg.y, asg.x @ asg.z, asg.y @ asg.z], 0.0, atol=1e-9)
    for across in (asg.x, asg.y):
        for angle in (0.01, 0.03):
            light = np.cos(angle) * asg.z + np.sin(angle) * across
            h = (light + view) / np.linalg.norm(light + view)
            truth = np.exp(sharpness * (h @ half - 1.0))
            assert float(asg(light)) == pytest.approx(truth, rel=0.02)


def test_frame_is_orthonormal_for_all_axes() -> None:
    for z in np.concatenate([fibonacci_sphere(100), np.eye(3), -np.eye(3)]):
        x, y = frame(z)
        np.testing.assert_allclose(np.stack([x, y, z]) @ np.stack([x, y, z]).T, np.eye(3), atol=1e-12)
        np.testing.assert_allclose(np.cross(x, y), z, atol=1e-12)
