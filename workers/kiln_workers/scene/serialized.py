"""Reader of Mitsuba's `serialized` meshes, versions 3 and 4: a deflated stream of counts, arrays and faces a mesh.

Mitsuba documentation, "Serialized mesh loader". The file ends with a table of where each mesh begins. Counts are held
to their bounds before anything is inflated, and no more is inflated than they announce.
"""

import struct
import zlib
from typing import Final

import numpy as np

from kiln_schemas.errors import InputError
from kiln_workers.scene.geometry import Floats, RawMesh, check_triangle_count
from kiln_workers.scene.limits import MAX_VERTICES, check_count

MAGIC: Final = 0x041C
NORMALS, UV, COLOURS, FACE_NORMALS, DOUBLE = 0x1, 0x2, 0x8, 0x10, 0x2000
MAX_NAME: Final = 4096


def parse_serialized(data: bytes, index: int, where: str) -> RawMesh:
    """Mesh `index` of a file, v as Mitsuba has it; InputError names `where` if it cannot be read."""
    version = _version(data, where)
    start = _start(data, index, version, where) if index else 0
    stream = _Inflated(data[start + 4 :], where)
    (flags,) = struct.unpack("<I", stream.take(4))
    if version == 4:
        for length in range(MAX_NAME + 1):
            if stream.take(1) == b"\0":
                break
            check_count(length, MAX_NAME - 1, "characters in the name of a mesh", where)
    vertices, triangles = struct.unpack("<QQ", stream.take(16))
    check_count(vertices, MAX_VERTICES, "vertices", where)
    check_triangle_count(triangles, where)
    kind = np.dtype("<f8" if flags & DOUBLE else "<f4")

    def columns(width: int) -> Floats:
        flat = np.frombuffer(stream.take(vertices * width * kind.itemsize), kind)
        return flat.reshape(-1, width).astype(np.float64)

    positions = columns(3)
    normals = columns(3) if flags & NORMALS else None
    uv = columns(2) if flags & UV else None
    if flags & COLOURS:
        columns(3)  # which Mitsuba ignores too
    faces = np.frombuffer(stream.take(12 * triangles), "<u4").reshape(-1, 3).astype(np.int64)
    return RawMesh(f"serialized {index}", positions, faces, 0, None if flags & FACE_NORMALS else normals, uv)


def _version(data: bytes, where: str) -> int:
    if len(data) < 4:
        raise InputError("is cut off", where=where, remedy="Export it again.")
    magic, version = struct.unpack_from("<HH", data)
    if magic != MAGIC or version not in (3, 4):
        detail = "is no serialized mesh" if magic != MAGIC else f"is of version {version}; 3 and 4 are read"
        raise InputError(detail, where=where, remedy="Save it as PLY.")
    return int(version)


def _start(data: bytes, index: int, version: int, where: str) -> int:
    (count,) = struct.unpack_from("<I", data, len(data) - 4)
    if not 0 <= index < count:
        raise InputError(f"has {count} meshes, no number {index}", where=where, remedy="Mend shape_index.")
    code, width = ("<Q", 8) if version == 4 else ("<I", 4)
    place = len(data) - 4 - width * (count - index)
    start = struct.unpack_from(code, data, place)[0] if place >= 4 else len(data)
    if start + 4 > len(data):
        raise InputError("its table of meshes is damaged", where=where, remedy="Export it again.")
    return int(start)


class _Inflated:
    def __init__(self, data: bytes, where: str) -> None:
        self.inflate = zlib.decompressobj()
        self.rest = data
        self.where = where

    def take(self, count: int) -> bytes:
        """The next `count` bytes; InputError where there are fewer."""
        out = bytearray()
        while len(out) < count:
            try:
                piece = self.inflate.decompress(self.rest, count - len(out))
            except zlib.error:
                piece = b""
            self.rest = self.inflate.unconsumed_tail
            if not piece:
                raise InputError("is cut off or damaged", where=self.where, remedy="Export it again.")
            out += piece
        return bytes(out)
