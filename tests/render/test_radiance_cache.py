"""The radiance cache: light fields traced with it agree with those of whole paths, and no light comes in by it."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from enclosures import box, closed_scene, rotated
from test_gltf_bsdf import direction, evaluated, seen_from, surface, upper

from kiln_schemas.errors import InputError
from kiln_schemas.settings import RenderSettings
from kiln_workers.render.gltf_bsdf import DIFFUSE_ALBEDO, reflections_only
from kiln_workers.render.materials import LIGHTMAP, vertex_attributes
from kiln_workers.render.tile import TexelBatch, TileRenderer
from kiln_workers.scene.container import pack
from kiln_workers.scene.model import Environment, LightKind, Material, Mesh, PunctualLight, Scene
from kiln_workers.scene.texel_map import TexelState
from kiln_workers.scene.texels import build_texel_map
from kiln_workers.stages.radiance_cache import KIND, UNKNOWN, make_cache, pack_cache, unpack_cache

RESOLUTION = 48
WHITE = Environment(np.ones((8, 16, 3), np.float32))
HASH = f"{1:064x}"


def with_charts(scene: Scene) -> Scene:
    """Each quad of a scene in a square of its own of the light map."""
    side = int(np.ceil(np.sqrt(len(scene.meshes))))
    meshes = []
    for number, mesh in enumerate(scene.meshes):
        square = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.float32)
        place = (0.1 + 0.8 * square + np.array(divmod(number, side))) / side
        meshes.append(replace(mesh, lightmap_uv=place.astype(np.float32)))
    return replace(scene, meshes=tuple(meshes))


def settings(**changes: int) -> RenderSettings:
    return RenderSettings(**({"image_size": 16, "samples": 16, "irradiance_samples": 64, "max_depth": 6} | changes))


def cache_of(scene: Scene) -> np.ndarray:
    return make_cache(scene, HASH, build_texel_map(scene, RESOLUTION, "cpu"), settings(), 1 << 27)


@pytest.mark.parametrize(("roughness", "metallic"), [(0.3, 0.0), (0.7, 0.4), (1.0, 0.0), (0.5, 1.0)])
def test_the_albedo_is_the_mean_of_the_diffuse_lobe(roughness: float, metallic: float) -> None:
    bsdf = surface(roughness, metallic)
    wo = upper(20_000)
    for degrees in (0.0, 30.0, 60.0, 80.0):
        wi = np.broadcast_to(direction(degrees), wo.shape)
        diffuse, _ = evaluated(bsdf, wi, wo, reflections_only(glossy=False))
        glossy, _ = evaluated(bsdf, wi, wo, reflections_only(diffuse=False))
        whole, _ = evaluated(bsdf, wi, wo)
        np.testing.assert_allclose(diffuse + glossy, whole, rtol=1e-4, atol=1e-6)
        albedo = np.array(bsdf.eval_attribute_3(DIFFUSE_ALBEDO, seen_from(direction(degrees)), True)).T[0]
        np.testing.assert_allclose(albedo, diffuse.mean(axis=0) * 2.0 * np.pi, atol=0.002)


def agree(scene: Scene, points: TexelBatch, tolerance: float) -> None:
    """Light fields of many paths, with and without the cache: pixels and means agree."""
    cache = cache_of(scene)
    kwargs = {"samples": 4096}
    fields = [
        TileRenderer(scene, HASH, settings(**kwargs), 1 << 27, "cpu", cache=held)
        .render_light_fields(points)
        .light_field.astype(np.float64)
        for held in (None, cache)
    ]
    truth, found = fields
    assert truth.mean() > 0.0
    np.testing.assert_allclose(found.mean(axis=(1, 2)), truth.mean(axis=(1, 2)), rtol=tolerance)
    error = np.sqrt(((found - truth) ** 2).mean()) / np.sqrt((truth**2).mean())
    assert error < 3.0 * tolerance


POINTS = [(0.2, 0.001, 0.3), (0.5, 0.001, 0.5), (0.8, 0.001, 0.7)]


@pytest.mark.parametrize("double_sided", [False, True])
def test_a_box_with_a_lamp(double_sided: bool, cornell: Callable, texels: Callable) -> None:
    scene = with_charts(cornell())
    materials = tuple(replace(material, double_sided=double_sided) for material in scene.materials)
    agree(replace(scene, materials=materials), texels(POINTS), 0.03)


def test_under_a_sky_and_with_a_sun(cornell: Callable, texels: Callable, sky: Environment) -> None:
    sun = PunctualLight("sun", LightKind.DIRECTIONAL, (5.0, 4.0, 3.0), direction=(0.4, -0.8, 0.3))
    agree(with_charts(replace(cornell(sky), lights=(sun,))), texels(POINTS), 0.03)


def test_a_mirrors_and_a_veils_light(cornell: Callable, texels: Callable, quad: Callable) -> None:
    scene = cornell()
    materials = (*scene.materials, Material("veil", (0.5, 0.7, 0.9, 0.4), blend=True, double_sided=True))
    veil = quad((0.1, 0.5, 0.1), (0.8, 0, 0), (0, 0, 0.8), len(scene.materials))
    agree(with_charts(replace(scene, meshes=(*scene.meshes, veil), materials=materials)), texels(POINTS), 0.03)


def test_light_of_points_is_not_in_the_cache(quad: Callable) -> None:
    floor = quad((-1, 0, -1), (0, 0, 2), (2, 0, 0))
    lamp = PunctualLight("lamp", LightKind.POINT, (10.0, 10.0, 10.0), position=(0.0, 1.0, 0.0))
    scene = with_charts(Scene((floor,), (Material("white", (0.8, 0.8, 0.8, 1.0)),), lights=(lamp,)))
    assert not cache_of(scene).any()


def test_each_side_of_a_sheet_has_its_own_light(quad: Callable) -> None:
    """A sheet over a dark floor under a white sky: pi on top, nothing below but what the floor sends back (none)."""
    sheet = quad((-1, 1, -1), (0, 0, 2), (2, 0, 0), 0)
    floor = quad((-50, 0, -50), (0, 0, 100), (100, 0, 0), 1)
    materials = (
        Material("sheet", (0.8, 0.8, 0.8, 1.0), double_sided=True),
        Material("black", (0.0, 0.0, 0.0, 1.0), roughness=1.0),
    )
    scene = with_charts(Scene((sheet, floor), materials, environment=WHITE))
    texel_map = build_texel_map(scene, RESOLUTION, "cpu")
    cache = cache_of(scene).astype(np.float64)[texel_map.mesh == 0]
    assert cache.shape[1] == 6
    np.testing.assert_allclose(cache[:, :3].mean(), np.pi, rtol=0.01)
    assert cache[:, 3:].mean() < 0.2 * np.pi


@pytest.mark.parametrize("double_sided", [False, True])
def test_no_sky_comes_into_a_closed_room(double_sided: bool) -> None:
    scene = closed_scene(rotated(box(), 3), seed=5, resolution=RESOLUTION)
    material = replace(scene.materials[0], double_sided=double_sided)
    scene = replace(scene, materials=(material,), environment=WHITE)
    texel_map = build_texel_map(scene, RESOLUTION, "cpu")
    cache = make_cache(scene, HASH, texel_map, settings(), 1 << 27)
    valid = np.nonzero(texel_map.state == TexelState.VALID)
    if double_sided:
        assert cache[valid][:, 3:].max() > 1.0, "outside there is light"
    renderer = TileRenderer(scene, HASH, settings(samples=8), 1 << 27, "cpu", cache=cache)
    assert not renderer.render_light_fields(TexelBatch.of(texel_map, valid)).light_field.any()


def test_every_texel_has_a_value_and_bytes_come_back(cornell: Callable) -> None:
    cache = cache_of(with_charts(cornell()))
    assert cache.dtype == np.float16 and cache.shape == (RESOLUTION, RESOLUTION, 3)
    assert ((cache >= 0.0) | (cache == UNKNOWN)).all() and (cache > 0.0).mean() > 0.8
    np.testing.assert_array_equal(unpack_cache(pack_cache(cache)), cache)
    assert pack_cache(cache) == pack_cache(cache_of(with_charts(cornell())))


@pytest.mark.parametrize(
    "values",
    [
        np.zeros((4, 4, 3), np.float32),
        np.zeros((4, 4, 4), np.float16),
        np.zeros((4, 12), np.float16),
        np.zeros((0, 4, 3), np.float16),
        np.full((4, 4, 3), np.inf, np.float16),
        np.full((4, 4, 3), -1.0, np.float16),
    ],
)
def test_other_arrays_are_refused(values: np.ndarray) -> None:
    with pytest.raises(InputError, match="irradiance"):
        unpack_cache(pack(KIND, {}, {"irradiance": values}))


def test_meshes_know_their_place_in_the_light_map(quad: Callable) -> None:
    mesh: Mesh = with_charts(Scene((quad((0, 0, 0), (0, 0, 1), (1, 0, 0)),), (Material("m"),))).meshes[0]
    assert mesh.lightmap_uv is not None
    for turned, side in ((False, 1.0), (True, -1.0)):
        values = vertex_attributes(mesh, Material("m"), turned)[LIGHTMAP]
        np.testing.assert_array_equal(values, np.column_stack([mesh.lightmap_uv, np.full(4, side, np.float32)]))
