"""The environment's directions, U and the GGX cube, and irradiance under it."""

from collections.abc import Callable

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from kiln_workers.render import environment as products
from kiln_workers.render.mitsuba_scene import to_mitsuba
from kiln_workers.render.tile import TexelBatch, TileRenderer
from kiln_workers.scene.model import Environment, Material, Mesh, Scene
from kiln_workers.sphere import ggx, octahedral
from kiln_workers.sphere.quadrature import fibonacci_sphere

POINTS = fibonacci_sphere(200_000)


def only(environment: Environment, quad: Callable[..., Mesh]) -> Scene:
    return Scene((quad((-1, 0, -1), (0, 0, 2), (2, 0, 0)),), (Material("m"),), environment=environment)


@pytest.mark.parametrize("rotation", [0.0, 90.0, -35.0])
def test_pixels_lie_where_the_model_says(rotation: float) -> None:
    """`scene.model.Environment`: (-sin t cos p, cos t, -sin t sin p), turned counter-clockwise seen from above."""
    pixels = np.random.default_rng(5).random((4, 8, 3)).astype(np.float32)
    environment = Environment(pixels, scale=2.0, rotation_deg=rotation)
    for row, column in ((0, 0), (1, 3), (3, 7)):
        theta, phi = np.pi * (row + 0.5) / 4, 2.0 * np.pi * (column + 0.5) / 8
        d = np.array([-np.sin(theta) * np.cos(phi), np.cos(theta), -np.sin(theta) * np.sin(phi)])
        turn = np.radians(rotation)
        # Counter-clockwise seen from +Y takes +Z to +X.
        d = np.array([np.cos(turn) * d[0] + np.sin(turn) * d[2], d[1], -np.sin(turn) * d[0] + np.cos(turn) * d[2]])
        np.testing.assert_allclose(products.look_up(environment, d), 2.0 * pixels[row, column], rtol=1e-6)


def test_mitsuba_sees_the_same_environment(sky: Environment, quad: Callable[..., Mesh]) -> None:
    scene = to_mitsuba(only(sky, quad))
    directions = fibonacci_sphere(5000)
    si = dr.zeros(mi.SurfaceInteraction3f, len(directions))
    si.wi = mi.Vector3f(-directions.T.astype(np.float32))
    seen = np.array(scene.environment().eval(si)).T
    np.testing.assert_allclose(seen, products.look_up(sky, directions), rtol=2e-3, atol=2e-3)


def test_samples_are_a_quadrature_of_the_look_up(sky: Environment) -> None:
    samples = products.environment_samples(sky, 100_000)
    assert samples.solid_angle.sum() == pytest.approx(4.0 * np.pi, rel=1e-9)
    np.testing.assert_allclose(samples.radiance, products.look_up(sky, samples.direction), rtol=1e-6)
    inside = samples.jittered(np.arange(100), np.full((100, 2), 0.5))
    np.testing.assert_allclose(inside, samples.direction[:100], atol=1e-12)


def test_large_images_keep_their_energy() -> None:
    pixels = np.zeros((2048, 4096, 3), np.float32)
    pixels[700, 1000] = 5e4
    samples = products.environment_samples(Environment(pixels), 1)
    assert len(samples.radiance) <= products.LARGEST_SAMPLES
    got = (samples.radiance[:, 0] * samples.solid_angle).sum()
    height = np.cos(np.pi * np.array([700, 701]) / 2048)
    assert got == pytest.approx(5e4 * (height[0] - height[1]) * 2.0 * np.pi / 4096, rel=2e-3)


def test_u_in_a_white_furnace() -> None:
    alphas = np.array([0.01, 0.1, 0.5, 1.0])
    layers, integrals = products.environment_u(Environment(np.full((8, 16, 3), 3.0, np.float32)), alphas, 16, "cpu")
    # The sums run over up to 65,536 sources in single precision.
    np.testing.assert_allclose(layers / integrals[:, None, None, None], 3.0, rtol=3e-4)
    # The integral of D over the hemisphere, by quadrature.
    for alpha, integral in zip(alphas[1:], integrals[1:], strict=True):
        cosine = POINTS[:, 2]
        d = np.where(cosine > 0.0, ggx.distribution(np.sqrt(0.5 * (1.0 + cosine)), alpha), 0.0)
        assert integral == pytest.approx(d.mean() * 4.0 * np.pi, rel=1e-4)


@pytest.mark.parametrize("alpha", [0.1, 0.4])
def test_u_agrees_with_brute_force(sky: Environment, alpha: float) -> None:
    layer = products.environment_u(sky, np.array([alpha]), 16, "cpu")[0][0]
    directions = octahedral.pixel_directions(16)
    radiance = products.look_up(sky, POINTS)
    for row, column in ((2, 3), (8, 8), (13, 4), (7, 14)):
        cosine = POINTS @ directions[row, column]
        weight = np.maximum(cosine, 0.0) * ggx.distribution(np.sqrt(0.5 * (1.0 + cosine)), alpha)
        truth = (weight[:, None] * radiance).sum(axis=0) / weight.sum() * 4.0 / (1.0 + alpha**2)
        np.testing.assert_allclose(layer[row, column], truth, rtol=0.03)


