"""A small PNG writer (W3C Portable Network Graphics, third edition): 8-bit gray, gray + alpha, RGB and RGBA.

The pictures of the report and the textures inside the GLB are encoded in memory; the bytes depend on the pixels and on
nothing else, which an image library's defaults (time stamps, software tags) do not promise.
"""

import struct
import zlib
from collections.abc import Mapping
from types import MappingProxyType
from typing import Final

import numpy as np
import numpy.typing as npt

UInt8 = npt.NDArray[np.uint8]

_COLOUR_TYPES: Final = {1: 0, 2: 4, 3: 2, 4: 6}


def encode(pixels: UInt8, texts: Mapping[str, str] = MappingProxyType({})) -> bytes:
    """PNG bytes of pixels [H, W, 1..4], row 0 at the top, with `texts` of Latin-1 by keyword."""
    height, width, channels = pixels.shape
    # Filter every row with "Sub": the difference to the pixel on the left, modulo 256.
    rows = np.zeros((height, 1 + width * channels), np.uint8)
    rows[:, 0] = 1
    difference = pixels.copy()
    difference[:, 1:] -= pixels[:, :-1]
    rows[:, 1:] = difference.reshape(height, -1)
    header = struct.pack(">2I5B", width, height, 8, _COLOUR_TYPES[channels], 0, 0, 0)
    words = [(b"tEXt", key.encode("latin-1") + b"\0" + text.encode("latin-1")) for key, text in texts.items()]
    parts = [(b"IHDR", header), *words, (b"IDAT", zlib.compress(rows.tobytes(), 9)), (b"IEND", b"")]
    return b"\x89PNG\r\n\x1a\n" + b"".join(_chunk(kind, data) for kind, data in parts)


def _chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
