"""Environments: what is read, what is refused, and that averaging down keeps the light."""

import numpy as np
import pytest

from kiln_schemas.errors import InputError, TooLarge
from kiln_schemas.tasks import EnvironmentRef
from kiln_workers.scene.environment import (
    averaged_down,
    checked_environment,
    load_environment,
    read_environment,
    row_solid_angles,
)
from kiln_workers.scene.images import decode_image
from kiln_workers.scene.sky import clear_sky, equirectangular_directions


def ramp(height: int, width: int) -> np.ndarray:
    y, x = np.mgrid[:height, :width]
    return np.stack([x, y, np.full_like(x, 3.0)], axis=-1).astype(np.float32)


@pytest.mark.parametrize(("name", "tolerance"), [("sky.exr", 1e-3), ("sky.hdr", 0.02)])
def test_hdr_and_exr_keep_rows_columns_and_values(tmp_path, write_image, name, tolerance):
    pixels = ramp(8, 16)
    write_image(tmp_path / name, pixels)
    environment, notes = load_environment(tmp_path, EnvironmentRef(file=name, scale=2.0, rotation_deg=30.0))
    assert (environment.scale, environment.rotation_deg, notes) == (2.0, 30.0, [])
    np.testing.assert_allclose(environment.pixels, pixels, rtol=tolerance, atol=0.07)


def test_the_suffix_does_not_decide(tmp_path, write_image):
    write_image(tmp_path / "sky.exr", ramp(8, 16))
    data = (tmp_path / "sky.exr").read_bytes()
    pixels, _ = read_environment(data, "sky.hdr")
    np.testing.assert_allclose(pixels, ramp(8, 16), rtol=1e-3)


@pytest.mark.parametrize("suffix", ["png", "jpg"])
def test_a_low_dynamic_range_picture_is_refused_even_if_renamed(tmp_path, write_image, suffix):
    path = write_image(tmp_path / f"sky.{suffix}", np.full((8, 16, 3), 200, np.uint8))
    path.rename(tmp_path / "sky.hdr")
    with pytest.raises(InputError, match=f"sky.hdr: is {suffix.upper()}, not Radiance HDR or OpenEXR"):
        load_environment(tmp_path, EnvironmentRef(file="sky.hdr"))


@pytest.mark.parametrize(
    ("shape", "place", "value", "says"),
    [
        ((8, 16, 3), (2, 5, 1), np.nan, "row 2, column 5 is not finite"),
        ((8, 16, 3), (0, 0, 0), np.inf, "not finite"),
        ((8, 16, 3), (7, 1, 2), -1.0, "is negative"),
        ((8, 8, 3), (0, 0, 0), 1.0, "8 x 8 pixels"),
    ],
)
def test_values_and_aspect_are_checked(tmp_path, write_image, shape, place, value, says):
    pixels = np.ones(shape, np.float32)
    pixels[place] = value
    write_image(tmp_path / "sky.exr", pixels)
    with pytest.raises(InputError, match=says):
        load_environment(tmp_path, EnvironmentRef(file="sky.exr"))


def test_damaged_and_foreign_files_are_refused(tmp_path, write_image):
    path = write_image(tmp_path / "sky.exr", ramp(64, 128))
    for data in (path.read_bytes()[:200], b"#?RADIANCE\n", b"MZ", b""):
        with pytest.raises(InputError):
            read_environment(data, "sky.exr")


def test_images_beyond_the_bound_are_refused(tmp_path, write_image):
    path = write_image(tmp_path / "wide.png", np.zeros((1, 16385, 3), np.uint8))
    with pytest.raises(TooLarge, match="16385 x 1"):
        decode_image(path.read_bytes(), "wide.png")


@pytest.mark.parametrize("width", [66, 130, 256])
def test_averaging_down_keeps_the_light(width):
    rng = np.random.default_rng(1)
    pixels = rng.gamma(0.3, 1.0, (width // 2, width, 3)).astype(np.float32)
    small = averaged_down(pixels, 64)
    assert small.shape == (32, 64, 3)
    flux = [np.einsum("hwc,h->c", p, row_solid_angles(len(p))) / p.shape[1] for p in (pixels, small)]
    np.testing.assert_allclose(flux[1], flux[0], rtol=1e-5)
    assert small[0, :, 0].std() > 0.0
    if width == 256:  # a whole factor: each pixel is the weighted mean of its block
        weight = row_solid_angles(128)[:4, None, None]
        block = (pixels[:4, :4] * weight).sum(axis=(0, 1)) / (4 * weight.sum())
        np.testing.assert_allclose(small[0, 0], block, rtol=1e-5)


def test_only_images_beyond_the_bound_are_averaged_down(monkeypatch):
    monkeypatch.setattr("kiln_workers.scene.environment.MAX_WIDTH", 64)
    for width, notes in ((64, 0), (128, 1)):
        pixels, said = checked_environment(np.ones((width // 2, width, 3), np.float32), "sky.exr")
        assert pixels.shape == (32, 64, 3) and len(said) == notes


def test_the_sky_has_the_irradiance_that_was_asked_for():
    sun = np.array([0.6, 0.64, 0.48])
    cosine = np.maximum(equirectangular_directions(512)[..., 1], 0.0)
    weight = row_solid_angles(256)[:, None] / 512 * cosine
    with_sun, without = (clear_sky(512, sun, 2.5, 1.5, ratio) for ratio in (4.0, 0.0))
    above = equirectangular_directions(512)[..., 1] > 0.0
    irradiance = [float((sky.mean(axis=2) * weight * above).sum()) for sky in (without, with_sun)]
    np.testing.assert_allclose(irradiance, [1.5, 7.5], rtol=1e-5)
    brightest = np.unravel_index(with_sun.sum(axis=2).argmax(), (256, 512))
    assert equirectangular_directions(512)[brightest] @ sun > np.cos(np.deg2rad(1.0))
    zenith, horizon = without[2].mean(axis=0), without[124].mean(axis=0)
    assert zenith[2] / zenith[0] > horizon[2] / horizon[0] > 0.5  # blue above, whiter at the horizon
