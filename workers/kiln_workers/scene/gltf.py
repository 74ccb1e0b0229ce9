"""Reader of glTF 2.0 and GLB: meshes under node transforms, metallic-roughness materials, textures, punctual lights.

Khronos glTF 2.0 with KHR_materials_emissive_strength, KHR_lights_punctual, KHR_texture_transform,
KHR_mesh_quantization, KHR_materials_unlit and EXT_mesh_gpu_instancing. Read by an own reader over pydantic models
(`gltf_document`), as general loaders drop TEXCOORD_1 or believe a stranger's offsets. What the method has no use for
is ignored with a note; a *required* extension that is not in the list is refused by name. Photometric and
radiometric units of lights are taken one to one, as renderers of glTF do (candela as W/sr, lux as W/m^2).
"""

from collections import Counter
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Final

import numpy as np

from kiln_schemas.errors import InputError
from kiln_schemas.text import QUOTE_LENGTH, told
from kiln_workers.scene.bundle import BundleFolder
from kiln_workers.scene.geometry import (
    Floats,
    Ints,
    RawMesh,
    check_mesh_count,
    check_triangle_count,
    place,
    unique_names,
)
from kiln_workers.scene.gltf_buffers import GltfBuffers, split_glb
from kiln_workers.scene.gltf_document import (
    Document,
    Instancing,
    LightIndex,
    Lights,
    Node,
    Primitive,
    parse_document,
    parse_extension,
    pick,
)
from kiln_workers.scene.gltf_materials import MaterialTable
from kiln_workers.scene.limits import NAME_LENGTH
from kiln_workers.scene.model import LightKind, Mesh, PunctualLight, Scene

READ_EXTENSIONS: Final = frozenset(
    {
        "KHR_materials_emissive_strength",
        "KHR_lights_punctual",
        "KHR_texture_transform",
        "KHR_mesh_quantization",
        "KHR_materials_unlit",
        "EXT_mesh_gpu_instancing",
    }
)
HARMLESS: Final = frozenset({"KHR_xmp", "KHR_xmp_json_ld", "KHR_materials_variants", "KHR_node_visibility"})
TRIANGLES, STRIP, FAN = 4, 5, 6


def read_gltf(folder: Path, entry: str) -> Scene:
    """The scene of a `.gltf` or `.glb` file of the bundle `folder`."""
    bundle = BundleFolder(folder, entry)
    text, binary = split_glb(bundle.read(Path(entry).name, "scene"), entry)
    document = parse_document(text, entry)
    return _Reader(document, GltfBuffers(document, bundle, binary), entry).read()


@dataclass
class _Placed:
    """A node with its transform to the world."""

    node: Node
    matrix: Floats


