"""Compressed geometry of glTF: KHR_draco_mesh_compression through DracoPy, EXT_meshopt_compression through meshopt.

Both announce sizes that a stranger wrote. They are held to the scene's bounds, and to what so few bytes can become at
the most, before a decoder is given anything: Draco's header is read here, meshopt's sizes are fields of the document.
"""

from collections.abc import Mapping
from typing import Final

import DracoPy
import meshopt
import numpy as np
import numpy.typing as npt

from kiln_schemas.errors import InputError
from kiln_workers.scene.container import Array
from kiln_workers.scene.gltf_document import Meshopt
from kiln_workers.scene.limits import MAX_READ_BYTES, MAX_VERTICES, check_count

DRACO_MOST: Final = 256
"""Faces and vertices that a byte of a Draco buffer may stand for. Coders come down to a tenth of a bit on large regular
grids; an announcement beyond is a lie."""
DRACO_SLACK: Final = 4096
DRACO_METADATA: Final = 0x8000
MESHOPT_MOST: Final = 1024
"""Bytes that a byte of a compressed vertex buffer may stand for: 256 equal elements of 4 bytes take one and more."""


def decode_meshopt(data: memoryview, view: Meshopt, index: int, where: str) -> bytes:
    """The bytes of buffer view `index`, which `data` compresses."""
    size, what = view.count * view.byte_stride, f"buffer view {index}"
    check_count(size, MAX_READ_BYTES, f"bytes in {what}", where)
    if view.mode != "ATTRIBUTES" and (view.byte_stride not in (2, 4) or view.filter != "NONE"):
        raise _damaged(what, "indices have 2 or 4 bytes and no filter", where)
    most = {"ATTRIBUTES": MESHOPT_MOST * len(data), "TRIANGLES": 3 * view.byte_stride * len(data)}
    if size > most.get(view.mode, view.byte_stride * len(data)):
        raise _damaged(what, f"{len(data)} bytes cannot become {size}", where)
    try:
        rows = meshopt.decode_gltf_buffer(bytes(data), view.count, view.byte_stride, view.mode, view.filter)
    except (ValueError, RuntimeError, MemoryError) as error:
        raise _damaged(what, f"meshopt's decoder says: {error}", where) from None
    return np.ascontiguousarray(rows).tobytes()


def decode_draco(
    data: bytes, attributes: Mapping[str, int], name: str
) -> tuple[dict[str, Array], npt.NDArray[np.int64]]:
    """Attributes [V, C] by name as they are stored, and faces [F, 3]."""
    where = f"mesh '{name}'"
    _check_draco_header(data, where)
    try:
        decoded = DracoPy.decode(data)
        found = {key: decoded.get_attribute_by_unique_id(number) for key, number in attributes.items()}
        count = len(decoded.points)
    except Exception as error:  # a Cython module over C++: whatever it raises says that the bytes are no mesh
        raise _damaged("its Draco buffer", f"Draco's decoder says: {error}", where) from None
    faces = np.asarray(getattr(decoded, "faces", np.zeros((0, 3))), dtype=np.int64).reshape(-1, 3)
    out: dict[str, Array] = {}
    for key, attribute in found.items():
        values = None if attribute is None else np.asarray(attribute["data"])
        if values is None or values.ndim == 0 or len(values) != count:
            raise _damaged("its Draco buffer", f"it has no {key} under the number that the file names", where)
        out[key] = values.reshape(count, -1)
    return out, faces


def _check_draco_header(data: bytes, where: str) -> None:
    """Hold the numbers that a Draco bitstream (2.2) begins with to the bounds, and to the bytes that there are."""
    what = "its Draco buffer"
    if data[:5] != b"DRACO" or len(data) < 16:
        raise _damaged(what, "it does not begin as Draco does", where)
    kind, method, flags = data[7], data[8], int.from_bytes(data[9:11], "little")
    if kind != 1 or method > 1 or data[5] != 2:
        raise _damaged(what, f"it is no mesh of Draco 2 (version {data[5]}.{data[6]}, kind {kind})", where)
    if flags & DRACO_METADATA:
        raise InputError(f"{what} has metadata, which is not read", where=where, remedy="Export it without.")
    first, end = _varint(data, 11 + method)  # Edgebreaker's traversal takes a byte
    second, _ = _varint(data, end)
    check_count(max(first, second), MAX_VERTICES, "vertices or faces in its Draco buffer", where)
    if first + second > DRACO_MOST * len(data) + DRACO_SLACK:
        raise _damaged(what, f"{len(data)} bytes cannot hold {first + second} faces and vertices", where)


def _varint(data: bytes, offset: int) -> tuple[int, int]:
    """An unsigned LEB128 number and the offset behind it."""
    value = shift = 0
    for byte in data[offset : offset + 5]:
        value |= (byte & 0x7F) << shift
        shift += 7
        offset += 1
        if byte < 0x80:
            break
    return value, offset


def _damaged(what: str, detail: str, where: str) -> InputError:
    return InputError(f"{what} is damaged: {detail}", where=where, remedy="Export it again, or without compression.")
