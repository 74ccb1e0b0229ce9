"""The GLB against Khronos' validator and, read back from its bytes, against the scene."""

import json
import struct
from pathlib import Path

import numpy as np
import pytest
from rich_scene import rich_scene

from kiln_schemas.errors import InternalError
from kiln_workers.package.colour import quantise, srgb_encode
from kiln_workers.package.glb import encode_glb, encode_image
from kiln_workers.scene.model import Image, Material, Mesh, Scene

DTYPES = {5123: "<u2", 5125: "<u4", 5126: "<f4"}
WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3}


def parse(data: bytes) -> tuple[dict, bytes]:
    """JSON and binary chunk of a GLB, straight from the specification's layout."""
    magic, version, length, json_length = struct.unpack_from("<4s3I", data)
    assert (magic, version, length) == (b"glTF", 2, len(data))
    document = json.loads(data[20 : 20 + json_length])
    return document, data[28 + json_length :]


def accessor(document: dict, blob: bytes, index: int) -> np.ndarray:
    entry = document["accessors"][index]
    view = document["bufferViews"][entry["bufferView"]]
    width = WIDTHS[entry["type"]]
    return np.frombuffer(
        blob, DTYPES[entry["componentType"]], entry["count"] * width, view.get("byteOffset", 0)
    ).reshape(-1, width)


def test_the_khronos_validator_finds_nothing(make_scene, node_tools, tmp_path: Path) -> None:
    path = tmp_path / "scene.glb"
    path.write_bytes(encode_glb(make_scene()))
    report = node_tools.script("gltf_report.mjs", path)
    assert (report["issues"]["numErrors"], report["issues"]["numWarnings"]) == (0, 0), report["issues"]
    assert report["info"]["totalTriangleCount"] == 6
    assert report["info"]["maxUVs"] == 2


def test_the_validator_finds_nothing_in_all_that_a_surface_has(node_tools, tmp_path: Path) -> None:
    path = tmp_path / "scene.glb"
    path.write_bytes(encode_glb(rich_scene()))
    issues = node_tools.script("gltf_report.mjs", path)["issues"]
    worst = [message["code"] for message in issues["messages"] if message["severity"] < 2]
    assert worst == [], issues


def test_a_scene_without_textures_and_lights_is_valid_too(make_scene, node_tools, tmp_path: Path) -> None:
    bare = Scene((make_scene().meshes[2],), (Material("a"), Material("b"), Material("plain")))
    path = tmp_path / "scene.glb"
    path.write_bytes(encode_glb(bare))
    issues = node_tools.script("gltf_report.mjs", path)["issues"]
    assert (issues["numErrors"], issues["numWarnings"]) == (0, 0), issues


def test_vertices_survive_to_the_bit(make_scene) -> None:
    scene = make_scene()
    document, blob = parse(encode_glb(scene))
    for mesh, written in zip(scene.meshes, document["meshes"], strict=True):
        (primitive,) = written["primitives"]
        attributes = primitive["attributes"]
        np.testing.assert_array_equal(accessor(document, blob, attributes["POSITION"]), mesh.positions)
        np.testing.assert_array_equal(accessor(document, blob, attributes["NORMAL"]), mesh.normals)
        np.testing.assert_array_equal(accessor(document, blob, attributes["TEXCOORD_1"]), mesh.lightmap_uv)
        if mesh.uv is not None:
            np.testing.assert_array_equal(accessor(document, blob, attributes["TEXCOORD_0"]), mesh.uv)
        indices = accessor(document, blob, primitive["indices"]).reshape(-1, 3)
        np.testing.assert_array_equal(indices, mesh.faces)
        assert primitive.get("material", 0) == mesh.material


