"""KTX 2.0 files with half-float texels (VK_FORMAT_R16G16B16A16_SFLOAT): writer and strict reader.

Follows the Khronos KTX File Format Specification, version 2.0, and the Khronos Data Format Specification 1.4 for the
data format descriptor. Texel data lie [layer, face, row, column, channel] inside a level and the smallest level comes
first in the file. `kiln_workers.package.ktx2_validate` checks files from the specification without this module.
"""

import mmap
import os
import struct
import tempfile
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from io import BufferedReader
from pathlib import Path
from typing import BinaryIO, Final

import numpy as np
import numpy.typing as npt
import zstandard

from kiln_schemas import __version__
from kiln_schemas.errors import InputError, InternalError, TooLarge
from kiln_schemas.files import open_regular
from kiln_workers.package.files import whole_file, write_bytes
from kiln_workers.package.ktx2_validate import WINDOW_BYTES, FileBytes, validate

Half = npt.NDArray[np.float16]

IDENTIFIER: Final = b"\xabKTX 20\xbb\r\n\x1a\n"
VK_FORMAT_R16G16B16A16_SFLOAT: Final = 97
TEXEL_BYTES: Final = 8
SCHEME_NONE: Final = 0
SCHEME_ZSTD: Final = 2
ZSTD_LEVEL: Final = 9
ONE_PIECE_BYTES: Final = 1 << 27
"""A level up to this is compressed in one piece, which takes as much memory again; a larger one as a stream."""
STREAM_BYTES: Final = 1 << 22

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
    def shape(self) -> "Shape":
        return Shape(self.width, self.height, self.layers, self.faces, self.is_array, self.metadata)

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


@dataclass(frozen=True)
class Shape:
    """What a file's header says of its texture."""

    width: int
    height: int
    layers: int
    faces: int
    is_array: bool
    metadata: Mapping[str, str]

    @property
    def nbytes(self) -> int:
        """Of the texels of the largest level."""
        return TEXEL_BYTES * self.width * self.height * self.layers * self.faces


Bands = Iterable[tuple[int, Half]]
"""First row and texels [layers, B, width, 4] of each band of rows, top to bottom."""


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
    lengths = [(len(data), len(bare)) for data, bare in zip(stored, plain, strict=True)]
    out, offsets = _head(texture.shape, lengths, supercompress)
    for level in reversed(range(len(stored))):
        out += bytes(offsets[level] - len(out)) + stored[level]
    return bytes(out)


def _head(shape: Shape, lengths: Sequence[tuple[int, int]], supercompressed: bool) -> tuple[bytearray, list[int]]:
    """All that comes before the levels, and where each begins, from the lengths of their stored and plain bytes."""
    descriptor = _data_format_descriptor()
    pairs = _key_value_data({**shape.metadata, "KTXorientation": "rd", "KTXwriter": f"lightkiln {__version__}"})
    descriptor_at = _HEADER.size + _INDEX.size + _LEVEL.size * len(lengths)
    pairs_at = descriptor_at + len(descriptor)
    end = pairs_at + len(pairs)
    offsets = [0] * len(lengths)
    for level in reversed(range(len(lengths))):
        offsets[level] = end if supercompressed else end + -end % TEXEL_BYTES
        end = offsets[level] + lengths[level][0]
    header = _HEADER.pack(
        IDENTIFIER,
        VK_FORMAT_R16G16B16A16_SFLOAT,
        2,  # typeSize: bytes of the type to swap on big-endian machines
        shape.width,
        shape.height,
        0,  # pixelDepth: not a volume
        shape.layers if shape.is_array else 0,
        shape.faces,
        len(lengths),
        SCHEME_ZSTD if supercompressed else SCHEME_NONE,
    )
    index = _INDEX.pack(descriptor_at, len(descriptor), pairs_at, len(pairs), 0, 0)
    entries = [_LEVEL.pack(offset, *length) for offset, length in zip(offsets, lengths, strict=True)]
    return bytearray(b"".join([header, index, *entries, descriptor, pairs])), offsets


def write(path: Path, texture: Texture, *, supercompress: bool = False) -> None:
    """Write the texture atomically, once the structural validator finds nothing wrong with its bytes."""
    data = encode(texture, supercompress=supercompress)
    faults = validate(data)
    if faults:
        raise InternalError(f"the KTX2 writer made an invalid file: {faults[0]}", where=path.name)
    write_bytes(path, data)


