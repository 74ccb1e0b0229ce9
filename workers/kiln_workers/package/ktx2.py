"""KTX 2.0 files with half-float texels (VK_FORMAT_R16G16B16A16_SFLOAT): writer and strict reader.

Follows the Khronos KTX File Format Specification, version 2.0, and the Khronos Data Format Specification 1.4 for the
data format descriptor. Texel data lie [layer, face, row, column, channel] inside a level and the smallest level comes
first in the file. `kiln_workers.package.ktx2_validate` checks files from the specification without this module.
"""

import os
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from io import BufferedReader
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt
import zstandard

from kiln_schemas import __version__
from kiln_schemas.errors import InputError, InternalError, TooLarge
from kiln_schemas.files import open_regular
from kiln_workers.package.files import write_bytes
from kiln_workers.package.ktx2_validate import validate

Half = npt.NDArray[np.float16]

IDENTIFIER: Final = b"\xabKTX 20\xbb\r\n\x1a\n"
VK_FORMAT_R16G16B16A16_SFLOAT: Final = 97
TEXEL_BYTES: Final = 8
SCHEME_NONE: Final = 0
SCHEME_ZSTD: Final = 2
ZSTD_LEVEL: Final = 9

OVERHEAD_BYTES: Final = 2**16
"""What a file has besides its texels, at most."""

_HEADER: Final = struct.Struct("<12s9I")
_INDEX: Final = struct.Struct("<4I2Q")
_LEVEL: Final = struct.Struct("<3Q")


@dataclass(frozen=True)
class Texture:
    """A texture as a KTX 2.0 file holds it."""

    levels: tuple[Half, ...]
    """Per mip level [layers, faces, height, width, 4]; level 0 is the largest."""
    is_array: bool
    """Whether it is an array texture (an array may have a single layer)."""
    metadata: Mapping[str, str]

    @property
    def layers(self) -> int:
        return int(self.levels[0].shape[0])

    @property
    def faces(self) -> int:
        return int(self.levels[0].shape[1])

    @property
    def height(self) -> int:
        return int(self.levels[0].shape[2])

    @property
    def width(self) -> int:
        return int(self.levels[0].shape[3])


def texture_2d(pixels: Half, metadata: Mapping[str, str]) -> Texture:
    """A plain 2D texture of pixels [H, W, 4]."""
    return Texture((pixels[None, None],), False, metadata)


def texture_array(layers: Half, metadata: Mapping[str, str]) -> Texture:
    """A 2D array texture of layers [L, H, W, 4]."""
    return Texture((layers[:, None],), True, metadata)


def texture_cube(mips: Sequence[Half], metadata: Mapping[str, str]) -> Texture:
    """A cube map of mips [6, S, S, 4], largest first, faces +X -X +Y -Y +Z -Z."""
    return Texture(tuple(mip[None] for mip in mips), False, metadata)


def encode(texture: Texture, *, supercompress: bool = False) -> bytes:
    """The file's bytes. `supercompress` applies Zstandard (scheme 2) to each level; the default is plain data."""
    _check(texture)
    plain = [np.ascontiguousarray(level, dtype="<f2").tobytes() for level in texture.levels]
    stored = [zstandard.compress(data, ZSTD_LEVEL) for data in plain] if supercompress else plain
    descriptor = _data_format_descriptor()
    pairs = _key_value_data({**texture.metadata, "KTXorientation": "rd", "KTXwriter": f"lightkiln {__version__}"})

    descriptor_at = _HEADER.size + _INDEX.size + _LEVEL.size * len(stored)
    pairs_at = descriptor_at + len(descriptor)
    end = pairs_at + len(pairs)
    body: list[bytes] = []
    entries: list[bytes] = [b""] * len(stored)
    for level in reversed(range(len(stored))):
        padding = 0 if supercompress else -end % TEXEL_BYTES
        entries[level] = _LEVEL.pack(end + padding, len(stored[level]), len(plain[level]))
        body += [bytes(padding), stored[level]]
        end += padding + len(stored[level])

    header = _HEADER.pack(
        IDENTIFIER,
        VK_FORMAT_R16G16B16A16_SFLOAT,
        2,  # typeSize: bytes of the type to swap on big-endian machines
        texture.width,
        texture.height,
        0,  # pixelDepth: not a volume
        texture.layers if texture.is_array else 0,
        texture.faces,
        len(stored),
        SCHEME_ZSTD if supercompress else SCHEME_NONE,
    )
    index = _INDEX.pack(descriptor_at, len(descriptor), pairs_at, len(pairs), 0, 0)
    return b"".join([header, index, *entries, descriptor, pairs, *body])


def write(path: Path, texture: Texture, *, supercompress: bool = False) -> None:
    """Write the texture atomically, once the structural validator finds nothing wrong with its bytes."""
    data = encode(texture, supercompress=supercompress)
    faults = validate(data)
    if faults:
        raise InternalError(f"the KTX2 writer made an invalid file: {faults[0]}", where=path.name)
    write_bytes(path, data)


