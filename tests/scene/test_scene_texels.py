"""The texel map: conservative coverage, points, normals, alpha, terminator, push-out."""

from dataclasses import replace

import numpy as np
import pytest

from kiln_schemas.errors import InputError
from kiln_workers.scene.lookup import look_up
from kiln_workers.scene.model import Image, Material, Mesh, Scene, TextureRef
from kiln_workers.scene.picture import texel_map_picture
from kiln_workers.scene.push_out import tangent_directions
from kiln_workers.scene.raster import interior_samples, kept_inside, touched_squares
from kiln_workers.scene.shapes import Cell, patch, sphere
from kiln_workers.scene.texel_map import TexelState, pack_texel_map, unpack_texel_map
from kiln_workers.scene.texels import MIN_COSINE, bent_normals, build_texel_map, rasterise_texels


def clipped_area(triangle: np.ndarray, column: int, row: int) -> float:
    """Area of a triangle inside a unit square by Sutherland and Hodgman's clipping: the slow reference."""
    polygon = [tuple(p) for p in triangle]
    bounds = [(0, column, 1), (0, column + 1, -1), (1, row, 1), (1, row + 1, -1)]
    for axis, bound, sign in bounds:
        out = []
        for i, p in enumerate(polygon):
            q = polygon[i - 1]
            inside_p, inside_q = sign * (p[axis] - bound) >= 0, sign * (q[axis] - bound) >= 0
            if inside_p != inside_q:
                t = (bound - q[axis]) / (p[axis] - q[axis])
                out.append((q[0] + t * (p[0] - q[0]), q[1] + t * (p[1] - q[1])))
            if inside_p:
                out.append(p)
        polygon = out
        if not polygon:
            return 0.0
    x, y = np.array(polygon).T
    return 0.5 * abs(float(np.dot(x, np.roll(y, 1)) - np.dot(y, np.roll(x, 1))))


