"""Rounding to half floats: unit axes, clamped and counted values, and the layout of lobe layers."""

import numpy as np
import pytest

from kiln_schemas.errors import InternalError
from kiln_workers.package.half import as_stored, layers_to_lobes, lobes_to_layers, to_half


def random_lobes(*shape: int) -> np.ndarray:
    random = np.random.default_rng(5)
    lobes = random.normal(size=(*shape, 7)).astype(np.float32)
    lobes[..., 3:] = random.lognormal(sigma=2.0, size=(*shape, 4))
    return lobes


def test_layers_hold_axis_sharpness_and_amplitude() -> None:
    lobes = random_lobes(3, 5, 4)
    layers, clamped = lobes_to_layers(lobes)
    assert layers.shape == (8, 3, 5, 4)
    assert layers.dtype == np.float16
    assert clamped == 0
    axis = lobes[2, 1, 3, :3] / np.linalg.norm(lobes[2, 1, 3, :3])
    np.testing.assert_allclose(layers[6, 2, 1, :3], axis, atol=2**-12)
    np.testing.assert_allclose(layers[6, 2, 1, 3], lobes[2, 1, 3, 3], rtol=2**-11)
    np.testing.assert_allclose(layers[7, 2, 1, :3], lobes[2, 1, 3, 4:], rtol=2**-11)
    assert not layers[1::2, ..., 3].any()


def test_layers_read_back_as_the_lobes_as_stored() -> None:
    lobes = random_lobes(3, 5, 4)
    layers, _ = lobes_to_layers(lobes)
    np.testing.assert_array_equal(layers_to_lobes(layers), as_stored(lobes))


def test_stored_axes_are_unit_to_half_precision() -> None:
    lobes = random_lobes(40, 40, 2)
    lobes[..., :3] *= 1e-3
    norms = np.linalg.norm(as_stored(lobes)[..., :3].astype(np.float64), axis=-1)
    assert np.abs(norms - 1.0).max() < 2**-11 * np.sqrt(3.0)


def test_a_zero_axis_becomes_up() -> None:
    lobes = np.zeros((1, 1, 1, 7), np.float32)
    np.testing.assert_array_equal(as_stored(lobes)[0, 0, 0], [0, 1, 0, 0, 0, 0, 0])


def test_values_beyond_the_range_are_clamped_and_counted() -> None:
    halves, clamped = to_half(np.array([1e6, -1e6, np.inf, 65504.0, 65519.0, 1.0], np.float32))
    np.testing.assert_array_equal(halves, np.array([65504, -65504, 65504, 65504, 65504, 1], np.float16))
    assert clamped == 4


def test_not_a_number_is_a_defect() -> None:
    with pytest.raises(InternalError, match="1 values are not numbers"):
        to_half(np.array([1.0, np.nan]))
