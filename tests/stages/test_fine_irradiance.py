"""The finer irradiance map: the same light as the light map's, sharper where it turns fast."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import OpenEXR
import pytest
import torch
from e2e_farm import TINY, room, sky
from in_process import Baked, MemoryContext, bake

from kiln_schemas.settings import LARGEST_SIDE, LightmapSettings, make_settings
from kiln_schemas.tasks import PackagePayload
from kiln_workers.package.denoise import denoise
from kiln_workers.package.dilate import plan_fill
from kiln_workers.render.tile import INSIDE_GEOMETRY, TexelBatch, TileRenderer
from kiln_workers.scene.atlas import make_lightmap
from kiln_workers.scene.model import Environment, Material, Mesh, Scene
from kiln_workers.scene.texel_map import TexelMap, TexelState, unpack_texel_map
from kiln_workers.scene.texels import build_texel_map
from kiln_workers.shade import textures
from kiln_workers.stages import package, prepare
from kiln_workers.stages.tiles import covered_texels, map_coordinates, without_texels
from kiln_workers.store.light_field import LightFieldStore

SCALE = 4


@pytest.fixture(scope="module")
def baked(tmp_path_factory: pytest.TempPathFactory) -> Baked:
    settings = make_settings("draft", [*TINY, f"lightmap.irradiance_scale={SCALE}", "render.irradiance_samples=1024"])
    scene = replace(room(), environment=Environment(sky()))
    return bake(tmp_path_factory.mktemp("fine"), scene, settings)


def test_a_texels_finer_ones_have_its_irradiance_on_average(baked: Baked) -> None:
    store = LightFieldStore.open(baked.prepare_payload.store_url)
    coarse_map = unpack_texel_map(baked.context.blob(baked.prepared.texel_map))
    finer_map = unpack_texel_map(baked.context.blob(baked.prepared.fine or ""))
    side = coarse_map.state.shape[0]
    assert finer_map.state.shape == (SCALE * side, SCALE * side) == store.read_fine_irradiance([]).shape[:2]
    coarse, finer = store.read_irradiance(baked.prepared.tiles), store.read_fine_irradiance(baked.prepared.tiles)
    counts = (finer_map.state == TexelState.VALID) & (finer != INSIDE_GEOMETRY).all(axis=2)
    blocks = counts.reshape(side, SCALE, side, SCALE).sum(axis=(1, 3))
    whole = (blocks == SCALE * SCALE) & (coarse_map.state == TexelState.VALID)
    mean = finer.reshape(side, SCALE, side, SCALE, 3).mean(axis=(1, 3))
    assert whole.sum() > 50
    # Irradiance is not linear over a texel: single ones differ, the map as a whole does not.
    assert mean[whole].mean(axis=0) == pytest.approx(coarse[whole].mean(axis=0), rel=0.03)
    assert np.corrcoef(mean[whole].ravel(), coarse[whole].ravel())[0, 1] > 0.97


def test_every_finer_texel_is_in_one_tile(baked: Baked) -> None:
    finer_map = unpack_texel_map(baked.context.blob(baked.prepared.fine or ""))
    count = np.zeros(finer_map.state.shape, int)
    for tile in baked.prepared.tiles:
        inside = covered_texels(finer_map, tile, SCALE)
        assert (np.diff(inside) > 0).all() and (inside < (SCALE * tile.size) ** 2).all()
        count[map_coordinates(tile, inside, SCALE)] += 1
    np.testing.assert_array_equal(count, finer_map.state != TexelState.GUTTER)


def of_store(baked: Baked) -> tuple[TexelMap, np.ndarray]:
    """The finer map's texels as rendering judged them, and its irradiance [H, W, 3] as the store holds it."""
    texels = unpack_texel_map(baked.context.blob(baked.prepared.fine or ""))
    finer = LightFieldStore.open(baked.prepare_payload.store_url).read_fine_irradiance(baked.prepared.tiles)
    return without_texels(texels, (finer == INSIDE_GEOMETRY).all(axis=2)), np.maximum(finer, 0.0)


def read_rgb(path: Path) -> np.ndarray:
    with OpenEXR.File(str(path)) as file:
        return np.array(file.channels()["RGB"].pixels, np.float32)


def test_the_package_has_the_finer_map(baked: Baked, tmp_path: Path) -> None:
    stored = read_rgb(baked.download(tmp_path) / "irradiance.exr")
    texels, finer = of_store(baked)
    valid = texels.state == TexelState.VALID
    assert stored.shape == finer.shape
    np.testing.assert_allclose(stored[valid], finer[valid], rtol=1e-5)
    assert (stored >= 0.0).all()


def test_the_package_takes_the_noise_out_where_it_is_asked_to(baked: Baked, tmp_path: Path) -> None:
    asked = baked.prepare_payload
    settings = asked.settings.model_copy(
        update={"package": asked.settings.package.model_copy(update={"denoise": True})}
    )
    context = MemoryContext(scratch=tmp_path, blobs=dict(baked.context.blobs))
    payload = PackagePayload(
        **{"job_id": "0" * 32, "job_name": "room", "bundle": asked.bundle, "store_url": asked.store_url},
        **{"prepare": baked.prepared, "renders": baked.renders, "fits": baked.fits, "refines": baked.refines},
        settings=settings,
    )
    package.run(payload, context)
    stored = read_rgb(tmp_path / "package" / "irradiance.exr")
    texels, finer = of_store(baked)
    valid = texels.state == TexelState.VALID
    expected = finer.copy()
    denoise(expected, texels)
    assert np.mean(np.abs(expected - finer)[valid]) > 0.005 * finer[valid].mean()
    np.testing.assert_allclose(stored[valid], expected[valid], rtol=1e-5)


