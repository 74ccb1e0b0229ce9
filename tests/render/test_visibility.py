"""W_E: 1 where nothing occludes, and eq. 7 by brute force where something does."""

from collections.abc import Callable

import numpy as np
import pytest

from kiln_workers.render.environment import look_up
from kiln_workers.render.tile import TexelBatch, TileRenderer
from kiln_workers.scene.model import Environment, Image, Material, Mesh, Scene, TextureRef
from kiln_workers.sphere import ggx, octahedral
from kiln_workers.sphere.quadrature import fibonacci_sphere

POINTS = fibonacci_sphere(50_000)
UP = np.array([0.0, 1.0, 0.0])


def brute_force(radiance: np.ndarray, w: np.ndarray, alpha: float, open_sky: np.ndarray) -> np.ndarray:
    """Eq. 7 for one direction by a Fibonacci sphere with `radiance` at POINTS, of which `open_sky` are not occluded."""
    cosine = POINTS @ w
    above = (cosine > 0.0) & (POINTS @ UP > 0.0)
    weight = np.where(above, cosine * ggx.distribution(np.sqrt(0.5 * (1.0 + cosine)), alpha), 0.0)
    energy = weight[:, None] * radiance
    return np.asarray(energy[open_sky].sum(axis=0) / energy.sum(axis=0))


def wall(quad: Callable[..., Mesh], material: Material = Material("wall")) -> Scene:
    """A floor, and a wall at x = 1 that hides every direction with x > 0 less steep than 45 degrees."""
    floor = quad((-50, 0, -50), (0, 0, 100), (100, 0, 0))
    return Scene((floor, quad((1, 0, -5e3), (0, 0, 1e4), (0, 1, 0), 1)), (Material("floor"), material))


def with_environment(scene: Scene, environment: Environment) -> Scene:
    return Scene(scene.meshes, scene.materials, scene.images, scene.lights, environment)


@pytest.mark.parametrize("alpha", [0.002, 0.3, 1.0])
def test_one_where_nothing_occludes(
    quad: Callable[..., Mesh],
    texels: Callable[..., TexelBatch],
    renderer: Callable[..., TileRenderer],
    sky: Environment,
    alpha: float,
) -> None:
    scene = with_environment(Scene((quad((-1, 0, -1), (0, 0, 2), (2, 0, 0)),), (Material("m"),)), sky)
    image = renderer(scene, samples=1, irradiance_samples=1).render(texels([(0, 0, 0)], alpha=alpha)).visibility
    assert image is not None
    above = octahedral.pixel_directions(16)[..., 1] > 0.0
    assert np.all(image[0][above] == 1.0)
    assert np.all(image[0][~above] == 0.0)


