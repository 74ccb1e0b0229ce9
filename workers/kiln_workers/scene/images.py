"""Decoding of images from bytes: PNG, JPEG, WebP, BMP, TGA, OpenEXR and Radiance HDR with OpenImageIO, KTX2 (`basis`).

The format is told by the first bytes, not by the file's name, and only these formats are ever given to a decoder.
OpenImageIO's Python module opens files only, so the bytes pass through a temporary file whose suffix fits the format.
Row 0 is the top of the picture. Colours are as the file stores them: OpenImageIO would multiply them by alpha, and
glTF's alpha (3.9.4) does not darken a colour.
"""

import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import OpenImageIO as oiio

from kiln_schemas.errors import InputError
from kiln_workers.scene.basis import decode_ktx2
from kiln_workers.scene.limits import MAX_IMAGE_BYTES, MAX_PIXELS, MAX_SIDE, check_count
from kiln_workers.scene.model import Float32, Image

SIGNATURES: Final[Mapping[str, bytes]] = {
    "png": b"\x89PNG\r\n\x1a\n",
    "jpg": b"\xff\xd8\xff",
    "exr": b"\x76\x2f\x31\x01",
    "hdr": b"#?",
    "webp": b"RIFF",
    "bmp": b"BM",
    "ktx2": b"\xabKTX 20\xbb\r\n\x1a\n",
}
HDR_FORMATS: Final = frozenset({"exr", "hdr"})
LOW_RANGE: Final = frozenset({"png", "jpg", "webp", "bmp", "tga", "ktx2"})
"""Formats whose colours are encoded as sRGB says."""
DECODERS: Final[Mapping[str, str]] = {name: name for name in ("png", "webp", "bmp", "hdr")} | {
    "jpg": "jpeg",
    "tga": "targa",
    "exr": "openexr",
}
"""OpenImageIO's names of the formats."""
TGA_KINDS: Final = frozenset({1, 2, 3, 9, 10, 11})
"""With a palette, of colours, grey; and these compressed."""

# What a decoder refuses is not offered to the fifty others.
oiio.attribute("try_all_readers", 0)


@dataclass(frozen=True)
class Decoded:
    """An image and the format that it came in (a key of SIGNATURES)."""

    pixels: npt.NDArray[np.uint8] | npt.NDArray[np.float32]  # [H, W, C]; 8 bits as they are, all else as float
    format: str


def image_format(data: bytes) -> str | None:
    """The format that the first bytes tell, None for any other."""
    kind = next((name for name, magic in SIGNATURES.items() if data.startswith(magic)), None)
    if kind is None and _is_tga(data):
        return "tga"
    return None if kind == "webp" and data[8:12] != b"WEBP" else kind


def _is_tga(data: bytes) -> bool:
    """Whether the first 18 bytes are a header of TGA, which has no signature (Truevision, 1989)."""
    if len(data) < 18 or data[1] > 1 or data[2] not in TGA_KINDS or data[16] not in (8, 15, 16, 24, 32):
        return False
    width, height = int.from_bytes(data[12:14], "little"), int.from_bytes(data[14:16], "little")
    return data[17] < 64 and width > 0 and height > 0


def decode_image(data: bytes, where: str, most_bytes: int = MAX_IMAGE_BYTES) -> Decoded:
    """Decode an image; InputError names `where` if it is of another format, damaged, or too large."""
    kind = image_format(data)
    if kind is None:
        raise InputError(
            "is neither PNG, JPEG, WebP, BMP, TGA, KTX2, OpenEXR nor Radiance HDR",
            where=where,
            remedy="Convert it to one of these.",
        )
    if kind == "ktx2":
        return Decoded(decode_ktx2(data, where, most_bytes), kind)
    with tempfile.TemporaryDirectory(prefix="kiln-image-") as folder:
        path = Path(folder) / f"image.{kind}"
        path.write_bytes(data)
        return Decoded(_read(path, kind, where, most_bytes), kind)


def _read(path: Path, kind: str, where: str, most_bytes: int) -> npt.NDArray[np.uint8] | npt.NDArray[np.float32]:
    unmultiplied = oiio.ImageSpec()
    unmultiplied.attribute("oiio:UnassociatedAlpha", 1)
    source = oiio.ImageInput.open(str(path), unmultiplied)
    if source is None or source.format_name() != DECODERS[kind]:
        raise InputError(f"cannot be decoded as {kind}: {oiio.geterror()}", where=where, remedy="Save it again.")
    try:
        spec = source.spec()
        size = f"({spec.width} x {spec.height})"
        check_count(max(spec.width, spec.height), MAX_SIDE, f"pixels along a side {size}", where, "Make it smaller.")
        check_count(spec.width * spec.height, MAX_PIXELS, f"pixels {size}", where, "Make it smaller.")
        if spec.depth > 1:
            raise InputError(f"is a volume of {spec.depth} layers", where=where, remedy="Save one layer.")
        if (spec.width, spec.height, spec.x, spec.y) != (spec.full_width, spec.full_height, spec.full_x, spec.full_y):
            raise InputError("its data window is not its display window", where=where, remedy="Save it uncropped.")
        narrow = kind in LOW_RANGE and spec.format.basetype == oiio.UINT8
        decoded = spec.width * spec.height * min(spec.nchannels, 4) * (1 if narrow else 4)
        check_count(decoded, most_bytes, "bytes when it is decoded beside the others", where, "Use smaller textures.")
        pixels = source.read_image(0, 0, 0, min(spec.nchannels, 4), oiio.UINT8 if narrow else oiio.FLOAT)
        if pixels is None:
            raise InputError(f"is damaged: {source.geterror()}", where=where, remedy="Save it again.")
    finally:
        source.close()
    return np.ascontiguousarray(np.asarray(pixels).reshape(spec.height, spec.width, -1))


def linear_pixels(image: Image) -> Float32:
    """The image as linear float32 RGBA [H, W, 4]; grey is spread over RGB, absent alpha is 1."""
    values = image.pixels.astype(np.float32)
    if image.pixels.dtype == np.uint8:
        values /= np.float32(255.0)
    channels = values.shape[-1]
    rgb = values[..., :1].repeat(3, axis=-1) if channels <= 2 else values[..., :3]
    if image.srgb:
        rgb = linearised(rgb)
    alpha = values[..., -1:] if channels in (2, 4) else np.ones_like(values[..., :1])
    return np.concatenate([rgb, alpha], axis=-1).astype(np.float32)


def linearised(pixels: Float32) -> Float32:
    """sRGB-encoded [..., C] to linear (IEC 61966-2-1); a second or fourth channel is alpha and stays."""
    colours = pixels.shape[-1] - (pixels.shape[-1] + 1) % 2
    out = pixels.copy()
    part = pixels[..., :colours]
    out[..., :colours] = linear_of_srgb(part)
    return out


def linear_of_srgb(encoded: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """sRGB-encoded values as linear ones (IEC 61966-2-1), of any shape and float type."""
    return np.where(encoded <= 0.04045, encoded / 12.92, ((np.maximum(encoded, 0.0) + 0.055) / 1.055) ** 2.4)
