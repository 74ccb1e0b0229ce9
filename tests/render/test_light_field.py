"""The rendered light field against Mitsuba's own path integrator, and the values that have to be exact."""

from collections.abc import Callable

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from scipy import stats

from kiln_workers.render.mitsuba_scene import to_mitsuba
from kiln_workers.render.tile import TexelBatch, TileRenderer
from kiln_workers.scene.model import Environment, Material, Mesh, Scene
from kiln_workers.sphere import octahedral

FALSE_ALARMS = 1e-4
"""Probability that a correct renderer fails a z-test here: over all groups and channels together."""

SIZE, BATCHES = 16, 24
POINT = (0.37, 0.0, 0.58)
GROUPS = np.add.outer(np.arange(SIZE) // 4 * (SIZE // 4), np.arange(SIZE) // 4)


def reference(scene: Scene, depth: int, seed: int, rays: int) -> np.ndarray:
    """Means [16, 3] over groups of 4 x 4 octahedral pixels, by rays uniform in solid angle from POINT."""
    integrator = mi.load_dict({"type": "path", "max_depth": depth + 1, "rr_depth": 100})
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(seed, rays)
    direction = mi.warp.square_to_uniform_sphere(sampler.next_2d())
    direction.y = dr.abs(direction.y)
    ray = mi.RayDifferential3f(mi.Point3f(POINT[0], 1e-5, POINT[2]), direction)
    world = to_mitsuba(scene)
    radiance = integrator.sample(world, sampler, ray)[0]
    # The environment is left out where it is seen directly.
    values = np.array(dr.select(world.ray_test(ray), radiance, 0.0)).T
    cell = ((octahedral.encode(np.array(direction).T.astype(float)) + 1.0) * 0.5 * SIZE).astype(int).clip(0, SIZE - 1)
    group = GROUPS[cell[:, 1], cell[:, 0]]
    counts = np.bincount(group, minlength=16)[:, None]
    sums = np.stack([np.bincount(group, weights=values[:, c], minlength=16) for c in range(3)], axis=-1)
    return sums / np.maximum(counts, 1)


def ours(renderer: TileRenderer, texels: TexelBatch) -> np.ndarray:
    """The same means, pixels weighted by solid angle; one row of independent estimates a texel."""
    images = renderer.render(texels).light_field.astype(float)
    weights = octahedral.pixel_solid_angles(SIZE)
    totals = [np.bincount(GROUPS.ravel(), weights=weights.ravel(), minlength=16)]
    sums = np.stack(
        [
            [np.bincount(GROUPS.ravel(), weights=(image[..., c] * weights).ravel(), minlength=16) for c in range(3)]
            for image in images
        ]
    )
    return np.moveaxis(sums / totals[0], 1, 2)


@pytest.mark.parametrize("lit_by", ["lamp", "sky"])
def test_agrees_with_mitsuba(
    lit_by: str,
    cornell: Callable[..., Scene],
    texels: Callable[..., TexelBatch],
    renderer: Callable[..., TileRenderer],
    sky: Environment,
) -> None:
    """Welch's t-test of every group and channel; the groups below the horizon are zero."""
    scene = cornell(sky if lit_by == "sky" else None)
    mine = ours(renderer(scene, samples=64, irradiance_samples=1), texels([POINT] * BATCHES))
    truth = np.stack([reference(scene, 6, seed, 40_000) for seed in range(BATCHES)])
    above = np.arange(16) >= 8
    assert np.all(mine[:, ~above] == 0.0)
    a, b = mine[:, above].reshape(BATCHES, -1), truth[:, above].reshape(BATCHES, -1)
    varies = (a.std(axis=0) + b.std(axis=0)) > 1e-9
    assert varies.sum() >= 12
    p = stats.ttest_ind(a[:, varies], b[:, varies], equal_var=False).pvalue
    assert p.min() > FALSE_ALARMS / varies.sum(), np.stack([a.mean(axis=0), b.mean(axis=0)])


def test_the_test_would_notice_one_bounce_less(
    cornell: Callable[..., Scene], texels: Callable[..., TexelBatch], renderer: Callable[..., TileRenderer]
) -> None:
    scene = cornell()
    a = ours(renderer(scene, samples=64, irradiance_samples=1, max_depth=4), texels([POINT] * BATCHES))
    b = ours(renderer(scene, samples=64, irradiance_samples=1, max_depth=3), texels([POINT] * BATCHES))
    p = stats.ttest_ind(a[:, 8:].reshape(BATCHES, -1), b[:, 8:].reshape(BATCHES, -1), equal_var=False).pvalue
    assert np.nanmin(p) < FALSE_ALARMS / p.size


def facing_lamp(quad: Callable[..., Mesh], **material: object) -> Scene:
    """A lamp of 2 x 2 m one metre above the origin, facing down."""
    lamp = Material("lamp", (0.0, 0.0, 0.0, 1.0), **material)  # type: ignore[arg-type]
    return Scene((quad((-1, 1, -1), (2, 0, 0), (0, 0, 2)),), (lamp,))


def test_emission_is_seen_exactly(
    quad: Callable[..., Mesh], texels: Callable[..., TexelBatch], renderer: Callable[..., TileRenderer]
) -> None:
    scene = facing_lamp(quad, emission=(8.0, 4.0, 0.5))
    image = renderer(scene).render(texels([(0.0, 0.0, 0.0)])).light_field[0]
    upwards = octahedral.pixel_directions(16)[..., 1] > 0.85
    np.testing.assert_array_equal(image[upwards], np.broadcast_to([8.0, 4.0, 0.5], image[upwards].shape))
    assert not image[octahedral.pixel_directions(16)[..., 1] < 0.0].any()


def test_irradiance_of_a_lamp(
    quad: Callable[..., Mesh], texels: Callable[..., TexelBatch], renderer: Callable[..., TileRenderer]
) -> None:
    """The form factor of a parallel square seen from its axis (Howell's catalogue, B-3, four times)."""
    scene = facing_lamp(quad, emission=(1.0, 2.0, 4.0))
    side = 1.0 / np.sqrt(2.0)
    wanted = 4.0 * 2.0 / (2.0 * np.pi) * side * np.arctan(side)
    got = renderer(scene, irradiance_samples=65536).render(texels([(0.0, 0.0, 0.0)])).irradiance[0]
    np.testing.assert_allclose(got / [1.0, 2.0, 4.0], np.pi * wanted, rtol=5e-3)


def test_values_beyond_fp16_are_clamped_and_counted(
    quad: Callable[..., Mesh], texels: Callable[..., TexelBatch], renderer: Callable[..., TileRenderer]
) -> None:
    scene = facing_lamp(quad, emission=(1e6, 1.0, 2e6))
    result = renderer(scene, samples=1).render(texels([(0.0, 0.0, 0.0)]))
    clamped = result.light_field[0] == np.float16(65504.0)
    assert result.overflows == clamped.sum() > 0
    assert np.isfinite(result.light_field).all() and not clamped[..., 1].any()


def test_a_mirrored_scene_gives_the_mirrored_field(
    cornell: Callable[..., Scene], texels: Callable[..., TexelBatch], renderer: Callable[..., TileRenderer]
) -> None:
    """Mirror x with the winding turned round: group means agree with the x-mirrored ones by t-test."""
    scene = cornell()
    turned = tuple(
        Mesh(
            m.name,
            (m.positions * np.float32([-1, 1, 1])).astype(np.float32),
            (m.normals * np.float32([-1, 1, 1])).astype(np.float32),
            m.faces[:, ::-1].copy(),
            m.material,
            m.uv,
        )
        for m in scene.meshes
    )
    mirrored = Scene(turned, scene.materials)
    a = ours(renderer(scene, samples=32), texels([POINT] * BATCHES))
    b = ours(renderer(mirrored, key=2, samples=32), texels([(-POINT[0], POINT[1], POINT[2])] * BATCHES))
    b = b.reshape(BATCHES, 4, 4, 3)[:, :, ::-1].reshape(BATCHES, 16, 3)
    p = stats.ttest_ind(a[:, 8:].reshape(BATCHES, -1), b[:, 8:].reshape(BATCHES, -1), equal_var=False).pvalue
    assert np.nanmin(p) > FALSE_ALARMS / p.size