@pytest.mark.parametrize("size", [32, 64])
@pytest.mark.parametrize("alpha", [0.1, 0.3, 0.6])
def test_agrees_with_brute_force(
    quad: Callable[..., Mesh],
    texels: Callable[..., TexelBatch],
    renderer: Callable[..., TileRenderer],
    sky: Environment,
    alpha: float,
    size: int,
) -> None:
    """Within 0.06 in every direction tried and 0.012 in the mean: the error of the pixel grid at the wall's edge."""
    scene = with_environment(wall(quad), sky)
    tile = renderer(scene, image_size=size, samples=1, irradiance_samples=1)
    image = tile.render(texels([(0, 0, 0)], alpha=alpha)).visibility
    assert image is not None
    open_sky = (POINTS[:, 0] <= 0.0) | (POINTS[:, 1] > POINTS[:, 0])
    directions = octahedral.pixel_directions(size)
    rows, columns = np.nonzero(directions[..., 1] > 0.1)
    errors = []
    radiance = look_up(sky, POINTS)
    for k in range(0, len(rows), len(rows) // 60):
        truth = brute_force(radiance, directions[rows[k], columns[k]], alpha, open_sky)
        errors.append(np.abs(image[0, rows[k], columns[k]].astype(float) - truth))
    assert np.max(errors) < 0.06 and np.mean(errors) < 0.012, (np.max(errors), np.mean(errors))


@pytest.mark.parametrize(("column", "lit"), [(16, True), (48, False)])
def test_a_sun_of_one_pixel_is_not_missed(
    quad: Callable[..., Mesh],
    texels: Callable[..., TexelBatch],
    renderer: Callable[..., TileRenderer],
    column: int,
    lit: bool,
) -> None:
    """The sun 23 degrees high holds nearly all the energy: W_E is close to its own visibility, 1 or 0."""
    pixels = np.full((32, 64, 3), 1e-3, np.float32)
    pixels[11, column] = 1e4
    # Column 16 is at -Z; turned by 90 degrees it is at -X, away from the wall.
    scene = with_environment(wall(quad), Environment(pixels, rotation_deg=90.0))
    image = renderer(scene, samples=1, irradiance_samples=1).render(texels([(0, 0, 0)])).visibility
    assert image is not None
    # The lobes whose hemisphere holds the sun.
    directions = octahedral.pixel_directions(16)
    sun = np.array([-0.9 if lit else 0.9, 0.4, 0.0])
    values = image[0][(directions[..., 1] > 0.1) & (directions @ sun > 0.2)].astype(float)
    assert (values > 0.98).all() if lit else (values < 0.02).all()


def test_a_black_channel_takes_the_plain_visibility(
    quad: Callable[..., Mesh], texels: Callable[..., TexelBatch], renderer: Callable[..., TileRenderer]
) -> None:
    white, red = np.ones((8, 16, 3), np.float32), np.zeros((8, 16, 3), np.float32)
    red[..., 0] = 1.0
    images = []
    for pixels in (white, red):
        scene = with_environment(wall(quad), Environment(pixels))
        images.append(renderer(scene, samples=1, irradiance_samples=1).render(texels([(0, 0, 0)])).visibility)
    assert images[0] is not None and images[1] is not None
    np.testing.assert_allclose(images[1].astype(float), images[0].astype(float), atol=2e-3)
    assert images[0].min() < 0.6


def test_cut_outs_let_light_through(
    quad: Callable[..., Mesh], texels: Callable[..., TexelBatch], renderer: Callable[..., TileRenderer]
) -> None:
    """A wall whose texture is transparent hides nothing; one that is opaque hides what a plain one does."""
    environment = Environment(np.ones((8, 16, 3), np.float32))
    images = []
    for alpha in (0, 255):
        leaf = Material("leaf", base_color_texture=TextureRef(0), alpha_cutoff=0.5)
        scene = wall(quad, leaf)
        texture = Image("leaf", np.full((2, 2, 4), [255, 255, 255, alpha], np.uint8), srgb=True)
        scene = Scene(scene.meshes, scene.materials, (texture,), (), environment)
        images.append(renderer(scene, samples=1, irradiance_samples=1).render(texels([(0, 0, 0)])).visibility)
    plain = with_environment(wall(quad), environment)
    wanted = renderer(plain, samples=1, irradiance_samples=1).render(texels([(0, 0, 0)])).visibility
    above = octahedral.pixel_directions(16)[..., 1] > 0.0
    assert images[0] is not None and images[1] is not None and wanted is not None
    assert np.all(images[0][0][above] == 1.0)
    np.testing.assert_array_equal(images[1], wanted)


def test_a_pane_lets_its_share_of_the_sky_through(
    quad: Callable[..., Mesh],
    texels: Callable[..., TexelBatch],
    renderer: Callable[..., TileRenderer],
    sky: Environment,
) -> None:
    """A wide pane of opacity 0.25: three quarters of the environment in every direction that is not grazing."""
    pane = Material("pane", (0.0, 0.0, 0.0, 0.25), blend=True, double_sided=True)
    floor = quad((-1, 0, -1), (0, 0, 2), (2, 0, 0))
    above = quad((-5e3, 0.5, -5e3), (0, 0, 1e4), (1e4, 0, 0), 1)
    scene = with_environment(Scene((floor, above), (Material("floor"), pane)), sky)
    points = [(0, 0, 0), (0.5, 0, 0.5)]
    image = renderer(scene, samples=1, irradiance_samples=1).render(texels(points, alpha=0.3)).visibility
    assert image is not None
    steep = octahedral.pixel_directions(16)[..., 1] > 0.3
    np.testing.assert_allclose(image[:, steep], 0.75, atol=0.01)
