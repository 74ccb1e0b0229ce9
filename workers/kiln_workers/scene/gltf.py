"""Reader of glTF 2.0 and GLB: meshes under node transforms, skins and morph targets at rest, materials, lights.

Read by an own reader over pydantic models (`gltf_document`), as general loaders drop TEXCOORD_1 or believe a stranger's
offsets. docs/scene-input.md says what becomes of each feature and extension; what the method has no use for is ignored
with a note. Photometric and radiometric units of lights are taken one to one, as renderers of glTF do (candela as W/sr,
lux as W/m^2).
"""

from collections import Counter
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from kiln_schemas.errors import InputError
from kiln_workers.scene.bundle import BundleFolder
from kiln_workers.scene.container import Array
from kiln_workers.scene.geometry import (
    Floats,
    Ints,
    RawMesh,
    check_mesh_count,
    check_triangle_count,
    placed_meshes,
)
from kiln_workers.scene.gltf_buffers import GltfBuffers, split_glb
from kiln_workers.scene.gltf_compression import decode_draco
from kiln_workers.scene.gltf_deform import Influences, influences, joint_matrices, morphed, skinned
from kiln_workers.scene.gltf_document import (
    Document,
    Draco,
    Instancing,
    LightIndex,
    Lights,
    Node,
    Primitive,
    Visibility,
    parse_document,
    parse_extension,
    pick,
)
from kiln_workers.scene.gltf_extensions import check_extensions
from kiln_workers.scene.gltf_materials import MaterialTable
from kiln_workers.scene.model import LightKind, PunctualLight, Scene
from kiln_workers.scene.polygons import FAN, STRIP, TRIANGLES, listed_faces


def read_gltf(folder: Path, entry: str) -> Scene:
    """The scene of a `.gltf` or `.glb` file of the bundle `folder`."""
    bundle = BundleFolder(folder, entry)
    text, binary = split_glb(bundle.read(Path(entry).name, "scene"), entry)
    document = parse_document(text, entry)
    return _Reader(document, GltfBuffers(document, bundle, binary), entry).read()


@dataclass
class Placed:
    """A node with its transform to the world."""

    index: int
    node: Node
    matrix: Floats
    visible: bool


@dataclass
class _Part:
    """A primitive, and the joints and weights of its vertices."""

    raw: RawMesh
    influence: Influences | None


@dataclass
class _Draco:
    """A primitive's decoded Draco buffer."""

    attributes: dict[str, Array]  # [V, C]
    faces: Ints  # [F, 3]


def placed_nodes(document: Document, entry: str) -> list[Placed]:
    """Nodes of the scene, depth first, each with its world transform; a node reached twice is refused."""
    if document.scenes:
        roots = pick(document.scenes, document.scene or 0, "scene", entry).nodes
    else:
        children = {child for node in document.nodes for child in node.children}
        roots = [index for index in range(len(document.nodes)) if index not in children]
    seen: set[int] = set()
    out: list[Placed] = []
    stack = [(index, np.eye(4), True) for index in reversed(roots)]
    while stack:
        index, parent, visible = stack.pop()
        if index in seen:
            raise InputError(
                f"node {index} is reached twice: a cycle, or two parents",
                where=entry,
                remedy="Export it again.",
            )
        seen.add(index)
        node = pick(document.nodes, index, "node", entry)
        with np.errstate(over="ignore", invalid="ignore"):
            matrix = parent @ _local_matrix(node)
        if not np.isfinite(matrix).all():
            raise InputError(
                f"the transform of node {index} '{node.name}' is not finite", where=entry, remedy="Mend it."
            )
        content = node.extensions.get("KHR_node_visibility", {})
        visible &= parse_extension(Visibility, content, f"{entry}: KHR_node_visibility").visible
        out.append(Placed(index, node, matrix, visible))
        stack += [(child, matrix, visible) for child in reversed(node.children)]
    return out


