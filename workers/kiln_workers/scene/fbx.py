"""Reader of FBX, binary and ASCII: meshes under node transforms, skins at rest, materials, textures, lights.

`fbx_native` reads the file in a process of its own, `fbx_materials` converts the surfaces. docs/scene-input.md says
what becomes of each feature. Of a group of levels of detail the first is taken; hidden nodes are left out.
"""

import subprocess
import sys
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from kiln_schemas.errors import InputError, TooLarge
from kiln_schemas.text import told
from kiln_workers.scene.bundle import BundleFolder
from kiln_workers.scene.container import Array, unpack
from kiln_workers.scene.fbx_bounds import check_inflation
from kiln_workers.scene.fbx_materials import FbxMaterials
from kiln_workers.scene.fbx_native import KIND, REFUSED
from kiln_workers.scene.geometry import (
    Floats,
    Ints,
    RawMesh,
    check_mesh_count,
    check_triangle_count,
    placed_meshes,
    unit,
)
from kiln_workers.scene.gltf_deform import skinned
from kiln_workers.scene.images import linearised
from kiln_workers.scene.limits import NAME_LENGTH, check_count
from kiln_workers.scene.model import LightKind, PunctualLight, Scene
from kiln_workers.scene.polygons import triangulated
from kiln_workers.scene.texture_files import TextureFiles

LIGHTS: Final = (LightKind.POINT, LightKind.DIRECTIONAL, LightKind.SPOT)
"""By ufbx' number of the kind; areas and volumes follow."""
QUADRATIC: Final = 2
MAX_JOINTS: Final = 64
"""Of a vertex."""


def read_fbx(folder: Path, entry: str) -> Scene:
    """The scene of an FBX file of the bundle `folder`."""
    bundle = BundleFolder(folder, entry)
    body, arrays = parse_fbx(bundle.read(Path(entry).name, "scene"), entry)
    return _Reader(body, arrays, bundle).read()


def parse_fbx(data: bytes, entry: str) -> tuple[dict[str, Any], dict[str, Array]]:
    """What `fbx_native` tells of a file."""
    check_inflation(data, entry)
    return unpack(KIND, _in_child(data, entry))


def _in_child(data: bytes, entry: str) -> bytes:
    """What `fbx_native` writes; InputError where it refuses the file, or dies of it."""
    command = [sys.executable, "-m", "kiln_workers.scene.fbx_native"]
    done = subprocess.run(command, input=data, capture_output=True, check=False)
    if done.returncode == 0:
        return done.stdout
    remedy = "Export it again as binary FBX, or convert it with FBX2glTF or Blender."
    if done.returncode == REFUSED:
        reason = told(done.stderr.decode(errors="replace"), NAME_LENGTH)
        kind = TooLarge if "at most" in reason or "memory" in reason else InputError
        raise kind(reason, where=entry, remedy=remedy)
    raise InputError(
        f"cannot be read as FBX: its reader ended with status {done.returncode}", where=entry, remedy=remedy
    )


@dataclass(frozen=True)
class _Part:
    """The faces of a mesh with one material."""

    material: int
    """Of the mesh's list, which each node fills."""
    raw: RawMesh
    uv: Mapping[str, Floats]  # [V, 2] by the set's name
    vertex: Ints  # [V] of the mesh's positions


