"""Materials, textures and lights as Mitsuba sees them."""

from collections.abc import Callable
from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from kiln_schemas.errors import TooLarge
from kiln_workers.render.mitsuba_scene import to_mitsuba
from kiln_workers.render.tile import TexelBatch, TileRenderer
from kiln_workers.scene.lookup import look_up
from kiln_workers.scene.model import Image, LightKind, Material, Mesh, PunctualLight, Scene, TextureRef
from kiln_workers.sphere import ggx, octahedral

# Row 0 is at v = 0, the far end of the quad's second edge.
QUADRANTS = np.array([[[255, 0, 0], [0, 255, 0]], [[0, 0, 255], [255, 255, 255]]], np.uint8)
RED, GREEN, BLUE, WHITE = (1, 0, 0), (0, 1, 0), (0, 0, 1), (1, 1, 1)
CORNERS = [(0.1, 0.9, RED), (0.9, 0.9, GREEN), (0.1, 0.1, BLUE), (0.9, 0.1, WHITE)]


def emission_at(scene: Scene, x: float, y: float) -> np.ndarray:
    """Radiance emitted towards +Z by the unit quad in the xy plane, at (x, y)."""
    world = to_mitsuba(scene)
    si = world.ray_intersect(mi.Ray3f(mi.Point3f(x, y, 1.0), mi.Vector3f(0.0, 0.0, -1.0)))
    return np.array(si.emitter(world).eval(si)).ravel()


def screen(quad: Callable[..., Mesh], reference: TextureRef, size: float = 1.0) -> Scene:
    """A quad whose texture coordinates run to `size`; v = 0 at the top."""
    mesh = quad((0, 0, 0), (1, 0, 0), (0, 1, 0))
    assert mesh.uv is not None
    mesh = Mesh(mesh.name, mesh.positions, mesh.normals, mesh.faces, 0, mesh.uv * np.float32(size))
    material = Material("screen", (0, 0, 0, 1), emission=(2.0, 2.0, 2.0), emission_texture=reference)
    return Scene((mesh,), (material,), (Image("quadrants", QUADRANTS, srgb=True),))


@pytest.mark.parametrize(
    ("x", "y", "colour"), [(0.1, 0.9, RED), (0.9, 0.9, GREEN), (0.1, 0.1, BLUE), (0.9, 0.1, WHITE)]
)
def test_textures_stand_upright(quad: Callable[..., Mesh], x: float, y: float, colour: tuple[int, int, int]) -> None:
    got = emission_at(screen(quad, TextureRef(0, wrap=("clamp", "clamp"))), x, y)
    np.testing.assert_allclose(got, 2.0 * np.array(colour), atol=1e-5)


def test_wrap_modes_of_the_two_axes(quad: Callable[..., Mesh]) -> None:
    """Coordinates run to 2; x = 0.55 ... is the second repetition in u, y = 0.45 ... the second in v."""
    repeated = screen(quad, TextureRef(0, wrap=("repeat", "clamp")), 2.0)
    np.testing.assert_allclose(emission_at(repeated, 0.625, 0.875), 2.0 * np.array(RED), atol=1e-5)
    np.testing.assert_allclose(emission_at(repeated, 0.625, 0.2), 2.0 * np.array(BLUE), atol=1e-5)
    mirrored = screen(quad, TextureRef(0, wrap=("clamp", "mirror")), 2.0)
    np.testing.assert_allclose(emission_at(mirrored, 0.8, 0.875), 2.0 * np.array(GREEN), atol=1e-5)
    np.testing.assert_allclose(emission_at(mirrored, 0.8, 0.375), 2.0 * np.array(WHITE), atol=1e-5)
    np.testing.assert_allclose(emission_at(mirrored, 0.8, 0.125), 2.0 * np.array(GREEN), atol=1e-5)


