"""`original.glb`: the user's own glTF file with the light-map UV as TEXCOORD_1, and nothing flattened.

The JSON is edited in place and written back, so nodes, names, materials, animations and whatever extensions and extras
are in it stay as they are. Buffers follow each other in one binary chunk, their bytes unchanged; images beside the file
are embedded. A mesh that several nodes share is copied for each of them, as each has its own part of the light map.
Where a vertex has several light-map UVs (a seam), it is duplicated with all its attributes and morph targets, whose
component types are kept. Triangles of the file are matched with those that were baked by their place in the world.
"""

import json
import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final
from urllib.parse import unquote

import numpy as np
import numpy.typing as npt

from kiln_schemas.errors import InputError
from kiln_schemas.text import told
from kiln_workers.scene.bundle import BundleFolder
from kiln_workers.scene.geometry import Floats, Ints, sound_faces
from kiln_workers.scene.gltf import _local_matrix
from kiln_workers.scene.gltf_buffers import CHUNK_BIN, CHUNK_JSON, COMPONENTS, GltfBuffers, split_glb
from kiln_workers.scene.gltf_document import Document, Primitive, parse_document
from kiln_workers.scene.limits import NAME_LENGTH
from kiln_workers.scene.model import Mesh
from kiln_workers.scene.polygons import FAN, STRIP, TRIANGLES, listed_faces

SUFFIXES: Final = (".glb", ".gltf")
SET: Final = "TEXCOORD_1"
UNFIT: Final = {
    "KHR_draco_mesh_compression": "its meshes are compressed with Draco",
    "EXT_meshopt_compression": "its buffers are compressed with meshopt",
    "EXT_mesh_gpu_instancing": "instances of EXT_mesh_gpu_instancing cannot have light-map UVs of their own",
}
ARRAY_BUFFER, ELEMENT_ARRAY_BUFFER = 34962, 34963
Array = npt.NDArray[Any]


def check_original(folder: Path, entry: str) -> None:
    """InputError where `package.scene=original` cannot be served for a scene file, with the reason."""
    if not entry.lower().endswith(SUFFIXES):
        raise _unfit(f"'{entry}' is not glTF, and only glTF files can be given back")
    tree = json.loads(_split(folder, entry)[0])
    for name in tree.get("extensionsUsed", []):
        if name in UNFIT:
            raise _unfit(UNFIT[name])
    for material in tree.get("materials", []):
        if any(info.get("texCoord") == 1 for info in _texture_infos(material)):
            raise _unfit(f"its material '{material.get('name', '')}' uses {SET} for a texture")


def encode_original(folder: Path, entry: str, meshes: Sequence[Mesh]) -> bytes:
    """The file `entry` of the bundle `folder` as GLB with the light-map UVs of the baked `meshes`, in their order."""
    text, binary = _split(folder, entry)
    document = parse_document(text, entry)
    bundle = BundleFolder(folder, entry)
    writer = _Writer(json.loads(text), GltfBuffers(document, bundle, binary))
    writer.embed(document)
    writer.add_sets(document, list(meshes))
    return writer.glb()


