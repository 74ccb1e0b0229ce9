"""The metrics of pictures against slow or independent forms of themselves."""

import numpy as np
import pytest

from kiln_schemas.errors import InputError
from kiln_workers.package import colour
from kiln_workers.shade import image_metrics


def picture(seed: int = 0, height: int = 24, width: int = 32) -> np.ndarray:
    """A smooth HDR picture with a bright spot."""
    random = np.random.default_rng(seed)
    rows, columns = np.indices((height, width)) / 16.0
    waves = 0.5 + 0.4 * np.sin(rows[..., None] * random.uniform(1, 5, 3) + columns[..., None] * random.uniform(1, 5, 3))
    waves[5:9, 12:16] *= 30.0
    return waves.astype(np.float32)


def test_equal_pictures_and_a_growing_error() -> None:
    one, noise = picture(), np.random.default_rng(1).normal(size=(24, 32, 3)).astype(np.float32)
    found = [image_metrics.compare_pictures(one, one + np.float32(size) * noise, 2.0) for size in (0.0, 0.02, 0.1)]
    assert found[0] == image_metrics.ImageMetrics(float("inf"), 1.0, 0.0) and found[0].rounded()["psnr"] is None
    assert found[0].psnr > found[1].psnr > found[2].psnr
    assert found[0].ssim > found[1].ssim > found[2].ssim
    assert 0.0 < found[1].flip < found[2].flip < 0.5


def test_ssim_is_the_sum_over_windows() -> None:
    """Wang et al. 2004 window by window, the pictures continued by reflection."""
    one, other = picture(2, 14, 17), picture(3, 14, 17)
    x, y = (colour.luminance(colour.tone_map(p, 2.0).astype(np.float64)) for p in (one, other))
    axis = np.exp(-0.5 * (np.arange(-5, 6) / 1.5) ** 2)
    weight = np.outer(axis, axis) / axis.sum() ** 2
    x, y = np.pad(x, 5, mode="symmetric"), np.pad(y, 5, mode="symmetric")
    total = 0.0
    for row in range(14):
        for column in range(17):
            a, b = (p[row : row + 11, column : column + 11] for p in (x, y))
            mean_a, mean_b = (weight * a).sum(), (weight * b).sum()
            variances = (weight * (a - mean_a) ** 2).sum() + (weight * (b - mean_b) ** 2).sum()
            covariance = (weight * (a - mean_a) * (b - mean_b)).sum()
            similar = (2 * mean_a * mean_b + 2.55**2) * (2 * covariance + 7.65**2)
            total += similar / ((mean_a**2 + mean_b**2 + 2.55**2) * (variances + 7.65**2))
    assert image_metrics.ssim(one, other, 2.0) == pytest.approx(total / (14 * 17), rel=1e-9)


def test_psnr_of_one_grey_level() -> None:
    one = np.full((8, 8, 3), 0.3, np.float32)
    codes = colour.tone_map(one, 1.0).astype(int)
    other = one.copy()
    while (colour.tone_map(other, 1.0) == codes).all():
        other *= np.float32(1.001)
    assert image_metrics.psnr(one, other, 1.0) == pytest.approx(20.0 * np.log10(255.0), abs=1e-9)


def test_the_noise_floor_is_what_noise_alone_makes() -> None:
    random, truth = np.random.default_rng(4), picture(5, 64, 64)
    halves = [(truth * random.gamma(200.0, 1.0 / 200.0, truth.shape)).astype(np.float32) for _ in range(2)]
    floor = image_metrics.flip_noise_floor((halves[0], halves[1])).mean()
    assert floor > 0.01
    assert floor == pytest.approx(image_metrics.flip(truth, 0.5 * (halves[0] + halves[1])), rel=0.1)


def test_means_by_alpha() -> None:
    alpha = np.array([[0.2, 0.2, np.nan], [0.5, 0.5, 0.9]], np.float32)
    error = np.array([[1.0, 3.0, 100.0], [0.0, 1.0, 7.0]], np.float32)
    assert image_metrics.mean_by_alpha(error, alpha, (0.2, 0.3, 0.5)) == {0.2: 2.0, 0.5: 0.5}


def test_black_references_and_wrong_pictures() -> None:
    black, one = np.zeros((8, 8, 3), np.float32), np.ones((8, 8, 3), np.float32)
    assert image_metrics.flip(black, black) == 0.0 and image_metrics.flip(black, one) == 1.0
    with pytest.raises(InputError, match="cannot be compared"):
        image_metrics.flip(one, one[:4])
    with pytest.raises(InputError, match="not finite"):
        image_metrics.flip(one, one * np.float32(np.nan))
