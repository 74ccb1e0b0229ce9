"""Paths go where an image's noise is: how they are shared out, no bias by it, less error at the same number."""

from collections.abc import Callable

import drjit as dr
import numpy as np
import pytest

from kiln_schemas.conventions import EXPOSURE_KEY
from kiln_workers.render import adaptive, jit
from kiln_workers.render.tile import TexelBatch, TileRenderer
from kiln_workers.scene.model import Material, Scene
from kiln_workers.sphere import octahedral

SIZE = 16
SAMPLES = 16


def images(seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Means, variances and which pixels are above the horizon, of three images."""
    random = np.random.default_rng(seed)
    above = np.zeros((3, SIZE, SIZE), bool)
    above[:, 3:, 2:12] = True
    mean, variance = random.exponential(size=(2, 3, SIZE, SIZE)) * above
    return mean, variance, above


def slow_shares(mean: np.ndarray, variance: np.ndarray, above: np.ndarray) -> np.ndarray:
    """Each pixel's share [R, R] of one image's paths, pixel by pixel, before any bound."""
    neighbours = {place: around for place, around in neighbours_of(SIZE).items() if above[place]}
    exposure = EXPOSURE_KEY / mean[above].mean()
    spread = np.zeros((SIZE, SIZE))
    for place, around in neighbours.items():
        seen = [other for other in around if above[other]]
        deviation = np.sqrt(np.mean([variance[other] for other in seen]))
        spread[place] = exposure * deviation / (1.0 + exposure * np.mean([mean[other] for other in seen]))
    return spread / spread.sum()


def neighbours_of(size: int) -> dict[tuple[int, int], list[tuple[int, int]]]:
    """The eight pixels around each, found by stepping over the square's edge on the sphere."""
    step = 2.0 / size
    out = {}
    for row, column in np.ndindex(size, size):
        centre = octahedral.pixel_grid(size)[row, column]
        around = []
        for down, right in [(a, b) for a in (-1, 0, 1) for b in (-1, 0, 1) if (a, b) != (0, 0)]:
            x, y = centre + np.array([right * step, down * step])
            if abs(x) > 1.0:
                x, y = np.sign(x) * 2.0 - x, -y
            if abs(y) > 1.0:
                x, y = -x, np.sign(y) * 2.0 - y
            place = np.floor((np.array([y, x]) + 1.0) / step).astype(int)
            around.append((int(place[0]), int(place[1])))
        out[row, column] = around
    return out


def test_neighbours_beyond_an_edge_are_near_on_the_sphere() -> None:
    directions = octahedral.pixel_directions(SIZE)
    ring = np.stack([octahedral.padded(directions[..., axis]) for axis in range(3)], axis=-1)
    for inner, outer in (
        (ring[1], ring[0]),
        (ring[-2], ring[-1]),
        (ring[:, 1], ring[:, 0]),
        (ring[:, -2], ring[:, -1]),
    ):
        angle = np.arccos(np.clip((inner * outer).sum(-1), -1.0, 1.0))
        assert angle.max() < 2.5 * np.sqrt(4.0 * np.pi) / SIZE
    assert np.array_equal(ring[1:-1, 1:-1], directions)


def test_shares_are_those_of_a_slow_computation() -> None:
    mean, variance, above = images(1)
    samples = 1000  # so many that rounding to whole paths is nothing
    more = adaptive.more_samples(mean, variance, above, samples)
    for image in range(3):
        expected = slow_shares(mean[image], variance[image], above[image]) * (samples // 2) * above[image].sum()
        assert expected.max() < adaptive.MOST_TIMES * samples / 2
        np.testing.assert_allclose(more[image], expected, atol=1.0)


def test_the_budget_is_kept_and_no_pixel_gets_more_than_its_bound(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(adaptive, "MOST_TIMES", 4)
    mean, variance, above = images(2)
    variance[0, 8, 6], variance[1] = 1e9, 0.0
    more = adaptive.more_samples(mean, variance, above, SAMPLES)
    most = 4 * SAMPLES - adaptive.even_samples(SAMPLES)
    budget = above.sum(axis=(1, 2)) * (SAMPLES - adaptive.even_samples(SAMPLES))
    assert (more >= 0).all() and more.max() == most and not more[~above].any()
    assert (more.sum(axis=(1, 2)) <= budget).all()
    assert more[2].sum() > 0.9 * budget[2] and not more[1].any(), "what is not noisy gets no more"


def test_a_pixel_has_no_say_in_its_own_number() -> None:
    mean, variance, above = images(3)
    variance[:] = 0.0
    variance[0, 8, 6] = 1.0
    more = adaptive.more_samples(mean, variance, above, SAMPLES)[0]
    assert more[8, 6] == 0 and (more[7:10, 5:8].sum() == more.sum() > 0)


def test_few_paths_are_spread_evenly() -> None:
    assert [adaptive.even_samples(samples) for samples in (1, 4, 7, 8, 16)] == [1, 4, 7, 4, 8]


@pytest.fixture
def grazed(quad: Callable) -> Scene:
    """A shiny wall that texels beside it graze, and a lamp that it shows them: a few very noisy pixels side by side."""
    materials = (
        Material("white", (0.7, 0.7, 0.7, 1.0)),
        Material("shiny", (0.1, 0.1, 0.1, 1.0), roughness=0.4),
        Material("lamp", (0.0, 0.0, 0.0, 1.0), emission=(400.0, 400.0, 400.0)),
    )
    meshes = (
        quad((-2, 0, -2), (0, 0, 4), (4, 0, 0), 0),
        quad((-2, 0, -0.5), (4, 0, 0), (0, 2, 0), 1),
        quad((1.6, 0.6, -0.3), (0, 0, 0.1), (0, 0.1, 0), 2),
    )
    return Scene(meshes, materials)


def test_the_mean_stays_and_the_error_falls(
    grazed: Scene,
    texels: Callable[..., TexelBatch],
    renderer: Callable[..., TileRenderer],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    batch = texels([(0.1 * k - 0.5, 0.3, -0.4) for k in range(4)])
    truth = renderer(grazed, key=99, samples=8192).render_light_fields(batch).light_field.astype(np.float64)
    assert truth.max() > 20.0 * truth[truth > 0.0].mean(), "a few pixels are far brighter than the others"

    def many(keys: range) -> np.ndarray:
        return np.array(
            [renderer(grazed, key=key, samples=SAMPLES).render_light_fields(batch).light_field for key in keys]
        ).astype(np.float64)

    found = many(range(24))
    monkeypatch.setattr(adaptive, "even_samples", lambda samples: samples)
    even = many(range(24, 48))
    for each in (found, even):
        totals = each.sum(axis=(1, 2, 3, 4))
        assert abs(totals.mean() - truth.sum()) < 4.0 * totals.std(ddof=1) / np.sqrt(len(totals))

    def error(each: np.ndarray) -> float:
        exposure = EXPOSURE_KEY / truth.mean()
        return float(((np.log1p(exposure * each) - np.log1p(exposure * truth)) ** 2).mean())

    assert error(found) < 0.7 * error(even)


def test_no_kernel_is_compiled_for_the_size_of_a_wavefront(
    cornell: Callable[..., Scene], texels: Callable[..., TexelBatch], renderer: Callable[..., TileRenderer]
) -> None:
    tracing = renderer(cornell(), irradiance_samples=32)
    points = [(0.1 + 0.1 * k, 0.0, 0.5) for k in range(7)]
    tracing.render(texels(points[:1]))
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        for count in (2, 3, 7):
            tracing.render(texels(points[:count]))
        history = dr.kernel_history()
    compiled = [kernel["size"] for kernel in history if not kernel.get("cache_hit", True)]
    assert history and not compiled


def test_arrays_for_kernels_are_aligned() -> None:
    values = np.arange(100, dtype=np.float32)
    for first in range(9):
        column = jit.column(jit.mi.Float, values[first:])
        assert np.array_equal(np.array(column), values[first:])
        assert np.asarray(column).ctypes.data % jit.ALIGNMENT == 0
    vectors = jit.columns(jit.mi.Vector3f, np.arange(15).reshape(5, 3))
    np.testing.assert_array_equal(jit.to_numpy(vectors), np.arange(15).reshape(5, 3))
