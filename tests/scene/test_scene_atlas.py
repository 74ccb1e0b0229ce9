"""Light-map UVs: which sets are kept, which are refused, and the atlas that is made instead."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import distance_transform_cdt

from kiln_schemas.errors import InputError
from kiln_schemas.settings import LightmapSettings, UvPolicy
from kiln_workers.scene.atlas import assign_lightmap_uv, find_faults
from kiln_workers.scene.geometry import face_areas
from kiln_workers.scene.model import Material, Mesh, Scene
from kiln_workers.scene.packing import Chart, pack_charts
from kiln_workers.scene.shapes import Cell, patch, sphere
from kiln_workers.scene.texels import rasterise_texels


def settings(resolution: int = 64, uv: UvPolicy = UvPolicy.AUTO, padding: int = 2) -> LightmapSettings:
    return LightmapSettings(resolution=resolution, uv=uv, padding=padding)


def smallest_gap(charts: np.ndarray) -> int:
    """Empty texels (chessboard) between the two nearest charts."""
    gaps = []
    for chart in np.unique(charts[charts >= 0]):
        others = (charts >= 0) & (charts != chart)
        gaps.append(int(distance_transform_cdt(charts != chart, "chessboard")[others].min()) - 1)
    return min(gaps)


@pytest.fixture
def balls() -> Scene:
    """Two spheres that share one light-map cell, as instances do."""
    parts = [patch(f"ball {x}", sphere(np.array([x, 0.0, 0.0]), 0.5), (12, 12), Cell(0, 0, 32, 32), 0) for x in (0, 2)]
    return Scene(tuple(parts), (Material("m"),))


def test_a_unique_set_is_kept_unchanged(two_quads):
    kept = assign_lightmap_uv(two_quads, settings())
    for before, after in zip(two_quads.meshes, kept.meshes, strict=True):
        np.testing.assert_array_equal(before.lightmap_uv, after.lightmap_uv)
    assert kept.notes == tuple(f"Mesh '{name}': its own light-map UV is kept." for name in ("left", "right"))


def moved(mesh: Mesh, offset: tuple[float, float]) -> Mesh:
    return replace(mesh, lightmap_uv=mesh.lightmap_uv + np.float32(offset))


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda mesh: replace(mesh, lightmap_uv=None), "is missing"),
        (lambda mesh: moved(mesh, (0.2, 0.0)), r"leaves \[0, 1\] at vertex 1"),
        (lambda mesh: moved(mesh, (-0.4, 0.0)), "overlaps mesh 'left'"),
        (lambda mesh: replace(mesh, lightmap_uv=mesh.lightmap_uv * [0, 1]), "2 faces without area"),
        (lambda mesh: replace(mesh, lightmap_uv=mesh.lightmap_uv[[0, 1, 2, 1]]), "overlap|without area"),
    ],
)
def test_a_set_given_as_final_is_refused_with_its_fault(two_quads, change, says):
    scene = replace(two_quads, meshes=(two_quads.meshes[0], change(two_quads.meshes[1])))
    with pytest.raises(InputError, match=f"mesh 'right': its light-map UV .*({says})"):
        assign_lightmap_uv(scene, settings(uv=UvPolicy.KEEP))
    unwrapped = assign_lightmap_uv(scene, settings())
    assert not find_faults(unwrapped.meshes, 64)
    assert any(
        note.startswith("Mesh 'right': unwrapped") and "its own light-map UV" in note for note in unwrapped.notes
    )


def test_charts_that_touch_or_share_an_edge_do_not_overlap(make_quad):
    left = make_quad("left", (0, 0, 0), (1, 0, 0), (0, 1, 0), (0.1, 0.1, 0.4333, 0.4))
    right = make_quad("right", (1, 0, 0), (1, 0, 0), (0, 1, 0), (0.4333, 0.1, 0.9, 0.4))
    assert find_faults((left, right), 64) == []
    deeper = moved(right, (-0.05, 0.0))
    assert [fault.mesh for fault in find_faults((left, deeper), 64)] == ["right"]


def test_instances_are_unwrapped_together_into_one_page(balls):
    scene = assign_lightmap_uv(balls, settings())
    uv = np.concatenate([mesh.lightmap_uv for mesh in scene.meshes])
    assert uv.min() >= 0.0 and uv.max() <= 1.0
    assert find_faults(scene.meshes, 64) == []
    for before, after in zip(balls.meshes, scene.meshes, strict=True):
        assert len(after.faces) == len(before.faces)
        np.testing.assert_allclose(
            face_areas(after.positions, after.faces).sum(), face_areas(before.positions, before.faces).sum(), rtol=1e-5
        )
        corners = [np.sort(mesh.positions[mesh.faces].reshape(-1, 9), axis=0) for mesh in (before, after)]
        np.testing.assert_array_equal(*corners)
    again = assign_lightmap_uv(balls, settings())
    for one, two in zip(scene.meshes, again.meshes, strict=True):
        np.testing.assert_array_equal(one.lightmap_uv, two.lightmap_uv)


@pytest.mark.parametrize(("resolution", "padding"), [(32, 2), (64, 1), (64, 3)])
def test_padding_lies_between_charts(balls, resolution, padding):
    scene = assign_lightmap_uv(balls, settings(resolution, UvPolicy.UNWRAP, padding))
    texels = rasterise_texels(scene, resolution)
    assert smallest_gap(texels.chart) >= padding
    assert texels.covered > 0.3 * resolution**2


def test_scale_is_the_same_everywhere(balls):
    big = replace(balls.meshes[1], positions=balls.meshes[1].positions * np.float32(2.0))
    scene = assign_lightmap_uv(replace(balls, meshes=(balls.meshes[0], big)), settings(64))
    texels = rasterise_texels(scene, 64)
    sizes = [np.median(texels.texel_size[texels.mesh == index]) for index in (0, 1)]
    np.testing.assert_allclose(sizes[0], sizes[1], rtol=0.1)


def test_too_many_charts_for_the_light_map_are_refused(make_quad):
    meshes = [make_quad(f"q{k}", (k * 2, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1, 1)) for k in range(12)]
    scene = Scene(tuple(meshes), (Material("m"),))
    with pytest.raises(InputError, match=r"12 charts with 2 texels .* 8 x 8 .*Raise lightmap.resolution"):
        assign_lightmap_uv(scene, settings(8))
    assert find_faults(assign_lightmap_uv(scene, settings(32)).meshes, 32) == []


def test_squares_are_packed_as_full_as_they_can_be():
    square = np.array([[[0, 0], [1, 0], [1, 1]], [[0, 0], [1, 1], [0, 1]]], dtype=np.float64)
    scale, places = pack_charts([Chart(square)] * 4, 34, 2)
    assert 15.0 < scale <= 16.0  # 2 x 16 + 2 = 34
    corners = sorted((int(place.origin[0]), int(place.origin[1])) for place in places)
    assert corners == [(0, 0), (0, 18), (18, 0), (18, 18)]
