"""Single tiles and texels out of a job's light-field store and texel map, by byte ranges and without a numeric library.

The layouts are those of `kiln_workers.store.layout` (Zarr v3: the irradiance has one uncompressed chunk a tile; a
light-field shard is a tile, its chunks are texels, its index lies at the end) and `kiln_workers.scene.container` (texel
map). What Zarr does not store is zero in tiles that are not rendered yet, and lost in those that are. Chunks and
indices end in their CRC-32C, which is checked.
"""

import asyncio
import json
import struct
from collections.abc import Collection, Sequence
from typing import Any, Final

import google_crc32c
import obstore
from obstore.exceptions import BaseError
from obstore.store import ObjectStore

from kiln_schemas.conventions import ARRAY_IRRADIANCE, ARRAY_LIGHT_FIELD
from kiln_schemas.errors import Damaged, InputError, NotFound
from kiln_schemas.settings import BakeSettings
from kiln_service.blobs import Blobs, open_objects

CRC_BYTES: Final = 4
INDEX_ENTRY: Final = struct.Struct("<QQ")
ABSENT: Final = 2**64 - 1
AT_ONCE: Final = 16
"""Objects read at the same time."""
HEADER_BYTES: Final = 4096
"""Of a texel map; more than its header has."""


class LightFields:
    """The light-field store of one job."""

    def __init__(self, store_url: str, settings: BakeSettings) -> None:
        self._url, self._settings = store_url, settings
        self._objects: ObjectStore | None = None

    async def open(self) -> None:
        """NotFound where the store cannot be reached from the coordinator, or is gone."""
        try:
            self._objects = open_objects(self._url)
            await obstore.head_async(self._objects, "zarr.json")
        except (BaseError, OSError, ValueError) as error:
            raise NotFound(
                f"the coordinator cannot read the light fields ({type(error).__name__})",
                where=self._url,
                remedy="Mount the store on the coordinator's machine; a store whose job was collected is gone.",
            ) from None

    async def irradiance(
        self, tiles: Sequence[tuple[int, int]], stride: int, rendered: Collection[tuple[int, int]]
    ) -> bytes:
        """float32 RGB of every `stride`-th texel of tiles (row, column of the first texel), one after the other.

        Damaged where a tile that is `rendered` is not there or has wrong bytes; others are zero.
        """
        gate = asyncio.Semaphore(AT_ONCE)

        async def one(row: int, column: int) -> bytes:
            async with gate:
                return self._thinned(await self._tile(row, column, (row, column) in rendered), stride)

        return b"".join(await asyncio.gather(*(one(row, column) for row, column in tiles)))

    async def _tile(self, row: int, column: int, rendered: bool) -> bytes:
        size = 12 * self._settings.lightmap.tile**2
        key = self._key(ARRAY_IRRADIANCE, row, column, 1)
        found = await self._read(key, (0, size + CRC_BYTES))
        if found is None and not rendered:
            return bytes(size)
        return self._checked(found, size, key)

    def _thinned(self, texels: bytes, stride: int) -> bytes:
        """Every `stride`-th texel of every `stride`-th row."""
        size = self._settings.lightmap.tile
        if stride == 1:
            return texels
        values = memoryview(texels).cast("c")
        kept = []
        for row in range(0, size, stride):
            for column in range(0, size, stride):
                start = 12 * (row * size + column)
                kept.append(values[start : start + 12])
        return b"".join(kept)

    async def image(self, row: int, column: int, rendered: bool) -> bytes:
        """A texel's light field, float16 [R, R, 3]; Damaged where it is `rendered` and lost or wrong, else zero."""
        size, side = self._settings.lightmap.tile, self._settings.render.image_size
        wanted = 2 * 3 * side * side
        key = self._key(ARRAY_LIGHT_FIELD, row, column, 3)
        index_bytes = INDEX_ENTRY.size * size * size + CRC_BYTES
        index = await self._read(key, {"suffix": index_bytes})
        if index is None and not rendered:
            return bytes(wanted)
        index = self._checked(index, index_bytes - CRC_BYTES, key)
        offset, length = INDEX_ENTRY.unpack_from(index, INDEX_ENTRY.size * (row % size * size + column % size))
        if offset == ABSENT and not rendered:
            return bytes(wanted)
        if length != wanted + CRC_BYTES:
            raise self._lost(key, "a texel is not stored")
        return self._checked(await self._read(key, (offset, offset + length)), wanted, key)

    def _checked(self, data: bytes | None, size: int, key: str) -> bytes:
        """So many bytes without their checksum; Damaged where they are not there, or wrong."""
        if data is None:
            raise self._lost(key, "it is gone")
        if len(data) != size + CRC_BYTES:
            raise self._lost(key, f"it has {len(data)} bytes, not {size + CRC_BYTES}")
        if google_crc32c.value(data[:size]) != int.from_bytes(data[size:], "little"):
            raise self._lost(key, "its checksum is wrong")
        return data[:size]

    def _lost(self, key: str, what: str) -> Damaged:
        return Damaged(
            f"{key} of the light-field store is damaged or lost: {what}",
            where=self._url,
            remedy="Do the tile's task again (`lightkiln requeue`).",
        )

    def _key(self, array: str, row: int, column: int, inner: int) -> str:
        size = self._settings.lightmap.tile
        return "/".join([array, "c", str(row // size), str(column // size), *["0"] * inner])

    async def _read(self, key: str, part: Any = None) -> bytes | None:
        """An object or a part of it; None where it is not there."""
        assert self._objects is not None
        try:
            found = await obstore.get_async(self._objects, key, options={"range": part} if part else None)
            return bytes(await found.bytes_async())
        except FileNotFoundError:
            return None


class TexelMapReader:
    """Arrays of a packed texel map, read in parts."""

    def __init__(self, blobs: Blobs, sha256: str, resolution: int) -> None:
        self._blobs, self._sha256, self._resolution = blobs, sha256, resolution
        self._starts: dict[str, int] = {}

    async def open(self) -> None:
        """Read the header; InputError where the map is another's than that of this light map."""
        head = await _bytes(self._blobs, self._sha256, 0, HEADER_BYTES)
        length = int.from_bytes(head[8:16], "little")
        try:
            arrays = json.loads(head[16 : 16 + length])["arrays"]
            for name in ("state", "normal"):
                if arrays[name]["shape"][:2] != [self._resolution, self._resolution]:
                    raise ValueError
                self._starts[name] = 16 + length + int(arrays[name]["offset"])
        except (ValueError, KeyError, TypeError):
            raise InputError("the texel map does not fit the job", where=self._sha256) from None

    async def states(self, stride: int) -> bytes:
        """One byte for every `stride`-th texel of every `stride`-th row."""
        side, start = self._resolution, self._starts["state"]
        data = await _bytes(self._blobs, self._sha256, start, start + side * side)
        if len(data) != side * side:
            raise InputError("the texel map ends early", where=self._sha256)
        return b"".join(data[row * side : (row + 1) * side : stride] for row in range(0, side, stride))

    async def has_surface(self, row: int, column: int) -> bool:
        """Whether a texel has a surface point: it is rendered with its tile."""
        at = self._starts["state"] + row * self._resolution + column
        return await _bytes(self._blobs, self._sha256, at, at + 1) not in (b"", b"\0")

    async def normal(self, row: int, column: int) -> tuple[float, ...]:
        """The geometric normal at a texel."""
        at = self._starts["normal"] + 12 * (row * self._resolution + column)
        data = await _bytes(self._blobs, self._sha256, at, at + 12)
        if len(data) != 12:
            raise InputError("the texel map ends early", where=self._sha256)
        return struct.unpack("<3f", data)


async def _bytes(blobs: Blobs, sha256: str, start: int, end: int) -> bytes:
    """Bytes start..end-1 of a blob, fewer where it ends before."""
    end = min(end, await blobs.size(sha256))
    if start >= end:
        return b""
    return (await blobs.read_parts(sha256, [start], end - start))[0]
