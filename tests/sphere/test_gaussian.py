"""Spherical Gaussians: the checked identities hold by quadrature, the printed ones do not."""

import numpy as np
import pytest

from kiln_workers.sphere import gaussian
from kiln_workers.sphere.quadrature import fibonacci_sphere

POINTS = fibonacci_sphere(1_000_000)


def lobe(axis: np.ndarray, sharpness: float) -> np.ndarray:
    return np.exp(sharpness * (POINTS @ axis - 1.0))


def integrate(values: np.ndarray) -> float:
    return float(values.mean() * 4.0 * np.pi)


@pytest.mark.parametrize("sharpness", [0.0, 1e-13, 0.5, 10.0, 300.0])
def test_integral(sharpness: float) -> None:
    axis = np.array([0.48, -0.6, 0.64])
    assert gaussian.integral(np.array(sharpness)) == pytest.approx(integrate(lobe(axis, sharpness)), rel=1e-6)


@pytest.mark.parametrize(("first", "second", "tilt"), [(8.0, 5.0, 0.7), (40.0, 3.0, 1.5), (2.0, 2.0, 1.0)])
def test_product_integral(first: float, second: float, tilt: float) -> None:
    """Eq. 23 without its division is exact; as printed it misses by orders of magnitude."""
    axis_1, axis_2 = np.array([0.0, 0.0, 1.0]), np.array([np.sin(tilt), 0.0, np.cos(tilt)])
    truth = integrate(lobe(axis_1, first) * lobe(axis_2, second))
    got = gaussian.product_integral(axis_1, np.array(first), axis_2, np.array(second))
    assert got == pytest.approx(truth, rel=1e-6)
    m = np.linalg.norm(first * axis_1 + second * axis_2) / (first + second)
    printed = 4.0 * np.pi * np.exp(-(first + second)) * np.sinh(m) / m
    assert abs(printed - truth) > 0.5 * truth


def test_product_integral_does_not_overflow() -> None:
    axis = np.array([0.0, 1.0, 0.0])
    got = gaussian.product_integral(axis, np.array(5e4), axis, np.array(5e4))
    assert got == pytest.approx(2.0 * np.pi / 1e5, rel=1e-9)


def test_evaluate_sums_the_lobes() -> None:
    lobes = np.array([[0, 0, 1, 4, 1, 2, 3], [0, 1, 0, 9, 0.5, 0, 1]], float)
    directions = fibonacci_sphere(50)
    wanted = sum(row[4:] * np.exp(row[3] * (directions @ row[:3] - 1.0))[:, None] for row in lobes)
    np.testing.assert_allclose(gaussian.evaluate(directions, lobes), wanted, rtol=1e-12)


def test_derivative_by_the_axis_is_the_tangential_part() -> None:
    """Eq. 14 needs the direction's component; on unit axes only the part across the axis is a change."""
    axis, sharpness, direction = np.array([0.6, 0.0, 0.8]), 7.0, np.array([0.0, 0.6, 0.8])
    value = np.exp(sharpness * (direction @ axis - 1.0))
    gradient = sharpness * value * (direction - (direction @ axis) * axis)
    for tangent in (np.array([0.8, 0.0, -0.6]), np.array([0.0, 1.0, 0.0])):
        step = 1e-6
        ends = [axis + sign * step * tangent for sign in (1.0, -1.0)]
        ends = [end / np.linalg.norm(end) for end in ends]
        slope = np.diff([np.exp(sharpness * (direction @ end - 1.0)) for end in reversed(ends)])[0] / (2.0 * step)
        assert slope == pytest.approx(float(gradient @ tangent), rel=1e-6, abs=1e-9)