@dataclass
class _Writer:
    tree: dict[str, Any]
    buffers: GltfBuffers
    blob: bytearray = field(default_factory=bytearray)

    def embed(self, document: Document) -> None:
        """All buffers, one after the other, and the images that are files, in one chunk."""
        starts = []
        for index in range(len(document.buffers)):
            starts.append(self._append(bytes(self.buffers._buffer(index))))
        for view in self.tree.get("bufferViews", []):
            view["byteOffset"] = view.get("byteOffset", 0) + starts[view["buffer"]]
            view["buffer"] = 0
        for image in self.tree.get("images", []):
            uri = image.get("uri", "data:")
            if not uri.startswith("data:"):
                data = self.buffers.folder.read(unquote(uri), "image")
                del image["uri"]
                image |= {"bufferView": self._view(data), "mimeType": _media_type(data)}

    def add_sets(self, document: Document, meshes: Sequence[Mesh]) -> None:
        """TEXCOORD_1 on every primitive that was baked; InputError where they are not found again."""
        source = json.loads(json.dumps(self.tree.get("meshes", [])))
        written: set[int] = set()
        done = 0
        for node, matrix in _placed(document):
            number = document.nodes[node].mesh
            if number is None:
                continue
            name = document.nodes[node].name or document.meshes[number].name or f"mesh {number}"
            own = json.loads(json.dumps(source[number]))
            found = 0
            for tree, primitive in zip(own["primitives"], document.meshes[number].primitives, strict=True):
                if done == len(meshes) or not meshes[done].name.startswith(told(name, NAME_LENGTH)):
                    break
                if primitive.mode not in (TRIANGLES, STRIP, FAN) or "POSITION" not in primitive.attributes:
                    continue
                positions, faces = self._surface(primitive)
                corner_uv = _corner_uv(positions, faces, matrix, meshes[done])
                if corner_uv is not None:
                    self._write(tree, primitive, len(positions), faces, corner_uv)
                    found, done = found + 1, done + 1
            if found and number not in written:
                self.tree["meshes"][number] = own
                written.add(number)
            elif found:
                self.tree["meshes"].append(own)
                self.tree["nodes"][node]["mesh"] = len(self.tree["meshes"]) - 1
        if done != len(meshes):
            raise _unfit(f"mesh '{meshes[done].name}' was not found again in the file")

    def glb(self) -> bytes:
        """The document and its one buffer (glTF 2.0, 4.4)."""
        self._append(b"")
        self.tree["buffers"] = [{"byteLength": len(self.blob)}]
        text = json.dumps(self.tree, ensure_ascii=False, separators=(",", ":")).encode()
        text += b" " * (-len(text) % 4)
        head = struct.pack("<4sII", b"glTF", 2, 12 + 8 + len(text) + 8 + len(self.blob))
        chunks = struct.pack("<II", len(text), CHUNK_JSON), text, struct.pack("<II", len(self.blob), CHUNK_BIN)
        return b"".join([head, *chunks, self.blob])

    def _surface(self, primitive: Primitive) -> tuple[Floats, Ints]:
        """Positions [V, 3] and faces [F, 3] as they are in the file."""
        positions = self.buffers.floats(primitive.attributes["POSITION"], 3, "POSITION")
        order = np.arange(len(positions), dtype=np.int64)
        if primitive.indices is not None:
            order = self.buffers.indices(primitive.indices)
        return positions, listed_faces(order, primitive.mode)

    def _write(self, tree: dict[str, Any], primitive: Primitive, count: int, faces: Ints, uv: Floats) -> None:
        """Give a primitive the UVs [F, 3, 2]; vertices that have several are duplicated."""
        rows = np.column_stack([faces.reshape(-1), uv.reshape(-1, 2).astype(np.float32).view(np.int32)])
        _, first, corner = np.unique(rows, axis=0, return_index=True, return_inverse=True)
        vertex = faces.reshape(-1)[first]
        values = uv.reshape(-1, 2)[first].astype("<f4")
        if len(np.unique(vertex)) == len(vertex):
            whole = np.zeros((count, 2), "<f4")
            whole[vertex] = values
            tree["attributes"][SET] = self._accessor(whole, "VEC2", 5126, {})
            return
        for attributes in [tree["attributes"], *tree.get("targets", [])]:
            for name, index in attributes.items():
                attributes[name] = self._gathered(index, vertex)
        tree["attributes"][SET] = self._accessor(values, "VEC2", 5126, {})
        short = len(vertex) < 65535
        indices = corner.reshape(-1, 1).astype("<u2" if short else "<u4")
        tree["indices"] = self._accessor(indices, "SCALAR", 5123 if short else 5125, {}, ELEMENT_ARRAY_BUFFER)
        tree["mode"] = TRIANGLES

    def _gathered(self, index: int, vertex: Ints) -> int:
        """A copy of an accessor with the elements `vertex`, its component type kept."""
        about = self.tree["accessors"][index]
        width = COMPONENTS[about["type"]]
        values = self.buffers._read(index, width, "attribute")[1][vertex]
        kept = {key: value for key, value in about.items() if key in ("name", "normalized", "extras", "extensions")}
        if "min" in about or "max" in about:
            kept |= {"min": values.min(axis=0).tolist(), "max": values.max(axis=0).tolist()}
        return self._accessor(values, about["type"], about["componentType"], kept)

    def _accessor(
        self, values: Array, kind: str, component: int, more: dict[str, Any], target: int = ARRAY_BUFFER
    ) -> int:
        """The number of a new accessor over rows [N, width]; vertex attributes start at multiples of four bytes."""
        size = values.shape[1] * values.dtype.itemsize
        stride = size + (-size % 4) if target == ARRAY_BUFFER else size
        rows = np.zeros((len(values), stride), np.uint8)
        rows[:, :size] = np.ascontiguousarray(values).view(np.uint8).reshape(len(values), size)
        view = self._view(rows.tobytes(), {"target": target} | ({"byteStride": stride} if stride != size else {}))
        about = {"bufferView": view, "componentType": component, "count": len(values), "type": kind}
        self.tree["accessors"].append(about | more)
        return len(self.tree["accessors"]) - 1

    def _view(self, data: bytes, more: dict[str, int] | None = None) -> int:
        start = self._append(data)
        views = self.tree.setdefault("bufferViews", [])
        views.append({"buffer": 0, "byteOffset": start, "byteLength": len(data)} | (more or {}))
        return len(views) - 1

    def _append(self, data: bytes) -> int:
        """Where the data lie in the chunk, at a multiple of four."""
        self.blob += bytes(-len(self.blob) % 4)
        start = len(self.blob)
        self.blob += data
        return start