@pytest.mark.parametrize("wrap", [("repeat", "mirror"), ("mirror", "clamp"), ("clamp", "repeat")])
def test_a_texture_of_two_wrap_modes_is_interpolated_across_its_border(
    quad: Callable[..., Mesh], wrap: tuple[str, str]
) -> None:
    """Everywhere, and so within half a pixel of the border too, as the look-up in numpy has it."""
    scene = screen(quad, TextureRef(0, wrap=wrap), 1.0)
    mesh, reference = scene.meshes[0], scene.materials[0].emission_texture
    assert mesh.uv is not None and reference is not None
    linear = QUADRANTS.astype(np.float64) / 255.0  # 0 and 255 are the same in sRGB
    for x, y in [(0.01, 0.5), (0.99, 0.5), (0.5, 0.01), (0.5, 0.99), (0.02, 0.03), (0.97, 0.99), (0.3, 0.6)]:
        right = 2.0 * look_up(linear, reference, np.array([[x, 1.0 - y]]))[0]
        np.testing.assert_allclose(emission_at(scene, x, y), right, atol=1e-4)


def test_unrolling_is_bounded(quad: Callable[..., Mesh]) -> None:
    with pytest.raises(TooLarge, match="repetitions"):
        to_mitsuba(screen(quad, TextureRef(0, wrap=("repeat", "clamp")), 1e5))


def test_texture_transform(quad: Callable[..., Mesh]) -> None:
    """Scale, then rotation counter-clockwise on the image, then offset."""
    shifted = screen(quad, TextureRef(0, offset=(0.5, 0.0)))
    np.testing.assert_allclose(emission_at(shifted, 0.25, 0.75), 2.0 * np.array(GREEN), atol=1e-5)
    scaled = screen(quad, TextureRef(0, scale=(2.0, 1.0)))
    np.testing.assert_allclose(emission_at(scaled, 0.375, 0.75), 2.0 * np.array(GREEN), atol=1e-5)
    # (u, v) = (0.25, 0.25) goes to (v, -u) = (0.25, -0.25), which repeats as (0.25, 0.75).
    turned = screen(quad, TextureRef(0, rotation=np.pi / 2))
    np.testing.assert_allclose(emission_at(turned, 0.25, 0.75), 2.0 * np.array(BLUE), atol=1e-5)


def test_cut_out_emitters_emit_where_they_are(
    quad: Callable[..., Mesh], texels: Callable[..., TexelBatch], renderer: Callable[..., TileRenderer]
) -> None:
    """A lamp whose half is cut away gives half of the irradiance to a point below its middle."""
    lamp = quad((-1, 1, -1), (2, 0, 0), (0, 0, 2))
    alpha = Image("half", np.array([[[9, 9, 9, 255], [9, 9, 9, 0]]], np.uint8), srgb=True)
    reference = TextureRef(0, wrap=("clamp", "clamp"))
    got = []
    for cutoff in (None, 0.5):
        material = Material("m", (0, 0, 0, 1), reference, emission=(3.0, 3.0, 3.0), alpha_cutoff=cutoff)
        tile = renderer(Scene((lamp,), (material,), (alpha,)), irradiance_samples=16384)
        got.append(tile.render(texels([(0.0, 0.0, 0.0)])).irradiance[0])
    np.testing.assert_allclose(got[1], 0.5 * got[0], rtol=0.02)


@pytest.mark.parametrize("textured", [False, True])
def test_an_alpha_test_takes_the_alpha_of_vertices_into_account(
    textured: bool, quad: Callable[..., Mesh], texels: Callable[..., TexelBatch], renderer: Callable[..., TileRenderer]
) -> None:
    """Alpha rises from 0 to 1 across a lamp: the half where it is below the cutoff neither shines nor shadows."""
    lamp = quad((-1, 1, -1), (2, 0, 0), (0, 0, 2))
    colors = np.ones((4, 4), np.float32)
    colors[[0, 3], 3] = 0.0
    faded = Mesh(lamp.name, lamp.positions, lamp.normals, lamp.faces, 0, lamp.uv, colors=colors)
    texture = TextureRef(0) if textured else None
    image = Image("even", np.full((2, 2, 4), 255, np.uint8), srgb=True)
    sun = PunctualLight("sun", LightKind.DIRECTIONAL, (20.0, 20.0, 20.0), direction=(0.0, -1.0, 0.0))
    material = Material("m", (0, 0, 0, 1), texture, alpha_cutoff=0.5)
    below = renderer(Scene((faded,), (material,), (image,), (sun,)), irradiance_samples=16)
    shadow, _, _ = below.render_irradiance(texels([(-0.01, 0.0, 0.0), (0.01, 0.0, 0.0)]))
    np.testing.assert_allclose(shadow, [[20.0] * 3, [0.0] * 3], rtol=1e-4)
    glowing = (replace(material, emission=(3.0, 3.0, 3.0)),)
    whole, half = (
        renderer(Scene((mesh,), glowing, (image,)), irradiance_samples=16384).render_irradiance(texels([(0, 0, 0)]))[0]
        for mesh in (lamp, faded)
    )
    np.testing.assert_allclose(half, 0.5 * whole, rtol=0.02)


