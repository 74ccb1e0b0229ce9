"""The lobes of one texel out of `lightfield.ktx2`, plain or with Zstandard inside, without the file in memory.

Of a plain file a few bytes a layer are read. A Zstandard level is one frame, so it is inflated up to the texel's last
layer, in pieces that are thrown away but for the texel's bytes: what is held is a window and a piece, whatever the file
claims.
"""

import asyncio
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from typing import IO, Final, cast

import zstandard

from kiln_schemas.conventions import LAYERS_PER_LOBE, LIGHT_FIELD_KTX2
from kiln_schemas.errors import InputError
from kiln_service.blobs import Blobs

IDENTIFIER: Final = b"\xabKTX 20\xbb\r\n\x1a\n"
HEAD: Final = struct.Struct("<12s9I4I2Q3Q")
"""Identifier, format to supercompression, index, and the first level's place (KTX 2.0, 3)."""
SCHEME_NONE: Final = 0
SCHEME_ZSTD: Final = 2
TEXEL: Final = struct.Struct("<4e")
MOST_LAYERS: Final = 128
MOST_INFLATED: Final = 2**30
"""Bytes of a level that is inflated for one texel: 16 lobes of 2048 x 2048 texels, two seconds or so."""
WINDOW_BYTES: Final = 2**23
"""What a frame may refer back to; RFC 8878 asks decoders for so much."""
PIECE_BYTES: Final = 2**20


@dataclass(frozen=True)
class _Level:
    """Where a lobe texture's texels are."""

    width: int
    height: int
    layers: int
    scheme: int
    offset: int
    stored: int
    size: int

    def places(self, row: int, column: int) -> list[int]:
        """Where a texel begins in each layer, from the beginning of the level on."""
        return [TEXEL.size * ((layer * self.height + row) * self.width + column) for layer in range(self.layers)]


async def read_lobes(blobs: Blobs, sha256: str, row: int, column: int) -> list[tuple[float, ...]]:
    """Lobes of a texel of `lightfield.ktx2`, seven numbers each; InputError where they cannot be had."""
    level = await _level(blobs, sha256)
    if row >= level.height or column >= level.width:
        raise InputError(f"it has {level.width} x {level.height} texels", where=LIGHT_FIELD_KTX2)
    places = level.places(row, column)
    if level.scheme == SCHEME_ZSTD:
        data = await _inflate(blobs, sha256, level, places)
    else:
        starts = [level.offset + place for place in places]
        data = b"".join(await blobs.read_parts(sha256, starts, TEXEL.size))
    texels = list(TEXEL.iter_unpack(data))
    pairs = zip(texels[::LAYERS_PER_LOBE], texels[1::LAYERS_PER_LOBE], strict=True)
    return [(*axis, *amplitude[:3]) for axis, amplitude in pairs]


async def _level(blobs: Blobs, sha256: str) -> _Level:
    """The file's only level; InputError where it holds no lobes, or less than it says."""
    size = await blobs.size(sha256)
    head = (await blobs.read_parts(sha256, [0], HEAD.size))[0] if size >= HEAD.size else b""
    if not head.startswith(IDENTIFIER):
        raise InputError("it is no KTX2 file", where=LIGHT_FIELD_KTX2)
    _, _, _, width, height, _, layers, _, _, scheme, *_, offset, stored, plain = HEAD.unpack(head)
    level = _Level(width, height, layers, scheme, offset, stored, TEXEL.size * width * height * layers)
    if not 0 < layers <= MOST_LAYERS or layers % LAYERS_PER_LOBE or plain != level.size:
        raise InputError(f"{layers} layers of {width} x {height} texels are no lobes", where=LIGHT_FIELD_KTX2)
    if scheme not in (SCHEME_NONE, SCHEME_ZSTD):
        raise InputError(f"its supercompression scheme is {scheme}", where=LIGHT_FIELD_KTX2)
    if offset + (stored if scheme == SCHEME_ZSTD else level.size) > size:
        raise InputError("the file ends before its lobes do", where=LIGHT_FIELD_KTX2)
    return level


async def _inflate(blobs: Blobs, sha256: str, level: _Level, places: Sequence[int]) -> bytes:
    """The texels at ascending places of an inflated level."""
    if level.size > MOST_INFLATED:
        raise InputError(
            f"the lobes are compressed, and {level.size / 2**30:.1f} GiB are too much to inflate for one texel",
            where=LIGHT_FIELD_KTX2,
            remedy="Set package.supercompress to false.",
        )
    kept = _Kept(places)
    decompressor = zstandard.ZstdDecompressor(max_window_size=WINDOW_BYTES)
    inflating = decompressor.stream_writer(cast(IO[bytes], kept), write_size=PIECE_BYTES)
    try:
        async for piece in await blobs.read(sha256, level.offset, level.offset + level.stored):
            await asyncio.to_thread(inflating.write, piece)
            if kept.whole:
                break
    except zstandard.ZstdError as error:
        raise InputError(f"its lobes cannot be inflated: {error}", where=LIGHT_FIELD_KTX2) from None
    if not kept.whole:
        raise InputError("the file ends before its lobes do", where=LIGHT_FIELD_KTX2)
    return bytes(kept.texels)


class _Kept:
    """Takes a stream and keeps the texels at ascending places of it."""

    def __init__(self, places: Sequence[int]) -> None:
        self._places = places
        self._at = self._number = 0
        self.texels = bytearray(TEXEL.size * len(places))

    @property
    def whole(self) -> bool:
        return self._number == len(self._places)

    def write(self, data: bytes) -> int:
        """The next bytes of the stream; a texel may lie in two of them."""
        end = self._at + len(data)
        while not self.whole:
            start = self._places[self._number]
            low, high = max(start, self._at), min(start + TEXEL.size, end)
            if low < high:
                to = TEXEL.size * self._number - start
                self.texels[to + low : to + high] = data[low - self._at : high - self._at]
            if start + TEXEL.size > end:
                break
            self._number += 1
        self._at = end
        return len(data)
