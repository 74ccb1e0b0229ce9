"""`package.scene=original` from end to end: the user's own file comes back, and its TEXCOORD_1 finds the light."""

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
import pytest
import trimesh
from e2e_farm import TINY
from in_process import bake_files

from kiln_schemas.settings import make_settings

Array = np.ndarray[Any, np.dtype[Any]]
COMPONENTS = {5121: "u1", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
CORNERS = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], np.float32) - np.float32(0.5)
SIDES = ((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3))


def user_file() -> bytes:
    """A room of boxes: a parent, a mesh that two nodes share (one of them mirrored), a lamp, and an animation."""
    blob = bytearray()
    views: list[dict[str, int]] = []
    accessors: list[dict[str, Any]] = []

    def accessor(values: Any, kind: str, component: int = 5126, **more: Any) -> int:
        data = np.asarray(values, COMPONENTS[component]).tobytes()
        views.append({"buffer": 0, "byteOffset": len(blob), "byteLength": len(data)})
        blob.extend(data + bytes(-len(data) % 4))
        accessors.append(
            {"bufferView": len(views) - 1, "componentType": component, "count": len(values), "type": kind, **more}
        )
        return len(accessors) - 1

    corners = np.concatenate([CORNERS[list(side)] for side in SIDES])
    normals = np.repeat([[-1, 0, 0], [1, 0, 0], [0, -1, 0], [0, 1, 0], [0, 0, -1], [0, 0, 1]], 4, axis=0)
    bounds = {"min": [-0.5] * 3, "max": [0.5] * 3}
    attributes = {"POSITION": accessor(corners, "VEC3", **bounds), "NORMAL": accessor(normals, "VEC3")}
    indices = accessor(
        np.concatenate([4 * i + np.array([0, 1, 2, 0, 2, 3]) for i in range(len(SIDES))]), "SCALAR", 5123
    )

    def box(material: int) -> dict[str, Any]:
        return {"attributes": dict(attributes), "indices": indices, "material": material}

    times = accessor([0.0, 1.0], "SCALAR", min=[0.0], max=[1.0])
    rise = accessor([[0, 0, 0], [0, 1, 0]], "VEC3")
    tree = {
        "asset": {"version": "2.0", "generator": "a user's program"},
        "scene": 0,
        "scenes": [{"name": "room", "nodes": [0]}],
        "nodes": [
            {"name": "everything", "rotation": [0, 0.3826834, 0, 0.9238795], "children": [1, 2, 3, 4]},
            {"name": "ground", "mesh": 0, "scale": [4, 0.2, 4], "translation": [0, -0.1, 0], "extras": {"walk": True}},
            {"name": "left block", "mesh": 0, "translation": [-1.1, 0.5, 0.2]},
            {"name": "right block", "mesh": 0, "scale": [-0.5, 2, 0.8], "translation": [1, 1, -0.4]},
            {"name": "lamp", "mesh": 1, "scale": [0.8, 0.1, 0.8], "translation": [0, 2.6, 0.5]},
        ],
        "meshes": [{"name": "block", "primitives": [box(0)]}, {"name": "bulb", "primitives": [box(1)]}],
        "materials": [
            {"name": "stone", "pbrMetallicRoughness": {"baseColorFactor": [0.7, 0.5, 0.4, 1], "metallicFactor": 0}},
            {"name": "glow", "emissiveFactor": [1, 1, 0.8], "extras": {"watts": 60}},
        ],
        "animations": [
            {
                "name": "lift",
                "samplers": [{"input": times, "output": rise, "interpolation": "LINEAR"}],
                "channels": [{"sampler": 0, "target": {"node": 3, "path": "translation"}}],
            }
        ],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": len(blob)}],
    }
    text = json.dumps(tree).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<II", len(text), 0x4E4F534A) + text + struct.pack("<II", len(blob), 0x004E4942) + bytes(blob)
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


class Glb:
    """A GLB file, read by nothing of lightkiln."""

    def __init__(self, data: bytes) -> None:
        (length,) = struct.unpack_from("<I", data, 12)
        self.tree: dict[str, Any] = json.loads(data[20 : 20 + length])
        self.blob = data[28 + length :]

    def values(self, index: int) -> Array:
        """An accessor [N, C]."""
        about = self.tree["accessors"][index]
        view = self.tree["bufferViews"][about["bufferView"]]
        kind, width = np.dtype(COMPONENTS[about["componentType"]]), WIDTHS[about["type"]]
        start = view.get("byteOffset", 0) + about.get("byteOffset", 0)
        step = view.get("byteStride", width * kind.itemsize)
        rows = np.frombuffer(self.blob, np.uint8, (about["count"] - 1) * step + width * kind.itemsize, start)
        picked = np.arange(about["count"])[:, None] * step + np.arange(width * kind.itemsize)
        return rows[picked].copy().view(kind)

    def triangles(self) -> tuple[Array, Array]:
        """Places [T, 3, 3] in the world and light-map coordinates [T, 3, 2]."""
        places, uv = [], []
        stack = [(root, np.eye(4)) for root in self.tree["scenes"][self.tree.get("scene", 0)]["nodes"]]
        while stack:
            index, parent = stack.pop()
            node = self.tree["nodes"][index]
            matrix = parent @ (
                trimesh.transformations.translation_matrix(node.get("translation", [0, 0, 0]))
                @ trimesh.transformations.quaternion_matrix(np.roll(node.get("rotation", [0, 0, 0, 1]), 1))
                @ np.diag([*node.get("scale", [1, 1, 1]), 1.0])
            )
            stack += [(child, matrix) for child in node.get("children", [])]
            for part in self.tree["meshes"][node["mesh"]]["primitives"] if "mesh" in node else ():
                order = self.values(part["indices"]).reshape(-1).astype(np.int64)
                local = self.values(part["attributes"]["POSITION"]).astype(np.float64)
                world = local @ matrix[:3, :3].T + matrix[:3, 3]
                places.append(world[order].reshape(-1, 3, 3))
                uv.append(self.values(part["attributes"]["TEXCOORD_1"]).astype(np.float64)[order].reshape(-1, 3, 2))
        return np.concatenate(places), np.concatenate(uv)


