"""Spot lights against the formula of KHR_lights_punctual, at many angles and between many cones."""

from collections.abc import Callable

import numpy as np
import pytest

from kiln_workers.render.tile import TexelBatch, TileRenderer
from kiln_workers.scene.model import LightKind, Material, Mesh, PunctualLight, Scene

HEIGHT, INTENSITY = 1.5, (30.0, 20.0, 10.0)
ANGLES = np.radians([0.0, 5.0, 14.0, 19.9, 22.0, 27.0, 31.0, 35.0, 40.0, 44.0, 46.0, 60.0])


def khronos(angle: np.ndarray, inner: float, outer: float) -> np.ndarray:
    """The share of the intensity at an angle off the axis, as the extension's text has it."""
    scale = 1.0 / max(0.001, np.cos(inner) - np.cos(outer))
    return np.clip(np.cos(angle) * scale - np.cos(outer) * scale, 0.0, 1.0) ** 2


@pytest.mark.parametrize(
    ("inner", "outer"), [(0.0, 45.0), (20.0, 45.0), (44.9, 45.0), (45.0, 45.0), (0.0, 89.9), (10.0, 30.0)]
)
@pytest.mark.parametrize("tilted", [False, True])
def test_falloff_between_the_cones(
    inner: float,
    outer: float,
    tilted: bool,
    quad: Callable[..., Mesh],
    texels: Callable[..., TexelBatch],
    renderer: Callable[..., TileRenderer],
) -> None:
    """E = I f(angle) cos / d^2 on a floor; with another axis, the angle is that to the axis."""
    axis = np.array([np.sin(0.2), -np.cos(0.2), 0.0]) if tilted else np.array([0.0, -1.0, 0.0])
    light = PunctualLight(
        "spot",
        LightKind.SPOT,
        INTENSITY,
        (0.0, HEIGHT, 0.0),
        (float(axis[0]), float(axis[1]), 0.0),
        float(np.radians(inner)),
        float(np.radians(outer)),
    )
    floor = quad((-9, 0, -9), (0, 0, 18), (18, 0, 0))
    scene = Scene((floor,), (Material("m"),), lights=(light,))
    points = np.stack([HEIGHT * np.tan(ANGLES), 0.0 * ANGLES, 0.0 * ANGLES], axis=1)
    found = renderer(scene, samples=1, irradiance_samples=16, max_depth=1).render(texels(points)).irradiance
    away = points - np.array([0.0, HEIGHT, 0.0])
    distance = np.linalg.norm(away, axis=1)
    angle = np.arccos(np.clip(away @ axis / distance, -1.0, 1.0))
    wanted = khronos(angle, np.radians(inner), np.radians(outer)) * (HEIGHT / distance) / distance**2
    near_edge = np.abs(angle - np.radians(outer)) < 1e-3
    np.testing.assert_allclose(found[~near_edge], wanted[~near_edge, None] * INTENSITY, rtol=2e-3, atol=2e-3)
