"""KTX2: round trips through our reader and npm's ktx-parse, and a validator that notices every damaged field."""

import hashlib
import struct
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import zstandard

from kiln_schemas.errors import InputError, InternalError
from kiln_workers.package import ktx2
from kiln_workers.package.ktx2_validate import validate


def halves(*shape: int) -> np.ndarray:
    return np.random.default_rng(0).normal(scale=50.0, size=shape).astype(np.float16)


TEXTURES = {
    "plane": ktx2.texture_2d(halves(5, 7, 4), {}),
    "array": ktx2.texture_array(halves(6, 5, 7, 4), {"lightkiln.lobes": "3", "a key": "värde"}),
    "array of one": ktx2.texture_array(halves(1, 3, 3, 4), {}),
    "cube": ktx2.texture_cube([halves(6, n, n, 4) for n in (8, 4, 2, 1)], {"lightkiln.lod": "x"}),
    "odd mips": ktx2.Texture(tuple(halves(2, 1, h, w, 4) for h, w in ((5, 9), (2, 4), (1, 2), (1, 1))), True, {}),
}


@pytest.mark.parametrize("supercompress", [False, True])
@pytest.mark.parametrize("name", TEXTURES)
def test_reader_returns_what_was_written(name: str, supercompress: bool, tmp_path: Path) -> None:
    texture = TEXTURES[name]
    ktx2.write(tmp_path / "t.ktx2", texture, supercompress=supercompress)
    read = ktx2.read(tmp_path / "t.ktx2")
    assert (read.is_array, len(read.levels)) == (texture.is_array, len(texture.levels))
    for mine, theirs in zip(texture.levels, read.levels, strict=True):
        np.testing.assert_array_equal(mine, theirs)
    assert {key: read.metadata[key] for key in texture.metadata} == dict(texture.metadata)
    assert read.metadata["KTXorientation"] == "rd"
    assert read.metadata["KTXwriter"].startswith("lightkiln ")


@pytest.mark.parametrize("supercompress", [False, True])
@pytest.mark.parametrize("name", TEXTURES)
def test_ktx_parse_agrees_and_writes_the_same_bytes(name, supercompress, tmp_path, node_tools) -> None:
    texture = TEXTURES[name]
    mine, theirs = tmp_path / "mine.ktx2", tmp_path / "theirs.ktx2"
    ktx2.write(mine, texture, supercompress=supercompress)
    found = node_tools.script("ktx_round_trip.mjs", mine, theirs)
    assert (found["vkFormat"], found["typeSize"], found["pixelDepth"]) == (97, 2, 0)
    assert (found["pixelWidth"], found["pixelHeight"]) == (texture.width, texture.height)
    assert (found["layerCount"], found["faceCount"]) == (texture.layers if texture.is_array else 0, texture.faces)
    assert found["supercompressionScheme"] == (2 if supercompress else 0)
    for level, read in zip(texture.levels, found["levels"], strict=True):
        assert read["uncompressed"] == level.nbytes
        if not supercompress:
            assert read["sha256"] == hashlib.sha256(level.tobytes()).hexdigest()
    assert [sample["channelType"] & 15 for sample in found["descriptor"][0]["samples"]] == [0, 1, 2, 15]
    # An independent writer lays the same container out in the same bytes, level alignment and padding included.
    assert theirs.read_bytes() == mine.read_bytes()
    assert validate(theirs.read_bytes()) == []


def test_small_mips_come_first_and_are_aligned() -> None:
    data = ktx2.encode(TEXTURES["odd mips"])
    offsets = [struct.unpack_from("<Q", data, 80 + 24 * level)[0] for level in range(4)]
    assert offsets == sorted(offsets, reverse=True)
    assert all(offset % 8 == 0 for offset in offsets)


HEADER = {
    "vkFormat": 12,
    "typeSize": 16,
    "pixelWidth": 20,
    "pixelHeight": 24,
    "pixelDepth": 28,
    "layerCount": 32,
    "faceCount": 36,
    "levelCount": 40,
    "supercompressionScheme": 44,
    "dfdByteOffset": 48,
    "dfdByteLength": 52,
    "kvdByteOffset": 56,
    "kvdByteLength": 60,
    "sgdByteOffset": 64,
    "sgdByteLength": 72,
    "byteOffset": 80,
    "byteLength": 88,
    "uncompressedByteLength": 96,
}


@pytest.mark.parametrize("name", HEADER)
@pytest.mark.parametrize("change", [1, -1, 1 << 20])
def test_validator_refuses_any_other_number_in_the_header(name: str, change: int) -> None:
    data = bytearray(ktx2.encode(TEXTURES["array"]))
    assert validate(bytes(data)) == []
    (value,) = struct.unpack_from("<I", data, HEADER[name])
    struct.pack_into("<I", data, HEADER[name], (value + change) % 2**32)
    assert validate(bytes(data))


