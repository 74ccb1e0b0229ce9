"""A deterministic container for arrays with a JSON header: what the scene archive and the texel map are stored in.

Layout: an 8-byte magic, the header's length (little-endian u64), the header (canonical JSON), then the arrays, each
starting at a multiple of 64 bytes. The same content gives the same bytes on every machine, nothing is executed on
reading (no pickle), and nothing is allocated beyond the bytes that are there: arrays are views into them.
"""

import json
import math
import mmap
from collections.abc import Iterator, Mapping
from typing import Any, BinaryIO, Final

import numpy as np
import numpy.typing as npt

from kiln_schemas.errors import InputError

Array = npt.NDArray[Any]

MAGIC: Final = b"KILNARR1"
ALIGNMENT: Final = 64
DTYPES: Final = frozenset({"|u1", "<f2", "<f4", "<f8", "<i4", "<i8"})
MAX_HEADER_BYTES: Final = 256 << 20


def chunks(kind: str, body: Mapping[str, Any], arrays: Mapping[str, Array]) -> Iterator[bytes]:
    """The container's bytes in pieces; `kind` tells containers of different content apart."""
    stored = {name: np.ascontiguousarray(array) for name, array in arrays.items()}
    yield _head(kind, body, {name: (array.dtype.str, array.shape) for name, array in stored.items()})[0]
    for array in stored.values():
        yield array.tobytes() + b"\0" * (_padded(array.nbytes) - array.nbytes)


def write_frame(
    file: BinaryIO, kind: str, body: Mapping[str, Any], arrays: Mapping[str, tuple[str, tuple[int, ...]]]
) -> dict[str, int]:
    """Write a container of zeros for arrays of a dtype and shape; where in the file each of them begins."""
    head, offsets, end = _head(kind, body, arrays)
    file.write(head)
    file.truncate(len(head) + end)
    return {name: len(head) + offset for name, offset in offsets.items()}


def _head(
    kind: str, body: Mapping[str, Any], arrays: Mapping[str, tuple[str, tuple[int, ...]]]
) -> tuple[bytes, dict[str, int], int]:
    """What comes before the arrays; where each of them begins after that, and where the last one ends."""
    table: dict[str, Any] = {}
    end = 0
    for name, (dtype, shape) in arrays.items():
        if dtype not in DTYPES:
            raise TypeError(f"array '{name}' of {dtype} has no place in a container")
        table[name] = {"dtype": dtype, "shape": list(shape), "offset": end}
        end += _padded(math.prod(shape) * np.dtype(dtype).itemsize)
    header = json.dumps(
        {"kind": kind, "body": body, "arrays": table}, sort_keys=True, separators=(",", ":"), allow_nan=False
    ).encode()
    header += b" " * (_padded(len(MAGIC) + 8 + len(header)) - len(MAGIC) - 8 - len(header))
    offsets = {name: int(entry["offset"]) for name, entry in table.items()}
    return MAGIC + len(header).to_bytes(8, "little") + header, offsets, end


def pack(kind: str, body: Mapping[str, Any], arrays: Mapping[str, Array]) -> bytes:
    """The container's bytes."""
    return b"".join(chunks(kind, body, arrays))


def unpack(kind: str, data: bytes | mmap.mmap) -> tuple[dict[str, Any], dict[str, Array]]:
    """Body and arrays (read-only views); InputError if the bytes are not a container of this kind."""
    start = len(MAGIC) + 8
    length = int.from_bytes(data[len(MAGIC) : start], "little")
    if data[: len(MAGIC)] != MAGIC or length > min(MAX_HEADER_BYTES, len(data) - start):
        raise _broken(kind, "it has no header")
    try:
        header = json.loads(data[start : start + length])
        if header["kind"] != kind:
            raise _broken(kind, f"it is a '{header['kind']}'")
        body, table = dict(header["body"]), dict(header["arrays"])
        arrays = {str(name): _view(kind, data, start + length, entry) for name, entry in table.items()}
    except (ValueError, KeyError, TypeError, RecursionError):
        raise _broken(kind, "its header does not fit the format") from None
    return body, arrays


def _view(kind: str, data: bytes | mmap.mmap, start: int, entry: Mapping[str, Any]) -> Array:
    shape = tuple(int(side) for side in entry["shape"])
    offset = int(entry["offset"])
    if entry["dtype"] not in DTYPES or min(shape, default=0) < 0 or offset < 0 or len(shape) > 4:
        raise _broken(kind, "an array's type or shape is not allowed")
    dtype = np.dtype(entry["dtype"])
    count = math.prod(shape)
    if start + offset + count * dtype.itemsize > len(data):
        raise _broken(kind, "an array leaves the data")
    return np.frombuffer(data, dtype, count, start + offset).reshape(shape)


def _padded(size: int) -> int:
    return -(-size // ALIGNMENT) * ALIGNMENT


def _broken(kind: str, detail: str) -> InputError:
    return InputError(f"the bytes are not a {kind}: {detail}", where=kind, remedy="Make it again from the scene.")
