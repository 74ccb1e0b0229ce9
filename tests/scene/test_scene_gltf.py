"""The glTF reader: transforms, attributes, materials, lights, and what it refuses."""

import json
import struct

import numpy as np
import pytest

from kiln_schemas.errors import InputError
from kiln_schemas.tasks import EnvironmentRef
from kiln_workers.scene.geometry import face_normals
from kiln_workers.scene.load import check_light, load_scene
from kiln_workers.scene.model import LightKind


def test_transforms_of_parents_and_children_multiply(gltf, tmp_path):
    gltf.mesh()
    half_turn = [0.0, np.sin(np.pi / 4), 0.0, np.cos(np.pi / 4)]  # 90 degrees about +Y
    nodes = [
        {"children": [1], "translation": [0, 0, 5], "rotation": half_turn},
        {"mesh": 0, "scale": [2, 3, 1], "name": "child"},
    ]
    mesh = load_scene(tmp_path, gltf.write(tmp_path, nodes=nodes)).meshes[0]
    assert mesh.name == "child"
    np.testing.assert_allclose(mesh.positions, [[0, 0, 5], [0, 0, 3], [0, 3, 5]], atol=1e-6)


def test_a_mirrored_node_keeps_its_outward_side(gltf, tmp_path):
    gltf.mesh(NORMAL=np.tile(np.float32([0, 0, 1]), (3, 1)))
    scene = load_scene(tmp_path, gltf.write(tmp_path, nodes=[{"mesh": 0}, {"mesh": 0, "scale": [-1, 1, 1]}]))
    plain, mirrored = scene.meshes
    for mesh in (plain, mirrored):
        np.testing.assert_allclose(face_normals(mesh.positions, mesh.faces), [[0, 0, 1]], atol=1e-6)
        np.testing.assert_allclose(mesh.normals, np.tile([0, 0, 1], (3, 1)), atol=1e-6)
    assert mirrored.positions[:, 0].min() == -1.0


def test_instances_become_meshes_of_their_own(gltf, tmp_path):
    gltf.mesh()
    places = gltf.accessor(np.float32([[0, 0, 0], [0, 0, 7]]))
    instancing = {"EXT_mesh_gpu_instancing": {"attributes": {"TRANSLATION": places}}}
    nodes = [{"mesh": 0}, {"mesh": 0, "translation": [3, 0, 0]}, {"mesh": 0, "extensions": instancing}]
    scene = load_scene(tmp_path, gltf.write(tmp_path, nodes=nodes))
    assert [mesh.name for mesh in scene.meshes] == ["mesh-0", "mesh-0 (2)", "mesh-0 (3)", "mesh-0 (4)"]
    np.testing.assert_allclose([m.positions[0] for m in scene.meshes], [[0, 0, 0], [3, 0, 0], [0, 0, 0], [0, 0, 7]])


def test_missing_normals_are_flat_and_bad_ones_are_mended(gltf, tmp_path):
    bend = np.float32([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 0, 1]])
    gltf.mesh(bend, (0, 1, 2, 0, 3, 1))
    gltf.mesh(bend, (0, 1, 2, 0, 3, 1), NORMAL=np.zeros((4, 3), np.float32))
    flat, mended = load_scene(tmp_path, gltf.write(tmp_path)).meshes
    np.testing.assert_allclose(flat.normals, np.repeat(face_normals(flat.positions, flat.faces), 3, axis=0), atol=1e-6)
    assert len(flat.positions) == 6 and len(mended.positions) == 4
    np.testing.assert_allclose(np.linalg.norm(mended.normals, axis=1), 1.0, atol=1e-6)


def test_normalised_and_sparse_accessors(gltf, tmp_path):
    gltf.mesh()
    primitive = gltf.document["meshes"][0]["primitives"][0]
    primitive["attributes"]["TEXCOORD_1"] = gltf.accessor(np.uint16([[0, 0], [65535, 0], [0, 32768]]), normalized=True)
    rows, values = gltf.accessor(np.uint16([2])), gltf.accessor(np.float32([[0, 9, 0]]))
    views = gltf.document["accessors"]
    views[primitive["attributes"]["POSITION"]]["sparse"] = {
        "count": 1,
        "indices": {"bufferView": views[rows]["bufferView"], "componentType": 5123},
        "values": {"bufferView": views[values]["bufferView"]},
    }
    mesh = load_scene(tmp_path, gltf.write(tmp_path)).meshes[0]
    np.testing.assert_allclose(mesh.lightmap_uv, [[0, 0], [1, 0], [0, 32768 / 65535]], atol=1e-7)
    np.testing.assert_allclose(mesh.positions[2], [0, 9, 0])


