"""Bounds that are met by counting, and deadlines."""

import json

import numpy as np
import pytest

from kiln_schemas.errors import TooLarge
from kiln_workers.scene import raster
from kiln_workers.scene.limits import deadline
from kiln_workers.scene.load import load_scene


def test_a_deadline_ends_what_has_no_end_and_nothing_else() -> None:
    with pytest.raises(TooLarge, match=r"takes more than 0 s to count\. Stop"), deadline(0.05, "x", "count", "Stop."):
        while True:
            pass
    with deadline(0.05, "x", "count", "Stop."):
        pass
    for _ in range(1_000_000):  # longer than the deadline, which is over
        pass


def test_textures_are_bounded_together(gltf, tmp_path, write_image, monkeypatch) -> None:
    monkeypatch.setattr("kiln_workers.scene.gltf_materials.MAX_IMAGE_BYTES", 3 * 64 * 64 * 5 // 2)
    for name in "abc":
        write_image(tmp_path / f"{name}.png", np.zeros((64, 64, 3), np.uint8))
    gltf.document |= {
        "images": [{"uri": f"{name}.png"} for name in "abc"],
        "textures": [{"source": i} for i in range(3)],
        "materials": [{"pbrMetallicRoughness": {"baseColorTexture": {"index": i}}} for i in range(3)],
    }
    gltf.mesh(material=0)
    gltf.mesh(material=1)
    assert len(load_scene(tmp_path, gltf.write(tmp_path)).images) == 2
    gltf.mesh(material=2)
    with pytest.raises(TooLarge, match=r"c\.png.*beside the others"):
        load_scene(tmp_path, gltf.write(tmp_path))


def test_a_library_s_textures_are_decoded_once_and_only_where_used(tmp_path, write_image) -> None:
    write_image(tmp_path / "a.png", np.zeros((4, 4, 3), np.uint8))
    library = "newmtl one\nmap_Kd a.png\nnewmtl two\nmap_Kd a.png\nnewmtl unused\nmap_Kd gone.png\n"
    (tmp_path / "lib.mtl").write_text(library)
    body = "v 0 0 0\nv 1 0 0\nv 0 \\\n1 0\nusemtl one\nf 1 2 3\nusemtl two\nf 1 2 3\n"
    (tmp_path / "a.obj").write_text("mtllib lib.mtl\n" + body)
    scene = load_scene(tmp_path, "a.obj")
    assert [image.name for image in scene.images] == ["a.png"] and len(scene.materials) == 2


def test_primitives_that_share_a_buffer_keep_their_own_vertices(gltf, tmp_path) -> None:
    grid = np.random.default_rng(1).random((300, 3)).astype(np.float32)
    uv = grid[:, :2].copy()
    gltf.mesh(grid, (7, 290, 31), TEXCOORD_0=uv, TEXCOORD_1=uv)
    (mesh,) = load_scene(tmp_path, gltf.write(tmp_path)).meshes
    np.testing.assert_array_equal(mesh.positions[mesh.faces[0]], grid[[7, 290, 31]])
    np.testing.assert_array_equal(mesh.lightmap_uv[mesh.faces[0]], uv[[7, 290, 31]])
    np.testing.assert_array_equal(mesh.uv[mesh.faces[0]], uv[[7, 290, 31]])


def test_squares_do_not_depend_on_the_batch(monkeypatch) -> None:
    corners = np.random.default_rng(2).random((50, 3, 2)) * 40.0
    whole = raster.touched_squares(corners, 40, 40)
    monkeypatch.setattr(raster, "BATCH_SQUARES", 7)
    small = raster.touched_squares(corners, 40, 40)
    for name in ("square", "face", "barycentric", "distance"):
        np.testing.assert_array_equal(getattr(whole, name), getattr(small, name))


def test_names_of_a_scene_are_short_and_inert(gltf, tmp_path) -> None:
    gltf.mesh()
    gltf.document["meshes"][0]["name"] = "\x1b[2J" + "x" * 10_000
    (mesh,) = load_scene(tmp_path, gltf.write(tmp_path)).meshes
    assert len(mesh.name) < 220 and mesh.name.startswith("\\x1b[2J") and mesh.name.endswith("…")
    assert json.loads((tmp_path / "scene.gltf").read_text())["meshes"][0]["name"].startswith("\x1b")