def test_materials_and_lights_keep_their_meaning(make_scene) -> None:
    scene = make_scene()
    document, _ = parse(encode_glb(scene))
    cutout, lamp, plain = document["materials"]
    assert (cutout["alphaMode"], cutout["alphaCutoff"], cutout["doubleSided"]) == ("MASK", 0.4, True)
    base = cutout["pbrMetallicRoughness"]["baseColorTexture"]
    assert base["extensions"]["KHR_texture_transform"] == {"offset": [0.1, 0.2], "scale": [2.0, 3.0], "rotation": 0.5}
    sampler = document["samplers"][document["textures"][base["index"]]["sampler"]]
    assert (sampler["wrapS"], sampler["wrapT"]) == (33071, 33648)
    strength = lamp["extensions"]["KHR_materials_emissive_strength"]["emissiveStrength"]
    brightest = scene.images[1].pixels.max()
    np.testing.assert_allclose(
        np.array(lamp["emissiveFactor"]) * strength, np.array([5.0, 2.0, 1.0]) * brightest, rtol=1e-6
    )
    assert plain["pbrMetallicRoughness"]["roughnessFactor"] == 0.3
    lights = document["extensions"]["KHR_lights_punctual"]["lights"]
    for light, written in zip(scene.lights, lights, strict=True):
        np.testing.assert_allclose(np.array(written["color"]) * written["intensity"], light.intensity)
    nodes = [node for node in document["nodes"] if "KHR_lights_punctual" in node.get("extensions", {})]
    for light, node in zip(scene.lights, nodes, strict=True):
        np.testing.assert_allclose(rotate(node["rotation"], (0.0, 0.0, -1.0)), light.direction, atol=1e-12)


def rotate(quaternion: list[float], vector: tuple[float, float, float]) -> np.ndarray:
    axis, w, v = np.array(quaternion[:3]), quaternion[3], np.array(vector)
    return v + 2.0 * np.cross(axis, np.cross(axis, v) + w * v)


def test_embedded_textures_keep_their_pixels(make_scene, read_png) -> None:
    scene = make_scene()
    document, blob = parse(encode_glb(scene))
    by_name = {}
    for image in document["images"]:
        view = document["bufferViews"][image["bufferView"]]
        by_name[image["name"]] = blob[view["byteOffset"] : view["byteOffset"] + view["byteLength"]]
    for index in (0, 2, 3):
        source = scene.images[index]
        np.testing.assert_array_equal(read_png(by_name[source.name]), source.pixels)
    hdr = scene.images[1].pixels
    np.testing.assert_array_equal(read_png(by_name["hdr"]), quantise(srgb_encode(hdr / hdr.max())))


def test_linear_bytes_used_as_colour_are_encoded_as_srgb(read_png) -> None:
    linear = Image("raw", np.full((1, 1, 3), 128, np.uint8), srgb=False)
    data, scale = encode_image(linear, colour=True)
    assert scale == 1.0
    np.testing.assert_array_equal(read_png(data), quantise(srgb_encode(np.full((1, 1, 3), 128 / 255))))


def test_large_meshes_get_wide_indices_and_normals_are_made_unit(node_tools, tmp_path: Path) -> None:
    count = 65535
    random = np.random.default_rng(0)
    positions = random.normal(size=(count, 3)).astype(np.float32)
    normals = (2.0 * random.normal(size=(count, 3))).astype(np.float32)
    normals[0] = 0.0
    uv = random.random((count, 2)).astype(np.float32)
    faces = np.arange(count, dtype=np.int32).reshape(-1, 3)
    path = tmp_path / "large.glb"
    path.write_bytes(encode_glb(Scene((Mesh("m", positions, normals, faces, 0, None, uv),), (Material("plain"),))))
    issues = node_tools.script("gltf_report.mjs", path)["issues"]
    assert (issues["numErrors"], issues["numWarnings"]) == (0, 0), issues
    document, blob = parse(path.read_bytes())
    (primitive,) = document["meshes"][0]["primitives"]
    assert document["accessors"][primitive["indices"]]["componentType"] == 5125
    written = accessor(document, blob, primitive["attributes"]["NORMAL"]).astype(np.float64)
    np.testing.assert_allclose(np.linalg.norm(written, axis=1), 1.0, atol=1e-6)


def test_a_mesh_without_light_map_uv_is_refused(make_scene) -> None:
    mesh = make_scene().meshes[0]
    bare = Mesh(mesh.name, mesh.positions, mesh.normals, mesh.faces, 0)
    with pytest.raises(InternalError, match="floor: the mesh has no light-map UV"):
        encode_glb(Scene((bare,), (Material("plain"),)))
