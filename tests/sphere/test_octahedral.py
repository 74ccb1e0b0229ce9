"""The octahedral map against brute force."""

import numpy as np
import pytest

from kiln_workers.sphere import octahedral
from kiln_workers.sphere.quadrature import fibonacci_sphere


def test_encode_undoes_decode() -> None:
    xy = np.random.default_rng(1).uniform(-1.0, 1.0, (100_000, 2))
    np.testing.assert_allclose(octahedral.encode(octahedral.decode(xy)), xy, atol=1e-12)


def test_decode_undoes_encode() -> None:
    directions = fibonacci_sphere(100_000)
    np.testing.assert_allclose(octahedral.decode(octahedral.encode(directions)), directions, atol=1e-12)


def test_axes_lie_where_the_conventions_say() -> None:
    directions = octahedral.decode(np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [1.0, 1.0], [-1.0, 1.0]]))
    np.testing.assert_allclose(directions, [[0, 0, 1], [1, 0, 0], [0, 1, 0], [0, 0, -1], [0, 0, -1]], atol=1e-12)


@pytest.mark.parametrize("size", [2, 16, 32, 128])
def test_solid_angles_sum_to_the_sphere(size: int) -> None:
    assert octahedral.pixel_solid_angles(size).sum() == pytest.approx(4.0 * np.pi, rel=1e-12)


def test_solid_angles_match_counted_points() -> None:
    """10^6 equal-area points binned by pixel: the counts deviate by the rims of the pixels only."""
    size, count = 16, 1_000_000
    cell = ((octahedral.encode(fibonacci_sphere(count)) + 1.0) * 0.5 * size).astype(int).clip(0, size - 1)
    counted = np.bincount(cell[:, 1] * size + cell[:, 0], minlength=size * size).reshape(size, size)
    np.testing.assert_allclose(counted * 4.0 * np.pi / count, octahedral.pixel_solid_angles(size), rtol=0.02)


def test_solid_angles_match_the_jacobian_integrated_over_each_pixel() -> None:
    size, sub = 16, 32
    fine = octahedral.jacobian(octahedral.pixel_grid(size * sub)) * (2.0 / (size * sub)) ** 2
    summed = fine.reshape(size, sub, size, sub).sum(axis=(1, 3))
    np.testing.assert_allclose(summed, octahedral.pixel_solid_angles(size), rtol=1e-3)


def test_jacobian_matches_finite_differences() -> None:
    xy = np.random.default_rng(2).uniform(-0.99, 0.99, (2000, 2))
    edge = np.minimum(np.abs(xy).min(axis=1), np.abs(1.0 - np.abs(xy).sum(axis=1)))
    xy = xy[edge > 1e-4]
    step, along_x, along_y = 1e-6, np.array([1e-6, 0.0]), np.array([0.0, 1e-6])
    dx = (octahedral.decode(xy + along_x) - octahedral.decode(xy - along_x)) / (2.0 * step)
    dy = (octahedral.decode(xy + along_y) - octahedral.decode(xy - along_y)) / (2.0 * step)
    np.testing.assert_allclose(np.linalg.norm(np.cross(dx, dy), axis=-1), octahedral.jacobian(xy), rtol=1e-6)


@pytest.mark.parametrize("size", [16, 64])
def test_pixels_of_directions_are_those_whose_square_they_lie_in(size: int) -> None:
    inside = np.random.default_rng(3).uniform(0.01, 0.99, 2)
    directions = octahedral.decode(octahedral.pixel_grid(size, (inside[0], inside[1])))
    np.testing.assert_array_equal(octahedral.pixel_of(directions, size).ravel(), np.arange(size * size))
