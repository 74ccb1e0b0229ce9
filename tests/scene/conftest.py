"""Small scenes made on the spot: a glTF document from arrays, and meshes of the model."""

import base64
import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio
import pytest

from kiln_workers.scene.model import Material, Mesh, Scene

TRIANGLE = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], dtype=np.float32)
COMPONENT = {"f4": 5126, "u1": 5121, "u2": 5123, "u4": 5125, "i1": 5120, "i2": 5122}
TYPES = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4"}


class GltfBuilder:
    """Collects accessors in one data URI buffer and writes the document."""

    def __init__(self) -> None:
        self.document: dict[str, Any] = {"asset": {"version": "2.0"}, "bufferViews": [], "accessors": []}
        self.data = bytearray()

    def accessor(self, values: Any, normalized: bool = False) -> int:
        array = np.ascontiguousarray(values)
        array = array.reshape(len(array), -1)
        self.document["bufferViews"].append({"buffer": 0, "byteOffset": len(self.data), "byteLength": array.nbytes})
        self.data += array.tobytes() + b"\0" * (-array.nbytes % 4)
        self.document["accessors"].append(
            {
                "bufferView": len(self.document["bufferViews"]) - 1,
                "componentType": COMPONENT[array.dtype.str[1:]],
                "count": len(array),
                "type": TYPES[array.shape[1]],
                "normalized": normalized,
            }
        )
        return len(self.document["accessors"]) - 1

    def mesh(
        self,
        positions: Any = TRIANGLE,
        indices: Sequence[int] | None = (0, 1, 2),
        material: int | None = None,
        **more: Any,
    ) -> int:
        """Append a mesh; `more` are further attributes by name."""
        attributes = {"POSITION": self.accessor(np.asarray(positions, dtype=np.float32))}
        attributes |= {name: self.accessor(values) for name, values in more.items()}
        primitive: dict[str, Any] = {"attributes": attributes}
        if indices is not None:
            primitive["indices"] = self.accessor(np.array(indices, dtype=np.uint16))
        if material is not None:
            primitive["material"] = material
        meshes = self.document.setdefault("meshes", [])
        meshes.append({"name": f"mesh-{len(meshes)}", "primitives": [primitive]})
        return len(meshes) - 1

    def write(self, folder: Path, name: str = "scene.gltf", nodes: Sequence[Mapping[str, Any]] | None = None) -> str:
        if nodes is None:
            nodes = [{"mesh": index} for index in range(len(self.document.get("meshes", [])))]
        children = {child for node in nodes for child in node.get("children", [])}
        self.document["nodes"] = list(nodes)
        self.document["scenes"] = [{"nodes": [i for i in range(len(nodes)) if i not in children]}]
        uri = "data:application/octet-stream;base64," + base64.b64encode(bytes(self.data)).decode()
        self.document["buffers"] = [{"byteLength": len(self.data), "uri": uri}]
        (folder / name).write_text(json.dumps(self.document))
        return name


@pytest.fixture
def gltf() -> GltfBuilder:
    return GltfBuilder()


@pytest.fixture
def write_image() -> Callable[[Path, Any], Path]:
    """Write [H, W, C] pixels in the format that the suffix names."""

    def write(path: Path, pixels: Any) -> Path:
        buffer = oiio.ImageBuf(np.ascontiguousarray(pixels))
        assert buffer.write(str(path)), buffer.geterror()
        return path

    return write


def quad_mesh(
    name: str,
    corner: Sequence[float],
    s: Sequence[float],
    t: Sequence[float],
    uv_box: tuple[float, float, float, float],
) -> Mesh:
    """A parallelogram with light-map UV over (u0, v0, u1, v1), normal s x t."""
    c, a, b = (np.array(v, dtype=np.float32) for v in (corner, s, t))
    normal = np.cross(a, b)
    u0, v0, u1, v1 = uv_box
    return Mesh(
        name=name,
        positions=np.stack([c, c + a, c + a + b, c + b]),
        normals=np.tile(normal / np.linalg.norm(normal), (4, 1)).astype(np.float32),
        faces=np.array([[0, 1, 2], [0, 2, 3]], dtype=np.int32),
        material=0,
        lightmap_uv=np.array([[u0, v0], [u1, v0], [u1, v1], [u0, v1]], dtype=np.float32),
    )


@pytest.fixture
def make_quad() -> Callable[..., Mesh]:
    return quad_mesh


@pytest.fixture
def two_quads() -> Scene:
    """Two squares of one metre with separate light-map charts."""
    return Scene(
        (
            quad_mesh("left", (0, 0, 0), (1, 0, 0), (0, 1, 0), (0.1, 0.1, 0.4, 0.4)),
            quad_mesh("right", (2, 0, 0), (1, 0, 0), (0, 1, 0), (0.6, 0.1, 0.9, 0.4)),
        ),
        (Material("plain"),),
    )


@pytest.fixture
def surface():
    """What the light sees of each mesh of a scene: name, and corner by corner all that belongs to it."""

    def of(scene):
        out = {}
        for mesh in scene.meshes:
            corner = mesh.faces.reshape(-1)
            out[mesh.name] = {
                "positions": (mesh.positions.astype(np.float64) + scene.origin)[corner],
                "normals": mesh.normals[corner],
                "lightmap_uv": mesh.lightmap_uv[corner],
                "colors": mesh.colors[corner],
                "uv": mesh.uv[corner],
            }
        return out

    return of
