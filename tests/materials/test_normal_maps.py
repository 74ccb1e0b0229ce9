"""Normal maps: a constant map is a tilted normal, turned and mirrored with its coordinates, in bake and pictures."""

from dataclasses import replace
from math import pi

import numpy as np
import pytest
from rich_scene import rich_scene

from kiln_schemas.camera import Camera
from kiln_schemas.settings import RenderSettings
from kiln_workers.render.backend import select_variant
from kiln_workers.render.jit import dr, mi
from kiln_workers.render.mitsuba_scene import to_mitsuba
from kiln_workers.render.tile import TexelBatch, TileRenderer
from kiln_workers.scene import geometry, normal_maps
from kiln_workers.scene.load import load_scene
from kiln_workers.scene.model import Image, LightKind, Material, Mesh, PunctualLight, Scene, TextureRef
from kiln_workers.scene.tangents import with_tangents
from kiln_workers.scene.texels import rasterise_texels
from kiln_workers.shade.gbuffer import render_gbuffer
from kiln_workers.shade.reference import ReferenceTracer

SQUARE = np.float32([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
FACES = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
UPRIGHT = np.float32([[0, 1], [1, 1], [1, 0], [0, 0]])  # v down: the image stands upright on the square
TILT = np.array([0.36, 0.48, 0.8])  # right and up on the image

WAYS = {
    "upright": (UPRIGHT, {}, TILT),
    # The image lies on its left side: its right points up in the world, its up to the left.
    "quarter turn": (UPRIGHT[[3, 0, 1, 2]], {}, TILT[[1, 0, 2]] * [-1, 1, 1]),
    "mirrored across": (UPRIGHT * [-1, 1], {}, TILT * [-1, 1, 1]),
    "mirrored down": (UPRIGHT * [1, -1], {}, TILT * [1, -1, 1]),
    # The transform turns coordinates counter-clockwise, hence what is seen clockwise.
    "turned by the transform": (UPRIGHT, {"rotation": pi / 2}, TILT[[1, 0, 2]] * [1, -1, 1]),
    "mirrored by the transform": (UPRIGHT, {"scale": (2.0, -3.0)}, TILT * [1, -1, 1]),
    # The second set is the first mirrored across.
    "another set": (UPRIGHT, {"uv_set": 1}, TILT * [-1, 1, 1]),
}  # fmt: skip


def square(material: Material, pixels: np.ndarray, uv: np.ndarray = UPRIGHT, **more: object) -> Scene:
    """The unit square that faces +Z, with a normal map."""
    mesh = Mesh(
        "square", SQUARE, np.tile(np.float32([0, 0, 1]), (4, 1)), FACES, 0, np.float32(uv), SQUARE[:, :2].copy()
    )
    mesh = replace(mesh, lightmap_uv=0.02 + 0.96 * mesh.lightmap_uv, more_uv=(np.float32(uv * [-1, 1]),))
    image = Image("bumps", pixels.astype(np.float32), False)
    return with_tangents(Scene((mesh,), (material,), (image,), **more))


def constant(vector: np.ndarray = TILT) -> np.ndarray:
    return np.broadcast_to(0.5 + 0.5 * np.asarray(vector), (2, 2, 3))


def bumps(size: int = 16) -> np.ndarray:
    """A smooth random map."""
    random = np.random.default_rng(4)
    rows, columns = np.indices((size, size)) * (2.0 * pi / size)
    slopes = [np.sin(columns * k + rows * j + p) for k, j, p in random.integers(0, 4, (2, 3))]
    return 0.5 + 0.5 * np.stack([0.5 * slopes[0], 0.5 * slopes[1], np.ones_like(rows)], axis=-1) / np.sqrt(1.5)


def sun(direction: np.ndarray) -> PunctualLight:
    """A lamp far away in a direction; 1 W/m^2 across."""
    x, y, z = -direction / np.linalg.norm(direction)
    return PunctualLight("sun", LightKind.DIRECTIONAL, (1.0, 1.0, 1.0), direction=(x, y, z))


@pytest.mark.parametrize("way", WAYS)
def test_a_constant_map_is_a_tilted_normal_in_the_bake(way):
    """The texel's normal, and the irradiance of a sun: the cosine to that normal."""
    uv, transform, expected = WAYS[way]
    towards = np.array([0.3, 0.5, 1.0])
    scene = square(Material("m", normal_texture=TextureRef(0, **transform)), constant(), uv, lights=(sun(towards),))
    texels = rasterise_texels(scene, 8, "cpu")
    np.testing.assert_allclose(texels.normal.reshape(-1, 3), np.tile([0, 0, 1], (64, 1)), atol=1e-6)
    np.testing.assert_allclose(texels.shading_normal.reshape(-1, 3), np.tile(expected, (64, 1)), atol=1e-6)
    batch = TexelBatch.of(texels, (np.array([3]), np.array([3])))
    settings = RenderSettings(image_size=16, samples=1, irradiance_samples=16, max_depth=1)
    found = TileRenderer(scene, "1" * 64, settings, 1 << 28, "cpu").render(batch).irradiance
    np.testing.assert_allclose(found, np.full((1, 3), expected @ towards / np.linalg.norm(towards)), rtol=1e-4)


@pytest.mark.parametrize("way", WAYS)
def test_a_constant_map_is_a_tilted_normal_in_pictures(way):
    """In `shade`'s G-buffer, and path-traced: as the square whose vertices have that normal."""
    uv, transform, expected = WAYS[way]
    scene = square(
        Material("m", roughness=0.4, normal_texture=TextureRef(0, **transform)), constant(), uv,
        lights=(sun(np.array([0.3, 0.5, 1.0])),),
    )  # fmt: skip
    camera = Camera(position=(0.7, 0.2, 2.0), target=(0.5, 0.5, 0.0), fov_deg=40)
    normal = render_gbuffer(scene, camera, 8, 8, 1, "cpu").normal
    np.testing.assert_allclose(normal, np.tile(expected, (len(normal), 1)), atol=1e-6)
    tilted = replace(scene.meshes[0], normals=np.tile(np.float32(expected), (4, 1)), tangents=None)
    assert_same_pictures(scene, replace(scene, meshes=(tilted,)), camera)


def assert_same_pictures(one: Scene, other: Scene, camera: Camera, samples: int = 16) -> None:
    pictures = [ReferenceTracer(scene, camera, 12, 12, 1, "cpu").render(samples).picture for scene in (one, other)]
    assert pictures[1].max() > 0.05
    np.testing.assert_allclose(pictures[0], pictures[1], rtol=1e-4, atol=1e-5)


def test_the_back_of_a_double_sided_surface_has_the_map_turned_over():
    """Seen from behind, the normal is the front's times -1."""
    material = Material("m", double_sided=True, roughness=0.4, normal_texture=TextureRef(0))
    light = sun(np.array([0.3, 0.2, -1.0]))
    scene = square(material, constant(), lights=(light,))
    camera = Camera(position=(0.7, 0.2, -2.0), target=(0.5, 0.5, 0.0), fov_deg=40)
    normal = render_gbuffer(scene, camera, 8, 8, 1, "cpu").normal
    np.testing.assert_allclose(normal, np.tile(-TILT, (len(normal), 1)), atol=1e-6)
    turned = replace(
        scene.meshes[0], faces=FACES[:, ::-1].copy(), normals=np.tile(np.float32(-TILT), (4, 1)), tangents=None
    )
    assert_same_pictures(scene, replace(scene, meshes=(turned,)), camera)


def test_a_map_is_mitsuba_s_own(monkeypatch):
    """Against Mitsuba's `normalmap` around the same surface, for what that knows: one set, not mirrored, scale 1."""
    plain = Material("m", base_color=(0.7, 0.5, 0.3, 1.0), roughness=0.35)
    light = PunctualLight("lamp", LightKind.POINT, (3.0, 3.0, 3.0), position=(0.8, 0.3, 0.7))
    scene = square(replace(plain, normal_texture=TextureRef(0)), bumps(), lights=(light,))
    camera = Camera(position=(0.3, 0.4, 1.5), target=(0.5, 0.5, 0.0), fov_deg=40)
    ours = ReferenceTracer(scene, camera, 24, 24, 1, "cpu")
    other = ReferenceTracer(square(plain, bumps(), lights=(light,)), camera, 24, 24, 1, "cpu")
    bare = other.render(64).picture
    image = {"type": "bitmap", "raw": True, "data": mi.TensorXf(bumps().astype(np.float32))}
    (shape,) = other._scene.shapes()
    wrapped = mi.load_dict(
        {"type": "normalmap", "normalmap": image, "bsdf": shape.bsdf(), "use_shadowing_function": False}
    )
    shape.set_bsdf(wrapped)
    expected, found = other.render(64).picture, ours.render(64).picture
    assert np.abs(expected - bare).mean() > 0.1 * bare.mean()
    np.testing.assert_allclose(found, expected, rtol=2e-3, atol=2e-3 * expected.max())


def test_light_from_a_mapped_floor_is_that_from_a_tilted_one():
    """The tracer that bakes: what a small glossy floor sends to a ceiling."""
    material = Material("m", roughness=0.4, normal_texture=TextureRef(0))
    scene = square(material, constant(), lights=(sun(np.array([-0.5, 0.1, 1.0])),))
    tilted = replace(scene.meshes[0], normals=np.tile(np.float32(TILT), (4, 1)), tangents=None)
    down = np.float32([[0, 0, -1]])
    batch = TexelBatch(np.array([0]), np.float32([[0.9, 0.9, 0.5]]), down, down, np.float32([1]), np.float32([0.01]))
    settings = RenderSettings(image_size=16, samples=1, irradiance_samples=4096, max_depth=2)
    found, expected = (
        TileRenderer(of, "1" * 64, settings, 1 << 28, "cpu").render(batch).irradiance
        for of in (scene, replace(scene, meshes=(tilted,)))
    )
    assert expected.min() > 0.01
    np.testing.assert_allclose(found, expected, rtol=1e-3)


def test_a_texel_has_the_mean_of_its_map():
    """Bumps finer than texels: left and right cancel, on a map whose size is no power of two."""
    columns = np.where(np.arange(370) % 2 < 1, 1.0, -1.0)[None, :, None]
    pixels = 0.5 + 0.5 * np.concatenate([0.6 * columns, np.zeros_like(columns), np.full_like(columns, 0.8)], axis=-1)
    fine = rasterise_texels(square(Material("m", normal_texture=TextureRef(0, scale=(10, 10))), pixels), 8, "cpu")
    np.testing.assert_allclose(fine.shading_normal.reshape(-1, 3), np.tile([0, 0, 1], (64, 1)), atol=0.03)
    # A map of two halves, as the light map's texels see them.
    halves = np.concatenate([constant(), constant(TILT * [-1, 1, 1])], axis=1).repeat(8, axis=0).repeat(8, axis=1)
    normal = rasterise_texels(square(Material("m", normal_texture=TextureRef(0)), halves), 17, "cpu").shading_normal
    np.testing.assert_allclose(normal[4:12, 2:7].reshape(-1, 3), np.tile(TILT, (40, 1)), atol=1e-6)
    assert np.abs(normal[4:12, 8, 0]).max() < 0.02


def test_the_scale_flattens_and_deepens():
    for scale in (0.0, 0.5, 2.0):
        scene = square(Material("m", normal_texture=TextureRef(0), normal_scale=scale), constant())
        found = rasterise_texels(scene, 8, "cpu").shading_normal[4, 4]
        expected = TILT * [scale, scale, 1.0]
        np.testing.assert_allclose(found, expected / np.linalg.norm(expected), atol=1e-6)


def test_normals_that_face_away_are_bent_to_the_eye():
    view = np.array([[0.8, 0.0, 0.6]])
    steep = normal_maps.facing(np.array([[-0.8, 0.0, 0.6]]), view)
    assert 0.0 < (steep * view).sum() < 0.1
    same = np.array([[0.0, 0.0, 1.0]])
    np.testing.assert_allclose(normal_maps.facing(same, view), same)


def test_tangents_of_a_globe_run_along_its_parallels():
    """East where u grows that way; the bitangent, up on the image, is north."""
    u, v = (values.ravel() for values in np.meshgrid(np.linspace(0, 1, 49), np.linspace(0, 1, 25)))
    phi, theta = 2.0 * pi * u, pi * v
    p = np.stack([np.sin(theta) * np.sin(phi), np.cos(theta), np.sin(theta) * np.cos(phi)], axis=1).astype(np.float32)
    corner = (np.arange(48) + 49 * np.arange(24)[:, None]).reshape(-1, 1, 1)
    faces = (corner + np.array([[0, 49, 50], [0, 50, 1]])).reshape(-1, 3).astype(np.int32)
    uv = np.stack([u, v], axis=1).astype(np.float32)
    scene = Scene(
        (Mesh("globe", p, p, faces, 0, uv, uv),),
        (Material("m", normal_texture=TextureRef(0)),),
        (Image("n", np.zeros((1, 1, 3), np.float32), False),),
    )
    tangents = with_tangents(scene).meshes[0].tangents
    away = (v > 0.1) & (v < 0.9)
    east = np.stack([np.cos(phi), np.zeros_like(phi), -np.sin(phi), np.ones_like(phi)], axis=1)
    assert away.sum() > 500
    np.testing.assert_allclose(tangents[away], east[away], atol=0.08)


def test_a_mirrored_half_has_vertices_of_its_own():
    """Two squares whose coordinates mirror at a common edge: its vertices become two, of both hands."""
    p = np.float32([[0, 0, 0], [1, 0, 0], [2, 0, 0], [2, 1, 0], [1, 1, 0], [0, 1, 0]])
    faces = np.array([[0, 1, 4], [0, 4, 5], [1, 2, 3], [1, 3, 4]], np.int32)
    uv = np.float32([[0, 1], [1, 1], [0, 1], [0, 0], [1, 0], [0, 0]])
    mesh = Mesh("two", p, np.tile(np.float32([0, 0, 1]), (6, 1)), faces, 0, uv, p[:, :2] / 2)
    scene = Scene((mesh,), (Material("m", normal_texture=TextureRef(0)),), (Image("n", constant(), False),))
    made = with_tangents(scene).meshes[0]
    assert len(made.positions) == 8
    np.testing.assert_array_equal(made.positions[made.faces], p[faces])
    left = made.tangents[made.faces[:2].reshape(-1)]
    right = made.tangents[made.faces[2:].reshape(-1)]
    np.testing.assert_allclose(left, np.tile([1, 0, 0, 1], (6, 1)), atol=1e-6)
    np.testing.assert_allclose(right, np.tile([-1, 0, 0, -1], (6, 1)), atol=1e-6)


@pytest.mark.parametrize("mirror", [1.0, -1.0])
def test_tangents_of_the_file_go_with_their_node(mirror):
    """A mapped normal moves as a vector of the surface does, through a turn, a stretch along it, and a mirror."""
    tangent = np.tile([1.0, 0.0, 0.0, -1.0], (4, 1))
    raw = geometry.RawMesh("m", SQUARE.astype(float), FACES, 0, np.tile([0.0, 0.0, 1.0], (4, 1)), tangents=tangent)
    turn = np.array([[0.0, 0.0, 1.0, 5.0], [1.0, 0.0, 0.0, 0.0], [0.0, mirror, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
    mesh, _ = geometry.place(raw, turn @ np.diag([3.0, 3.0, 3.0, 1.0]))
    normal, tangents = mesh.normals.astype(float), mesh.tangents.astype(float)
    found = normal_maps.mapped(normal, tangents, np.tile(0.5 + 0.5 * TILT, (4, 1)), 1.0)
    # In its own space the bitangent is -Y, by the tangent's hand.
    expected = turn[:3, :3] @ (TILT * [1, -1, 1])
    np.testing.assert_allclose(found, np.tile(expected, (4, 1)), atol=1e-6)


def test_tangents_are_there_where_they_are_used():
    scene = rich_scene()
    assert with_tangents(scene).meshes[0].tangents.shape == (4, 4)
    unused = replace(scene.materials[0], normal_texture=None)
    assert with_tangents(replace(with_tangents(scene), materials=(unused,))).meshes[0].tangents is None


@pytest.mark.parametrize(("double_sided", "height"), [(False, 1.0), (True, -1.0), (False, 0.08)])
def test_samples_under_a_map_are_those_of_its_values(double_sided, height):
    """The mean weight of samples is the integral of the values, and that of 1 / pdf over them the solid angle.

    From above, from behind, and so low that the mapped normal faces away and is bent.
    """
    select_variant("cpu")
    material = Material("m", roughness=0.5, double_sided=double_sided, normal_texture=TextureRef(0))
    scene = to_mitsuba(square(material, constant([-0.7, 0.0, 0.3])))
    count = 1 << 18
    origin = mi.Point3f(1.5, 0.5, height)
    ray = mi.Ray3f(origin, dr.normalize(mi.Point3f(0.5, 0.5, 0.0) - origin))
    si = scene.ray_intersect(dr.gather(type(ray), ray, dr.zeros(mi.UInt32, count)))
    state = mi.PCG32(count)
    sample, weight = si.bsdf().sample(
        mi.BSDFContext(), si, state.next_float32(), mi.Point2f(state.next_float32(), state.next_float32())
    )
    uniform = mi.warp.square_to_uniform_sphere(mi.Point2f(state.next_float32(), state.next_float32()))
    value, pdf = si.bsdf().eval_pdf(mi.BSDFContext(), si, uniform)
    found = np.array(weight).mean(axis=1)
    expected = 4.0 * pi * np.array(value).mean(axis=1)
    assert expected.min() > 0.1
    np.testing.assert_allclose(found, expected, rtol=0.02)
    # No sample leaves through the surface, nor is one expected there.
    through = np.array(uniform)[2] * height < 0.0
    assert not np.array(pdf)[through].any() and not np.array(value)[:, through].any()
    drawn = np.array(sample.pdf) > 0.0
    assert drawn.any() and (np.array(sample.wo)[2][drawn] * height > 0.0).all()
    again = np.array(si.bsdf().eval_pdf(mi.BSDFContext(), si, sample.wo)[1])
    np.testing.assert_allclose(again[drawn], np.array(sample.pdf)[drawn], rtol=1e-3)


@pytest.mark.parametrize("options", ["", "-o 0.25 0.5 0 "])
def test_a_map_of_mtl_stands_upright(tmp_path, write_png, options):
    """Coordinates grow upwards in OBJ; `norm` is green upwards as glTF's."""
    write_png(tmp_path / "bumps.png", np.round(255.0 * constant()).astype(np.uint8))
    (tmp_path / "a.mtl").write_text(f"newmtl m\nKd 0.5 0.5 0.5\nnorm {options}bumps.png\n")
    corners = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\n"
    (tmp_path / "a.obj").write_text(f"mtllib a.mtl\n{corners}usemtl m\nf 1/1 2/2 3/3 4/4\n")
    scene = load_scene(tmp_path, "a.obj")
    mesh = replace(scene.meshes[0], lightmap_uv=scene.meshes[0].positions[:, :2] * 0.9 + 0.05)
    found = rasterise_texels(replace(scene, meshes=(mesh,)), 8, "cpu").shading_normal[4, 4]
    np.testing.assert_allclose(found, TILT, atol=0.01)