@pytest.mark.parametrize("double_sided", [False, True])
def test_emission_from_behind(quad: Callable[..., Mesh], double_sided: bool) -> None:
    material = Material("m", (0, 0, 0, 1), emission=(3.0, 2.0, 1.0), double_sided=double_sided)
    world = to_mitsuba(Scene((quad((0, 0, 0), (1, 0, 0), (0, 1, 0)),), (material,)))
    for side, lit in ((1.0, True), (-1.0, double_sided)):
        si = world.ray_intersect(mi.Ray3f(mi.Point3f(0.5, 0.4, side), mi.Vector3f(0.0, 0.0, -side)))
        np.testing.assert_allclose(np.array(si.emitter(world).eval(si)).ravel(), [3 * lit, 2 * lit, 1 * lit])


def bsdf_value(material: Material, quad: Callable[..., Mesh], side: float = 1.0) -> np.ndarray:
    """BRDF times cosine for light and view along the normal."""
    world = to_mitsuba(Scene((quad((0, 0, 0), (1, 0, 0), (0, 1, 0)),), (material,)))
    si = world.ray_intersect(mi.Ray3f(mi.Point3f(0.5, 0.4, side), mi.Vector3f(0.0, 0.0, -side)))
    return np.array(si.bsdf().eval(mi.BSDFContext(), si, mi.Vector3f(0.0, 0.0, side))).ravel()


@pytest.mark.parametrize("roughness", [0.2, 0.5, 0.8])
def test_metal_is_ggx_with_alpha_the_square_of_roughness(quad: Callable[..., Mesh], roughness: float) -> None:
    got = bsdf_value(Material("m", (0.9, 0.5, 0.1, 1.0), metallic=1.0, roughness=roughness), quad)
    wanted = np.array([0.9, 0.5, 0.1]) * float(ggx.distribution(np.array(1.0), roughness**2)) / 4.0
    np.testing.assert_allclose(got, wanted, rtol=1e-3)


def test_dielectrics_reflect_four_per_cent(quad: Callable[..., Mesh]) -> None:
    got = bsdf_value(Material("m", (0.0, 0.0, 0.0, 1.0), roughness=0.5), quad)
    np.testing.assert_allclose(got, 0.04 * float(ggx.distribution(np.array(1.0), 0.25)) / 4.0, rtol=2e-3)


def test_backs_reflect_only_where_double_sided(quad: Callable[..., Mesh]) -> None:
    assert not bsdf_value(Material("m"), quad, side=-1.0).any()
    front, back = (bsdf_value(Material("m", double_sided=True), quad, side=side) for side in (1.0, -1.0))
    np.testing.assert_allclose(front, back)
    assert front.min() > 0.1


def test_metallic_roughness_texture(quad: Callable[..., Mesh]) -> None:
    """G is roughness, B is metallic, both linear; the factors multiply."""
    pixels = np.full((2, 2, 3), [7, 128, 255], np.uint8)
    material = Material(
        "m", (0.9, 0.5, 0.1, 1.0), metallic=1.0, roughness=0.9, metallic_roughness_texture=TextureRef(0)
    )
    scene = Scene((quad((0, 0, 0), (1, 0, 0), (0, 1, 0)),), (material,), (Image("mr", pixels, srgb=False),))
    world = to_mitsuba(scene)
    si = world.ray_intersect(mi.Ray3f(mi.Point3f(0.5, 0.4, 1.0), mi.Vector3f(0.0, 0.0, -1.0)))
    got = np.array(si.bsdf().eval(mi.BSDFContext(), si, mi.Vector3f(0.0, 0.0, 1.0))).ravel()
    alpha = (0.9 * 128 / 255) ** 2
    np.testing.assert_allclose(got, np.array([0.9, 0.5, 0.1]) / (4.0 * np.pi * alpha**2), rtol=2e-3)


