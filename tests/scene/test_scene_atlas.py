"""Light-map UVs: which sets are kept, which are refused, and the atlas that is made instead."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import distance_transform_cdt

from kiln_schemas.errors import InputError
from kiln_schemas.settings import AUTO, PRESETS, LightmapSettings, UvPolicy
from kiln_workers.scene.atlas import assign_lightmap_uv, make_lightmap
from kiln_workers.scene.charts import cut_long, gather, straightened
from kiln_workers.scene.examples import courtyard_scene, gallery_scene
from kiln_workers.scene.geometry import face_areas
from kiln_workers.scene.model import Material, Mesh, Scene
from kiln_workers.scene.packing import lay_out, side_for
from kiln_workers.scene.shapes import Cell, patch, sphere
from kiln_workers.scene.texels import rasterise_texels
from kiln_workers.scene.unwrap import cut_into_charts
from kiln_workers.scene.uv_faults import find_faults


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
    whole = says.startswith("overlaps mesh")  # its set has no fault of its own, so it is packed by object
    done = "its own light-map UV is packed" if whole else "unwrapped into 1 chart (its own light-map UV"
    assert any(note.startswith(f"Mesh 'right': {done}") for note in unwrapped.notes)


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


def test_a_light_map_that_is_too_small_says_what_is_needed(make_quad):
    meshes = [make_quad(f"q{k}", (k * 2, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1, 1)) for k in range(12)]
    scene = Scene(tuple(replace(mesh, lightmap_uv=None) for mesh in meshes), (Material("m"),))
    with pytest.raises(InputError, match=r"12 charts with 2 texels between them need 10 x 10 .* has 8 x 8.*auto"):
        assign_lightmap_uv(scene, settings(8))
    assert find_faults(assign_lightmap_uv(scene, settings(10)).meshes, 10) == []
    small = LightmapSettings(resolution=AUTO, density=1e-3, least=8, most=8)
    enlarged = make_lightmap(scene, small)
    assert enlarged.resolution == 16 and find_faults(enlarged.scene.meshes, 16) == []
    assert any("12 charts need them" in note for note in enlarged.scene.notes)


@pytest.mark.parametrize(("charts", "padding", "side"), [(12, 2, 10), (847, 2, 88), (1, 1, 1), (4, 3, 5)])
def test_texels_that_charts_of_one_texel_need(charts, padding, side):
    assert side_for(charts, padding) == side
    assert ((side + padding) // (1 + padding)) ** 2 >= charts > ((side - 1 + padding) // (1 + padding)) ** 2


def test_squares_are_packed_as_full_as_they_can_be(make_quad):
    meshes = [make_quad(f"q{k}", (k * 2, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1, 1)) for k in range(4)]
    parts = [straightened(part) for part in cut_into_charts(meshes)]
    layout = lay_out(meshes, parts, 34, 2)
    assert layout is not None and 15.0 < layout.scale <= 16.0  # 2 x 16 + 2 = 34
    corners = sorted(tuple(uv.min(axis=0).astype(int).tolist()) for uv in layout.uv)
    assert corners == [(0, 0), (0, 18), (18, 0), (18, 18)]
    assert (layout.cut, layout.merged) == (0, 0)


SCALES = [1e-3, 1.0, 1e3]


@pytest.mark.parametrize("scale", SCALES)
@pytest.mark.parametrize("place", [0.0, 5.0])
def test_scale_and_place_of_a_mesh_do_not_matter(scale, place):
    """Faces of 2e-13 m^2 at the smallest scale, far below what unwrappers take for an area (1.2e-7 m^2)."""
    parts = []
    for factor, offset in ((1.0, 0.0), (scale, place * scale)):
        ball = patch("ball", sphere(np.zeros(3), 0.03), (60, 60), Cell(0, 0, 32, 32), 0)
        positions = (ball.positions * factor + offset).astype(np.float32)
        parts += cut_into_charts([replace(ball, positions=positions, lightmap_uv=None)])
    assert [part.loose for part in parts] == [0, 0]
    assert len(parts[1].faces) == len(parts[0].faces) and abs(parts[1].charts - parts[0].charts) <= 2


def test_needles_get_a_chart_of_their_own():
    """Beside a square: two needles of 1 m and 1 um, which the unwrapper leaves out."""
    square = [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]
    needles = [[x, y, z] for z in (1, 2) for x, y in ((0, 0), (1, 0), (0.5, 1e-6))]
    normals = np.tile(np.float32([0, 0, 1]), (10, 1))
    faces = np.array([[0, 1, 2], [0, 2, 3], [4, 5, 6], [7, 8, 9]], np.int32)
    mesh = Mesh("needles", np.array(square + needles, np.float32), normals, faces, 0)
    baked = assign_lightmap_uv(Scene((mesh,), (Material("m"),)), settings(32))
    assert len(baked.meshes[0].faces) == 4 and find_faults(baked.meshes, 32) == []
    assert any("2 faces have a chart each, as they could not be flattened with others" in note for note in baked.notes)


def test_sheets_back_to_back_are_two_surfaces(make_quad):
    """A grid of faces, and all of them once more the other way round, without common vertices."""
    across, down = np.meshgrid(np.arange(6.0), np.arange(6.0))
    points = np.stack([across.ravel(), down.ravel(), 0.1 * across.ravel() ** 2], axis=1).astype(np.float32)
    cells = [(r * 6 + c, r * 6 + c + 1, r * 6 + c + 7, r * 6 + c + 6) for r in range(5) for c in range(5)]
    front = np.array([face for a, b, c, d in cells for face in ((a, b, c), (a, c, d))])
    faces = np.concatenate([front, front[:, ::-1]])
    mesh = Mesh(
        "sheet", points[faces.ravel()], np.zeros((3 * len(faces), 3), np.float32), np.arange(300).reshape(-1, 3), 0
    )
    (part,) = cut_into_charts([mesh])
    assert part.charts <= 6 and part.loose == 0
    chart = part.chart[part.faces[:, 0]]
    assert not set(chart[:50]) & set(chart[50:])


def strip(length: float) -> Scene:
    """A floor of 4 x 4 m and a strip of 0.1 m beside it, as in shared/data/faults/08."""

    def quad(name: str, low: tuple[float, float], high: tuple[float, float]) -> Mesh:
        points = [(low[0], 0, low[1]), (low[0], 0, high[1]), (high[0], 0, high[1]), (high[0], 0, low[1])]
        up = np.tile(np.float32([0, 1, 0]), (4, 1))
        along = np.array(points, np.float32)[:, [0, 2]]
        return Mesh(name, np.array(points, np.float32), up, np.array([[0, 1, 2], [0, 2, 3]], np.int32), 0, uv=along)

    return Scene(
        (quad("floor", (-2, -2), (2, 2)), quad("strip", (-length / 2, 3), (length / 2, 3.1))), (Material("m"),)
    )


def test_a_long_strip_is_cut_and_leaves_the_floor_its_texels():
    scene = assign_lightmap_uv(strip(400.0), settings(256))
    texels = rasterise_texels(scene, 256)
    assert (texels.texel_size[texels.mesh == 0] < 0.03).all()  # uncut 1.6 m at best
    assert (texels.mesh == 1).sum() < 0.125 * 256**2 and np.median(texels.texel_size[texels.mesh == 1]) < 0.2
    floor, cut = scene.meshes
    assert len(floor.faces) == 2 and len(cut.faces) > 20
    np.testing.assert_allclose(face_areas(cut.positions, cut.faces).sum(), 40.0, rtol=1e-4)
    np.testing.assert_allclose(cut.uv, cut.positions[:, [0, 2]], atol=1e-5)  # the texture stays where it was
    np.testing.assert_array_equal(cut.normals, np.tile(np.float32([0, 1, 0]), (len(cut.normals), 1)))
    assert find_faults(scene.meshes, 256) == [] and smallest_gap(texels.chart) >= 2
    whole = make_lightmap(strip(400.0), settings(256), may_cut=False).scene
    assert [len(mesh.faces) for mesh in whole.meshes] == [2, 2]
    coarse = rasterise_texels(whole, 256)  # the strip is shrunk instead
    assert coarse.texel_size[coarse.mesh == 0].max() < 0.03


def test_both_sides_of_a_cut_share_its_points():
    """A strip of many faces: each point of a cut lies in both pieces, and nothing is lost or doubled."""
    (part,) = cut_into_charts([strip(400.0).meshes[1]])
    part = straightened(part)
    pieces = cut_long(part, 30.0)
    assert pieces.charts == 14
    gathered = gather(strip(400.0).meshes[1:], [pieces])
    np.testing.assert_allclose(gathered.area, 40.0 / 14, rtol=1e-5)
    assert gathered.extent.max() <= 30.0
    inner = pieces.share > 0.0
    points = np.stack([pieces.vertex, pieces.other, pieces.share.view(np.int64)], axis=1)[inner]
    edges = np.unique(points, axis=0, return_counts=True)[1]
    assert (edges >= 2).all()


def test_tiny_charts_that_face_the_same_way_share_a_texel(make_quad):
    """400 chips of 1 mm on a floor of 4 m: one mesh, so at 32 texels they would need 60 x 60 texels of their own."""
    floor = make_quad("floor", (0, 0, 0), (4, 0, 0), (0, 4, 0), (0, 0, 1, 1))
    corner = np.array([[0, 0, 0], [1e-3, 0, 0], [1e-3, 1e-3, 0], [0, 1e-3, 0]])
    chips = np.concatenate([corner + np.array([0.01 * (k % 20), 0.01 * (k // 20), 0.1]) for k in range(400)])
    faces = np.concatenate([np.array([[0, 1, 2], [0, 2, 3]]) + 4 * k for k in range(400)])
    up = np.tile(np.float32([0, 0, 1]), (len(chips), 1))
    mesh = Mesh("chips", chips.astype(np.float32), up, faces.astype(np.int32), 0)
    scene = assign_lightmap_uv(Scene((floor, mesh), (Material("m"),)), settings(32, UvPolicy.UNWRAP))
    texels = rasterise_texels(scene, 32)
    assert texels.texel_size[texels.mesh == 0].max() < 0.2
    assert 1 <= (texels.mesh == 1).sum() <= 9
    assert any("of 401 charts are smaller than a texel and share one" in note for note in scene.notes)


@pytest.mark.parametrize(
    ("density", "metres", "side"), [(1.0, 4.0, 16), (10.0, 4.0, 40), (10.0, 20.0, 200), (1e3, 4.0, 256)]
)
def test_auto_takes_the_texels_that_the_density_wants(make_quad, density, metres, side):
    mesh = make_quad("floor", (0, 0, 0), (metres, 0, 0), (0, metres, 0), (0, 0, 1, 1))
    wish = LightmapSettings(resolution=AUTO, density=density, least=16, most=256)
    for uv in (mesh.lightmap_uv, None):
        made = make_lightmap(Scene((replace(mesh, lightmap_uv=uv),), (Material("m"),)), wish)
        assert side <= made.resolution <= 1.3 * side + 8 and made.resolution <= 256
        assert any(
            f"{made.resolution} x {made.resolution} texels" in note and "auto, between 16 and 256" in note
            for note in made.scene.notes
        )


@pytest.mark.parametrize(("preset", "side"), [("draft", 32), ("preview", 64), ("production", 512)])
def test_examples_keep_their_size(preset, side):
    for example in (gallery_scene(), courtyard_scene()):
        assert make_lightmap(example, PRESETS[preset].lightmap).resolution == side


def object_uv(mesh: Mesh) -> Mesh:
    """The mesh with its set stretched over all of 0..1, as Unity, Blender and Bakery make it."""
    low, high = mesh.lightmap_uv.min(axis=0), mesh.lightmap_uv.max(axis=0)
    return replace(mesh, lightmap_uv=((mesh.lightmap_uv - low) / (high - low)).astype(np.float32))


def test_sets_by_object_are_packed_with_a_scale_and_an_offset(make_quad):
    small = object_uv(make_quad("small", (5, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1, 1)))
    large = object_uv(make_quad("large", (0, 0, 0), (4, 0, 0), (0, 4, 0), (0, 0, 1, 1)))
    other = replace(make_quad("other", (0, 0, 3), (2, 0, 0), (0, 2, 0), (0, 0, 1, 1)), lightmap_uv=None)
    scene = Scene((small, large, other), (Material("m"),))
    made = make_lightmap(scene, settings(64))
    assert [place.mesh for place in made.placements] == ["small", "large"]
    for place, before, after in zip(made.placements, scene.meshes, made.scene.meshes, strict=False):
        np.testing.assert_allclose(after.lightmap_uv, before.lightmap_uv * place.scale + place.offset, atol=1e-6)
        np.testing.assert_array_equal(after.faces, before.faces)
    assert made.placements[1].scale == pytest.approx(4.0 * made.placements[0].scale, rel=1e-5)  # by area
    assert find_faults(made.scene.meshes, 64) == []
    texels = rasterise_texels(made.scene, 64)
    assert smallest_gap(texels.chart) >= 2
    np.testing.assert_allclose(texels.texel_size[texels.mesh >= 0], texels.texel_size.max(), rtol=0.01)
    assert any("Mesh 'other': unwrapped" in note for note in made.scene.notes)
