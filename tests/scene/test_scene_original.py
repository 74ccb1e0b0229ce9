"""`original.glb`: the user's own file with the light-map UV, held against the flattened scene that was baked."""

import json
from dataclasses import replace

import numpy as np
import pytest

from kiln_schemas.errors import InputError
from kiln_schemas.settings import LightmapSettings
from kiln_workers.package.original import check_original, encode_original
from kiln_workers.scene.atlas import make_lightmap
from kiln_workers.scene.gltf import read_gltf
from kiln_workers.scene.gltf_buffers import split_glb

CORNERS = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], np.float32)
SIDES = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
NO_AREA = (0, 0, 1)
FACES = np.array([face for a, b, c, d in SIDES for face in ((a, b, c), (a, c, d))] + [NO_AREA], np.uint16)


@pytest.fixture
def scene_file(gltf, tmp_path):
    """Two nodes that share a cube of 8 vertices (one mirrored), under a parent; extras, an extension, an animation."""
    normals = (CORNERS - 0.5) / np.linalg.norm(CORNERS - 0.5, axis=1, keepdims=True)
    colours = np.arange(24, dtype=np.uint8).reshape(8, 3)
    cube = {
        "attributes": {
            "POSITION": gltf.accessor(CORNERS),
            "NORMAL": gltf.accessor(normals.astype(np.float32)),
            "_HEAT": gltf.accessor(np.arange(8, dtype=np.uint8).reshape(8, 1)),
            "_TRIPLE": gltf.accessor(colours, normalized=False),
        },
        "indices": gltf.accessor(FACES.reshape(-1)),
        "material": 0,
        "targets": [{"POSITION": gltf.accessor(CORNERS * np.float32(0.25))}],
        "extras": {"layer": 7},
    }
    gltf.document["accessors"][0] |= {"min": [0, 0, 0], "max": [1, 1, 1]}
    times, turns = gltf.accessor(np.float32([0, 1])), gltf.accessor(np.float32([[0, 0, 0], [0, 1, 0]]))
    gltf.document |= {
        "meshes": [{"name": "cube", "primitives": [cube], "weights": [0.0], "extras": {"author": "me"}}],
        "nodes": [
            {"name": "parent", "translation": [1, 2, 3], "children": [1, 2]},
            {"name": "left", "mesh": 0, "extras": {"id": 1}},
            {"name": "right", "mesh": 0, "scale": [-2, 1, 1], "translation": [5, 0, 0]},
        ],
        "scenes": [{"nodes": [0]}],
        "scene": 0,
        "materials": [{"name": "paint", "extensions": {"VENDOR_thing": {"answer": 42}}}],
        "extensionsUsed": ["VENDOR_thing"],
        "animations": [
            {
                "name": "rise",
                "samplers": [{"input": times, "output": turns}],
                "channels": [{"sampler": 0, "target": {"node": 1, "path": "translation"}}],
            }
        ],
    }
    nodes = gltf.document.pop("nodes")
    return tmp_path / gltf.write(tmp_path, "scene.gltf", nodes)


