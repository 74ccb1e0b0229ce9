"""Buffers, buffer views and accessors of a glTF file, every offset checked before it is used (glTF 2.0, 3.6).

Reads strided, interleaved, sparse and normalised accessors into float64 or int64 arrays. Whatever leaves its buffer is
an InputError that names the accessor, never an exception of numpy's.
"""

import base64
import binascii
import struct
from dataclasses import dataclass, field
from typing import Any, Final
from urllib.parse import unquote

import numpy as np
import numpy.typing as npt

from kiln_schemas.errors import InputError
from kiln_workers.scene.bundle import BundleFolder
from kiln_workers.scene.container import Array
from kiln_workers.scene.gltf_compression import decode_meshopt
from kiln_workers.scene.gltf_document import Accessor, Document, Meshopt, parse_extension, pick
from kiln_workers.scene.limits import MAX_READ_BYTES, MAX_VERTICES, MAX_ZEROS, check_count

COMPONENTS: Final = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}
DTYPES: Final = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}

MESHOPT: Final = ("EXT_meshopt_compression", "KHR_meshopt_compression")
GLB_MAGIC: Final = b"glTF"
CHUNK_JSON: Final = 0x4E4F534A
CHUNK_BIN: Final = 0x004E4942


def split_glb(data: bytes, where: str) -> tuple[bytes, bytes | None]:
    """JSON and binary chunk of a GLB file (glTF 2.0, 4.4); a file of plain JSON passes with None."""
    if data[:4] != GLB_MAGIC:
        return data, None
    if len(data) < 20:
        raise _broken("its GLB header is cut off", where)
    version, length = struct.unpack_from("<II", data, 4)
    if version != 2:
        raise InputError(f"is GLB version {version}", where=where, remedy="Export it as glTF 2.0.")
    if length > len(data):
        raise _broken(f"it should have {length} bytes and has {len(data)}", where)
    chunks: dict[int, bytes] = {}  # of the two kinds that are read
    offset = 12
    while offset + 8 <= length:
        size, kind = struct.unpack_from("<II", data, offset)
        offset += 8
        if offset + size > length:
            raise _broken(f"a chunk of {size} bytes leaves the file", where)
        if kind in (CHUNK_JSON, CHUNK_BIN) and kind not in chunks:
            chunks[kind] = data[offset : offset + size]
        offset += size
    if CHUNK_JSON not in chunks:
        raise _broken("it has no JSON chunk", where)
    return chunks[CHUNK_JSON], chunks.get(CHUNK_BIN)


def decode_data_uri(uri: str, where: str) -> bytes:
    """The bytes of a `data:` URI (RFC 2397)."""
    head, comma, body = uri.partition(",")
    if not comma:
        raise _broken("a data: URI has no comma", where)
    try:
        return base64.b64decode(body, validate=True) if head.endswith(";base64") else unquote(body).encode("latin-1")
    except (binascii.Error, UnicodeEncodeError):
        raise _broken("a data: URI cannot be decoded", where) from None


