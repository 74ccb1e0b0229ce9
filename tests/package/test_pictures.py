"""EXR and PNG against OpenImageIO's readers, colour functions against their definitions, and atomic files."""

import hashlib
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest

from kiln_schemas.errors import InternalError, MachineLacks
from kiln_workers.package import colour, exr, files, png


def test_exr_holds_the_floats_and_says_which_colours(tmp_path: Path) -> None:
    pixels = np.random.default_rng(0).lognormal(sigma=4.0, size=(9, 13, 3)).astype(np.float32)
    exr.write_rgb(tmp_path / "i.exr", pixels, comments="W/m^2")
    picture = oiio.ImageBuf(str(tmp_path / "i.exr"))
    np.testing.assert_array_equal(picture.get_pixels(oiio.FLOAT), pixels)
    chromaticities = picture.spec().getattribute("chromaticities")
    np.testing.assert_allclose(chromaticities, (0.64, 0.33, 0.30, 0.60, 0.15, 0.06, 0.3127, 0.3290), atol=1e-6)
    assert picture.spec().get_string_attribute("ImageDescription") == "W/m^2"


def test_exr_refuses_what_is_not_finite(tmp_path: Path) -> None:
    with pytest.raises(InternalError, match="not finite"):
        exr.write_rgb(tmp_path / "i.exr", np.full((2, 2, 3), np.nan, np.float32))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("channels", [1, 2, 3, 4])
def test_png_reads_back(channels: int, read_png) -> None:
    pixels = np.random.default_rng(channels).integers(0, 256, (7, 11, channels), dtype=np.uint8)
    np.testing.assert_array_equal(read_png(png.encode(pixels)), pixels)


def test_srgb_encode_and_decode_are_inverse() -> None:
    codes = np.arange(256) / 255.0
    np.testing.assert_array_equal(colour.quantise(colour.srgb_encode(colour.srgb_decode(codes))), np.arange(256))
    assert colour.srgb_decode(np.array(0.5)) == pytest.approx(0.2140, abs=1e-4)


def test_tone_map_is_monotone_and_white_is_white() -> None:
    grays = np.linspace(0.0, 3.0, 50)[:, None].repeat(3, axis=1)
    codes = colour.tone_map(grays, white=3.0)
    assert (np.diff(codes[:, 0].astype(int)) >= 0).all()
    assert codes[0].tolist() == [0, 0, 0]
    assert codes[-1].tolist() == [255, 255, 255]


def test_viridis_lightness_rises_evenly() -> None:
    linear = colour.srgb_decode(colour.viridis(np.linspace(0.0, 1.0, 64)) / 255.0)
    lightness = np.cbrt(colour.luminance(linear))  # CIE L* is affine in this above a small threshold
    steps = np.diff(lightness)
    assert steps.min() > 0.0
    assert steps.max() < 2.0 * steps.mean()


def test_files_are_whole_or_absent(tmp_path: Path) -> None:
    path = tmp_path / "sub" / "f.ktx2"
    files.write_bytes(path, b"one")
    files.write_bytes(path, b"two!")
    assert path.read_bytes() == b"two!"
    assert [entry.name for entry in path.parent.iterdir()] == ["f.ktx2"]
    described = files.artifact(tmp_path, "sub/f.ktx2")
    assert (described.size, described.media_type) == (4, "image/ktx2")
    assert described.sha256 == hashlib.sha256(b"two!").hexdigest()


def test_a_place_that_cannot_be_written_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(MachineLacks, match=r"file/x\.ktx2: cannot be written"):
        files.write_bytes(tmp_path / "file" / "x.ktx2", b"abc")


def test_a_full_disk_leaves_nothing_behind(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    files.write_bytes(tmp_path / "old", b"old")

    def full(_: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(files.os, "fsync", full)
    with pytest.raises(MachineLacks, match="No space left on device"):
        files.write_bytes(tmp_path / "old", b"newer")
    assert [entry.name for entry in tmp_path.iterdir()] == ["old"]
    assert (tmp_path / "old").read_bytes() == b"old"