@pytest.mark.parametrize(("mode", "order", "faces"), [(5, (0, 1, 2, 3), 2), (6, (0, 1, 3, 2), 2), (1, (0, 1), 0)])
def test_strips_and_fans_are_wound_alike(gltf, tmp_path, mode, order, faces):
    square = np.float32([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]])
    gltf.mesh()
    gltf.mesh(square, order)
    gltf.document["meshes"][1]["primitives"][0]["mode"] = mode
    scene = load_scene(tmp_path, gltf.write(tmp_path))
    assert scene.triangles == 1 + faces
    assert any("points or lines" in note for note in scene.notes) == (faces == 0)
    for mesh in scene.meshes:
        np.testing.assert_allclose(face_normals(mesh.positions, mesh.faces)[:, 2], 1.0)


def test_materials_textures_and_emission(gltf, tmp_path, write_image):
    write_image(tmp_path / "rough ness.png", np.full((4, 4, 3), 128, np.uint8))
    gltf.mesh(material=0, TEXCOORD_0=np.float32([[0, 0], [1, 0], [0, 1]]), TEXCOORD_2=np.float32([[5, 5]] * 3))
    gltf.document["images"] = [{"uri": "rough%20ness.png"}]
    gltf.document["samplers"] = [{"wrapS": 33071, "wrapT": 33648}]
    gltf.document["textures"] = [{"source": 0, "sampler": 0}]
    turned = {"KHR_texture_transform": {"offset": [0.5, 0], "rotation": 1.0, "scale": [2, 2], "texCoord": 2}}
    gltf.document["materials"] = [
        {
            "name": "lamp",
            "pbrMetallicRoughness": {
                "roughnessFactor": 0.5,
                "baseColorTexture": {"index": 0, "extensions": turned},
                "metallicRoughnessTexture": {"index": 0, "texCoord": 2},
            },
            "emissiveFactor": [1, 0.5, 0],
            "extensions": {"KHR_materials_emissive_strength": {"emissiveStrength": 8}, "KHR_materials_sheen": {}},
            "alphaMode": "BLEND",
            "doubleSided": True,
        }
    ]
    gltf.document["extensionsUsed"] = ["KHR_texture_transform", "KHR_materials_sheen"]
    scene = check_light(load_scene(tmp_path, gltf.write(tmp_path)))
    material = scene.materials[0]
    assert material.emission == (8.0, 4.0, 0.0)
    assert material.metallic == 1.0 and material.roughness == 0.5
    assert material.double_sided and material.blend and material.alpha_cutoff is None
    assert material.base_color_texture.wrap == ("clamp", "mirror")
    assert (material.base_color_texture.offset, material.base_color_texture.rotation) == ((0.5, 0.0), 1.0)
    assert [image.srgb for image in scene.images] == [True, False]
    np.testing.assert_array_equal(scene.images[0].pixels, 128)
    np.testing.assert_allclose(scene.meshes[0].uv, 5.0)
    assert sum("sheen" in note for note in scene.notes) == 2


@pytest.mark.parametrize(
    ("tangent", "expected"),
    [
        ([0.0, 1.0, 0.0, -1.0], [0.0, 1.0, 0.0, -1.0]),
        (None, [1.0, 0.0, 0.0, 1.0]),
        ([np.nan, 0.0, 0.0, 1.0], [1.0, 0.0, 0.0, 1.0]),
        ([0.0, 0.0, 0.0, 1.0], [1.0, 0.0, 0.0, 1.0]),
    ],
)
def test_tangents_are_the_file_s_or_made(gltf, tmp_path, write_image, tangent, expected):
    """A normal map of TEXCOORD_2, which stands upright; TEXCOORD_0 is turned."""
    scene = load_scene(tmp_path, bumpy(gltf, tmp_path, write_image, tangent))
    mesh, material = scene.meshes[0], scene.materials[0]
    assert material.normal_scale == 0.5 and not scene.images[0].srgb
    np.testing.assert_allclose(mesh.tangents, np.tile(expected, (3, 1)), atol=1e-6)
    assert not [note for note in scene.notes if "ormal" in note]