def test_a_light_map_of_scale_one_has_none(baked: Baked, tmp_path: Path) -> None:
    settings = make_settings("draft", [*TINY, "lightmap.irradiance_scale=1"])
    store_url = (tmp_path / "store.zarr").as_uri()
    payload = baked.prepare_payload.model_copy(update={"settings": settings, "store_url": store_url})
    assert prepare.run(payload, baked.context).fine is None
    assert LightFieldStore.open(store_url).irradiance_scale == 1


@pytest.mark.parametrize(
    ("side", "scale", "expected"), [(64, 4, 256), (LARGEST_SIDE, 4, LARGEST_SIDE), (3000, 8, 6000), (100, 1, 100)]
)
def test_the_finer_map_is_no_larger_than_a_light_map_may_be(side: int, scale: int, expected: int) -> None:
    assert LightmapSettings(irradiance_scale=scale).irradiance_side(side) == expected


def test_a_chart_that_wholly_lies_inside_geometry_stays(baked: Baked) -> None:
    finer_map = unpack_texel_map(baked.context.blob(baked.prepared.fine or ""))
    charts = np.unique(finer_map.chart[finer_map.chart >= 0])
    inside = finer_map.chart == charts[0]
    at = np.argwhere(finer_map.chart == charts[1])[0]
    inside[tuple(at)] = True
    state = without_texels(finer_map, inside).state
    np.testing.assert_array_equal(state[finer_map.chart == charts[0]], finer_map.state[finer_map.chart == charts[0]])
    assert state[tuple(at)] == TexelState.INVALID


def block_over_a_floor() -> Scene:
    """A block of 1 m that floats 15 cm over a floor of 8 m under a white sky."""

    def mesh(name: str, corners: list[list[float]], faces: list[list[int]]) -> Mesh:
        used = np.array(corners, np.float32)[np.array(faces).ravel()]
        triangles = used.reshape(-1, 3, 3)
        normal = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
        normal = np.repeat(normal / np.linalg.norm(normal, axis=1, keepdims=True), 3, axis=0).astype(np.float32)
        return Mesh(name, used, normal, np.arange(len(used), dtype=np.int32).reshape(-1, 3), 0)

    floor = mesh("floor", [[-4, 0, 4], [4, 0, 4], [4, 0, -4], [-4, 0, -4]], [[0, 1, 2], [0, 2, 3]])
    cube = [[x, y, z] for x in (-0.5, 0.5) for y in (0.15, 1.15) for z in (-0.5, 0.5)]
    quads = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
    faces = [triangle for a, b, c, d in quads for triangle in ([a, b, c], [a, c, d])]
    white = Environment(np.ones((4, 8, 3), np.float32))
    return Scene((floor, mesh("block", cube, faces)), (Material("grey", (0.5, 0.5, 0.5)),), environment=white)


def renderer_of(scene: Scene, digit: str, samples: int) -> TileRenderer:
    settings = make_settings("draft", [f"render.irradiance_samples={samples}"]).render
    return TileRenderer(scene, digit * 64, settings, 1 << 28, "cpu")


def as_packaged(scene: Scene, texel_map: TexelMap) -> np.ndarray:
    """The irradiance map [H, W, 3] of a texel map as the package fills it."""
    renderer = renderer_of(scene, "5", 1024)
    place = np.nonzero(texel_map.state != TexelState.GUTTER)
    found, _, _ = renderer.render_fine_irradiance(TexelBatch.of(texel_map, place))
    values = np.zeros((*texel_map.state.shape, 3), np.float32)
    values[place] = found
    judged = without_texels(texel_map, (values < 0.0).any(axis=2))
    fill = plan_fill(judged.state == TexelState.VALID, texel_map.chart)
    return np.asarray(fill.nearest(np.maximum(values, 0.0)))


def test_a_contact_shadow_is_sharper() -> None:
    """On the floor, from 30 cm under the block to 40 cm beside it, against the irradiance at the points themselves."""
    scene = make_lightmap(block_over_a_floor(), LightmapSettings(resolution=32)).scene
    floor = scene.meshes[0]
    assert floor.lightmap_uv is not None
    away = np.linspace(-0.3, 0.4, 20)
    points = np.stack([0.5 + away, 0.0 * away, 0.1 + 0.0 * away], axis=1)
    # The floor is a quad: its light-map UV is affine in x and z.
    system = np.stack([floor.positions[:, 0], floor.positions[:, 2], np.ones(len(floor.positions))], axis=1)
    affine = np.linalg.lstsq(system.astype(np.float64), floor.lightmap_uv.astype(np.float64), rcond=None)[0]
    uv = torch.from_numpy((np.stack([points[:, 0], points[:, 2], np.ones(20)], axis=1) @ affine).astype(np.float32))

    up = np.tile(np.float32([0.0, 1.0, 0.0]), (20, 1))
    batch = TexelBatch(
        index=np.arange(20) + (1 << 40),
        position=(points + np.array([0.0, 1e-5, 0.0])).astype(np.float32),
        normal=up,
        shading_normal=up,
        alpha=np.ones(20, np.float32),
        texel_size=np.full(20, 1e-3, np.float32),
    )
    truth = renderer_of(scene, "6", 1 << 14).render_irradiance(batch)[0]
    errors = {}
    for side in (32, 32 * SCALE):
        irradiance = torch.from_numpy(as_packaged(scene, build_texel_map(scene, side, "cpu")))
        found = textures.bilinear(irradiance, uv).numpy()
        errors[side] = float(np.sqrt(np.mean((found - truth) ** 2)) / np.pi)
    assert errors[32 * SCALE] < 0.5 * errors[32], errors