def test_textured_emitters_light_as_they_look(
    quad: Callable[..., Mesh], texels: Callable[..., TexelBatch], renderer: Callable[..., TileRenderer]
) -> None:
    """Irradiance under a lamp whose texture repeats 3 x 3 times: by next-event estimation and without it."""
    lamp = quad((-1, 1, -1), (2, 0, 0), (0, 0, 2))
    assert lamp.uv is not None
    lamp = Mesh(lamp.name, lamp.positions, lamp.normals, lamp.faces, 0, lamp.uv * np.float32(3.0))
    material = Material("m", (0, 0, 0, 1), emission=(2.0, 2.0, 2.0), emission_texture=TextureRef(0))
    scene = Scene((lamp,), (material,), (Image("quadrants", QUADRANTS, srgb=True),))
    result = renderer(scene, image_size=64, samples=16, irradiance_samples=16384).render(texels([(0.0, 0.0, 0.0)]))
    weight = octahedral.pixel_solid_angles(64) * np.maximum(octahedral.pixel_directions(64)[..., 1], 0.0)
    from_image = (result.light_field[0].astype(float) * weight[..., None]).sum(axis=(0, 1))
    np.testing.assert_allclose(result.irradiance[0], from_image, rtol=0.02)


@pytest.mark.parametrize(
    ("light", "wanted"),
    [
        (PunctualLight("p", LightKind.POINT, (8.0, 4.0, 2.0), position=(0.0, 2.0, 0.0)), 1 / 4),
        (PunctualLight("d", LightKind.DIRECTIONAL, (8.0, 4.0, 2.0), direction=(0.6, -0.8, 0.0)), 0.8),
        (
            PunctualLight(
                "s", LightKind.SPOT, (8.0, 4.0, 2.0), (0, 2, 0), (0.0, -1.0, 0.0), inner_cone=0.2, outer_cone=0.4
            ),
            1 / 4,
        ),
        (
            PunctualLight(
                "beside", LightKind.SPOT, (8.0, 4.0, 2.0), (2, 2, 0), (0.0, -1.0, 0.0), inner_cone=0.2, outer_cone=0.4
            ),
            0.0,
        ),
    ],
    ids=lambda value: getattr(value, "name", None),
)
def test_punctual_lights(
    quad: Callable[..., Mesh],
    texels: Callable[..., TexelBatch],
    renderer: Callable[..., TileRenderer],
    light: PunctualLight,
    wanted: float,
) -> None:
    """Lambert's and the inverse-square law; the light itself is not seen."""
    floor = Scene((quad((-1, 0, -1), (0, 0, 2), (2, 0, 0)),), (Material("floor"),), lights=(light,))
    result = renderer(floor, irradiance_samples=64).render(texels([(0.0, 0.0, 0.0)]))
    np.testing.assert_allclose(result.irradiance[0], wanted * np.array([8.0, 4.0, 2.0]), rtol=1e-3)
    assert not result.light_field.any()


def test_a_scene_without_light_is_black(
    quad: Callable[..., Mesh], texels: Callable[..., TexelBatch], renderer: Callable[..., TileRenderer]
) -> None:
    scene = Scene((quad((-1, 1, -1), (2, 0, 0), (0, 0, 2)),), (Material("m"),))
    result = renderer(scene).render(texels([(0.0, 0.0, 0.0)]))
    assert not result.light_field.any() and not result.irradiance.any() and result.visibility is None


def test_positions_survive_the_transfer(cornell: Callable[..., Scene]) -> None:
    scene = cornell()
    world = to_mitsuba(scene)
    low, high = np.array(world.bbox().min).ravel(), np.array(world.bbox().max).ravel()
    np.testing.assert_allclose([low, high], [[0, 0, 0], [1, 1, 1]], atol=1e-6)
    assert dr.width(world.shapes_dr()) == len(scene.meshes)