@dataclass
class GltfBuffers:
    """Access to the binary data of one document."""

    document: Document
    folder: BundleFolder
    binary: bytes | None
    _loaded: dict[int, memoryview] = field(default_factory=dict)
    _files: dict[str, bytes] = field(default_factory=dict)
    _decoded: dict[int, bytes] = field(default_factory=dict)

    def file(self, uri: str, what: str) -> bytes:
        """The bytes behind a URI: inline data or a file of the bundle."""
        if uri.startswith("data:"):
            return decode_data_uri(uri, self.folder.origin)
        return self.folder.read(unquote(uri), what)

    def view(self, index: int) -> memoryview:
        """The bytes of a buffer view."""
        where = self.folder.origin
        view = pick(self.document.buffer_views, index, "buffer view", where)
        packed = next((view.extensions[name] for name in MESHOPT if name in view.extensions), None)
        if packed is not None:
            return self._unpacked(index, packed)
        data = self._buffer(view.buffer)
        if view.byte_offset + view.byte_length > len(data):
            raise _broken(
                f"buffer view {index} ends at byte {view.byte_offset + view.byte_length} of a buffer of {len(data)}",
                where,
            )
        return data[view.byte_offset : view.byte_offset + view.byte_length]

    def _unpacked(self, index: int, content: dict[str, Any]) -> memoryview:
        """The bytes of a buffer view that meshopt compresses; each is decoded once."""
        if index not in self._decoded:
            where = self.folder.origin
            view = parse_extension(Meshopt, content, f"{where}: {MESHOPT[0]}")
            data = self._buffer(view.buffer)
            if view.byte_offset + view.byte_length > len(data):
                raise _broken(f"the compressed bytes of buffer view {index} leave their buffer", where)
            part = data[view.byte_offset : view.byte_offset + view.byte_length]
            self._decoded[index] = decode_meshopt(part, view, index, where)
            read = sum(map(len, self._decoded.values()))
            check_count(read, MAX_READ_BYTES, "bytes in its compressed buffers", where)
        return memoryview(self._decoded[index])

    def width(self, index: int) -> int:
        """Components of an element of accessor `index`."""
        return COMPONENTS[pick(self.document.accessors, index, "accessor", self.folder.origin).type]

    def scaled(self, index: int, values: Array) -> npt.NDArray[np.float64]:
        """`values` as accessor `index` would have them: integers mapped to [0, 1] or [-1, 1] where it is normalised."""
        return _scaled(pick(self.document.accessors, index, "accessor", self.folder.origin), values)

    def floats(self, index: int, width: int, what: str) -> npt.NDArray[np.float64]:
        """Accessor `index` as [count, width], normalised integers mapped to [0, 1] or [-1, 1]."""
        return _scaled(*self._read(index, width, what))

    def indices(self, index: int) -> npt.NDArray[np.int64]:
        """Accessor `index` as unsigned integers [count]."""
        accessor, values = self._read(index, 1, "indices")
        if accessor.component_type not in (5121, 5123, 5125):
            raise _broken(f"accessor {index} (indices) does not hold unsigned integers", self.folder.origin)
        return values[:, 0].astype(np.int64)

    def _buffer(self, index: int) -> memoryview:
        if index not in self._loaded:
            where = self.folder.origin
            buffer = pick(self.document.buffers, index, "buffer", where)
            if buffer.uri is not None:
                if buffer.uri not in self._files:
                    self._files[buffer.uri] = self.file(buffer.uri, "buffer")
                    read = sum(map(len, self._files.values()))
                    check_count(read, MAX_READ_BYTES, "bytes in its buffers", where)
                data = self._files[buffer.uri]
            elif index == 0 and self.binary is not None:
                data = self.binary
            else:
                raise _broken(f"buffer {index} has neither a URI nor a binary chunk", where)
            if len(data) < buffer.byte_length:
                raise _broken(f"buffer {index} should have {buffer.byte_length} bytes and has {len(data)}", where)
            self._loaded[index] = memoryview(data)[: buffer.byte_length]
        return self._loaded[index]

    def _read(self, index: int, width: int, what: str) -> tuple[Accessor, Array]:
        where = self.folder.origin
        accessor = pick(self.document.accessors, index, "accessor", where)
        label = f"accessor {index} ({what})"
        if COMPONENTS[accessor.type] != width:
            raise _broken(f"{label} is {accessor.type}, not of {width} components", where)
        check_count(accessor.count, MAX_VERTICES, f"elements in {label}", where)
        dtype = np.dtype(DTYPES[accessor.component_type])
        if accessor.buffer_view is None:
            check_count(accessor.count * width, MAX_ZEROS, f"numbers in {label}, which has no bytes", where)
            values = np.zeros((accessor.count, width), dtype)
        else:
            stride = pick(self.document.buffer_views, accessor.buffer_view, "buffer view", where).byte_stride
            data = self.view(accessor.buffer_view)
            values = _strided(data, accessor.byte_offset, stride, accessor.count, width, dtype, label, where)
        if accessor.sparse is not None:
            values = self._with_sparse(accessor, values, label)
        return accessor, values

    def _with_sparse(self, accessor: Accessor, values: Array, label: str) -> Array:
        assert accessor.sparse is not None
        where, sparse = self.folder.origin, accessor.sparse
        if sparse.count > accessor.count:
            raise _broken(f"{label} is sparse with {sparse.count} of {accessor.count} values", where)
        kind = np.dtype(DTYPES[sparse.indices.component_type])
        data = self.view(sparse.indices.buffer_view)
        rows = _strided(data, sparse.indices.byte_offset, None, sparse.count, 1, kind, label, where)[:, 0]
        rows = rows.astype(np.int64)
        if len(rows) and (rows.max() >= accessor.count or (np.diff(rows) <= 0).any()):
            raise _broken(f"the sparse indices of {label} do not rise or leave it", where)
        data = self.view(sparse.values.buffer_view)
        fresh = _strided(
            data, sparse.values.byte_offset, None, sparse.count, values.shape[1], values.dtype, label, where
        )
        out = values.copy()
        out[rows] = fresh
        return out


def _scaled(accessor: Accessor, values: Array) -> npt.NDArray[np.float64]:
    out = values.astype(np.float64)
    if accessor.component_type == 5126 or not accessor.normalized:
        return out
    largest = np.iinfo(np.dtype(DTYPES[accessor.component_type])).max
    return np.asarray(np.maximum(out / largest, -1.0))


def _strided(
    data: memoryview,
    offset: int,
    stride: int | None,
    count: int,
    width: int,
    dtype: np.dtype[np.generic],
    label: str,
    where: str,
) -> Array:
    size = width * dtype.itemsize
    step = size if stride is None else stride
    if step < size or offset + (count - 1) * step + size > len(data):
        raise _broken(f"{label} leaves its buffer view of {len(data)} bytes", where)
    rows = np.ndarray((count, size), np.uint8, buffer=data, offset=offset, strides=(step, 1))
    return np.ascontiguousarray(rows).view(dtype).reshape(count, width)


def _broken(detail: str, where: str) -> InputError:
    return InputError(f"is broken: {detail}", where=where, remedy="Export it again.")