def write_bands(path: Path, shape: Shape, bands: Bands, *, supercompress: bool = False) -> None:
    """Write a texture of one level and one face that is never in memory as a whole, validated and atomically.

    The bytes are those of `write`, but for a compressed level of more than ONE_PIECE_BYTES, in which a stream of
    Zstandard ends its blocks elsewhere.
    """
    with whole_file(path) as file:
        if supercompress:
            with tempfile.TemporaryFile(dir=path.parent) as plain:
                _write_level(plain, 0, shape, bands)
                _compress_level(file, plain, shape)
        else:
            head, offsets = _head(shape, [(shape.nbytes, shape.nbytes)], False)
            file.write(head)
            _write_level(file, offsets[0], shape, bands)
        faults = validate(FileBytes(file))
        if faults:
            raise InternalError(f"the KTX2 writer made an invalid file: {faults[0]}", where=path.name)


def _write_level(file: BinaryIO, start: int, shape: Shape, bands: Bands) -> None:
    """Write a level's bands where they belong, [layer, row, column, channel], from byte `start` on."""
    done = 0
    for first, texels in bands:
        expected = (shape.layers, texels.shape[1], shape.width, 4)
        if texels.shape != expected or texels.dtype != np.float16 or first != done:
            raise InternalError(f"rows from {first} are {texels.dtype} {texels.shape}, not float16 {expected}")
        if not np.isfinite(texels).all():
            raise InternalError(f"rows from {first} hold values that are not finite", where="KTX2")
        for layer, rows in enumerate(texels):
            file.seek(start + TEXEL_BYTES * shape.width * (layer * shape.height + first))
            file.write(np.ascontiguousarray(rows, "<f2").data)
        done += texels.shape[1]
    if done != shape.height:
        raise InternalError(f"the bands have {done} rows, the texture {shape.height}", where="KTX2")


def _compress_level(file: BinaryIO, plain: BinaryIO, shape: Shape) -> None:
    """Write the whole file of a texture whose only level is the content of `plain`."""
    _, offsets = _head(shape, [(0, shape.nbytes)], True)
    file.seek(offsets[0])
    plain.seek(0)
    compressor = zstandard.ZstdCompressor(level=ZSTD_LEVEL)
    if shape.nbytes <= ONE_PIECE_BYTES:
        length = file.write(compressor.compress(plain.read()))
    else:
        _, length = compressor.copy_stream(
            plain, file, size=shape.nbytes, read_size=STREAM_BYTES, write_size=STREAM_BYTES
        )
    file.seek(0)
    file.write(_head(shape, [(length, shape.nbytes)], True)[0])


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


def map_layers(path: Path, most_bytes: int) -> tuple[npt.NDArray[np.float16], Shape]:
    """The texels [layers, height * width, 4] of a texture of one level and one face, mapped from their file.

    A compressed level is inflated into a file without a name beside it. Errors as of `read`.
    """
    try:
        with open_regular(path) as file:
            _refuse_larger(file, path.name, most_bytes)
            faults = validate(FileBytes(file))
            head = FileBytes(file)[: _HEADER.size + _INDEX.size + _LEVEL.size]
            if not faults and _HEADER.unpack_from(head)[7:9] != (1, 1):
                faults = ["it has more than one face or level"]
            if faults:
                raise InputError(faults[0], where=path.name, remedy="Bake or download the package again.")
            _, _, _, width, height, _, layers, faces, _, scheme = _HEADER.unpack_from(head)
            offset, _, _ = _LEVEL.unpack_from(head, _HEADER.size + _INDEX.size)
            shape = Shape(width, height, max(1, layers), faces, layers > 0, {})
            if scheme != SCHEME_ZSTD:
                return _mapped_level(file, offset, shape), shape
            with tempfile.TemporaryFile(dir=path.parent) as plain:
                file.seek(offset)
                zstandard.ZstdDecompressor(max_window_size=WINDOW_BYTES).copy_stream(file, plain)
                plain.flush()
                return _mapped_level(plain, 0, shape), shape
    except OSError as error:
        raise InputError(f"cannot be read: {error.strerror}", where=path.name) from None


def _mapped_level(file: BinaryIO, offset: int, shape: Shape) -> npt.NDArray[np.float16]:
    pages = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
    texels = np.frombuffer(pages, "<f2", shape.nbytes // 2, offset)
    return texels.reshape(shape.layers, shape.height * shape.width, 4)


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