def test_the_file_comes_back_with_the_light_map_uv(scene_file, tmp_path):
    folder, entry = scene_file.parent, scene_file.name
    check_original(folder, entry)
    baked = make_lightmap(read_gltf(folder, entry), LightmapSettings(resolution=32), may_cut=False).scene
    data = encode_original(folder, entry, baked.meshes)
    (tmp_path / "original.glb").write_bytes(data)
    back = read_gltf(tmp_path, "original.glb")

    assert [mesh.name for mesh in back.meshes] == [mesh.name for mesh in baked.meshes] == ["left", "right"]
    for one, two in zip(baked.meshes, back.meshes, strict=True):
        np.testing.assert_array_equal(one.positions[one.faces], two.positions[two.faces])
        np.testing.assert_array_equal(one.lightmap_uv[one.faces], two.lightmap_uv[two.faces])
        assert len(two.positions) == len(one.positions) > 8  # seams

    old, new = json.loads(scene_file.read_text()), json.loads(split_glb(data, "")[0])
    for name in ("nodes", "scenes", "materials", "animations", "extensionsUsed", "asset"):
        expected = json.loads(json.dumps(old[name]))
        if name == "nodes":
            expected[2]["mesh"] = 1  # a mesh of its own, as its light-map UV is
        assert new[name] == expected
    assert new["accessors"][: len(old["accessors"])] == old["accessors"]
    for mesh in new["meshes"]:
        assert (mesh["name"], mesh["extras"], mesh["weights"]) == ("cube", {"author": "me"}, [0.0])
        (primitive,) = mesh["primitives"]
        assert primitive["extras"] == {"layer": 7} and primitive["material"] == 0
        attributes = {name: new["accessors"][index] for name, index in primitive["attributes"].items()}
        counts = {about["count"] for about in attributes.values()}
        assert counts == {new["accessors"][primitive["targets"][0]["POSITION"]]["count"]}
        assert attributes["_HEAT"]["componentType"] == attributes["_TRIPLE"]["componentType"] == 5121
        assert attributes["POSITION"]["min"] == [0, 0, 0] and attributes["POSITION"]["max"] == [1, 1, 1]
    heat = new["accessors"][new["meshes"][0]["primitives"][0]["attributes"]["_HEAT"]]
    view = new["bufferViews"][heat["bufferView"]]
    blob = split_glb(data, "")[1]
    rows = np.frombuffer(blob, np.uint8)[view["byteOffset"] : view["byteOffset"] + view["byteLength"]].reshape(-1, 4)
    left = back.meshes[0]
    original = CORNERS + np.float32([1, 2, 3])
    np.testing.assert_array_equal(original[rows[:, 0]][np.unique(left.faces)], left.positions)


def test_a_set_without_seams_changes_no_vertex(gltf, tmp_path):
    """A quad: the accessors of the file are used as they are, and only TEXCOORD_1 is new."""
    corners = np.float32([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    up = np.tile(np.float32([0, 0, 1]), (4, 1))
    attributes = {"POSITION": gltf.accessor(corners), "NORMAL": gltf.accessor(up)}
    indices = gltf.accessor(np.uint16([0, 1, 2, 0, 2, 3]))
    gltf.document |= {
        "meshes": [{"primitives": [{"attributes": attributes, "indices": indices}]}],
        "nodes": [{"mesh": 0}],
        "scenes": [{"nodes": [0]}],
    }
    path = tmp_path / gltf.write(tmp_path, "quad.gltf")
    baked = make_lightmap(read_gltf(path.parent, path.name), LightmapSettings(resolution=16), may_cut=False).scene
    tree = json.loads(split_glb(encode_original(path.parent, path.name, baked.meshes), "")[0])
    (primitive,) = tree["meshes"][0]["primitives"]
    assert primitive == {"attributes": attributes | {"TEXCOORD_1": 3}, "indices": indices}


def test_what_cannot_be_given_back_is_said(gltf, tmp_path):
    (tmp_path / "scene.obj").write_text("v 0 0 0\n")
    with pytest.raises(InputError, match=r"'scene.obj' is not glTF"):
        check_original(tmp_path, "scene.obj")
    gltf.document["materials"] = [{"name": "wall", "normalTexture": {"index": 0, "texCoord": 1}}]
    path = tmp_path / gltf.write(tmp_path, "two.gltf")
    with pytest.raises(InputError, match=r"its material 'wall' uses TEXCOORD_1 for a texture"):
        check_original(path.parent, path.name)
    gltf.document["extensionsUsed"] = ["KHR_draco_mesh_compression"]
    path = tmp_path / gltf.write(tmp_path, "draco.gltf")
    with pytest.raises(InputError, match=r"compressed with Draco.*flat"):
        check_original(path.parent, path.name)


def test_a_scene_that_is_another_is_refused(scene_file):
    scene = make_lightmap(read_gltf(scene_file.parent, scene_file.name), LightmapSettings(resolution=32)).scene
    other = [replace(mesh, name=f"x{mesh.name}") for mesh in scene.meshes]
    with pytest.raises(InputError, match="'xleft' was not found again"):
        encode_original(scene_file.parent, scene_file.name, other)