@pytest.mark.parametrize("seed", range(4))
def test_coverage_and_winners_agree_with_brute_force(seed):
    rng = np.random.default_rng(seed)
    size = 12
    corners = rng.uniform(-1.0, size + 1.0, (1, 1, 2)) + rng.normal(0.0, [1.0, 5.0][seed % 2], (6, 3, 2))
    touched = touched_squares(corners, size, size)
    covered = {
        (row, column)
        for row in range(size)
        for column in range(size)
        if any(clipped_area(triangle, column, row) > 1e-7 for triangle in corners)
    }
    assert {divmod(int(square), size) for square in touched.square} == covered
    weights = rng.dirichlet(np.full(3, 0.5), 20_000)
    for square, face, barycentric, distance in zip(
        touched.square, touched.face, touched.barycentric, touched.distance, strict=True
    ):
        centre = np.array([square % size + 0.5, square // size + 0.5])
        point = barycentric @ corners[face]
        assert barycentric.min() >= 0.0 and abs(barycentric.sum() - 1.0) < 1e-9
        assert abs(np.linalg.norm(point - centre) - distance) < 1e-6
        rivals = [
            i for i in range(len(corners)) if clipped_area(corners[i], int(square % size), int(square // size)) > 1e-7
        ]
        nearest = min(np.linalg.norm(weights @ corners[i] - centre, axis=1).min() for i in rivals)
        assert distance <= nearest + 1e-9


def test_interior_samples_count_the_area():
    corners = np.array([[[2.0, 3.0], [60.0, 10.0], [20.0, 55.0]]])
    samples = sum(len(sample) for _, sample in interior_samples(corners, 64, 0.0))
    area = 0.5 * abs(58.0 * 52.0 - 7.0 * 18.0)
    assert abs(samples - area) < 0.02 * area
    assert sum(len(sample) for _, sample in interior_samples(corners[:, ::-1], 64, 0.0)) == samples


def test_points_lie_at_texel_centres_or_on_the_charts_edge(make_quad):
    mesh = make_quad("floor", (0, 0, 0), (4, 0, 0), (0, 0, -4), (0.25, 0.25, 0.75, 0.75))
    texels = rasterise_texels(Scene((mesh,), (Material("m", roughness=0.5),)), 16)
    assert texels.covered == 64 and texels.chart.max() == 0
    assert (texels.state[4:12, 4:12] == TexelState.VALID).all()
    # Row 4, column 6 is 2.5 texels along u, 0.5 along v, of 0.5 m each.
    np.testing.assert_allclose(texels.position[4, 6], [1.25, 0.0, -0.25], atol=1e-5)
    np.testing.assert_allclose(texels.normal[4:12, 4:12].reshape(-1, 3), np.tile([0, 1, 0], (64, 1)))
    np.testing.assert_allclose(texels.texel_size[4:12, 4:12], 0.5, rtol=1e-5)
    np.testing.assert_allclose(texels.alpha[4:12, 4:12], 0.25)
    assert texels.mesh[0, 0] == -1 and texels.position[0, 0].tolist() == [0, 0, 0]
    half = replace(mesh, lightmap_uv=mesh.lightmap_uv + np.float32(0.3 / 16))
    edge = rasterise_texels(Scene((half,), (Material("m"),)), 16)
    assert edge.covered == 81
    np.testing.assert_allclose(edge.position[4, 5], [0.6, 0.0, -0.1], atol=1e-5)
    # The centre of texel 12, 12 lies beyond the corner: its point keeps 0.02 texels of 0.5 m from its triangle's edges.
    inset = np.abs(edge.position[12, 12][[0, 2]] - [4.0, -4.0])
    assert inset.min() > 0.0099 and inset.max() < 0.03


@pytest.mark.parametrize("margin", [0.0, 0.01, 0.3, 5.0])
def test_points_kept_inside_have_their_margin_where_the_triangle_has_room(margin):
    rng = np.random.default_rng(3)
    corners = rng.normal(size=(200, 3, 2)) * rng.choice([1.0, 1e-3], (200, 1, 1))
    weights = rng.dirichlet(np.full(3, 0.2), 200)
    edges = np.linalg.norm(corners[:, [2, 0, 1]] - corners[:, [1, 2, 0]], axis=2)
    (ax, ay), (bx, by) = (corners[:, 1] - corners[:, 0]).T, (corners[:, 2] - corners[:, 0]).T
    area = np.abs(ax * by - ay * bx)
    heights = area[:, None] / edges
    kept = kept_inside(weights, heights, np.full(200, margin))
    np.testing.assert_allclose(kept.sum(axis=1), 1.0)
    gaps = (kept * heights).min(axis=1)
    radius = area / edges.sum(axis=1)
    assert (gaps >= np.minimum(margin, 0.5 * radius) * (1.0 - 1e-9)).all()
    roomy = (weights * heights).min(axis=1) >= np.minimum(margin, 0.5 * radius)
    np.testing.assert_allclose(kept[roomy], weights[roomy], atol=1e-12)


def test_charts_are_connected_by_shared_edges_only(make_quad, two_quads):
    strip = [make_quad(f"s{i}", (i, 0, 0), (1, 0, 0), (0, 1, 0), (0.2 * i, 0.5, 0.2 * i + 0.2, 0.7)) for i in (0, 1)]
    texels = rasterise_texels(replace(two_quads, meshes=(*two_quads.meshes, *strip)), 32)
    charts = [np.unique(texels.chart[texels.mesh == index]) for index in range(4)]
    assert [len(chart) for chart in charts] == [1, 1, 1, 1]
    assert len(np.unique(np.concatenate(charts))) == 4


def test_alpha_follows_the_roughness_texture(make_quad):
    mesh = make_quad("floor", (0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1, 1))
    mesh = replace(mesh, uv=mesh.lightmap_uv)
    pixels = np.zeros((1, 2, 3), np.uint8)
    pixels[0, :, 1] = (51, 255)
    material = Material("m", roughness=0.5, metallic_roughness_texture=TextureRef(0, ("clamp", "clamp")))
    texels = rasterise_texels(Scene((mesh,), (material,), (Image("r", pixels, False),)), 64)
    np.testing.assert_allclose(texels.alpha[:, :16], (0.5 * 0.2) ** 2, rtol=1e-5)
    np.testing.assert_allclose(texels.alpha[:, 48:], 0.25, rtol=1e-5)
    assert (np.diff(texels.alpha[7, 16:48]) > 0.0).all()
    mirror = rasterise_texels(Scene((mesh,), (Material("m", roughness=0.0),)), 16)
    assert mirror.alpha.min() == np.float32(0.002)


def test_roughness_is_looked_up_by_its_own_uv_set(make_quad):
    """The first set is another texture's; by it all would be smooth."""
    mesh = make_quad("floor", (0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1, 1))
    mesh = replace(mesh, uv=np.zeros_like(mesh.lightmap_uv), more_uv=(mesh.lightmap_uv,))
    pixels = np.zeros((1, 2, 3), np.uint8)
    pixels[0, :, 1] = (51, 255)
    reference = TextureRef(0, ("clamp", "clamp"), uv_set=1)
    scene = Scene((mesh,), (Material("m", metallic_roughness_texture=reference),), (Image("r", pixels, False),))
    alpha = rasterise_texels(scene, 64).alpha
    np.testing.assert_allclose(alpha[:, :16], 0.2**2, rtol=1e-5)
    np.testing.assert_allclose(alpha[:, 48:], 1.0, rtol=1e-5)


@pytest.mark.parametrize(("wrap", "expected"), [("repeat", [0, 1, 2, 3, 0, 1]), ("mirror", [0, 1, 2, 3, 3, 2])])
def test_textures_wrap(wrap, expected):
    pixels = np.arange(4, dtype=np.float32).reshape(1, 4, 1)
    uv = np.stack([(np.arange(6) + 0.5) / 4, np.full(6, 0.5)], axis=1)
    np.testing.assert_allclose(look_up(pixels, TextureRef(0, (wrap, wrap)), uv)[:, 0], expected, atol=1e-6)
    shifted = TextureRef(0, (wrap, wrap), offset=(0.25, 0.0), scale=(0.5, 1.0))
    np.testing.assert_allclose(look_up(pixels, shifted, uv[:2] * 2.0)[:, 0], expected[1:3], atol=1e-6)


def test_shading_normals_stay_on_the_lit_side():
    rng = np.random.default_rng(0)
    shading, geometric = (v / np.linalg.norm(v, axis=1, keepdims=True) for v in rng.normal(size=(2, 500, 3)))
    bent = bent_normals(shading, geometric)
    np.testing.assert_allclose(np.linalg.norm(bent, axis=1), 1.0)
    cosine = np.einsum("nd,nd->n", bent, geometric)
    assert cosine.min() > 0.9 * MIN_COSINE
    kept = np.einsum("nd,nd->n", shading, geometric) > MIN_COSINE
    np.testing.assert_allclose(bent[kept], shading[kept], atol=1e-12)


def test_paths_from_a_smooth_sphere_start_nearer_to_the_sphere_than_its_facets():
    ball = patch("ball", sphere(np.zeros(3), 1.0), (8, 8), Cell(0, 0, 32, 32), 0)
    texels = rasterise_texels(Scene((ball,), (Material("m"),)), 64)
    lit = texels.state == TexelState.VALID
    flat_ball = replace(ball, normals=np.zeros_like(ball.normals))
    flat = rasterise_texels(Scene((flat_ball,), (Material("m"),)), 64)
    radius, facet = (np.linalg.norm(t.position[lit], axis=1) for t in (texels, flat))
    assert (radius >= facet - 1e-6).all() and facet.min() < 0.95
    # The facets lie up to 6 % inside the sphere, the points within 3 % of it.
    assert radius.min() > 0.97 and radius.max() < 1.03


def test_texels_under_a_box_move_out_where_they_can(make_quad):
    """A closed box of 1.8 m x 1.8 m on a floor of half-metre texels: those near its walls get out, the others stay."""
    floor = make_quad("floor", (-4, 0, 4), (8, 0, 0), (0, 0, -8), (0, 0, 0.5, 0.5))
    low, high = np.array([-0.9, -0.1, -0.9]), np.array([0.9, 1.0, 0.9])
    sides = []
    for axis in range(3):
        s, t = np.zeros(3), np.zeros(3)
        s[(axis + 1) % 3], t[(axis + 2) % 3] = (high - low)[(axis + 1) % 3], (high - low)[(axis + 2) % 3]
        v = 0.6 + 0.12 * axis
        sides.append(make_quad(f"+{axis}", high - s - t, s, t, (0.0, v, 0.1, v + 0.1)))
        sides.append(make_quad(f"-{axis}", low, t, s, (0.2, v, 0.3, v + 0.1)))
    scene = Scene((floor, *sides), (Material("m"),))
    before, after = rasterise_texels(scene, 32), build_texel_map(scene, 32, "cpu")
    on_floor = before.mesh == 0
    inside = on_floor & (np.abs(before.position[..., [0, 2]]) < 0.9).all(axis=-1)
    moved = np.abs(after.position - before.position).max(axis=-1) > 0
    assert inside.sum() == 16 and moved[on_floor].sum() == (moved & inside).sum() == 12
    places = after.position[moved & inside]
    outside = np.abs(places[:, [0, 2]]).max(axis=1)
    assert (outside > 0.9).all() and (outside < 0.91).all()
    np.testing.assert_allclose(places[:, 1], 0.0, atol=1e-5)
    doubled = replace(scene, materials=(Material("m", double_sided=True),))
    np.testing.assert_array_equal(build_texel_map(doubled, 32, "cpu").position, before.position)


def test_a_thin_wall_is_never_crossed(make_quad):
    """Floor texels on either side of a wall of 2 cm stay on their side; one under it goes to the nearer side."""
    floor = make_quad("floor", (-2, 0, 2), (4, 0, 0), (0, 0, -4), (0, 0, 0.5, 0.5))
    x = 0.125
    front = make_quad("front", (x + 0.01, -0.5, 2), (0, 0, -4), (0, 2, 0), (0.6, 0.0, 0.9, 0.3))
    back = make_quad("back", (x - 0.01, -0.5, -2), (0, 0, 4), (0, 2, 0), (0.6, 0.4, 0.9, 0.7))
    scene = Scene((floor, front, back), (Material("m"),))
    before, after = rasterise_texels(scene, 32), build_texel_map(scene, 32, "cpu")
    on_floor = before.mesh == 0
    old, new = before.position[on_floor][:, 0] - x, after.position[on_floor][:, 0] - x
    under = np.abs(old) < 0.01
    assert under.sum() == 16 and (np.abs(new[under]) > 0.01).all() and (np.abs(new[under]) < 0.02).all()
    np.testing.assert_array_equal(new[~under], old[~under])


def test_tangent_directions_are_orthonormal_to_the_normal():
    normals = np.random.default_rng(5).normal(size=(50, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    directions = tangent_directions(normals)
    np.testing.assert_allclose(np.einsum("nkd,nd->nk", directions, normals), 0.0, atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(directions, axis=2), 1.0)
    np.testing.assert_allclose(directions.sum(axis=1), 0.0, atol=1e-12)


def test_the_map_round_trips_and_malformed_ones_are_refused(two_quads):
    texels = rasterise_texels(two_quads, 16)
    data = pack_texel_map(texels)
    back = unpack_texel_map(data)
    assert pack_texel_map(back) == data
    np.testing.assert_array_equal(back.position, texels.position)
    for damaged in (data[:-64], b"", pack_texel_map(replace(texels, alpha=texels.alpha[1:]))):
        with pytest.raises(InputError):
            unpack_texel_map(damaged)
    with pytest.raises(InputError, match="state"):
        unpack_texel_map(pack_texel_map(replace(texels, state=texels.state + np.uint8(7))))


def test_a_mesh_without_light_map_uv_is_named(two_quads):
    bare: Mesh = replace(two_quads.meshes[1], lightmap_uv=None)
    with pytest.raises(InputError, match="mesh 'right': has no light-map UV"):
        rasterise_texels(replace(two_quads, meshes=(bare,)), 16)


def test_the_picture_shows_states_and_charts(two_quads):
    texels = rasterise_texels(two_quads, 32)
    row, column = np.argwhere(texels.state == TexelState.VALID)[0]
    state = texels.state.copy()
    state[row, column] = TexelState.INVALID
    picture = texel_map_picture(replace(texels, state=state))
    assert picture.dtype == np.uint8 and picture.shape == (256, 3 * 256 + 16, 3)
    red = picture[8 * row + 4, 8 * column + 4].astype(int)
    assert red[0] > 1.5 * red[1]
    charts = picture[:, -256:]
    colours = {tuple(charts[8 * r + 4, 8 * c + 4]) for r, c in np.argwhere(texels.chart >= 0)}
    assert len(colours) == 2