def test_validator_refuses_every_damaged_byte_of_the_descriptor() -> None:
    data = ktx2.encode(TEXTURES["array"])
    start, length = struct.unpack_from("<2I", data, 48)
    for at in range(start, start + length):
        damaged = bytearray(data)
        damaged[at] ^= 0x40
        assert validate(bytes(damaged)), f"byte {at - start} of the descriptor"


def test_validator_refuses_every_truncation() -> None:
    data = ktx2.encode(ktx2.texture_array(halves(2, 2, 2, 4), {"k": "v"}))
    assert all(validate(data[:length]) for length in range(len(data)))
    assert validate(data + b"\0")


@pytest.mark.parametrize(
    ("before", "after", "words"),
    [
        (b"KTXwriter\0", b"KTXwrites\0", "reserved"),
        (b"KTXorientation\0rd", b"KTXorientation\0xx", "KTXorientation"),
        (b"KTXorientation\0rd", b"ZTXorientation\0rd", "sorted"),
        (b"a key\0v\0", b"a key\1v\1", "NUL"),
        (b"a key\0v", b"\xff key\0v", "UTF-8"),
    ],
)
def test_validator_refuses_bad_key_values(before: bytes, after: bytes, words: str) -> None:
    data = ktx2.encode(ktx2.texture_2d(halves(2, 2, 4), {"a key": "v"}))
    assert data.count(before) == 1
    assert any(words in fault for fault in validate(data.replace(before, after)))


def test_validator_refuses_padding_that_is_not_zero() -> None:
    data = bytearray(ktx2.encode(ktx2.texture_2d(halves(2, 2, 4), {"abc": "d"})))  # a pair of 6 bytes, 2 of padding
    at = bytes(data).index(b"abc\0d\0") + 6
    data[at] = 1
    assert any("valuePadding" in fault for fault in validate(bytes(data)))


def test_validator_refuses_a_broken_zstandard_frame() -> None:
    data = bytearray(ktx2.encode(TEXTURES["array"], supercompress=True))
    (offset,) = struct.unpack_from("<Q", data, 80)
    data[offset] ^= 0xFF
    assert any("Zstandard" in fault for fault in validate(bytes(data)))


def test_reader_names_file_and_fault(tmp_path: Path) -> None:
    path = tmp_path / "broken.ktx2"
    path.write_bytes(ktx2.encode(TEXTURES["plane"])[:-1])
    with pytest.raises(InputError, match=r"broken\.ktx2: level 0: the data are cut off"):
        ktx2.read(path)


def test_writer_refuses_infinities_and_wrong_mips(tmp_path: Path) -> None:
    bad = halves(2, 2, 4)
    bad[0, 0, 0] = np.inf
    with pytest.raises(InternalError, match="not finite"):
        ktx2.write(tmp_path / "t.ktx2", ktx2.texture_2d(bad, {}))
    with pytest.raises(InternalError, match="mip 1"):
        ktx2.write(tmp_path / "t.ktx2", ktx2.texture_cube([halves(6, 8, 8, 4), halves(6, 3, 3, 4)], {}))
    assert list(tmp_path.iterdir()) == []


def bomb(side: int, layers: int, inflated: int) -> bytes:
    """A valid file that declares `layers` of side x side texels and whose frame inflates to `inflated` zeros."""
    small = ktx2.encode(ktx2.texture_array(np.zeros((2, 4, 4, 4), np.float16), {}), supercompress=True)
    data = bytearray(small)
    struct.pack_into("<2I", data, 20, side, side)
    struct.pack_into("<I", data, 32, layers)
    offset, _, _ = struct.unpack_from("<3Q", data, 80)
    compressor = zstandard.ZstdCompressor(level=19).compressobj()
    zeros = bytes(1 << 20)
    frame = b"".join([compressor.compress(zeros) for _ in range(inflated >> 20)]) + compressor.flush()
    struct.pack_into("<3Q", data, 80, offset, len(frame), 8 * side * side * layers)
    return bytes(data[:offset]) + frame


_READ = """
import resource, sys
from pathlib import Path
from kiln_schemas.errors import InputError
from kiln_workers.package import ktx2
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
try:
    ktx2.read(Path(sys.argv[1]), int(sys.argv[2]) or None)
except InputError as error:
    print(error)
print((resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) // 1024)
"""


@pytest.mark.parametrize(
    ("side", "layers", "inflated", "most", "words"),
    [(8192, 6, 3 << 30, 10**6, "the package's settings allow 1000000"), (8, 2, 3 << 30, 0, "inflates to more than")],
)
def test_a_small_file_that_inflates_to_gigabytes_takes_no_memory(
    tmp_path: Path, side: int, layers: int, inflated: int, most: int, words: str
) -> None:
    """3 GiB of zeros in 100 KB: declared and refused by the settings, or not declared and cut short."""
    path = tmp_path / "bomb.ktx2"
    path.write_bytes(bomb(side, layers, inflated))
    assert path.stat().st_size < 400_000
    command = [sys.executable, "-c", _READ, str(path), str(most)]
    told, grown = subprocess.run(command, capture_output=True, text=True, check=True).stdout.splitlines()
    assert words in told and int(grown) < 100