def test_cube_faces_point_where_gl_says() -> None:
    """The middles of the faces +X -X +Y -Y +Z -Z, and the first texel of +X: up and towards +Z."""
    middles = products.cube_directions(3)[:, 1, 1]
    np.testing.assert_allclose(
        middles, [[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]], atol=1e-12
    )
    corner = products.cube_directions(64)[0, 0, 0]
    assert corner[1] > 0.5 and corner[2] > 0.5


def test_cube_mips(sky: Environment) -> None:
    """Mip 0 is the environment; mip m is its mean under D (n.l) with r = 1 - sqrt(1 - m / maxLod)."""
    mips = products.ggx_prefilter(sky, 32, 4, "cpu")
    assert [level.shape for level in mips] == [(6, 32, 32, 3), (6, 16, 16, 3), (6, 8, 8, 3), (6, 4, 4, 3)]
    np.testing.assert_allclose(mips[0], products.look_up(sky, products.cube_directions(32)), rtol=1e-5)
    radiance = products.look_up(sky, POINTS)
    for mip in (1, 2, 3):
        roughness = 1.0 - np.sqrt(1.0 - mip / 3.0)
        assert 3.0 * roughness * (2.0 - roughness) == pytest.approx(mip)
        directions = products.cube_directions(32 >> mip)
        for face in range(6):
            cosine = POINTS @ directions[face, 1, 2]
            weight = ggx.distribution(np.sqrt(0.5 * (1.0 + cosine)), roughness**2) * np.maximum(cosine, 0.0)
            truth = (weight[:, None] * radiance).sum(axis=0) / weight.sum()
            np.testing.assert_allclose(mips[mip][face, 1, 2], truth, rtol=0.04)


def test_cube_in_a_white_furnace() -> None:
    for level in products.ggx_prefilter(Environment(np.full((8, 16, 3), 0.7, np.float32)), 16, 5, "cpu"):
        np.testing.assert_allclose(level, 0.7, rtol=3e-4)


@pytest.mark.parametrize("rotation", [0.0, 90.0, -35.0])
def test_the_panorama_looks_where_it_says(rotation: float) -> None:
    """Row 0 is +Y, the centre +X and to the right of it +Z: three.js' `equirectUv`, upside down."""
    pixels = np.random.default_rng(5).random((8, 16, 3)).astype(np.float32)
    environment = Environment(pixels, scale=2.0, rotation_deg=rotation)
    theta = np.pi * (np.arange(8)[:, None] + 0.5) / 8
    along = 2.0 * np.pi * ((np.arange(16) + 0.5) / 16 - 0.5)
    directions = np.stack(
        np.broadcast_arrays(np.sin(theta) * np.cos(along), np.cos(theta), np.sin(theta) * np.sin(along)), axis=-1
    )
    expected = products.look_up(environment, directions)
    np.testing.assert_allclose(products.panorama(environment), expected, rtol=1e-5)


def test_irradiance_in_a_white_furnace(
    quad: Callable[..., Mesh], texels: Callable[..., TexelBatch], renderer: Callable[..., TileRenderer]
) -> None:
    """On a plane under a constant environment every texel has irradiance pi: by z-test (1e-5), and within 1 %."""
    scene = only(Environment(np.ones((8, 16, 3), np.float32)), quad)
    result = renderer(scene, samples=1, irradiance_samples=1024).render(texels([(0.1, 0, 0.2)] * 64))
    mean, spread = result.irradiance.mean(), result.irradiance[:, 0].std(ddof=1) / 8.0
    assert abs(mean - np.pi) < 4.4 * spread and abs(mean - np.pi) < 0.01 * np.pi
    assert not result.light_field.any()


def test_irradiance_under_the_sky(
    sky: Environment,
    quad: Callable[..., Mesh],
    texels: Callable[..., TexelBatch],
    renderer: Callable[..., TileRenderer],
) -> None:
    """Against quadrature, for a shading normal that is tilted from the surface's."""
    batch = texels([(0.0, 0.0, 0.0)] * 64)
    shading = np.array([0.4, 0.9, 0.1]) / np.linalg.norm([0.4, 0.9, 0.1])
    tilted = TexelBatch(
        batch.index,
        batch.position,
        batch.normal,
        np.repeat(shading[None], 64, 0).astype(np.float32),
        batch.alpha,
        batch.texel_size,
    )
    got = renderer(only(sky, quad), samples=1, irradiance_samples=1024).render(tilted).irradiance.mean(axis=0)
    weight = np.maximum(POINTS @ shading, 0.0) * (POINTS[:, 1] > 0.0)
    truth = (weight[:, None] * products.look_up(sky, POINTS)).mean(axis=0) * 4.0 * np.pi
    np.testing.assert_allclose(got, truth, rtol=0.01)
