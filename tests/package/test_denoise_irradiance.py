"""The irradiance map's denoiser: against a slow twin, against converged maps, and what it must leave alone."""

import itertools
from collections.abc import Callable
from functools import cache

import numpy as np
import pytest

from kiln_schemas.settings import make_settings
from kiln_workers.package import denoise
from kiln_workers.render.tile import TexelBatch, TileRenderer
from kiln_workers.scene import bands
from kiln_workers.scene.model import Environment, Material, Scene
from kiln_workers.scene.shapes import Cell, patch, quad, sphere
from kiln_workers.scene.texel_map import TexelMap, TexelState
from kiln_workers.scene.texels import build_texel_map

Values = np.ndarray


def flat(chart: np.ndarray) -> TexelMap:
    """A map whose charts [H, W] lie in planes; -1 is gutter."""
    shape = chart.shape
    normal = np.zeros((*shape, 3), np.float32)
    normal[..., 1] = 1.0
    return TexelMap(
        state=np.where(chart >= 0, TexelState.VALID, TexelState.GUTTER).astype(np.uint8),
        position=np.zeros((*shape, 3), np.float32),
        normal=normal,
        shading_normal=normal.copy(),
        alpha=np.ones(shape, np.float32),
        texel_size=np.ones(shape, np.float32),
        mesh=np.zeros(shape, np.int32),
        chart=chart.astype(np.int32),
    )


def denoised(values: Values, texels: TexelMap) -> Values:
    out = values.copy()
    denoise.denoise(out, texels)
    return out