@dataclass
class _Reader:
    document: Document
    buffers: GltfBuffers
    entry: str
    notes: list[str] = field(default_factory=list)
    ignored: Counter[str] = field(default_factory=Counter)

    def read(self) -> Scene:
        self._check_extensions()
        materials = MaterialTable(self.document, self.buffers, self.notes)
        placed = self._placed_nodes()
        meshes: list[Mesh] = []
        for raw, matrix in self._instances(placed, materials):
            mesh, notes = place(raw, matrix)
            self.notes += notes
            meshes += [mesh] if mesh is not None else []
        self.notes += [f"'{self.entry}': {what} ({count}) ignored." for what, count in sorted(self.ignored.items())]
        if self.document.animations:
            self.notes.append(f"'{self.entry}': animations ignored; the scene is baked in its rest pose.")
        return Scene(
            meshes=tuple(meshes),
            materials=tuple(materials.materials),
            images=tuple(materials.images),
            lights=tuple(self._lights(placed)),
            notes=tuple(self.notes),
        )

    def _check_extensions(self) -> None:
        if not self.document.asset.version.startswith("2."):
            raise InputError(
                f"is glTF {told(self.document.asset.version, QUOTE_LENGTH)}",
                where=self.entry,
                remedy="Export it as glTF 2.0.",
            )
        for name in self.document.extensions_required:
            if name not in READ_EXTENSIONS:
                raise InputError(
                    f"requires the extension {told(name, NAME_LENGTH)}, which is not read",
                    where=self.entry,
                    remedy="Export it without this extension (uncompressed geometry, PNG or JPEG textures).",
                )
        for name in sorted(set(self.document.extensions_used) - READ_EXTENSIONS - HARMLESS):
            self.notes.append(f"'{self.entry}': extension {told(name, NAME_LENGTH)} ignored.")

    def _placed_nodes(self) -> list[_Placed]:
        """Nodes of the scene, depth first, each with its world transform; a node reached twice is refused."""
        document = self.document
        if document.scenes:
            roots = pick(document.scenes, document.scene or 0, "scene", self.entry).nodes
        else:
            children = {child for node in document.nodes for child in node.children}
            roots = [index for index in range(len(document.nodes)) if index not in children]
        seen: set[int] = set()
        out: list[_Placed] = []
        stack = [(index, np.eye(4)) for index in reversed(roots)]
        while stack:
            index, parent = stack.pop()
            if index in seen:
                raise InputError(
                    f"node {index} is reached twice: a cycle, or two parents",
                    where=self.entry,
                    remedy="Export it again.",
                )
            seen.add(index)
            node = pick(document.nodes, index, "node", self.entry)
            with np.errstate(over="ignore", invalid="ignore"):
                matrix = parent @ _local_matrix(node)
            if not np.isfinite(matrix).all():
                raise InputError(
                    f"the transform of node {index} '{node.name}' is not finite", where=self.entry, remedy="Mend it."
                )
            out.append(_Placed(node, matrix))
            stack += [(child, matrix) for child in reversed(node.children)]
        return out

    def _instances(self, placed: list[_Placed], materials: MaterialTable) -> list[tuple[RawMesh, Floats]]:
        """Every primitive of every instance with its transform; triangles are counted before anything is copied."""
        primitives: dict[int, list[RawMesh]] = {}
        pairs: list[tuple[RawMesh, Floats]] = []
        triangles = instances = 0
        for item in placed:
            index = item.node.mesh
            if index is None:
                continue
            if index not in primitives:
                primitives[index] = self._primitives(index, materials)
            if item.node.skin is not None:
                self.ignored["skinning"] += 1
            matrices = self._instance_matrices(item, instances)
            instances += len(matrices)
            for matrix in matrices:
                for raw in primitives[index]:
                    triangles += len(raw.faces)
                    check_triangle_count(triangles, self.entry)
                    check_mesh_count(len(pairs) + 1, self.entry)
                    suffix = raw.name[raw.name.rfind("/") :] if len(primitives[index]) > 1 else ""
                    name = item.node.name + suffix if item.node.name else raw.name
                    pairs.append((replace(raw, name=name), matrix))
        names = unique_names(raw.name for raw, _ in pairs)
        return [(replace(raw, name=name), matrix) for name, (raw, matrix) in zip(names, pairs, strict=True)]

    def _instance_matrices(self, item: _Placed, before: int) -> list[Floats]:
        """World transforms of a node's instances; `before` are there already."""
        content = item.node.extensions.get("EXT_mesh_gpu_instancing")
        if content is None:
            return [item.matrix]
        instancing = parse_extension(Instancing, content, f"{self.entry}: EXT_mesh_gpu_instancing")
        widths = {"TRANSLATION": 3, "ROTATION": 4, "SCALE": 3}
        for index in instancing.attributes.values():
            count = pick(self.document.accessors, index, "accessor", self.entry).count
            check_mesh_count(before + count, self.entry)
        parts = {
            name: self.buffers.floats(index, widths[name], name)
            for name, index in instancing.attributes.items()
            if name in widths
        }
        counts = {len(values) for values in parts.values()}
        if len(counts) != 1:
            raise InputError(
                f"node '{item.node.name}' has instancing attributes of {sorted(counts)} elements",
                where=self.entry,
                remedy="All need the same, sensible count.",
            )
        count = counts.pop()
        translation = parts.get("TRANSLATION", np.zeros((count, 3)))
        rotation = parts.get("ROTATION", np.tile([0.0, 0.0, 0.0, 1.0], (count, 1)))
        scale = parts.get("SCALE", np.ones((count, 3)))
        return [item.matrix @ _trs(translation[i], rotation[i], scale[i]) for i in range(count)]

    def _primitives(self, mesh_index: int, materials: MaterialTable) -> list[RawMesh]:
        part = pick(self.document.meshes, mesh_index, "mesh", self.entry)
        name = part.name or f"mesh {mesh_index}"
        several = len(part.primitives) > 1
        out = []
        for number, primitive in enumerate(part.primitives):
            raw = self._primitive(primitive, f"{name}/{number}" if several else name, materials)
            out += [raw] if raw is not None else []
        return out

    def _primitive(self, primitive: Primitive, name: str, materials: MaterialTable) -> RawMesh | None:
        if primitive.mode not in (TRIANGLES, STRIP, FAN):
            self.ignored["primitives of points or lines"] += 1
            return None
        if "POSITION" not in primitive.attributes:
            self.ignored["primitives without positions"] += 1
            return None
        if primitive.targets:
            self.ignored["morph targets"] += 1
        if "COLOR_0" in primitive.attributes:
            self.ignored["vertex colours"] += 1
        positions = self.buffers.floats(primitive.attributes["POSITION"], 3, f"POSITION of mesh '{name}'")
        order = (
            self.buffers.indices(primitive.indices)
            if primitive.indices is not None
            else np.arange(len(positions), dtype=np.int64)
        )
        material, uv_set = materials.use(primitive.material, name)
        used: Ints | slice = slice(None)
        if len(positions) > 2 * len(order) > 0 and order.max() < len(positions):
            # Primitives may share one large vertex buffer: each keeps its own vertices only.
            used, order = np.unique(order, return_inverse=True)

        def attribute(key: str, width: int) -> Floats | None:
            values = self._attribute(primitive, key, width, name, len(positions))
            return None if values is None else values[used]

        return RawMesh(
            name=name,
            positions=positions[used],
            faces=_triangulated(order, primitive.mode),
            material=material,
            normals=attribute("NORMAL", 3),
            uv=attribute(f"TEXCOORD_{uv_set}", 2),
            lightmap_uv=attribute("TEXCOORD_1", 2),
        )

    def _attribute(self, primitive: Primitive, key: str, width: int, name: str, count: int) -> Floats | None:
        if key not in primitive.attributes:
            return None
        values = self.buffers.floats(primitive.attributes[key], width, f"{key} of mesh '{name}'")
        if len(values) != count:
            raise InputError(
                f"{key} has {len(values)} values for {count} vertices",
                where=f"mesh '{name}'",
                remedy="Export it again.",
            )
        return values

    def _lights(self, placed: list[_Placed]) -> list[PunctualLight]:
        where = f"{self.entry}: KHR_lights_punctual"
        table = parse_extension(Lights, self.document.extensions.get("KHR_lights_punctual", {}), where).lights
        out = []
        for item in placed:
            content = item.node.extensions.get("KHR_lights_punctual")
            if content is None:
                continue
            light = pick(table, parse_extension(LightIndex, content, where).light, "light", where)
            direction = item.matrix[:3, :3] @ np.array([0.0, 0.0, -1.0])
            length = float(np.linalg.norm(direction))
            if length == 0.0 and light.type != "point":
                raise InputError(f"light '{light.name}' has no direction: its node is scaled to 0", where=where)
            direction = direction / length if length > 0.0 else np.array([0.0, 0.0, -1.0])
            if light.spot.inner_cone_angle > light.spot.outer_cone_angle:
                raise InputError(f"light '{light.name}' has an inner cone wider than its outer one", where=where)
            red, green, blue = (float(c * light.intensity) for c in light.color)
            out.append(
                PunctualLight(
                    name=light.name or item.node.name or light.type,
                    kind=LightKind(light.type),
                    intensity=(red, green, blue),
                    position=_triple(item.matrix[:3, 3]),
                    direction=_triple(direction),
                    inner_cone=light.spot.inner_cone_angle,
                    outer_cone=light.spot.outer_cone_angle,
                )
            )
        return out


