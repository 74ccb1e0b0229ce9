"""Draco, meshopt, WebP and KTX2: what they decode to, and what is refused before a decoder is given it.

Encoders are those of the same public packages, except for KTX2, whose UASTC blocks of one colour are put together here.
"""

import json
import struct

import DracoPy
import meshopt
import numpy as np
import OpenImageIO as oiio
import pytest

from kiln_schemas.errors import InputError, TooLarge
from kiln_workers.scene.geometry import face_areas
from kiln_workers.scene.images import decode_image
from kiln_workers.scene.load import load_scene

GRID = np.stack(np.meshgrid(np.arange(9.0), np.arange(9.0)), axis=-1).reshape(-1, 2)
POSITIONS = np.column_stack([GRID, 0.25 * np.sin(GRID).sum(axis=1)]).astype(np.float32)
CELLS = (np.arange(8)[:, None] * 9 + np.arange(8)).reshape(-1, 1)
FACES = np.concatenate([CELLS + np.array(corners) for corners in ([0, 1, 10], [0, 10, 9])]).astype(np.uint32)
COLOURS = np.tile(np.uint8([255, 128, 0]), (81, 1))


def document(accessors, views, primitive, data, **more):
    return {
        "asset": {"version": "2.0"},
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": len(data), "uri": "data.bin"}],
        "meshes": [{"primitives": [primitive]}],
        "nodes": [{"mesh": 0}],
        **more,
    }


def write(tmp_path, content, data):
    (tmp_path / "data.bin").write_bytes(data)
    (tmp_path / "a.gltf").write_text(json.dumps(content))
    return load_scene(tmp_path, "a.gltf")


def draco_file(data: bytes, required: bool):
    accessors = [
        {"componentType": 5126, "count": 81, "type": "VEC3"},
        {"componentType": 5125, "count": 384, "type": "SCALAR"},
        {"componentType": 5121, "count": 81, "type": "VEC3", "normalized": True},
    ]
    packed = {"bufferView": 0, "attributes": {"POSITION": 0, "COLOR_0": 1}}
    attributes = {"POSITION": 0, "COLOR_0": 2}
    primitive = {"attributes": attributes, "indices": 1, "extensions": {"KHR_draco_mesh_compression": packed}}
    names = {"extensionsUsed": ["KHR_draco_mesh_compression"]}
    if required:
        names["extensionsRequired"] = names["extensionsUsed"]
    return document(accessors, [{"buffer": 0, "byteLength": len(data)}], primitive, data, **names)


def encoded_draco() -> bytes:
    data = DracoPy.encode(POSITIONS, FACES, colors=COLOURS, quantization_bits=16)
    ids = {attribute["attribute_type"]: attribute["unique_id"] for attribute in DracoPy.decode(data).attributes}
    assert sorted(ids) == [0, 2]
    return data


@pytest.mark.parametrize("required", [False, True])
def test_draco_is_read_whether_required_or_only_used(tmp_path, required):
    data = encoded_draco()
    content = draco_file(data, required)
    numbers = {attribute["attribute_type"]: attribute["unique_id"] for attribute in DracoPy.decode(data).attributes}
    packed = content["meshes"][0]["primitives"][0]["extensions"]["KHR_draco_mesh_compression"]
    packed["attributes"] = {"POSITION": numbers[0], "COLOR_0": numbers[2]}
    scene = write(tmp_path, content, data)
    mesh = scene.meshes[0]
    assert scene.triangles == 128 and not scene.notes
    assert face_areas(mesh.positions, mesh.faces).sum() == pytest.approx(face_areas(POSITIONS, FACES).sum(), rel=1e-3)
    np.testing.assert_allclose(mesh.colors, np.tile([1.0, 128 / 255, 0.0, 1.0], (len(mesh.colors), 1)), atol=1e-6)


@pytest.mark.parametrize(
    "damage,says",
    [
        (lambda data: data[:60], "is damaged"),
        (lambda data: b"NOTDR" + data[5:], "does not begin as Draco does"),
        (lambda data: data[:12] + b"\xff\xff\xff\x7f" + data[13:], "at most|cannot hold"),
        (lambda data: data[:12] + b"\xff\xff\x3f" + data[13:], "cannot hold"),
        (lambda data: data[:9] + b"\0\x80" + data[11:], "has metadata"),
        (lambda data: data[:5] + b"\x01" + data[6:], "no mesh of Draco 2"),
    ],
)
def test_draco_that_lies_is_refused_before_it_is_decoded(tmp_path, damage, says):
    data = damage(encoded_draco())
    with pytest.raises(InputError, match=says):
        write(tmp_path, draco_file(data, True), data)


def meshopt_file(vertices: bytes, triangles: bytes, stride: int = 12, count: int = 81):
    accessors = [
        {"bufferView": 0, "componentType": 5126, "count": 81, "type": "VEC3"},
        {"bufferView": 1, "componentType": 5125, "count": 384, "type": "SCALAR"},
    ]
    first = {"buffer": 0, "byteLength": len(vertices), "byteStride": stride, "count": count, "mode": "ATTRIBUTES"}
    second = {"buffer": 0, "byteOffset": len(vertices), "byteLength": len(triangles), "byteStride": 4, "count": 384}
    views = [
        {"buffer": 1, "byteLength": 972, "byteStride": 12, "extensions": {"EXT_meshopt_compression": first}},
        {"buffer": 1, "byteOffset": 972, "byteLength": 1536}
        | {"extensions": {"EXT_meshopt_compression": second | {"mode": "TRIANGLES"}}},
    ]
    content = document(accessors, views, {"attributes": {"POSITION": 0}, "indices": 1}, vertices + triangles)
    fallback = {"byteLength": 2508, "extensions": {"EXT_meshopt_compression": {"fallback": True}}}
    content["buffers"].append(fallback)
    content["extensionsRequired"] = content["extensionsUsed"] = ["EXT_meshopt_compression"]
    return content