def looked_up(texture: Array, uv: Array) -> Array:
    """Bilinear values [N, 3] at uv [N, 2], v downwards."""
    height, width, _ = texture.shape
    x, y = uv[:, 0] * width - 0.5, uv[:, 1] * height - 0.5
    left, top = np.floor(x).astype(int), np.floor(y).astype(int)
    fx, fy = (x - left)[:, None], (y - top)[:, None]

    def at(i: Array, j: Array) -> Array:
        return texture[np.clip(j, 0, height - 1), np.clip(i, 0, width - 1)]

    upper = at(left, top) * (1 - fx) + at(left + 1, top) * fx
    return upper * (1 - fy) + (at(left, top + 1) * (1 - fx) + at(left + 1, top + 1) * fx) * fy


@pytest.fixture(scope="module")
def package(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The user's file baked, its package in a folder."""
    folder = tmp_path_factory.mktemp("original")
    settings = make_settings("draft", [*TINY, "lightmap.resolution=64", "package.scene=original"])
    baked = bake_files(folder / "bake", {"user.glb": user_file()}, settings)
    (folder / "package").mkdir()
    return baked.download(folder / "package")


def test_the_file_comes_back_with_its_nodes_materials_and_animation(package: Path) -> None:
    old, new = Glb(user_file()), Glb((package / "original.glb").read_bytes())
    for part in ("asset", "scene", "scenes", "materials"):
        assert new.tree[part] == old.tree[part], part
    for one, two in zip(old.tree["nodes"], new.tree["nodes"], strict=True):
        assert one | {"mesh": None} == two | {"mesh": None}
        if "mesh" in one:
            assert new.tree["meshes"][two["mesh"]]["name"] == old.tree["meshes"][one["mesh"]]["name"]
    (lift,), (same,) = old.tree["animations"], new.tree["animations"]
    assert (lift["name"], lift["channels"]) == (same["name"], same["channels"])
    for end in ("input", "output"):
        np.testing.assert_array_equal(
            old.values(lift["samplers"][0][end]), new.values(same["samplers"][0][end]), err_msg=end
        )


def test_another_program_opens_it(package: Path) -> None:
    opened = trimesh.load(package / "original.glb")
    assert set(opened.graph.nodes_geometry) == {"ground", "left block", "right block", "lamp"}
    before = trimesh.load(trimesh.util.wrap_as_stream(user_file()), file_type="glb")
    np.testing.assert_allclose(opened.bounds, before.bounds, atol=1e-6)
    for node in before.graph.nodes_geometry:
        np.testing.assert_allclose(opened.graph[node][0], before.graph[node][0], atol=1e-6, err_msg=node)
    assert {mesh.visual.material.name for mesh in opened.geometry.values()} == {"stone", "glow"}


def test_its_light_map_coordinates_find_the_light_of_scene_glb(package: Path) -> None:
    """At random points of every triangle, both files look up the same irradiance, of which there are many values."""
    original, flat = (Glb((package / name).read_bytes()) for name in ("original.glb", "scene.glb"))
    places, uv = original.triangles()
    others, other_uv = flat.triangles()
    assert len(places) == len(others) == 48
    with OpenEXR.File(str(package / "irradiance.exr")) as file:
        irradiance = np.array(file.channels()["RGB"].pixels, dtype=np.float64)
    rng = np.random.default_rng(7)
    seen = []
    for triangle, corners in zip(places, uv, strict=True):
        # The same triangle of the other file, whose corners may come in another order.
        distance = np.linalg.norm(others[:, None] - triangle[None, :, None], axis=3)  # [T, 3, 3]
        match = int(np.argmin(distance.min(axis=2).max(axis=1)))
        order = distance[match].argmin(axis=1)
        assert sorted(order) == [0, 1, 2] and distance[match].min(axis=1).max() < 1e-5
        weights = rng.dirichlet([1, 1, 1], 16)
        one, two = weights @ corners, weights @ other_uv[match][order]
        np.testing.assert_allclose(one, two, atol=1e-6)
        seen.append(looked_up(irradiance, one))
        np.testing.assert_allclose(seen[-1], looked_up(irradiance, two), rtol=1e-3, atol=1e-4)
    values = np.concatenate(seen)
    assert values.max() > 10 * values[values > 0].min() > 0.0
    # The ground lies in the lamp's light, its underside in the dark.
    up = np.cross(places[:, 1] - places[:, 0], places[:, 2] - places[:, 0])[:, 1]
    middle = places.mean(axis=1)[:, 1]
    brightness = np.array([part.mean() for part in seen])
    top, bottom = (up > 10) & (np.abs(middle) < 1e-3), np.abs(middle + 0.2) < 1e-3
    assert top.sum() == bottom.sum() == 2
    assert brightness[top].min() > 0.02 > 10 * brightness[bottom].max()