@dataclass
class _Reader:
    body: dict[str, Any]
    arrays: dict[str, Array]
    bundle: BundleFolder
    notes: list[str] = field(default_factory=list)
    ignored: Counter[str] = field(default_factory=Counter)
    _parts: dict[int, list[_Part]] = field(default_factory=dict)

    def read(self) -> Scene:
        files = TextureFiles(self.bundle, self.notes)
        materials = FbxMaterials(self.body, self.arrays, files)
        hidden = self._hidden()
        meshes, notes = placed_meshes(self._instances(materials, hidden))
        self.notes += notes
        lights = tuple(self._lights(hidden))
        entry = self.bundle.origin
        for what in ("curves", "nurbs"):
            self.ignored |= Counter({what: self.body[what]}) if self.body[what] else Counter()
        self.notes += [f"'{entry}': {what} ({count}) ignored." for what, count in sorted(self.ignored.items())]
        if self.body["animated"]:
            self.notes.append(f"'{entry}': animations ignored; the scene is baked in its rest pose.")
        images, notes_in_order = tuple(files.images), tuple(dict.fromkeys(self.notes))
        return Scene(meshes, tuple(materials.materials), images, lights, notes=notes_in_order)

    def _hidden(self) -> set[int]:
        """Nodes that are not seen: hidden ones, further levels of detail, and all below them."""
        nodes = self.body["nodes"]
        hidden: set[int] = set()
        first: dict[int, int] = {}
        for number, node in enumerate(nodes):  # parents come before their children
            parent = node["parent"]
            in_group = 0 <= parent < len(nodes) and nodes[parent]["lod_group"]
            if parent in hidden or not node["visible"] or (in_group and first.setdefault(parent, number) != number):
                hidden.add(number)
        if any(nodes[number]["mesh"] >= 0 for number in hidden):
            self.notes.append(f"'{self.bundle.origin}': hidden nodes and further levels of detail left out.")
        return hidden

    def _instances(self, materials: FbxMaterials, hidden: set[int]) -> Iterator[tuple[RawMesh, Floats]]:
        """Every part of every instance with its transform; triangles are counted before anything is copied."""
        triangles = objects = 0
        for number, node in enumerate(self.body["nodes"]):
            if node["mesh"] < 0 or number in hidden:
                continue
            mesh = self.body["meshes"][node["mesh"]]
            if node["mesh"] not in self._parts:
                self._parts[node["mesh"]] = self._mesh_parts(node["mesh"], mesh)
            parts = self._parts[node["mesh"]]
            triangles += sum(len(part.raw.faces) for part in parts)
            objects += len(parts)
            check_triangle_count(triangles, self.bundle.origin)
            check_mesh_count(objects, self.bundle.origin)
            name = told(node["name"] or mesh["name"] or "mesh", NAME_LENGTH)
            matrix = _matrix(node["geometry_to_world"])
            for index, part in enumerate(parts):
                own = node["materials"]
                coat = materials.use(own[part.material] if part.material < len(own) else None)
                first = part.raw.uv
                uv = [] if first is None else [part.uv.get(title, first) for title in coat.semantics]
                raw = replace(
                    part.raw,
                    name=f"{name}/{index}" if len(parts) > 1 else name,
                    material=coat.index,
                    uv=uv[0] if uv else first,
                    more_uv=tuple(uv[1:]),
                )
                if mesh["skinned"]:
                    yield self._posed(raw, part, f"m{node['mesh']}", matrix), np.eye(4)
                else:
                    yield raw, matrix

    def _mesh_parts(self, number: int, mesh: dict[str, Any]) -> list[_Part]:
        for what in ("morphed", "subdivided"):
            self.ignored[f"{what} meshes' deformation"] += bool(mesh[what])
        key = f"m{number}"
        begins, sizes = self.arrays[f"{key} faces"].T
        face_material = self.arrays[f"{key} material"]
        if not len(face_material):
            face_material = np.zeros(len(sizes), np.int64)
        keep = sizes >= 3
        if f"{key} position index" not in self.arrays or not keep.any():
            return []
        attributes = {"position": f"{key} position"}
        attributes |= {name: f"{key} {name}" for name in ("normal", "color") if mesh[name]}
        attributes |= {f"uv{i}": f"{key} uv{i}" for i in range(len(mesh["uv"]))}
        index = np.stack([self.arrays[f"{part} index"] for part in attributes.values()], axis=1)  # [C, A]
        values = {name: self.arrays[f"{part} values"] for name, part in attributes.items()}
        parts = []
        for material in np.unique(face_material[keep]):
            chosen = keep & (face_material == material)
            own = np.repeat(begins[chosen], sizes[chosen]) + _counted(sizes[chosen])
            faces = own[triangulated(values["position"][index[own, 0]], sizes[chosen])]
            rows, compact = np.unique(index[faces.reshape(-1)], axis=0, return_inverse=True)
            picked = {name: values[name][rows[:, column]] for column, name in enumerate(attributes)}
            parts.append(self._part(int(material), mesh, picked, compact.reshape(-1, 3), rows[:, 0]))
        return parts

    def _part(self, material: int, mesh: dict[str, Any], picked: dict[str, Array], faces: Ints, vertex: Ints) -> _Part:
        colors = None
        if "color" in picked:
            clipped = np.clip(np.nan_to_num(picked["color"]), 0.0, 1.0)
            colours = linearised(clipped[:, :3].astype(np.float32)).astype(np.float64)
            colors = np.concatenate([colours, clipped[:, 3:]], axis=1)
        # v grows upwards in FBX.
        sets = [picked[f"uv{i}"] * [1.0, -1.0] + [0.0, 1.0] for i in range(len(mesh["uv"]))]
        # Sets may have no names; of one name the first counts.
        uv = dict(reversed(list(zip(mesh["uv"], sets, strict=True))))
        raw = RawMesh(
            name="",
            positions=picked["position"],
            faces=faces,
            material=0,
            normals=picked.get("normal"),
            uv=sets[0] if sets else None,
            lightmap_uv=sets[1] if len(sets) > 1 else None,
            colors=colors,
        )
        return _Part(material, raw, uv, vertex)

    def _posed(self, raw: RawMesh, part: _Part, key: str, matrix: Floats) -> RawMesh:
        """A skinned mesh where its joints stand; a vertex without weights goes with the node."""
        joint, vertex, weight = (self.arrays[f"{key} {name}"] for name in ("joint", "vertex", "weight"))
        count = len(self.arrays[f"{key} position values"])
        sound = (vertex >= 0) & (vertex < count) & np.isfinite(weight) & (weight > 0.0)
        joint, vertex, weight = joint[sound], vertex[sound], weight[sound]
        order = np.argsort(vertex, kind="stable")
        sizes = np.bincount(vertex, minlength=count)
        most = int(sizes.max(initial=0))
        check_count(most, MAX_JOINTS, "joints at a vertex", f"mesh '{raw.name}'")
        matrices = np.concatenate([self.arrays[f"{key} joints"], matrix[None]])
        joints = np.full((count, max(most, 1)), len(matrices) - 1)
        weights = np.zeros((count, max(most, 1)))
        joints[vertex[order], _counted(sizes)] = joint[order]
        weights[vertex[order], _counted(sizes)] = weight[order]
        weights[sizes == 0, 0] = 1.0
        weights /= weights.sum(axis=1, keepdims=True)
        return skinned(raw, (joints[part.vertex], weights[part.vertex]), matrices)

    def _lights(self, hidden: set[int]) -> Iterator[PunctualLight]:
        for number, node in enumerate(self.body["nodes"]):
            if node["light"] < 0 or number in hidden:
                continue
            light = self.body["lights"][node["light"]]
            if light["kind"] >= len(LIGHTS):
                self.ignored["area and volume lights"] += 1
            elif light["on"]:
                yield self._light(light, node)

    def _light(self, light: dict[str, Any], node: dict[str, Any]) -> PunctualLight:
        kind, matrix = LIGHTS[light["kind"]], _matrix(node["node_to_world"])
        name = told(light["name"] or node["name"] or kind.value, NAME_LENGTH)
        if min(*light["color"], light["intensity"]) < 0.0:
            raise InputError(
                "its colour or intensity is not a number of 0 or more", where=f"light '{name}'", remedy="Mend it."
            )
        factor = light["intensity"] * (1.0 if kind is LightKind.DIRECTIONAL else self._per_steradian(light, name))
        red, green, blue = (factor * value for value in light["color"])
        ahead = unit(matrix[:3, :3] @ np.array(light["direction"]))
        dx, dy, dz = (float(value) for value in ahead) if ahead.any() else (0.0, -1.0, 0.0)
        x, y, z = (float(value) for value in matrix[:3, 3])
        outer = min(max(np.deg2rad(light["outer"]) / 2.0, 1e-3), np.pi / 2)
        inner = min(max(np.deg2rad(light["inner"]) / 2.0, 0.0), outer)
        return PunctualLight(name, kind, (red, green, blue), (x, y, z), (dx, dy, dz), float(inner), float(outer))

    def _per_steradian(self, light: dict[str, Any], name: str) -> float:
        """W/sr of a light of intensity 1: of Blender's a watt, of others the irradiance at one unit of the file."""
        if self.body["blender"]:
            return 1.0 / (4.0 * np.pi)
        if light["decay"] == QUADRATIC:
            return float(self.body["unit"]) ** 2
        self.notes.append(f"Light '{name}': its decay has no counterpart; its intensity is taken as W/sr.")
        return 1.0


def _matrix(flat: list[float]) -> Floats:
    return np.array(flat, dtype=np.float64).reshape(4, 4)


def _counted(sizes: Ints) -> Ints:
    """0, 1, ... within each of the groups of `sizes`, one after the other."""
    return np.asarray(np.arange(int(sizes.sum())) - np.repeat(np.cumsum(sizes) - sizes, sizes))
