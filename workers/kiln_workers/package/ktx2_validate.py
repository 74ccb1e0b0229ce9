"""Structural validator of half-float KTX 2.0 files, written from the specification and not from our writer.

It walks the file as the Khronos KTX File Format Specification 2.0 lays it out (section numbers are not stable between
revisions, so rules are named) and returns every breach as a sentence. It accepts what lightkiln uses and
refuses the rest: RGBA16F texels in 2D textures, 2D arrays and cube maps, plain or with Zstandard.
"""

import os
import re
import struct
from dataclasses import dataclass, field
from typing import BinaryIO, Final

import zstandard

_FIRST_LEVEL_AT: Final = 80
_HEADER_FIELDS: Final = (
    "vkFormat",
    "typeSize",
    "pixelWidth",
    "pixelHeight",
    "pixelDepth",
    "layerCount",
    "faceCount",
    "levelCount",
    "supercompressionScheme",
    "dfdByteOffset",
    "dfdByteLength",
    "kvdByteOffset",
    "kvdByteLength",
    "sgdByteOffset",
    "sgdByteLength",
)
PIECE_BYTES: Final = 1024
"""A frame is inflated in pieces that each give 32 MiB at most: a block of 128 KiB takes 4 bytes (RFC 8878, 3.1.1.2)."""
WINDOW_BYTES: Final = 2**27
_RESERVED_KEYS: Final = {
    "KTXcubemapIncomplete",
    "KTXorientation",
    "KTXglFormat",
    "KTXdxgiFormat__",
    "KTXmetalPixelFormat",
    "KTXswizzle",
    "KTXwriter",
    "KTXwriterScParams",
    "KTXastcDecodeMode",
    "KTXanimData",
}


class FileBytes:
    """A file's bytes, of which only those are read that are asked for."""

    def __init__(self, file: BinaryIO) -> None:
        self._file = file
        self._length = file.seek(0, os.SEEK_END)

    def __len__(self) -> int:
        return self._length

    def __getitem__(self, part: slice) -> bytes:
        first, last, _ = part.indices(self._length)
        self._file.seek(first)
        return self._file.read(max(last - first, 0))


@dataclass
class _File:
    """The bytes under inspection, the header's fields by name, and the faults found so far."""

    data: bytes | FileBytes
    head: dict[str, int]
    faults: list[str] = field(default_factory=list)

    def require(self, holds: bool, sentence: str) -> bool:
        if not holds:
            self.faults.append(sentence)
        return holds

    def unpack(self, layout: str, offset: int) -> tuple[int, ...]:
        return struct.unpack(layout, self.data[offset : offset + struct.calcsize(layout)])

    def inside(self, offset: int, length: int) -> bool:
        return offset >= 0 and offset + length <= len(self.data)


def validate(data: bytes | FileBytes) -> list[str]:
    """Every breach of the specification in a KTX 2.0 file's bytes, as sentences; empty for a valid file."""
    if data[:12] != bytes((0xAB, 0x4B, 0x54, 0x58, 0x20, 0x32, 0x30, 0xBB, 0x0D, 0x0A, 0x1A, 0x0A)):
        return ["the first 12 bytes are not the KTX 2.0 identifier"]
    if len(data) < _FIRST_LEVEL_AT:
        return [f"the file ends inside the header, after {len(data)} bytes"]
    file = _File(data, dict(zip(_HEADER_FIELDS, struct.unpack("<13I2Q", data[12:_FIRST_LEVEL_AT]), strict=True)))
    _check_header(file)
    if file.faults:
        return file.faults
    _check_sections(file)
    if file.faults:
        return file.faults
    _check_descriptor(file)
    _check_key_values(file)
    _check_levels(file)
    return file.faults


def _check_header(file: _File) -> None:
    """Format, dimensions and texture type."""
    head = file.head
    file.require(head["vkFormat"] == 97, f"vkFormat is {head['vkFormat']}, not 97 (R16G16B16A16_SFLOAT)")
    file.require(head["typeSize"] == 2, f"typeSize is {head['typeSize']}, not 2 as 16-bit components need")
    file.require(head["pixelWidth"] > 0, "pixelWidth is 0")
    file.require(head["pixelHeight"] > 0, "pixelHeight is 0: 1D textures are not used here")
    file.require(head["pixelDepth"] == 0, f"pixelDepth is {head['pixelDepth']}: volumes are not used here")
    file.require(head["faceCount"] in (1, 6), f"faceCount is {head['faceCount']}, neither 1 nor 6")
    if head["faceCount"] == 6:
        file.require(head["pixelWidth"] == head["pixelHeight"], "the faces of the cube map are not square")
    most = max(head["pixelWidth"], head["pixelHeight"]).bit_length()
    file.require(
        1 <= head["levelCount"] <= most, f"levelCount is {head['levelCount']}; this size takes 1 to {most} levels"
    )
    scheme = head["supercompressionScheme"]
    file.require(scheme in (0, 2), f"supercompressionScheme is {scheme}; only 0 and 2 (Zstandard) are used here")