def test_tangents_of_a_wrong_shape_are_refused(gltf, tmp_path, write_image):
    with pytest.raises(InputError, match="TANGENT"):
        load_scene(tmp_path, bumpy(gltf, tmp_path, write_image, [1.0, 0.0, 0.0]))


def bumpy(gltf, folder, write_image, tangent):
    """A file of the triangle with a normal map, and a tangent that all of its vertices have."""
    write_image(folder / "bumps.png", np.full((4, 4, 3), 128, np.uint8))
    more = {} if tangent is None else {"TANGENT": np.tile(np.float32(tangent), (3, 1))}
    gltf.mesh(
        material=0,
        NORMAL=np.float32([[0, 0, 1]] * 3),
        TEXCOORD_0=np.float32([[0, 0], [0, 1], [1, 0]]),
        TEXCOORD_2=np.float32([[0, 1], [1, 1], [0, 0]]),
        **more,
    )
    gltf.document["images"], gltf.document["textures"] = [{"uri": "bumps.png"}], [{"source": 0}]
    gltf.document["materials"] = [{"normalTexture": {"index": 0, "texCoord": 2, "scale": 0.5}}]
    return gltf.write(folder)


def test_punctual_lights_are_placed_by_their_nodes(gltf, tmp_path):
    gltf.mesh()
    gltf.document["extensions"] = {
        "KHR_lights_punctual": {
            "lights": [
                {"type": "spot", "intensity": 10, "color": [1, 0.5, 0], "spot": {"outerConeAngle": 0.5}},
                {"type": "directional", "intensity": 3},
            ]
        }
    }
    down = [-np.sin(np.pi / 4), 0, 0, np.cos(np.pi / 4)]
    nodes = [{"mesh": 0}] + [
        {"translation": [0, 4, 0], "rotation": down, "extensions": {"KHR_lights_punctual": {"light": i}}}
        for i in (0, 1)
    ]
    scene = load_scene(tmp_path, gltf.write(tmp_path, nodes=nodes))
    spot, sun = scene.lights
    assert (spot.kind, sun.kind) == (LightKind.SPOT, LightKind.DIRECTIONAL)
    assert spot.intensity == (10.0, 5.0, 0.0) and spot.outer_cone == 0.5
    np.testing.assert_allclose(spot.position, [0, 4, 0])
    np.testing.assert_allclose(sun.direction, [0, -1, 0], atol=1e-12)


def test_degenerate_faces_are_dropped_with_a_note(gltf, tmp_path):
    positions = np.float32([[0, 0, 0], [1, 0, 0], [0, 1, 0], [2, 0, 0]])
    gltf.mesh(positions, (0, 1, 2, 0, 0, 1, 0, 1, 3))
    scene = load_scene(tmp_path, gltf.write(tmp_path))
    assert scene.triangles == 1
    assert "Mesh 'mesh-0': 2 degenerate faces dropped." in scene.notes


def refused(tmp_path, name, **kwargs):
    with pytest.raises(InputError) as caught:
        load_scene(tmp_path, name, **kwargs)
    return str(caught.value)


def test_no_faces_names_the_file(gltf, tmp_path):
    assert "scene.gltf: has no faces" in refused(tmp_path, gltf.write(tmp_path, nodes=[{"name": "empty"}]))
    gltf.mesh(np.zeros((3, 3), np.float32))
    assert "has no faces" in refused(tmp_path, gltf.write(tmp_path))


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_a_vertex_that_is_no_number_is_named(gltf, tmp_path, bad):
    positions = np.float32([[0, 0, 0], [1, bad, 0], [0, 1, 0]])
    gltf.mesh(positions)
    message = refused(tmp_path, gltf.write(tmp_path))
    assert "mesh 'mesh-0'" in message and "vertex 1" in message


def test_a_missing_texture_is_named(gltf, tmp_path):
    gltf.mesh(material=0)
    gltf.document["images"] = [{"uri": "absent.png"}]
    gltf.document["textures"] = [{"source": 0}]
    gltf.document["materials"] = [{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}]
    assert "the texture 'absent.png' is missing" in refused(tmp_path, gltf.write(tmp_path))


