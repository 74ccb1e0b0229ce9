"""Real spherical harmonics against scipy's complex ones and their own orthonormality."""

import numpy as np
import scipy.special

from kiln_workers.sphere import harmonics
from kiln_workers.sphere.quadrature import fibonacci_sphere


def test_they_are_scipys() -> None:
    directions = np.random.default_rng(0).standard_normal((200, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    theta, phi = np.arccos(directions[:, 2]), np.arctan2(directions[:, 1], directions[:, 0])
    found = harmonics.basis(directions, 12)
    for degree in range(12):
        for order in range(-degree, degree + 1):
            value = scipy.special.sph_harm_y(degree, abs(order), theta, phi) * (-1.0) ** order
            part = value.real if order >= 0 else value.imag
            expected = part if order == 0 else np.sqrt(2.0) * part
            np.testing.assert_allclose(found[:, degree * (degree + 1) + order], expected, atol=1e-11)


def test_they_are_orthonormal() -> None:
    values = harmonics.basis(fibonacci_sphere(200_000), 6)
    np.testing.assert_allclose(values.T @ values * (4.0 * np.pi / 200_000), np.eye(36), atol=1e-4)
    assert harmonics.band_of(3).tolist() == [0, 1, 1, 1, 2, 2, 2, 2, 2]