def _check_sections(file: _File) -> None:
    """Order, alignment and bounds of descriptor, key/value data and global data."""
    head = file.head
    after_index = _FIRST_LEVEL_AT + 24 * head["levelCount"]
    file.require(len(file.data) >= after_index, "the file ends inside the level index")
    file.require(
        head["dfdByteOffset"] == after_index,
        f"dfdByteOffset is {head['dfdByteOffset']}; the level index ends at {after_index}",
    )
    file.require(file.inside(head["dfdByteOffset"], head["dfdByteLength"]), "the data format descriptor is cut off")
    after_descriptor = head["dfdByteOffset"] + head["dfdByteLength"]
    if head["kvdByteLength"]:
        file.require(
            head["kvdByteOffset"] == after_descriptor,
            f"kvdByteOffset is {head['kvdByteOffset']}; the descriptor ends at {after_descriptor}",
        )
        file.require(file.inside(head["kvdByteOffset"], head["kvdByteLength"]), "the key/value data are cut off")
    else:
        file.require(head["kvdByteOffset"] == 0, "kvdByteOffset is not 0 though there are no key/value data")
    file.require(
        head["sgdByteOffset"] == 0 and head["sgdByteLength"] == 0,
        "there are supercompression global data, which neither scheme 0 nor scheme 2 has",
    )


def _check_descriptor(file: _File) -> None:
    """The data format descriptor must be that of R16G16B16A16_SFLOAT with linear Rec.709 colour."""
    start, length = file.head["dfdByteOffset"], file.head["dfdByteLength"]
    if not file.require(length == 92, f"dfdByteLength is {length}; one block with four samples takes 92"):
        return
    words = file.unpack("<23I", start)
    vendor_and_type, version, block_size = words[1], words[2] & 0xFFFF, words[2] >> 16
    file.require(words[0] == length, f"dfdTotalSize is {words[0]}, dfdByteLength {length}")
    file.require(vendor_and_type == 0, "the descriptor block is not Khronos' basic one")
    file.require(version == 2, f"the descriptor's version is {version}, not 2")
    file.require(block_size == 88, f"descriptorBlockSize is {block_size}, not 24 + 4 x 16")
    names = ("colorModel", "colorPrimaries", "transferFunction", "flags")
    for shift, (name, wanted) in enumerate(zip(names, (1, 1, 1, 0), strict=True)):
        found = words[3] >> 8 * shift & 0xFF
        file.require(found == wanted, f"{name} is {found}, not {wanted}")
    file.require(words[4] == 0, "texelBlockDimension is not 1 x 1 x 1 x 1")
    file.require((words[5], words[6]) == (8, 0), "bytesPlane is not 8, 0, 0, 0, 0, 0, 0, 0")
    for number, channel in enumerate((0, 1, 2, 15)):
        first, position, lower, upper = words[7 + 4 * number : 11 + 4 * number]
        name = f"sample {number}"
        file.require(first & 0xFFFF == 16 * number, f"{name}: bitOffset is {first & 0xFFFF}, not {16 * number}")
        file.require(first >> 16 & 0xFF == 15, f"{name}: bitLength is not 16")
        file.require(first >> 24 & 0x0F == channel, f"{name}: channelType is {first >> 24 & 0x0F}, not {channel}")
        file.require(first >> 28 == 0xC, f"{name}: qualifiers are not signed and float")
        file.require(position == 0, f"{name}: samplePosition is not 0")
        file.require((lower, upper) == (0xBF800000, 0x3F800000), f"{name}: sampleLower and sampleUpper are not -1, 1")