@pytest.mark.parametrize(
    "uri", ["../outside.png", "/etc/passwd", "..%2Foutside.png", "a/../../outside.png", "C:\\x.png"]
)
def test_a_path_that_leaves_the_bundle_is_refused(gltf, tmp_path, uri):
    folder = tmp_path / "bundle"
    folder.mkdir()
    (tmp_path / "outside.png").write_bytes(b"secret")
    gltf.mesh(material=0)
    gltf.document["images"] = [{"uri": uri}]
    gltf.document["textures"] = [{"source": 0}]
    gltf.document["materials"] = [{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}]
    assert "leaves the bundle" in refused(folder, gltf.write(folder))


def test_a_link_that_leaves_the_bundle_is_refused(gltf, tmp_path):
    folder = tmp_path / "bundle"
    folder.mkdir()
    (tmp_path / "outside.png").write_bytes(b"secret")
    (folder / "inside.png").symlink_to(tmp_path / "outside.png")
    gltf.mesh(material=0)
    gltf.document["images"] = [{"uri": "inside.png"}]
    gltf.document["textures"] = [{"source": 0}]
    gltf.document["materials"] = [{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}]
    assert "link that leaves the bundle" in refused(folder, gltf.write(folder))


def test_cycles_and_dangling_indices_are_refused(gltf, tmp_path):
    gltf.mesh()
    nodes = [{"children": [1]}, {"children": [2]}, {"children": [1], "mesh": 0}]
    assert "reached twice" in refused(tmp_path, gltf.write(tmp_path, nodes=nodes))
    assert "mesh 5 is named" in refused(tmp_path, gltf.write(tmp_path, nodes=[{"mesh": 5}]))
    assert "not finite" in refused(
        tmp_path,
        gltf.write(tmp_path, nodes=[{"children": [1], "scale": [1e300] * 3}, {"mesh": 0, "scale": [1e300] * 3}]),
    )


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"count": 4}, "leaves its buffer view"),
        ({"byteOffset": 8}, "leaves its buffer view"),
        ({"type": "VEC2"}, "not of 3 components"),
        ({"bufferView": 99}, "buffer view 99 is named"),
        ({"count": 10**9, "bufferView": None}, "elements"),
        ({"componentType": 7}, "not valid glTF"),
    ],
)
def test_accessors_that_leave_their_data_are_refused(gltf, tmp_path, change, says):
    gltf.mesh()
    gltf.document["accessors"][0].update(change)
    if change.get("bufferView", 0) is None:
        del gltf.document["accessors"][0]["bufferView"]
    assert says in refused(tmp_path, gltf.write(tmp_path))


def test_indices_beyond_the_vertices_are_refused(gltf, tmp_path):
    gltf.mesh(indices=(0, 1, 9))
    assert "face 0 names vertex 9" in refused(tmp_path, gltf.write(tmp_path))


def test_required_extensions_that_are_not_read_are_named(gltf, tmp_path):
    gltf.mesh()
    gltf.document["extensionsRequired"] = ["ADOBE_unheard_of"]
    assert "ADOBE_unheard_of" in refused(tmp_path, gltf.write(tmp_path))


def test_broken_files_are_refused(tmp_path):
    cases = {
        "cut.glb": b"glTF" + struct.pack("<II", 2, 999) + b"\0" * 20,
        "old.glb": b"glTF" + struct.pack("<II", 1, 20) + b"\0" * 8,
        "chunk.glb": b"glTF" + struct.pack("<IIII", 2, 20, 500, 0x4E4F534A),
        "text.gltf": b"no json",
        "deep.gltf": b"[" * 100_000,
        "nan.gltf": json.dumps(
            {"asset": {"version": "2.0"}, "nodes": [{"translation": [float("nan"), 0, 0]}]}
        ).encode(),
        "list.gltf": b"[]",
        "one.gltf": b'{"asset": {"version": "1.0"}}',
        "scene.blend": b"",
    }
    for name, data in cases.items():
        (tmp_path / name).write_bytes(data)
        assert name in refused(tmp_path, name), name
    assert "is missing" in refused(tmp_path, "absent.glb")


def test_a_scene_without_light_is_refused_by_prepare(gltf, tmp_path):
    gltf.mesh()
    scene = load_scene(tmp_path, gltf.write(tmp_path))
    with pytest.raises(InputError, match="emits light"):
        check_light(scene)


def test_a_missing_environment_is_named(gltf, tmp_path):
    gltf.mesh()
    name = gltf.write(tmp_path)
    assert "the environment 'sky.hdr' is missing" in refused(tmp_path, name, environment=EnvironmentRef(file="sky.hdr"))