def test_meshopt_is_read(tmp_path):
    vertices = meshopt.encode_gltf_buffer(POSITIONS, "ATTRIBUTES")
    triangles = meshopt.encode_gltf_buffer(FACES.reshape(-1), "TRIANGLES")
    scene = write(tmp_path, meshopt_file(vertices, triangles), vertices + triangles)
    mesh = scene.meshes[0]
    assert scene.triangles == 128 and not scene.notes
    assert face_areas(mesh.positions, mesh.faces).sum() == pytest.approx(face_areas(POSITIONS, FACES).sum(), rel=1e-6)


@pytest.mark.parametrize(
    "change,says",
    [
        ({"count": 2**31 - 1}, "at most"),
        ({"count": 10**7}, "cannot become"),
        ({"vertices": b"\0" * 40}, "meshopt's decoder says"),
        ({"stride": 2}, "meshopt's decoder says"),
    ],
)
def test_meshopt_that_lies_is_refused(tmp_path, change, says):
    vertices = change.pop("vertices", meshopt.encode_gltf_buffer(POSITIONS, "ATTRIBUTES"))
    triangles = meshopt.encode_gltf_buffer(FACES.reshape(-1), "TRIANGLES")
    with pytest.raises((InputError, TooLarge), match=says):
        write(tmp_path, meshopt_file(vertices, triangles, **change), vertices + triangles)


def ktx2(wide: int, high: int, colour, **change) -> bytes:
    """UASTC of one colour: mode 8 (code 10111 from the lowest bit), then R, G, B, A, the rest hints for ETC1."""
    bits = 0b10111 | sum(int(part) << (5 + 8 * number) for number, part in enumerate(colour))
    blocks = bits.to_bytes(16, "little") * (-(-wide // 4) * -(-high // 4))
    sample = struct.pack("<HBB4BII", 0, 127, 3, 0, 0, 0, 0, 0, 0xFFFFFFFF)
    dfd = struct.pack("<HHHHBBBB4B8B", 0, 0, 2, 24 + 16, 166, 1, 2, 0, 3, 3, 0, 0, 16, 0, 0, 0, 0, 0, 0, 0) + sample
    dfd = struct.pack("<I", len(dfd) + 4) + dfd
    start = 80 + 24 + len(dfd)
    padding = -start % 16
    head = {"format": 0, "width": wide, "height": high, "inflated": len(blocks), "levels": 1} | change
    fields = (head["format"], 1, head["width"], head["height"], 0, 0, 1, head["levels"], 0)
    index = (80 + 24, len(dfd), 0, 0, 0, 0)
    out = b"\xabKTX 20\xbb\r\n\x1a\n" + struct.pack("<9I4I2Q", *fields, *index)
    return out + struct.pack("<3Q", start + padding, len(blocks), head["inflated"]) + dfd + b"\0" * padding + blocks


@pytest.mark.parametrize("size", [(8, 4), (5, 3)])
def test_ktx2_is_read(size):
    decoded = decode_image(ktx2(*size, (200, 100, 50, 128)), "image")
    assert decoded.format == "ktx2"
    np.testing.assert_array_equal(decoded.pixels, np.tile(np.uint8([200, 100, 50, 128]), (size[1], size[0], 1)))


@pytest.mark.parametrize(
    "change,says",
    [
        ({"width": 1 << 20}, "pixels along a side"),
        ({"width": 16384, "height": 16384}, "pixels"),
        ({"format": 43}, "Vulkan's format 43"),
        ({"inflated": 1 << 40}, "announces"),
        ({"levels": 200}, "no single picture"),
        ({"width": 4096, "height": 4096}, "transcoder says"),
    ],
)
def test_ktx2_that_lies_is_refused(change, says):
    with pytest.raises((InputError, TooLarge), match=says):
        decode_image(ktx2(8, 8, (1, 2, 3, 4), **change), "image")


@pytest.mark.parametrize("extension,suffix", [("EXT_texture_webp", "webp"), ("KHR_texture_basisu", "ktx2")])
def test_textures_of_extensions_go_before_their_fallback(tmp_path, write_png, extension, suffix):
    pixels = np.full((4, 4, 3), 200, np.uint8)
    write_png(tmp_path / "fallback.png", pixels // 2)
    if suffix == "webp":
        assert oiio.ImageBuf(pixels).write(str(tmp_path / "a.webp"))
    else:
        (tmp_path / "a.ktx2").write_bytes(ktx2(4, 4, (200, 200, 200, 255)))
    data = POSITIONS[:3].tobytes() + GRID[:3].astype(np.float32).tobytes()
    accessors = [
        {"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3"},
        {"bufferView": 1, "componentType": 5126, "count": 3, "type": "VEC2"},
    ]
    views = [{"buffer": 0, "byteLength": 36}, {"buffer": 0, "byteOffset": 36, "byteLength": 24}]
    accessors[0]["bufferView"], triangle = 0, np.float32([[0, 0, 0], [1, 0, 0], [0, 1, 0]]).tobytes()
    primitive = {"attributes": {"POSITION": 0, "TEXCOORD_0": 1}, "material": 0}
    more = {
        "images": [{"uri": "fallback.png"}, {"uri": f"a.{suffix}"}],
        "textures": [{"source": 0, "extensions": {extension: {"source": 1}}}],
        "materials": [{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}],
        "extensionsUsed": [extension],
    }
    scene = write(tmp_path, document(accessors, views, primitive, data, **more), triangle + data[36:])
    assert not scene.notes
    np.testing.assert_allclose(scene.images[0].pixels[..., :3].astype(int), 200, atol=2)