def _check_key_values(file: _File) -> None:
    """Lengths, UTF-8 keys, order, padding and the reserved keys' values."""
    at, end = file.head["kvdByteOffset"], file.head["kvdByteOffset"] + file.head["kvdByteLength"]
    pairs: dict[str, bytes] = {}
    previous = ""
    while at < end:
        if not file.require(end - at >= 4, "the key/value data end inside a length"):
            return
        (length,) = file.unpack("<I", at)
        pair = file.data[at + 4 : at + 4 + length]
        if not file.require(2 <= length <= end - at - 4, f"a key/value pair has length {length}"):
            return
        raw, nul, value = pair.partition(b"\0")
        if not file.require(nul == b"\0" and raw != b"", "a key is empty or has no NUL terminator"):
            return
        padding = file.data[at + 4 + length : at + 4 + length + -length % 4]
        file.require(not any(padding), "valuePadding is not 0")
        key = raw.decode("utf-8", errors="replace")
        file.require("�" not in key and not raw.startswith(b"\xef\xbb\xbf"), f"key {key!r} is not UTF-8 without a BOM")
        file.require(key not in pairs, f"key {key} appears twice")
        file.require(previous <= key, f"key {key} comes after {previous}: keys are not sorted")
        reserved = key[:3] in ("KTX", "ktx")
        file.require(not reserved or key in _RESERVED_KEYS, f"key {key} is reserved and not in the specification")
        pairs[key], previous = value, key
        at += 4 + length + -length % 4
    file.require(at == end, "the last pair's padding is not counted in kvdByteLength")
    orientation = pairs.get("KTXorientation", b"rd\0")
    file.require(re.fullmatch(rb"[rl][du]\0", orientation) is not None, f"KTXorientation is {orientation!r}")
    if file.head["faceCount"] == 6:
        file.require(orientation == b"rd\0", "a cube map's KTXorientation is not rd")
    file.require(pairs.get("KTXwriter", b"").endswith(b"\0"), "KTXwriter is missing or not NUL-terminated")
    for key in ("KTXglFormat", "KTXdxgiFormat__", "KTXmetalPixelFormat"):
        file.require(key not in pairs, f"{key} must not be used with a vkFormat")


def _check_levels(file: _File) -> None:
    """Sizes, order (smallest first), alignment and padding of the mip levels, and that they fill the file."""
    head = file.head
    compressed = head["supercompressionScheme"] == 2
    at = head["kvdByteOffset"] + head["kvdByteLength"] or head["dfdByteOffset"] + head["dfdByteLength"]
    for level in reversed(range(head["levelCount"])):
        offset, length, plain = file.unpack("<3Q", _FIRST_LEVEL_AT + 24 * level)
        width, height = max(1, head["pixelWidth"] >> level), max(1, head["pixelHeight"] >> level)
        wanted = 8 * width * height * head["faceCount"] * max(1, head["layerCount"])
        name = f"level {level}"
        file.require(plain == wanted, f"{name}: uncompressedByteLength is {plain}, the images take {wanted}")
        aligned = at if compressed else at + -at % 8
        file.require(offset == aligned, f"{name}: byteOffset is {offset}, the data before it end at {aligned}")
        if not file.require(file.inside(offset, length), f"{name}: the data are cut off"):
            return
        file.require(not any(file.data[at:offset]), f"{name}: mipPadding is not 0")
        if compressed:
            _check_frame(file, name, offset, length, plain)
        else:
            file.require(length == plain, f"{name}: byteLength is {length}, uncompressedByteLength {plain}")
        at = offset + length
    file.require(at == len(file.data), f"{len(file.data) - at} bytes follow the last level")


def _check_frame(file: _File, name: str, offset: int, length: int, plain: int) -> None:
    """A supercompressed level must be one Zstandard frame that inflates to the stated length."""
    inflater = zstandard.ZstdDecompressor(max_window_size=WINDOW_BYTES).decompressobj()
    found, at, end = 0, offset, offset + length
    try:
        while at < end and not inflater.eof and found <= plain:
            found += len(inflater.decompress(file.data[at : min(at + PIECE_BYTES, end)]))
            at += PIECE_BYTES
    except zstandard.ZstdError as error:
        file.require(False, f"{name}: not a Zstandard frame ({error})")
        return
    if not file.require(found <= plain, f"{name}: inflates to more than its uncompressedByteLength of {plain}"):
        return
    whole = inflater.eof and not inflater.unused_data and at >= end
    file.require(whole, f"{name}: the Zstandard frame is cut off or followed by more")
    file.require(found == plain, f"{name}: inflates to {found} bytes, uncompressedByteLength is {plain}")
