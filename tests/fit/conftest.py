"""Small light fields made of true lobes: two moving lights over a floor and a wall."""

import numpy as np
import pytest

from kiln_workers.fit.field import TexelField
from kiln_workers.fit.source import ArraySource
from kiln_workers.sphere import gaussian, octahedral

SIZE = 16


def made_of_lobes(texels: int, size: int = SIZE) -> tuple[np.ndarray, np.ndarray]:
    """Images [T, R, R, 3] float16, black below the horizon, and normals [T, 3]; neighbours differ a little."""
    t = np.linspace(0.0, 1.0, texels)[:, None]
    normals = np.where(np.arange(texels)[:, None] % 2 == 0, [0.0, 1.0, 0.0], [0.0, 0.6, 0.8])

    def moving(start: list[float], end: list[float], sharpness: float, amplitude: list[float]) -> np.ndarray:
        axis = np.array(start) * (1.0 - t) + np.array(end) * t
        axis /= np.linalg.norm(axis, axis=-1, keepdims=True)
        return np.concatenate([axis, np.full_like(t, sharpness), np.tile(amplitude, (texels, 1))], axis=1)

    lobes = np.stack(
        [
            moving([1.0, 0.8, 0.3], [0.2, 1.0, 0.9], 20.0, [9.0, 6.0, 2.0]),
            moving([-0.6, 1.0, 0.5], [-0.9, 0.6, 0.9], 4.0, [0.3, 0.5, 1.0]),
        ],
        axis=1,
    )
    directions = octahedral.pixel_directions(size).reshape(-1, 3)
    above = normals @ directions.T > 0.0
    images = gaussian.evaluate(directions, lobes) * above[..., None]
    return images.reshape(texels, size, size, 3).astype(np.float16), normals.astype(np.float32)


@pytest.fixture
def lobe_source() -> ArraySource:
    return ArraySource(*made_of_lobes(40), tile=16)


@pytest.fixture(scope="session")
def lobe_field() -> TexelField:
    """A flat chart of 3 x 4 texels, two lobes a texel whose axes turn by some 6 degrees from texel to texel."""
    place = np.argwhere(np.ones((3, 4), bool))
    normals = np.tile(np.float32([0.0, 1.0, 0.0]), (len(place), 1))
    row, column = place.T.astype(np.float64)

    def turning(axis: list[float], sharpness: float, amplitude: list[float]) -> np.ndarray:
        axes = np.array(axis) + 0.1 * np.stack([column, 0.0 * row, row], axis=1)
        axes /= np.linalg.norm(axes, axis=1, keepdims=True)
        return np.concatenate([axes, np.tile([sharpness, *amplitude], (len(place), 1))], axis=1)

    lobes = np.stack(
        [turning([-0.6, 1.0, 0.2], 25.0, [4.0, 3.0, 1.0]), turning([0.5, 0.7, -0.4], 8.0, [0.5, 1.0, 2.0])], axis=1
    )
    directions = octahedral.pixel_directions(SIZE).reshape(-1, 3)
    images = gaussian.evaluate(directions, lobes) * (normals @ directions.T > 0.0)[..., None]
    chart = np.zeros(len(place), np.int64)
    return TexelField(images.reshape(-1, SIZE, SIZE, 3).astype(np.float16), normals, place, chart, 0.7)
