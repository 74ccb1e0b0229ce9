"""How large the arrays of a binary FBX file become when they are inflated, as it announces, before they are.

By the format's public description (Blender Foundation, "FBX binary file format specification"): records follow each
other, those in a record behind its properties. Arrays of numbers may be compressed with deflate, a thousandfold at
best, which only a file that means harm comes near as a whole.
"""

import struct
from typing import Final

from kiln_schemas.errors import TooLarge

MAGIC: Final = b"Kaydara FBX Binary  \0\x1a"
HEAD: Final = 27
WIDE: Final = 7500
"""The version from which on offsets have 64 bits."""
NUMBERS: Final = {b"Y"[0]: 2, b"C"[0]: 1, b"B"[0]: 1, b"I"[0]: 4, b"F"[0]: 4, b"D"[0]: 8, b"L"[0]: 8}
ARRAYS: Final = {b"f"[0]: 4, b"d"[0]: 8, b"l"[0]: 8, b"i"[0]: 4, b"b"[0]: 1, b"c"[0]: 1}
MAX_RATIO: Final = 256
"""Bytes that a byte of the file may become."""
FREE_BYTES: Final = 64 << 20
"""What any file may become."""


def check_inflation(data: bytes, where: str) -> None:
    """Raise TooLarge where the arrays would become more than the bounds."""
    most, found = MAX_RATIO * len(data) + FREE_BYTES, inflated_bytes(data)
    if found > most:
        raise TooLarge(
            f"its arrays are {found} bytes when they are inflated, at most {most} are read of a file of its size",
            where=where,
            remedy="Export it again without compression.",
        )


def inflated_bytes(data: bytes) -> int:
    """Sum over all arrays; what is before the first record that makes no sense, of a file that ufbx will refuse."""
    if not data.startswith(MAGIC) or len(data) < HEAD:
        return 0
    order = ">" if data[22] else "<"
    (version,) = struct.unpack_from(order + "I", data, 23)
    record = struct.Struct(order + ("QQQB" if version >= WIDE else "IIIB"))
    size, counts = struct.Struct(order + "I"), struct.Struct(order + "III")
    total, at = 0, HEAD
    try:
        while at + record.size <= len(data):
            end, properties, _, name = record.unpack_from(data, at)
            at += record.size + name
            if not end:
                continue  # ends a list of records
            for _ in range(properties):
                kind, at = data[at], at + 1
                if kind in NUMBERS:
                    at += NUMBERS[kind]
                elif kind in ARRAYS:
                    length, _, stored = counts.unpack_from(data, at)
                    total += length * ARRAYS[kind]
                    at += counts.size + stored
                else:
                    at += size.size + size.unpack_from(data, at)[0]
    except (struct.error, IndexError):
        pass
    return total