def decode(data: bytes, *, where: str = "KTX2") -> Texture:
    """The texture in a file's bytes; InputError names the first fault of a file that is not valid or not half-float."""
    faults = validate(data)
    if faults:
        raise InputError(faults[0], where=where, remedy="Bake or download the package again.")
    _, _, _, width, height, _, layer_count, faces, level_count, scheme = _HEADER.unpack_from(data)
    _, _, pairs_at, pairs_length, _, _ = _INDEX.unpack_from(data, _HEADER.size)
    levels = []
    for level in range(max(1, level_count)):
        offset, length, plain_length = _LEVEL.unpack_from(data, _HEADER.size + _INDEX.size + _LEVEL.size * level)
        plain = data[offset : offset + length]
        if scheme == SCHEME_ZSTD:
            plain = zstandard.decompress(plain, max_output_size=plain_length)
        shape = (max(1, layer_count), faces, max(1, height >> level), max(1, width >> level), 4)
        levels.append(np.frombuffer(plain, "<f2").astype(np.float16).reshape(shape))
    metadata = _parse_key_value_data(data[pairs_at : pairs_at + pairs_length])
    return Texture(tuple(levels), layer_count > 0, metadata)


def read(path: Path, most_bytes: int | None = None) -> Texture:
    """Read and check a half-float KTX 2.0 file; InputError names the first fault.

    TooLarge, before anything is inflated, where its levels would take more than `most_bytes`, which the caller knows of
    the package's settings.
    """
    try:
        with open_regular(path) as file:
            if most_bytes is not None:
                _refuse_larger(file, path.name, most_bytes)
            data = file.read()
    except OSError as error:
        raise InputError(f"cannot be read: {error.strerror}", where=path.name) from None
    return decode(data, where=path.name)


def _refuse_larger(file: BufferedReader, name: str, most_bytes: int) -> None:
    """TooLarge where a file, or what its header declares, is larger than that; other faults are `decode`'s to find."""
    head = file.read(_HEADER.size)
    file.seek(0)
    if len(head) < _HEADER.size:
        return
    _, _, _, width, height, _, layers, faces, levels, _ = _HEADER.unpack(head)
    shapes = ((max(1, height >> level), max(1, width >> level)) for level in range(min(max(1, levels), 32)))
    declared = TEXEL_BYTES * max(1, layers) * faces * sum(rows * columns for rows, columns in shapes)
    for size, what in ((declared, "its texels take"), (os.fstat(file.fileno()).st_size - OVERHEAD_BYTES, "it has")):
        if size > most_bytes:
            raise TooLarge(
                f"{what} {size} bytes, the package's settings allow {most_bytes}",
                where=name,
                remedy="Bake or download the package again.",
            )


def _check(texture: Texture) -> None:
    """Refuse what the format cannot say: wrong shapes of mips, odd cubes, values that are not finite."""
    layers, faces, height, width, _ = texture.levels[0].shape
    for number, level in enumerate(texture.levels):
        expected = (layers, faces, max(1, height >> number), max(1, width >> number), 4)
        if level.shape != expected or level.dtype != np.float16:
            raise InternalError(f"mip {number} is {level.dtype} {level.shape}, not float16 {expected}", where="KTX2")
        if not np.isfinite(level).all():
            raise InternalError(f"mip {number} holds values that are not finite", where="KTX2")


def _data_format_descriptor() -> bytes:
    """Basic descriptor block of four 16-bit signed floats: linear, Rec.709 primaries (Data Format 1.4, section 5)."""
    channels = (0, 1, 2, 15)  # red, green, blue, alpha
    model, primaries, transfer, flags = 1, 1, 1, 0  # RGBSDA, BT709, LINEAR, straight alpha
    block_size = 24 + 16 * len(channels)
    words = [0, 2 | block_size << 16, model | primaries << 8 | transfer << 16 | flags << 24, 0, TEXEL_BYTES, 0]
    signed_float = 0xC0
    minus_one, one = (struct.unpack("<I", struct.pack("<f", value))[0] for value in (-1.0, 1.0))
    for position, channel in enumerate(channels):
        words += [16 * position | 15 << 16 | (channel | signed_float) << 24, 0, minus_one, one]
    return struct.pack(f"<{1 + len(words)}I", 4 + block_size, *words)


def _key_value_data(metadata: Mapping[str, str]) -> bytes:
    """Key/value pairs sorted by code point, values as NUL-terminated UTF-8, each pair padded to 4 bytes."""
    out = bytearray()
    for key in sorted(metadata):
        pair = key.encode() + b"\0" + metadata[key].encode() + b"\0"
        out += struct.pack("<I", len(pair)) + pair + bytes(-len(pair) % 4)
    return bytes(out)


def _parse_key_value_data(data: bytes) -> dict[str, str]:
    """The pairs of validated key/value data; NUL terminators of values are dropped."""
    out, at = {}, 0
    while at < len(data):
        (length,) = struct.unpack_from("<I", data, at)
        key, _, value = data[at + 4 : at + 4 + length].partition(b"\0")
        out[key.decode()] = value.removesuffix(b"\0").decode()
        at += 4 + length + -length % 4
    return out
