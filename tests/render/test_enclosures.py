"""A closed room without a lamp is dark, however bright the sky around it is: every texel, exactly."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from enclosures import Room, box, closed_scene, octahedron, polygon, rotated, sliced, tetrahedron, wedge

from kiln_workers.render.tile import TexelBatch, TileRenderer
from kiln_workers.scene.model import Environment, Scene
from kiln_workers.scene.texel_map import TexelState
from kiln_workers.scene.texels import build_texel_map

RESOLUTION = 64

ROOMS: dict[str, Room] = {
    "box": box(),
    "turned box": rotated(box(), 1),
    "another turned box": rotated(box((7.0, 3.0, 0.4)), 2),
    "triangle": polygon(3),
    "hexagon": rotated(polygon(6), 3),
    "many sides": polygon(17),
    "tetrahedron": rotated(tetrahedron(), 4),
    "octahedron": octahedron(),
    "wedge": wedge(),
    "turned wedge": rotated(wedge(), 5),
    "slivers of 1 mm": sliced(rotated(box(), 6), 1e-3),
    "slivers of 10 um": sliced(box(), 1e-5),
}
WHITE = Environment(np.ones((8, 16, 3), np.float32))


def lit(scene: Scene, renderer: Callable[..., TileRenderer]) -> tuple[np.ndarray, np.ndarray]:
    """Irradiance [T, 3] and light fields [T, R, R, 3] of all texels."""
    texel_map = build_texel_map(scene, RESOLUTION, "cpu")
    batch = TexelBatch.of(texel_map, np.nonzero(texel_map.state == TexelState.VALID))
    assert len(batch) > 300
    images = renderer(replace(scene, environment=WHITE), samples=1, irradiance_samples=256).render(batch)
    return images.irradiance, images.light_field


@pytest.mark.parametrize("double_sided", [False, True])
@pytest.mark.parametrize("name", ROOMS)
def test_no_sky_comes_in(name: str, double_sided: bool, renderer: Callable[..., TileRenderer]) -> None:
    scene = closed_scene(ROOMS[name], seed=len(name), resolution=RESOLUTION, one_mesh=len(name) % 2 == 0)
    material = replace(scene.materials[0], double_sided=double_sided)
    irradiance, light_field = lit(replace(scene, materials=(material,)), renderer)
    leaks = np.flatnonzero(irradiance.max(axis=1) > 0.0)
    assert not len(leaks), f"{len(leaks)} of {len(irradiance)} texels are lit, up to {irradiance.max():.3f}"
    assert not light_field.any()


def test_the_test_sees_a_hole(renderer: Callable[..., TileRenderer]) -> None:
    room = box()
    irradiance, _ = lit(closed_scene(Room(room.corners, room.walls[:-1])), renderer)
    assert (irradiance.max(axis=1) > 0.0).mean() > 0.8
