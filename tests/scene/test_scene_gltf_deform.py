"""Hidden nodes, vertex colours, skins and morph targets of glTF."""

import numpy as np
import pytest

from kiln_schemas.errors import InputError
from kiln_workers.scene.load import load_scene


def test_what_hangs_on_a_hidden_node_is_hidden_too(gltf, tmp_path):
    gltf.mesh()
    gltf.document["extensions"] = {"KHR_lights_punctual": {"lights": [{"type": "point"}]}}
    hidden = {"children": [1, 2], "extensions": {"KHR_node_visibility": {"visible": False}}}
    nodes = [hidden, {"mesh": 0}, {"extensions": {"KHR_lights_punctual": {"light": 0}}}, {"mesh": 0, "name": "seen"}]
    scene = load_scene(tmp_path, gltf.write(tmp_path, nodes=nodes))
    assert [mesh.name for mesh in scene.meshes] == ["seen"] and not scene.lights


@pytest.mark.parametrize("kind", ["f4", "u1", "u2"])
@pytest.mark.parametrize("width", [3, 4])
def test_vertex_colours_of_every_kind(gltf, tmp_path, kind, width):
    values = np.array([[0.0, 0.2, 1.0, 0.4]] * 3)[:, :width]
    scale = {"f4": 1.0, "u1": 255, "u2": 65535}[kind]
    gltf.mesh()
    accessor = gltf.accessor(
        (values * scale).round().astype(f"<{kind}") if kind != "f4" else np.float32(values), kind != "f4"
    )
    gltf.document["meshes"][0]["primitives"][0]["attributes"]["COLOR_0"] = accessor
    mesh = load_scene(tmp_path, gltf.write(tmp_path)).meshes[0]
    np.testing.assert_allclose(mesh.colors, np.array([[0.0, 0.2, 1.0, 0.4 if width == 4 else 1.0]] * 3), atol=1e-6)


def skinned_file(gltf, joints, weights, binds):
    gltf.mesh(NORMAL=np.tile(np.float32([0, 0, 1]), (3, 1)), JOINTS_0=np.uint8(joints), WEIGHTS_0=np.float32(weights))
    gltf.document["accessors"].append(
        {"bufferView": len(gltf.document["bufferViews"]), "componentType": 5126, "count": len(binds), "type": "MAT4"}
    )
    flat = np.float32([np.transpose(bind).ravel() for bind in binds])
    gltf.document["bufferViews"].append({"buffer": 0, "byteOffset": len(gltf.data), "byteLength": flat.nbytes})
    gltf.data += flat.tobytes()
    gltf.document["skins"] = [{"joints": [1, 2], "inverseBindMatrices": len(gltf.document["accessors"]) - 1}]


def test_skins_are_where_their_joints_put_them(gltf, tmp_path):
    """Half of joint 1 and half of joint 2 at the last vertex; the node that has the mesh plays no part."""
    shift = np.eye(4)
    shift[:3, 3] = (0, 0, -2)
    joints = [[0, 0, 0, 0], [1, 0, 0, 0], [0, 1, 0, 0]]
    weights = [[1, 0, 0, 0], [1, 0, 0, 0], [0.5, 0.5, 0, 0]]
    skinned_file(gltf, joints, weights, [np.eye(4), shift])
    turn = [0.0, 0.0, np.sin(np.pi / 4), np.cos(np.pi / 4)]  # 90 degrees about +Z: (x, y) to (-y, x)
    nodes = [
        {"mesh": 0, "skin": 0, "translation": [100, 0, 0]},
        {"translation": [0, 0, 1], "children": [2]},
        {"rotation": turn},
    ]
    mesh = load_scene(tmp_path, gltf.write(tmp_path, nodes=nodes)).meshes[0]
    # Vertices (0,0,0), (1,0,0), (0,1,0): joint 0 lifts by 1, joint 1 turns and moves by 1 - 2.
    np.testing.assert_allclose(mesh.positions, [[0, 0, 1], [0, 1, -1], [-0.5, 0.5, 0]], atol=1e-6)


@pytest.mark.parametrize(
    "joints,weights,says",
    [(7, 1.0, "names joint 7 of a skin of 2"), (0, 0.0, "the weights of vertex 0 sum to 0")],
)
def test_skins_that_name_what_is_not_there_are_refused(gltf, tmp_path, joints, weights, says):
    skinned_file(gltf, [[joints, 0, 0, 0]] * 3, [[weights, 0, 0, 0]] * 3, [np.eye(4)] * 2)
    nodes = [{"mesh": 0, "skin": 0}, {}, {}]
    with pytest.raises(InputError, match=says):
        load_scene(tmp_path, gltf.write(tmp_path, nodes=nodes))


def test_morph_targets_are_added_by_their_weights(gltf, tmp_path):
    gltf.mesh()
    target = gltf.accessor(np.float32([[0, 0, 4]] * 3))
    gltf.document["meshes"][0]["primitives"][0]["targets"] = [{"POSITION": target}]
    gltf.document["meshes"][0]["weights"] = [0.25]
    nodes = [{"mesh": 0}, {"mesh": 0, "weights": [0.5]}, {"mesh": 0, "weights": [0.0]}]
    scene = load_scene(tmp_path, gltf.write(tmp_path, nodes=nodes))
    assert [float(mesh.positions[0, 2]) for mesh in scene.meshes] == [1.0, 2.0, 0.0]
