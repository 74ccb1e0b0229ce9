"""Whole pictures: geometry against Mitsuba's own camera, a furnace, a mirrored scene, the store in place of lobes."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from kiln_schemas.camera import Camera
from kiln_schemas.errors import InputError
from kiln_schemas.settings import Function
from kiln_schemas.tasks import Tile
from kiln_workers.scene.model import Scene
from kiln_workers.shade import algorithm, textures
from kiln_workers.shade.gbuffer import render_gbuffer
from kiln_workers.shade.package import LobeTextures
from kiln_workers.shade.picture import shade
from kiln_workers.shade.reference import path_trace
from kiln_workers.shade.stored import StoredImages
from kiln_workers.shade.term import Term
from kiln_workers.sphere import gaussian, ggx, octahedral
from kiln_workers.sphere.quadrature import fibonacci_sphere
from kiln_workers.store.light_field import LightFieldStore

CAMERA = Camera(position=(0.4, 0.9, 2.6), target=(0.0, 0.35, -0.4), fov_deg=45.0, up=(0.1, 1.0, 0.0))


def test_the_gbuffer_lies_where_mitsubas_camera_sees_it(make_package, room_scene: Scene) -> None:
    """Lamps alone: emission over the G-buffer is the path tracer's picture at depth 0, edges included."""
    buffer = render_gbuffer(room_scene, CAMERA, 48, 30, grid=8, device="cpu")
    shaded = shade(make_package(), buffer, [Term.EMISSION])
    black = tuple(replace(m, base_color=(0.0, 0.0, 0.0, 1.0), metallic=1.0) for m in room_scene.materials)
    traced = path_trace(replace(room_scene, materials=black), CAMERA, 48, 30, 128, 1, device="cpu")
    assert shaded.max() > 3.0
    # Only edge pixels are noisy, by the fraction of their area that is seen.
    assert np.abs(shaded - traced.picture).max() < 0.15 * 4.0
    assert np.abs(shaded - traced.picture).mean() < 0.004


def test_the_gbuffer_is_the_surface(room_scene: Scene) -> None:
    buffer = render_gbuffer(room_scene, CAMERA, 40, 25, grid=1, device="cpu")
    floor = buffer.metallic > 0.5
    assert floor.sum() > 100
    # The floor's light-map cell is (0.05, 0.05) + 0.4 (s, t), with x = -1.5 + 3 s and z = 1 - 2 t.
    s, t = ((buffer.lightmap_uv[floor] - 0.05) / 0.4).T
    np.testing.assert_allclose(buffer.position[floor, 0], -1.5 + 3.0 * s, atol=1e-4)
    np.testing.assert_allclose(buffer.position[floor, 2], 1.0 - 2.0 * t, atol=1e-4)
    np.testing.assert_allclose(buffer.normal[floor], np.tile([0, 1, 0], (int(floor.sum()), 1)), atol=1e-6)
    np.testing.assert_allclose(buffer.alpha[floor], 0.55**2, rtol=1e-6)
    towards = np.asarray(CAMERA.position) - buffer.position
    np.testing.assert_allclose(buffer.view, towards / np.linalg.norm(towards, axis=-1, keepdims=True), atol=1e-5)


def test_the_back_of_a_single_sided_surface_is_black(make_package, room_scene: Scene) -> None:
    behind = Camera(position=(0.3, 0.5, -4.0), target=(0.0, 0.5, 0.0), fov_deg=30.0)
    buffer = render_gbuffer(room_scene, behind, 32, 20, grid=1, device="cpu")
    wall = np.isclose(buffer.position[:, 2], -1.0, atol=1e-3)
    assert wall.sum() > 50 and not buffer.reflects[wall].any()
    assert shade(make_package(constant=True), buffer, [Term.DIFFUSE]).max() == 0.0


def test_a_furnace(make_package) -> None:
    """All light is 1: the floor reflects the albedo of GGX (F G as the paper has it), the wall its colour."""
    package = make_package(constant=True, environment=True)
    buffer = render_gbuffer(package.scene, CAMERA, 24, 15, grid=1, device="cpu")
    cosine = np.einsum("pc,pc->p", buffer.normal, buffer.view).astype(np.float64)
    f0 = 0.04 + (buffer.base_color - 0.04) * buffer.metallic[:, None]
    fresnel = ggx.fresnel_schlick(cosine[:, None], f0)
    masking = ggx.masking_shadowing(cosine, cosine, buffer.alpha)[:, None]
    on_floor = buffer.metallic > 0.5

    seen = shade(package, buffer, [Term.ENVIRONMENT], paper=True).reshape(-1, 3)[buffer.hit.ravel()]
    integral = np.exp(np.interp(np.log(0.55**2), np.log([0.2, 0.5]), np.log([4.0 / 1.04, 4.0 / 1.25])))
    expected = (integral * fresnel * masking / (4.0 * cosine[:, None]))[on_floor]
    np.testing.assert_allclose(seen[on_floor], expected, rtol=1e-4)
    np.testing.assert_allclose(
        seen, shade(package, buffer, [Term.UNOCCLUDED], paper=True).reshape(-1, 3)[buffer.hit.ravel()], rtol=1e-5
    )

    wall = (buffer.base_color[:, 0] > 0.35) & ~on_floor
    diffuse = shade(package, buffer, [Term.DIFFUSE]).reshape(-1, 3)[buffer.hit.ravel()]
    passes = algorithm.transmission(torch.from_numpy(cosine)).numpy()[:, None]
    np.testing.assert_allclose(diffuse[wall], (buffer.base_color * passes)[wall], rtol=1e-4)
    assert wall.sum() > 20 and on_floor.sum() > 20