def two_charts(size: int = 24) -> np.ndarray:
    """Side by side without a gutter, and an island of gutter in one of them."""
    chart = np.zeros((size, size), np.int32)
    chart[:, size // 2 :] = 1
    chart[5:8, 3:5] = -1
    return chart


def noisy(truth: Values, part: float, seed: int = 0) -> Values:
    noise = np.random.default_rng(seed).normal(0.0, part, truth.shape)
    return np.maximum(truth * (1.0 + noise), 0.0).astype(np.float32)


def twin(values: Values, texels: TexelMap) -> Callable[[tuple[int, int]], Values]:
    """What becomes of one texel [3], in float64, straight from the module's text."""
    known = texels.state == TexelState.VALID
    height, width = known.shape

    def same(a: tuple[int, int], b: tuple[int, int]) -> bool:
        inside = all(0 <= row < height and 0 <= column < width for row, column in (a, b))
        return inside and bool(known[a] and known[b]) and texels.chart[a] == texels.chart[b]

    def around(radius: int) -> list[tuple[int, int]]:
        return list(itertools.product(range(-radius, radius + 1), repeat=2))

    def plus(a: tuple[int, int], b: tuple[int, int]) -> tuple[int, int]:
        return a[0] + b[0], a[1] + b[1]

    exact = values.astype(np.float64)

    @cache
    def noise(where: tuple[int, int]) -> Values:
        logs = []
        for step in around(denoise.NOISE_RADIUS):
            here = plus(where, step)
            if not same(where, here):
                continue
            for way in ((0, 1), (1, 0), (1, 1), (1, -1)):
                ends = plus(here, way), plus(here, (-way[0], -way[1]))
                if all(same(here, end) for end in ends):
                    bend = exact[here] - 0.5 * (exact[ends[0]] + exact[ends[1]])
                    logs.append(np.log(bend**2 / 1.5 + (denoise.FAINT * exact[here]) ** 2 + denoise.TINY))
        # The mean of log chi-squared with one degree of freedom is -gamma - log 2.
        return np.exp(np.mean(logs, axis=0) + np.euler_gamma + np.log(2.0)) if logs else np.zeros(3)

    def filtered(at: tuple[int, int]) -> Values:
        rows, right, weights = [], [], []
        for step in around(denoise.RADIUS):
            there = plus(at, step)
            if not same(at, there):
                continue
            distances = []
            for inside in around(denoise.PATCH):
                a, b = plus(at, inside), plus(there, inside)
                if same(at, a) and same(there, b):
                    one, other = noise(a), noise(b)
                    excess = (exact[a] - exact[b]) ** 2 - one - np.minimum(one, other)
                    distances.append(excess / (denoise.STRICTNESS**2 * (one + other) + denoise.TINY))
            turn = max(1.0 - float(texels.shading_normal[at] @ texels.shading_normal[there]), 0.0)
            weight = np.exp(-max(float(np.mean(distances)), 0.0) - turn / denoise.CREASE) if step != (0, 0) else 1.0
            rows.append([1.0, step[1] / denoise.RADIUS, step[0] / denoise.RADIUS])
            right.append(exact[there])
            weights.append(weight)
        ridge = np.sqrt(denoise.RIDGE * sum(weights)) * np.eye(3)[1:]
        system = np.concatenate([np.sqrt(weights)[:, None] * rows, ridge])
        target = np.concatenate([np.sqrt(weights)[:, None] * right, np.zeros((2, 3))])
        return np.maximum(np.linalg.lstsq(system, target, rcond=None)[0][0], 0.0)

    return filtered


def test_each_texel_is_its_slow_twins() -> None:
    texels = flat(two_charts())
    texels.shading_normal[12:] = (0.0, 0.6, 0.8)
    truth = 1.0 + np.indices((24, 24)).sum(axis=0)[..., None] * np.array([0.01, 0.05, 0.0])
    truth[:, 6:] *= 2.0
    values = noisy(truth, 0.1)
    values[:4, :4] = 0.0
    found, expected = denoised(values, texels), twin(values, texels)
    for at in ((0, 0), (3, 4), (6, 2), (8, 4), (11, 5), (12, 11), (12, 12), (13, 20), (23, 23), (20, 6)):
        np.testing.assert_allclose(found[at], expected(at), rtol=2e-4, err_msg=str(at))


def test_bands_change_no_byte(monkeypatch: pytest.MonkeyPatch) -> None:
    texels, values = flat(two_charts(40)), noisy(np.ones((40, 40, 3)), 0.2)
    whole = denoised(values, texels)
    for rows in (1, 7):
        monkeypatch.setattr(bands, "BAND_TEXELS", 40 * rows)
        np.testing.assert_array_equal(denoised(values, texels), whole)


def test_a_chart_hears_nothing_of_another_one_or_of_what_lies_between() -> None:
    texels = flat(two_charts())
    values = noisy(np.ones((24, 24, 3)), 0.2)
    other = values.copy()
    other[texels.chart != 0] *= 1000.0
    before, after = denoised(values, texels), denoised(other, texels)
    np.testing.assert_array_equal(before[texels.chart == 0], after[texels.chart == 0])
    assert (before[texels.chart == 0] != values[texels.chart == 0]).any()
    np.testing.assert_array_equal(after[texels.chart == -1], other[texels.chart == -1])


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
def test_noise_goes_and_an_even_gradient_stays(scale: float) -> None:
    texels = flat(np.zeros((32, 32), np.int32))
    gradient = (scale * (1.0 + 0.1 * np.indices((32, 32))[1])[..., None] * np.ones(3)).astype(np.float32)
    np.testing.assert_allclose(denoised(gradient, texels), gradient, rtol=3e-3)
    values = noisy(gradient, 0.1)
    before, after = (np.sqrt(np.mean((each / gradient - 1.0) ** 2)) for each in (values, denoised(values, texels)))
    assert after < 0.5 * before
    assert denoised(values, texels).mean() == pytest.approx(values.mean(), rel=0.01)


def test_a_shadows_edge_stays() -> None:
    """A step to a third: the texels beside it keep their light within 4 %, at noise of 10 %."""
    texels = flat(np.zeros((32, 32), np.int32))
    truth = np.ones((32, 32, 3))
    truth[:, 16:] = 0.33
    for seed in range(4):
        found = denoised(noisy(truth, 0.1, seed), texels)
        assert found[:, 15].mean() == pytest.approx(1.0, rel=0.04)
        assert found[:, 16].mean() == pytest.approx(0.33, rel=0.04)


def ball_over_a_floor() -> Scene:
    """A ball that floats 5 cm over a floor under a small sun and a sky: a contact shadow and a penumbra."""
    sky = np.ones((32, 64, 3), np.float32)
    sky[6:8, 10:12] = 150.0
    floor = quad(np.array([-2.0, 0.0, 2.0]), np.array([4.0, 0.0, 0.0]), np.array([0.0, 0.0, -4.0]))
    return Scene(
        (
            patch("floor", floor, (1, 1), Cell(0, 0, 20, 20), 0),
            patch("ball", sphere(np.array([0.0, 0.75, 0.0]), 0.7), (24, 24), Cell(21, 0, 10, 10), 0),
        ),
        (Material("grey", (0.5, 0.5, 0.5)),),
        environment=Environment(sky),
    )


@pytest.fixture(scope="module")
def traced() -> tuple[TexelMap, Callable[[int], Values]]:
    scene = ball_over_a_floor()
    texels = build_texel_map(scene, 64, "cpu")
    place = np.nonzero(texels.state == TexelState.VALID)

    def irradiance(samples: int) -> Values:
        settings = make_settings("draft", [f"render.irradiance_samples={samples}"]).render
        renderer = TileRenderer(scene, f"{samples:064x}", settings, 1 << 28, "cpu")
        out = np.zeros((*texels.state.shape, 3), np.float32)
        out[place] = renderer.render_irradiance(TexelBatch.of(texels, place))[0]
        return out

    return texels, irradiance


def test_errors_against_a_converged_map_fall_at_every_number_of_paths(
    traced: tuple[TexelMap, Callable[[int], Values]],
) -> None:
    """Over all texels, and over the tenth of them where light turns fastest."""
    texels, irradiance = traced
    truth = irradiance(4096)
    valid = texels.state == TexelState.VALID
    beside = valid[:, 1:] & valid[:, :-1] & (np.diff(texels.chart, axis=1) == 0)
    turns = np.zeros(valid.shape)
    turns[:, 1:] = np.where(beside, np.abs(np.diff(truth, axis=1)).sum(axis=2), 0.0)
    steep = valid & (turns > np.quantile(turns[valid], 0.9))
    rms = {}
    for samples in (16, 64, 256):
        values = irradiance(samples)
        for name, each in (("before", values), ("after", denoised(values, texels))):
            for part, where in (("all", valid), ("steep", steep)):
                rms[samples, name, part] = float(np.sqrt(np.mean((each - truth)[where] ** 2)))
        assert rms[samples, "after", "all"] < 0.8 * rms[samples, "before", "all"], rms
        assert rms[samples, "after", "steep"] < rms[samples, "before", "steep"], rms
    bias = np.sqrt(np.mean((denoised(truth, texels) - truth)[valid] ** 2))
    assert bias < 0.5 * rms[256, "before", "all"]
