"""Furnaces and mirrors through the whole chain: bake, package, shade from the package's files."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from e2e_farm import TINY, quad, room, sky
from in_process import bake

from kiln_schemas.camera import Camera
from kiln_schemas.settings import Function, make_settings
from kiln_schemas.tasks import Tile
from kiln_workers.scene.model import Environment, Material, Scene
from kiln_workers.scene.shapes import Cell, patch, sphere
from kiln_workers.shade.gbuffer import render_gbuffer
from kiln_workers.shade.package import ShadePackage
from kiln_workers.shade.picture import shade
from kiln_workers.shade.term import Term
from kiln_workers.sphere import gaussian, ggx, octahedral
from kiln_workers.sphere.quadrature import fibonacci_sphere
from kiln_workers.store.light_field import LightFieldStore

CPU = torch.device("cpu")
GLOW = 1.7
NO_SCATTERING = ("render.max_depth=0", "render.irradiance_samples=16384")
"""A surface of glTF always reflects a little, more so towards grazing: with it nothing would be constant."""


def read(folder: Path) -> ShadePackage:
    return ShadePackage.read(folder, CPU)


def enclosure() -> Scene:
    """The inside of a box of 2 m that emits GLOW everywhere and reflects nothing."""
    corners = [
        ((-1, 0, 1), (2, 0, 0), (0, 0, -2)),
        ((-1, 2, -1), (2, 0, 0), (0, 0, 2)),
        ((-1, 0, 1), (0, 0, -2), (0, 2, 0)),
        ((1, 0, -1), (0, 0, 2), (0, 2, 0)),
        ((-1, 0, -1), (2, 0, 0), (0, 2, 0)),
        ((1, 0, 1), (-2, 0, 0), (0, 2, 0)),
    ]
    meshes = tuple(quad(f"side {k}", *sides, 0) for k, sides in enumerate(corners))
    return Scene(meshes, (Material("glow", (0.0, 0.0, 0.0, 1.0), emission=(GLOW, GLOW, GLOW)),))


@pytest.fixture(scope="module")
def furnace(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("furnace")
    settings = make_settings("draft", [*TINY, "fit.refine_steps=400", "render.samples=2", *NO_SCATTERING])
    bake(folder, enclosure(), settings).download(folder / "package")
    return folder


def test_inside_a_glowing_box_everything_is_constant(furnace: Path) -> None:
    """Irradiance, stored light fields and those of the package's lobes within 1 % above each horizon."""
    store = LightFieldStore.open((furnace / "store.zarr").as_uri())
    texels = store.read_texel_map()
    valid = texels["state"] == 1
    assert valid.sum() > 50
    places = {(int(row) // 8 * 8, int(column) // 8 * 8) for row, column in np.argwhere(valid)}
    tiles = [Tile(row=row, column=column, size=8, texels=1) for row, column in places]
    irradiance = store.read_irradiance(tiles)[valid]
    np.testing.assert_allclose(irradiance, np.pi * GLOW, rtol=0.01)
    package = read(furnace / "package")
    np.testing.assert_allclose(package.irradiance.numpy(), np.pi * GLOW, rtol=0.01)  # gutters are filled
    directions = octahedral.pixel_directions(store.image_size).reshape(-1, 3)
    weight = octahedral.pixel_solid_angles(store.image_size).ravel()
    lobes = package.lobes.light_field.numpy().astype(np.float64)
    deviations = []
    for row, column in np.argwhere(valid):
        above = directions @ texels["normal"][row, column] > 0.0
        tile = Tile(row=row // 8 * 8, column=column // 8 * 8, size=8, texels=64)
        image = store.read_tile(Function.LIGHT_FIELD, tile, np.array([row % 8 * 8 + column % 8]))[0].reshape(-1, 3)
        np.testing.assert_allclose(image[above].astype(np.float64), GLOW, rtol=0.01)
        made = gaussian.evaluate(directions[above], lobes[row, column])
        deviations.append(np.average((made / GLOW - 1.0) ** 2, axis=0, weights=weight[above]).mean())
    assert np.sqrt(np.mean(deviations)) < 0.01, "root mean square over texels and directions"


def albedo(cosine: float, alpha: float) -> float:
    """Single-scattering albedo of GGX with F = 1, by quadrature."""
    view = np.array([np.sqrt(1.0 - cosine**2), 0.0, cosine])
    directions = fibonacci_sphere(200_000)
    directions = directions[directions[:, 2] > 0.0]
    half = directions + view
    half /= np.linalg.norm(half, axis=1, keepdims=True)
    shape = ggx.distribution(half[:, 2], alpha) * ggx.masking_shadowing(directions[:, 2], cosine, alpha)
    return float((shape / (4.0 * cosine)).sum() * 4.0 * np.pi / 200_000)


def test_a_ball_in_a_constant_environment(tmp_path: Path) -> None:
    """Nothing occludes a convex object: W_E is 1 within 1 %, and it reflects the albedo of GGX within 3 %."""
    ball = patch("ball", sphere(np.zeros(3), 1.0), (24, 24), Cell(0, 0, 32, 32), 0)
    white = Material("white metal", (1.0, 1.0, 1.0, 1.0), metallic=1.0, roughness=0.6)
    environment = Environment(np.full((8, 16, 3), 0.8, np.float32))
    settings = make_settings("draft", [*TINY, "fit.visibility_refine_steps=400"])
    package = read(
        bake(tmp_path, Scene((ball,), (white,), environment=environment), settings).download(tmp_path / "package")
    )
    store = LightFieldStore.open((tmp_path / "store.zarr").as_uri())
    texels = store.read_texel_map()
    assert package.lobes.visibility_lobes is not None
    directions = octahedral.pixel_directions(store.image_size).reshape(-1, 3)
    lobes, compared = package.lobes.visibility_lobes.numpy().astype(np.float64), []
    for row, column in np.argwhere(texels["state"] == 1):
        above = directions @ texels["normal"][row, column] > 0.0
        tile = Tile(row=row // 8 * 8, column=column // 8 * 8, size=8, texels=64)
        image = store.read_tile(Function.VISIBILITY, tile, np.array([row % 8 * 8 + column % 8]))[0].reshape(-1, 3)
        np.testing.assert_allclose(image[above].astype(np.float64), 1.0, rtol=1e-3)
        compared.append(np.mean((gaussian.evaluate(directions[above], lobes[row, column]) - 1.0) ** 2))
    assert len(compared) > 100 and np.sqrt(np.mean(compared)) < 0.01

    camera = Camera(position=(0.0, 0.5, 4.0), target=(0.0, 0.0, 0.0), fov_deg=32.0)
    buffer = render_gbuffer(package.scene, camera, 40, 40, grid=1, device="cpu")
    cosine = np.einsum("pc,pc->p", buffer.normal, buffer.view)
    for alpha in (0.1, 0.3, 0.6, 1.0):
        rough = replace(buffer, alpha=np.full_like(buffer.alpha, alpha))
        seen = shade(package, rough, [Term.ENVIRONMENT]).reshape(-1, 3)[buffer.hit.ravel()] / 0.8
        for low, high in ((0.2, 0.3), (0.5, 0.6), (0.9, 1.0)):
            at = (cosine > low) & (cosine < high)
            expected = np.mean([albedo(float(c), alpha) for c in np.quantile(cosine[at], (0.1, 0.5, 0.9))])
            assert at.sum() > 20
            assert seen[at].mean() == pytest.approx(expected, rel=0.03), (alpha, low)


def mirrored(scene: Scene, environment: Environment) -> Scene:
    """x becomes -x, faces are wound the other way, the light map and the environment are turned over."""
    turn = np.array([-1, 1, 1], np.float32)
    meshes = tuple(
        replace(
            mesh,
            positions=mesh.positions * turn,
            normals=mesh.normals * turn,
            faces=mesh.faces[:, ::-1].copy(),
        )
        for mesh in scene.meshes
    )
    # The middle column looks along +X, its quarters along -Z and +Z: the columns are turned over about those.
    pixels = np.roll(environment.pixels[:, ::-1], environment.pixels.shape[1] // 2, axis=1)
    return replace(scene, meshes=meshes, environment=Environment(pixels))


def test_a_mirrored_scene_gives_the_mirrored_picture(tmp_path: Path) -> None:
    """Baked and shaded on their own: alike when one is turned over, far apart when it is not."""
    pixels = sky()
    pixels[:, :16] *= 0.3
    settings = make_settings("draft", [*TINY, "render.samples=32", "render.irradiance_samples=1024"])
    straight = replace(room(), environment=Environment(pixels))
    pictures = []
    for name, scene, side in (("one", straight, 1.0), ("other", mirrored(room(), Environment(pixels)), -1.0)):
        package = read(bake(tmp_path / name, scene, settings).download(tmp_path / name / "package"))
        camera = Camera(position=(side * 0.4, 1.1, 3.6), target=(0.0, 0.8, -0.5), fov_deg=42.0)
        pictures.append(shade(package, render_gbuffer(package.scene, camera, 48, 36, device="cpu")))
    one, other = (np.log1p(picture.astype(np.float64)) for picture in pictures)

    def apart(a: np.ndarray, b: np.ndarray) -> float:
        return float(np.sqrt(np.mean((a - b) ** 2)) / np.sqrt(np.mean(a**2)))

    assert apart(one, other[:, ::-1]) < 0.06
    assert apart(one, other) > 0.3