def _corner_uv(positions: Floats, faces: Ints, matrix: Floats, mesh: Mesh) -> Floats | None:
    """The light-map UV [F, 3, 2] at the corners of the file's faces; None where `mesh` is not this primitive.

    Faces that were not baked, as they have no area, take the UV of a neighbour, or 0.
    """
    assert mesh.lightmap_uv is not None
    linear = matrix[:3, :3]
    placed = positions @ linear.T + matrix[:3, 3]
    mirrored = bool(np.linalg.det(linear) < 0.0)
    baked = sound_faces(placed, faces) if len(mesh.faces) < len(faces) else np.ones(len(faces), dtype=bool)
    if int(baked.sum()) != len(mesh.faces):
        return None
    out = np.zeros((len(faces), 3, 2))
    out[baked] = mesh.lightmap_uv[mesh.faces[:, ::-1] if mirrored else mesh.faces]
    some = np.zeros((len(positions), 2))
    some[faces[baked]] = out[baked]
    out[~baked] = some[faces[~baked]]
    return out


def _placed(document: Document) -> Iterator[tuple[int, Floats]]:
    """Number and world transform of every node of the scene, in the reader's order."""
    children = {child for node in document.nodes for child in node.children}
    roots = [index for index in range(len(document.nodes)) if index not in children]
    if document.scenes:
        roots = list(document.scenes[document.scene or 0].nodes)
    stack = [(index, np.eye(4)) for index in reversed(roots)]
    while stack:
        index, parent = stack.pop()
        node = document.nodes[index]
        matrix = parent @ _local_matrix(node)
        yield index, matrix
        stack += [(child, matrix) for child in reversed(node.children)]


def _texture_infos(tree: Any) -> Iterator[dict[str, Any]]:
    """All objects of a material that name a texture."""
    if isinstance(tree, dict):
        if "index" in tree:
            yield tree
        for value in tree.values():
            yield from _texture_infos(value)


def _media_type(data: bytes) -> str:
    if data[:4] == b"RIFF":
        return "image/webp"
    if data[:4] == b"\xabKTX":
        return "image/ktx2"
    return "image/png" if data[:4] == b"\x89PNG" else "image/jpeg"


def _split(folder: Path, entry: str) -> tuple[bytes, bytes | None]:
    return split_glb(BundleFolder(folder, entry).read(Path(entry).name, "scene"), entry)


def _unfit(reason: str) -> InputError:
    return InputError(
        f"the original file cannot be given back: {reason}",
        where="package.scene",
        remedy="Leave package.scene at flat, or export the scene as plain glTF.",
    )
