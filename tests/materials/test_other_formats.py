"""STL and OFF, and what is said about formats that are not read."""

import json

import numpy as np
import pytest

from kiln_schemas.errors import InputError
from kiln_workers.scene.geometry import face_areas
from kiln_workers.scene.load import load_scene

CORNERS = np.float32([[[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 0, 0], [0, 1, 0], [0, 0, 1]]])


def ascii_stl() -> bytes:
    loops = "".join(
        "facet normal 0 0 0\nouter loop\n"
        + "".join(f"vertex {x} {y} {z}\n" for x, y, z in face)
        + "endloop\nendfacet\n"
        for face in CORNERS
    )
    return f"solid two\n{loops}endsolid two\n".encode()


def binary_stl(head: bytes = b"solid but binary") -> bytes:
    faces = b"".join(np.float32([[7, 7, 7], *face]).tobytes() + b"\0\0" for face in CORNERS)
    return head.ljust(80, b" ") + len(CORNERS).to_bytes(4, "little") + faces


@pytest.mark.parametrize("data", [ascii_stl(), binary_stl(), b"\xef\xbb\xbf" + ascii_stl()])
def test_stl(tmp_path, data):
    (tmp_path / "a.stl").write_bytes(data)
    mesh = load_scene(tmp_path, "a.stl").meshes[0]
    np.testing.assert_array_equal(mesh.positions[mesh.faces], CORNERS)
    np.testing.assert_allclose(np.unique(mesh.normals, axis=0), [[0, 0, 1], [1, 0, 0]], atol=1e-6)


@pytest.mark.parametrize("data", [b"", b"solid", binary_stl()[:-9], ascii_stl().replace(b"vertex 1", b"vertex x")])
def test_broken_stl_is_refused(tmp_path, data):
    (tmp_path / "a.stl").write_bytes(data)
    with pytest.raises(InputError, match=r"a\.stl"):
        load_scene(tmp_path, "a.stl")


@pytest.mark.parametrize("head", ["OFF\n# by hand\n4 2 0\n", "OFF 4 2 0\n"])
def test_off(tmp_path, head):
    (tmp_path / "a.OFF").write_text(head + "0 0 0\n2 -1 0\n0 3 0\n-2 -1 0\n\n4 0 1 2 3 255 0 0\n2 0 1\n")
    mesh = load_scene(tmp_path, "a.OFF").meshes[0]
    # The arrow of a concave quad: 8 of its hull's area less the notch's 2.
    assert face_areas(mesh.positions, mesh.faces).sum() == pytest.approx(6.0)


@pytest.mark.parametrize(
    "text,says",
    [
        ("PLY", "begin with OFF"),
        ("OFF 9 9 0\n0 0 0\n", "announced"),
        ("OFF 3 1 0\n0 0 0\n0 1 0\n1 0 0\n3 0 1 9\n", "not one of 3"),
    ],
)
def test_broken_off_is_refused(tmp_path, text, says):
    (tmp_path / "a.off").write_text(text)
    with pytest.raises(InputError, match=says):
        load_scene(tmp_path, "a.off")


@pytest.mark.parametrize(
    ("suffix", "names"),
    [(".zae", "ZIP"), (".3ds", "Blender"), (".blend", "Blender"), (".usdz", "glTF")],
)
def test_what_is_not_read_names_a_converter(tmp_path, suffix, names):
    (tmp_path / f"a{suffix}").write_bytes(b"x")
    with pytest.raises(InputError) as refusal:
        load_scene(tmp_path, f"a{suffix}")
    assert names in refusal.value.remedy


def test_gltf_1_is_named(tmp_path):
    (tmp_path / "a.gltf").write_text(
        '{"asset": {"version": "1.0"}, "nodes": {"n": {}}, "scenes": {"s": {"nodes": ["n"]}}}'
    )
    with pytest.raises(InputError, match=r"is glTF 1\.0") as refusal:
        load_scene(tmp_path, "a.gltf")
    assert "gltf-pipeline" in refusal.value.remedy


@pytest.mark.parametrize(
    "name,remedy", [("EXT_materials_odd", "materials"), ("MSFT_texture_dds", "textures"), ("EXT_mesh_odd", "meshes")]
)
def test_a_required_extension_is_refused_for_what_it_is(tmp_path, name, remedy):
    (tmp_path / "a.gltf").write_text(json.dumps({"asset": {"version": "2.0"}, "extensionsRequired": [name]}))
    with pytest.raises(InputError, match=f"requires the extension {name}") as refusal:
        load_scene(tmp_path, "a.gltf")
    assert f"Export its {remedy}" in refusal.value.remedy


def test_a_byte_order_mark_is_no_fault(tmp_path, data):
    text = (data / "glass.gltf").read_bytes()
    (tmp_path / "a.gltf").write_bytes(b"\xef\xbb\xbf" + text)
    assert load_scene(tmp_path, "a.gltf").triangles == load_scene(data, "glass.gltf").triangles
