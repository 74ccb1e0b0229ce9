"""Colours of a texture are those that its file stores, whatever its alpha is (glTF 2.0, 3.9.2 and 3.9.4)."""

import struct

import numpy as np
import OpenImageIO as oiio
import pytest

from kiln_workers.scene.images import decode_image


def encoded(path, pixels):
    """`pixels` [H, W, C] in the format of the suffix, written as they are."""
    height, width, channels = pixels.shape
    spec = oiio.ImageSpec(width, height, channels, oiio.UINT8 if pixels.dtype == np.uint8 else oiio.UINT16)
    spec.attribute("oiio:UnassociatedAlpha", 1)
    spec.attribute("compression", "lossless:100")
    spec.attribute("oiio:ColorSpace", "sRGB")
    out = oiio.ImageOutput.create(str(path))
    assert out.open(str(path), spec) and out.write_image(pixels), out.geterror()
    out.close()
    return path.read_bytes()


@pytest.mark.parametrize("suffix,channels", [("png", 4), ("png", 2), ("webp", 4)])
@pytest.mark.parametrize("alpha", [0, 1, 128, 255])
def test_eight_bits_are_kept(tmp_path, suffix, channels, alpha):
    pixels = np.full((8, 8, channels), 188, np.uint8)
    pixels[..., -1] = alpha
    decoded = decode_image(encoded(tmp_path / f"a.{suffix}", pixels), "image").pixels
    if suffix == "webp" and alpha == 0:  # WebP's encoder forgets colours that nobody sees
        pixels[..., :3] = 0
    # An opaque WebP has no alpha.
    np.testing.assert_array_equal(decoded, pixels[..., : decoded.shape[2]])


@pytest.mark.parametrize("alpha", [0, 20000, 65535])
def test_sixteen_bits_are_kept(tmp_path, alpha):
    pixels = np.full((4, 4, 4), 40000, np.uint16)
    pixels[..., 3] = alpha
    decoded = decode_image(encoded(tmp_path / "a.png", pixels), "image").pixels
    np.testing.assert_allclose(decoded, pixels / 65535, atol=1e-6)


@pytest.mark.parametrize("name", ["emissive0.glb", "emissive128.glb", "emissiveNone.glb"])
def test_a_panel_glows_as_bright_whatever_the_alpha_of_its_texture(irradiance_in, name):
    """A panel of 1 m^2, radiance 10 x 0.503, 2 m above the point: 1.161 by quadrature."""
    np.testing.assert_allclose(irradiance_in(name, [[0, 0, 0]]), 1.161, rtol=0.01)


@pytest.mark.parametrize("name", ["base0.glb", "baseNone.glb"])
def test_a_floor_reflects_as_much_whatever_the_alpha_of_its_texture(irradiance_in, name):
    """On the ceiling 0.262, by plain Mitsuba with Lambert's floor; glTF's floor reflects less at grazing angles."""
    np.testing.assert_allclose(irradiance_in(name, [[1.2, 2.2, 0]], normal=(0, -1, 0)), 0.262, rtol=0.05)


@pytest.mark.parametrize("alpha", [0, 128, 255])
def test_tga_is_read_as_it_is_stored(alpha):
    """Written by hand: 32 bits, blue first, the bottom row first."""
    pixels = np.arange(2 * 3 * 4, dtype=np.uint8).reshape(2, 3, 4)
    pixels[..., 3] = alpha
    head = struct.pack("<BBBHHBHHHHBB", 0, 0, 2, 0, 0, 0, 0, 0, 3, 2, 32, 8)
    found = decode_image(head + pixels[::-1, :, [2, 1, 0, 3]].tobytes(), "image")
    assert found.format == "tga"
    np.testing.assert_array_equal(found.pixels, pixels)


def test_compressed_tga_and_bmp_are_read():
    """A run of three pixels and two by themselves; 24 bits, rows of BMP padded to four bytes."""
    colours = np.array([[[9, 8, 7], [9, 8, 7], [9, 8, 7]], [[1, 2, 3], [4, 5, 6], [9, 8, 7]]], np.uint8)
    head = struct.pack("<BBBHHBHHHHBB", 0, 0, 10, 0, 0, 0, 0, 0, 3, 2, 24, 32)  # the top row first
    packed = bytes([0x82, 7, 8, 9]) + bytes([0x02, 3, 2, 1, 6, 5, 4, 7, 8, 9])
    np.testing.assert_array_equal(decode_image(head + packed, "image").pixels, colours)
    rows = b"".join(row[:, ::-1].tobytes() + bytes(3) for row in colours[::-1])
    bmp = (
        b"BM" + struct.pack("<IIIIiiHHIIiiII", 54 + len(rows), 0, 54, 40, 3, 2, 1, 24, 0, len(rows), 0, 0, 0, 0) + rows
    )
    found = decode_image(bmp, "image")
    assert found.format == "bmp"
    np.testing.assert_array_equal(found.pixels, colours)