def mirrored(scene: Scene) -> Scene:
    """x becomes -x; faces are wound the other way, so fronts stay fronts."""
    flip = np.array([-1, 1, 1], np.float32)
    meshes = (
        replace(mesh, positions=mesh.positions * flip, normals=mesh.normals * flip, faces=mesh.faces[:, ::-1].copy())
        for mesh in scene.meshes
    )
    return replace(scene, meshes=tuple(meshes))


def test_a_mirrored_scene_gives_the_mirrored_picture(make_package) -> None:
    package = make_package()
    camera = Camera(position=(-0.4, 0.9, 2.6), target=(0.0, 0.35, -0.4), fov_deg=45.0, up=(-0.1, 1.0, 0.0))
    straight = shade(package, render_gbuffer(package.scene, CAMERA, 40, 25, grid=2, device="cpu"))
    lobes = package.lobes.light_field * torch.tensor([-1.0, 1, 1, 1, 1, 1, 1])
    other = replace(package, scene=mirrored(package.scene), lobes=LobeTextures(lobes, None))
    turned = shade(other, render_gbuffer(other.scene, camera, 40, 25, grid=2, device="cpu"))
    assert straight.max() > 1.0 and np.abs(straight - straight[:, ::-1]).mean() > 0.05
    np.testing.assert_allclose(turned[:, ::-1], straight, rtol=2e-3, atol=2e-3)


@pytest.fixture
def store_of_lobes(tmp_path: Path, make_package) -> str:
    """A store whose images are those that the package's lobes give, as the light field and as the visibility."""
    lobes = make_package().lobes.light_field.numpy().astype(np.float64)
    size, shape = 32, lobes.shape[:2]
    directions = octahedral.pixel_directions(size).reshape(-1, 3)
    images = gaussian.evaluate(directions, lobes.reshape(-1, 3, 7)).reshape(-1, size, size, 3).astype(np.float16)
    url = (tmp_path / "store.zarr").as_uri()
    store = LightFieldStore.create(
        url, shape=shape, image_size=size, tile=8, functions=list(Function), attributes={"test": True}
    )
    state = np.ones(shape, np.uint8)
    state[0, 0] = 0
    flat = np.zeros((*shape, 3), np.float32)
    store.write_texel_map({"state": state, "position": flat, "normal": flat, "alpha": flat[..., 0]})
    numbers = np.arange(shape[0] * shape[1]).reshape(shape)
    for row, column in ((0, 0), (0, 8), (8, 0), (8, 8)):
        part = numbers[row : row + 8, column : column + 8].ravel()
        values = images[part]
        store.write_tile(
            Tile(row=row, column=column, size=8, texels=64),
            np.arange(64),
            values,
            values,
            np.zeros((64, 3), np.float32),
        )
    return url


def test_the_store_in_place_of_lobes(make_package, store_of_lobes: str) -> None:
    """Sums over stored pixels against quadrature of the functions that were stored, bilinear between texels."""
    package = make_package(environment=True)
    above = Camera(position=(0.2, 2.4, 1.2), target=(0.0, 0.0, 0.0), fov_deg=35.0)
    buffer = render_gbuffer(package.scene, above, 10, 6, grid=1, device="cpu")
    floor = buffer.metallic > 0.5
    names = ("normal", "view", "base_color", "metallic", "alpha")
    surface = algorithm.Surface(*(torch.from_numpy(getattr(buffer, name)[floor]) for name in names))
    uv = torch.from_numpy(buffer.lightmap_uv[floor])
    stored = StoredImages.open(store_of_lobes, (16, 16))

    rows, columns, weights = textures.corners(16, 16, uv)
    lobes = package.lobes.light_field[rows, columns].numpy().astype(np.float64)  # [P, 4, 3, 7]
    directions = fibonacci_sphere(20_000)
    light = np.einsum("pcds,pc->pds", gaussian.evaluate(directions, lobes), weights.numpy())
    at = torch.from_numpy(directions.astype(np.float32))
    kernel = sum(kernel(at).numpy() for kernel in algorithm.reflection_kernels(surface))
    expected = np.einsum("pd,pds->ps", kernel, light) * 4.0 * np.pi / len(directions)
    assert len(expected) > 20
    np.testing.assert_allclose(stored.reflected(uv, surface).numpy(), expected, rtol=0.02)

    seen = np.einsum("pcs,pc->ps", _at_specular(lobes, surface), weights.numpy())
    np.testing.assert_allclose(stored.visibility(uv, surface.specular).numpy(), seen, rtol=0.03, atol=0.03)


def _at_specular(lobes: np.ndarray, surface: algorithm.Surface) -> np.ndarray:
    """Lobes [P, 4, N, 7] in each point's specular direction: [P, 4, 3]."""
    specular = surface.specular.numpy().astype(np.float64)
    return np.stack([gaussian.evaluate(d[None], one)[:, 0] for d, one in zip(specular, lobes, strict=True)])


def test_a_texel_without_data_passes_its_weight_on(make_package, store_of_lobes: str) -> None:
    """Texel (0, 0) is not valid: a quarter of a texel beside its centre the next one counts alone."""
    normal = torch.tensor([[0.0, 1.0, 0.0]])
    surface = algorithm.Surface(normal, normal, normal, torch.ones(1), torch.tensor([0.3]))
    stored = StoredImages.open(store_of_lobes, (16, 16))
    beside, centre = (stored.reflected(torch.tensor([[x / 16, 0.5 / 16]]), surface) for x in (0.75, 1.5))
    assert centre.min() > 0.0
    torch.testing.assert_close(beside, centre, rtol=1e-5, atol=0.0)


def test_a_store_of_another_size_is_refused(store_of_lobes: str) -> None:
    with pytest.raises(InputError, match="16 x 16"):
        StoredImages.open(store_of_lobes, (32, 32))