@dataclass
class _Reader:
    document: Document
    buffers: GltfBuffers
    entry: str
    notes: list[str] = field(default_factory=list)
    ignored: Counter[str] = field(default_factory=Counter)

    def read(self) -> Scene:
        document = self.document
        self.notes += check_extensions(document.extensions_used, document.extensions_required, self.entry)
        materials = MaterialTable(self.document, self.buffers, self.notes)
        placed = placed_nodes(document, self.entry)
        hidden = sum(not item.visible for item in placed)
        meshes, notes = placed_meshes(self._instances(placed, materials))
        self.notes += notes
        self.notes += [f"'{self.entry}': {what} ({count}) ignored." for what, count in sorted(self.ignored.items())]
        if self.document.animations:
            self.notes.append(f"'{self.entry}': animations ignored; the scene is baked in its rest pose.")
        if hidden:
            self.notes.append(f"'{self.entry}': {hidden} hidden nodes left out.")
        return Scene(
            meshes=meshes,
            materials=tuple(materials.materials),
            images=tuple(materials.images),
            lights=tuple(self._lights(placed)),
            notes=tuple(self.notes),
        )

    def _instances(self, placed: list[Placed], materials: MaterialTable) -> list[tuple[RawMesh, Floats]]:
        """Every primitive of every instance with its transform; triangles are counted before anything is copied."""
        primitives: dict[tuple[int, tuple[float, ...]], list[_Part]] = {}
        worlds = {item.index: item.matrix for item in placed}
        pairs: list[tuple[RawMesh, Floats]] = []
        triangles = instances = 0
        for item in placed:
            index = item.node.mesh
            if index is None or not item.visible:
                continue
            key = (index, tuple(item.node.weights))
            if key not in primitives:
                primitives[key] = self._primitives(index, key[1], materials)
            parts, matrices = primitives[key], self._instance_matrices(item, instances)
            instances += len(matrices)
            for part in parts:
                # Counted before anything is copied.
                triangles += len(part.raw.faces) * len(matrices)
                check_triangle_count(triangles, self.entry)
                check_mesh_count(len(pairs) + len(matrices), self.entry)
                suffix = part.raw.name[part.raw.name.rfind("/") :] if len(parts) > 1 else ""
                raw = replace(part.raw, name=item.node.name + suffix if item.node.name else part.raw.name)
                if item.node.skin is not None and part.influence is not None:
                    skin = pick(self.document.skins, item.node.skin, "skin", self.entry)
                    joints = joint_matrices(skin, item.node.skin, worlds, self.buffers, self.entry)
                    pairs.append((skinned(raw, part.influence, joints), np.eye(4)))
                else:
                    pairs += [(raw, matrix) for matrix in matrices]
        return pairs

    def _instance_matrices(self, item: Placed, before: int) -> list[Floats]:
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

    def _primitives(self, index: int, weights: tuple[float, ...], materials: MaterialTable) -> list[_Part]:
        part = pick(self.document.meshes, index, "mesh", self.entry)
        name = part.name or f"mesh {index}"
        several = len(part.primitives) > 1
        out = []
        for number, primitive in enumerate(part.primitives):
            title = f"{name}/{number}" if several else name
            if primitive.mode not in (TRIANGLES, STRIP, FAN):
                self.ignored["primitives of points or lines"] += 1
            elif "POSITION" not in primitive.attributes:
                self.ignored["primitives without positions"] += 1
            else:
                out.append(self._primitive(primitive, title, weights or tuple(part.weights), materials))
        return out

    def _primitive(
        self, primitive: Primitive, name: str, weights: tuple[float, ...], materials: MaterialTable
    ) -> _Part:
        packed = self._draco(primitive, name)
        positions = self._read(primitive, packed, "POSITION", 3, name)
        if packed is not None:
            order = packed.faces.reshape(-1)
        elif primitive.indices is not None:
            order = self.buffers.indices(primitive.indices)
        else:
            order = np.arange(len(positions), dtype=np.int64)
        material, sets = materials.use(primitive.material, name)
        used: Ints | slice = slice(None)
        if len(positions) > 2 * len(order) > 0 and order.max() < len(positions):
            # Primitives may share one large vertex buffer: each keeps its own vertices only.
            used, order = np.unique(order, return_inverse=True)

        def attribute(key: str, width: int) -> Floats | None:
            if key not in primitive.attributes:
                return None
            values = self._read(primitive, packed, key, width, name, len(positions))
            if key in ("POSITION", "NORMAL"):
                values = morphed(values, key, primitive, weights, self.buffers, name)
            return np.asarray(values[used])

        uv = [attribute(f"TEXCOORD_{number}", 2) for number in sets]
        if any(values is not None for values in uv):
            uv = [np.zeros((len(positions), 2))[used] if values is None else values for values in uv]
        moved = attribute("POSITION", 3)
        assert moved is not None
        influence = influences(primitive, self.buffers, name, len(positions))
        raw = RawMesh(
            name=name,
            positions=moved,
            faces=order.reshape(-1, 3) if packed is not None else listed_faces(order, primitive.mode),
            material=material,
            normals=attribute("NORMAL", 3),
            uv=uv[0],
            lightmap_uv=attribute("TEXCOORD_1", 2),
            more_uv=tuple(values for values in uv[1:] if values is not None),
            colors=self._colors(primitive, packed, name, len(positions), used),
            # A morphed surface has other tangents than the file's.
            tangents=attribute("TANGENT", 4)
            if materials.materials[material].normal_texture and not any(weights)
            else None,
        )
        return _Part(raw, None if influence is None else (influence[0][used], influence[1][used]))

    def _colors(
        self, primitive: Primitive, packed: _Draco | None, name: str, count: int, used: Ints | slice
    ) -> Floats | None:
        """COLOR_0 as linear RGBA in [0, 1]."""
        if "COLOR_0" not in primitive.attributes:
            return None
        width = self.buffers.width(primitive.attributes["COLOR_0"])
        values = self._read(primitive, packed, "COLOR_0", min(max(width, 3), 4), name, count)[used]
        alpha = values[:, 3:] if width == 4 else np.ones((len(values), 1))
        return np.asarray(np.clip(np.concatenate([values[:, :3], alpha], axis=1), 0.0, 1.0))

    def _draco(self, primitive: Primitive, name: str) -> _Draco | None:
        """What KHR_draco_mesh_compression holds, whether the file requires it or only uses it."""
        content = primitive.extensions.get("KHR_draco_mesh_compression")
        if content is None:
            return None
        draco = parse_extension(Draco, content, f"{self.entry}: KHR_draco_mesh_compression")
        unknown = sorted(set(draco.attributes) - set(primitive.attributes))
        if unknown or "POSITION" not in draco.attributes:
            what = f"names {unknown[0]}, which the primitive lacks" if unknown else "has no POSITION"
            raise InputError(f"its Draco buffer {what}", where=f"mesh '{name}'", remedy="Export it again.")
        return _Draco(*decode_draco(bytes(self.buffers.view(draco.buffer_view)), draco.attributes, name))

    def _read(
        self, primitive: Primitive, packed: _Draco | None, key: str, width: int, name: str, count: int | None = None
    ) -> Floats:
        """An attribute [count, width], from the Draco buffer where that has it."""
        accessor = primitive.attributes[key]
        if packed is not None and key in packed.attributes:
            values = self.buffers.scaled(accessor, packed.attributes[key])
            if values.shape[1] != width:
                raise InputError(
                    f"its Draco buffer has {values.shape[1]} components of {key}, not {width}",
                    where=f"mesh '{name}'",
                    remedy="Export it again.",
                )
        else:
            values = self.buffers.floats(accessor, width, f"{key} of mesh '{name}'")
        if count is not None and len(values) != count:
            raise InputError(
                f"{key} has {len(values)} values for {count} vertices",
                where=f"mesh '{name}'",
                remedy="Export it again.",
            )
        return values

    def _lights(self, placed: list[Placed]) -> list[PunctualLight]:
        where = f"{self.entry}: KHR_lights_punctual"
        table = parse_extension(Lights, self.document.extensions.get("KHR_lights_punctual", {}), where).lights
        out = []
        for item in placed:
            content = item.node.extensions.get("KHR_lights_punctual")
            if content is None or not item.visible:
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


def _triple(vector: Floats) -> tuple[float, float, float]:
    x, y, z = (float(value) for value in vector)
    return x, y, z