def _local_matrix(node: Node) -> Floats:
    if node.matrix is not None:
        return np.array(node.matrix, dtype=np.float64).reshape(4, 4).T
    return _trs(np.array(node.translation), np.array(node.rotation), np.array(node.scale))


def _trs(translation: Floats, rotation: Floats, scale: Floats) -> Floats:
    """Translation times rotation (quaternion x, y, z, w; need not be of unit length) times scale."""
    length = float(np.linalg.norm(rotation))
    x, y, z, w = rotation / length if length > 0.0 else np.array([0.0, 0.0, 0.0, 1.0])
    turn = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )
    matrix = np.eye(4)
    matrix[:3, :3] = turn * scale[None, :]
    matrix[:3, 3] = translation
    return matrix


def _triangulated(order: Ints, mode: int) -> Ints:
    """Faces [F, 3] of a list, strip or fan of vertices (glTF 2.0, 3.7.2.1)."""
    if mode == TRIANGLES:
        return order[: len(order) // 3 * 3].reshape(-1, 3)
    count = max(len(order) - 2, 0)
    i = np.arange(count)
    if mode == FAN:
        return np.stack([order[i + 1], order[i + 2], np.broadcast_to(order[:1], count)], axis=1).reshape(-1, 3)
    odd = i % 2
    return np.stack([order[i], order[i + 1 + odd], order[i + 2 - odd]], axis=1).reshape(-1, 3)


def _triple(vector: Floats) -> tuple[float, float, float]:
    x, y, z = (float(value) for value in vector)
    return x, y, z
