"""Light depends neither on the unit of length, nor on where the origin is, nor on what else is in the file."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import pytest

from kiln_workers.render.tile import TexelBatch, TileRenderer
from kiln_workers.scene.model import Material, Mesh, Scene
from kiln_workers.scene.origin import about_own_centre
from kiln_workers.scene.texel_map import TexelState
from kiln_workers.scene.texels import build_texel_map

Quad = Callable[..., Mesh]

MATERIALS = (
    Material("grey", (0.5, 0.5, 0.5, 1.0)),
    Material("lamp", (0.0, 0.0, 0.0, 1.0), emission=(6.0, 6.0, 6.0)),
    Material("open", (0.5, 0.5, 0.5, 1.0), double_sided=True),
)
SIZE = 24
UTM = (5e5, 0.0, 4e6)


def charted(mesh: Mesh, place: int, material: int = 0) -> Mesh:
    """The quad with the chart number `place` of a 3 x 3 grid, at an odd place within it."""
    uv = np.array([[0, 1], [1, 1], [1, 0], [0, 0]], np.float32) * 0.27 + [0.017, 0.023]
    lightmap_uv = (uv + np.array([place % 3, place // 3]) / 3.0).astype(np.float32)
    return replace(mesh, lightmap_uv=lightmap_uv, material=material)


def slab_scene(quad: Quad) -> tuple[Mesh, ...]:
    """Fault 04: a floor, a slab 0.3 m above it, a lamp."""
    return (
        charted(quad((-2, 0, -2), (0, 0, 4), (4, 0, 0)), 0),
        charted(quad((-1, 0.32, -1), (0, 0, 2), (2, 0, 0)), 1),
        charted(quad((-1, 0.3, -1), (2, 0, 0), (0, 0, 2)), 2),
        charted(quad((-0.5, 2, -0.5), (1, 0, 0), (0, 0, 1)), 3, 1),
    )


def crate_scene(quad: Quad) -> tuple[Mesh, ...]:
    """Fault 05: a crate 3 cm above a floor, turned a little, under a lamp."""
    a, b, c = (np.array(v) for v in ((0.6, 0.02, 0.1), (-0.02, 0.6, 0.03), (-0.1, -0.03, 0.6)))
    o = np.array([-0.3, 0.08, -0.3])
    sides = [(o, a, c), (o + b, c, a), (o, b, a), (o + c, a, b), (o, c, b), (o + a, b, c)]
    return (
        charted(quad((-2, 0, -2), (0, 0, 4), (4, 0, 0)), 0),
        charted(quad((-0.5, 2, -0.5), (1, 0, 0), (0, 0, 1)), 1, 1),
        *(charted(quad(*side), 2 + number) for number, side in enumerate(sides)),
    )


def irradiance(
    meshes: Sequence[Mesh], renderer: Callable[..., TileRenderer], scale: float, offset: Sequence[float]
) -> np.ndarray:
    """Of the first mesh's texels [T, 3], the scene scaled about the origin and then moved."""
    moved = [replace(mesh, positions=mesh.positions.astype(np.float64) * scale + offset) for mesh in meshes]
    scene = about_own_centre(Scene(tuple(moved), MATERIALS))
    texel_map = build_texel_map(scene, SIZE, "cpu")
    place = np.nonzero((texel_map.mesh == 0) & (texel_map.state == TexelState.VALID))
    return (
        renderer(scene, samples=1, irradiance_samples=1024, max_depth=3)
        .render(TexelBatch.of(texel_map, place))
        .irradiance
    )


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e4])
@pytest.mark.parametrize("offset", [(0.0, 0.0, 0.0), UTM], ids=["origin", "UTM"])
@pytest.mark.parametrize("make", [slab_scene, crate_scene], ids=["slab", "crate"])
def test_scales_and_offsets(
    make: Callable[[Quad], tuple[Mesh, ...]], scale: float, offset: tuple[float, ...], quad: Quad, renderer: Callable
) -> None:
    """The random numbers are the same, so are the values but for what rounding does to a few rays."""
    wanted = irradiance(make(quad), renderer, 1.0, (0.0, 0.0, 0.0))
    found = irradiance(make(quad), renderer, scale, offset)
    assert wanted.max() > 0.05 and wanted.min() < 0.05 * wanted.max()
    np.testing.assert_allclose(found, wanted, rtol=0.01, atol=0.004 * wanted.max())


@pytest.mark.parametrize("tilt", [0.0, 3e-5])
def test_a_ground_of_20_km_changes_nothing(tilt: float, quad: Quad, renderer: Callable) -> None:
    """Fault 05: half a metre below, level or not."""
    ground = charted(quad((-1e4, -0.5 - 1e4 * tilt, -1e4), (0, 0, 2e4), (2e4, 2e4 * tilt, 0)), 8)
    alone = irradiance(crate_scene(quad), renderer, 1.0, (0.0, 0.0, 0.0))
    found = irradiance((*crate_scene(quad), ground), renderer, 1.0, (0.0, 0.0, 0.0))
    np.testing.assert_allclose(found, alone, rtol=0.01, atol=0.004 * alone.max())


def test_a_stray_mesh_at_the_origin_does_not_blur_a_scene_in_map_coordinates(quad: Quad, renderer: Callable) -> None:
    stray = charted(quad(tuple(-x for x in UTM), (0.1, 0, 0), (0, 0.1, 0)), 8)
    wanted = irradiance(slab_scene(quad), renderer, 1.0, (0.0, 0.0, 0.0))
    found = irradiance((*slab_scene(quad), stray), renderer, 1.0, UTM)
    np.testing.assert_allclose(found, wanted, rtol=0.01, atol=0.004 * wanted.max())


def test_lights_and_user_coordinates_follow_the_origin(quad: Quad) -> None:
    near = about_own_centre(Scene((quad((3, 1, -7), (1, 0, 0), (0, 1, 0)),), MATERIALS))
    assert near.origin == (0.0, 0.0, 0.0) and near.meshes[0].positions.dtype == np.float32
    np.testing.assert_array_equal(near.meshes[0].positions[0], [3, 1, -7])
    mesh = quad((0, 0, 0), (1, 0, 0), (0, 1, 0))
    far = about_own_centre(Scene((replace(mesh, positions=mesh.positions + np.array(UTM) + 0.1),), MATERIALS))
    local = far.meshes[0].positions
    assert np.abs(local).max() < 40.0 and any("far from the origin" in note for note in far.notes)
    np.testing.assert_allclose(local[0].astype(np.float64) + far.origin, np.array(UTM) + 0.1, rtol=0, atol=1e-6)
