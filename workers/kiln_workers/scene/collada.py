"""Reader of Collada (`.dae`): meshes under node transforms, skins at rest, materials, lights, in metres with +Y up.

By an own reader, as general ones open whatever a file names and drop skins, second UV sets or lights:
`collada_document` has the elements, `collada_nodes` their places, `collada_geometry` the meshes, `collada_materials`
the surfaces, `collada_lights` the lights, `collada_skins` the skins. docs/scene-input.md lists what becomes of each.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

import numpy as np

from kiln_schemas.text import told
from kiln_workers.scene.bundle import BundleFolder
from kiln_workers.scene.collada_document import Collada, name_of
from kiln_workers.scene.collada_geometry import Part, geometry_parts
from kiln_workers.scene.collada_lights import read_light
from kiln_workers.scene.collada_materials import Materials, is_double_sided
from kiln_workers.scene.collada_nodes import Placed, placed_nodes
from kiln_workers.scene.collada_skins import Joints, Skin, read_skin
from kiln_workers.scene.geometry import Floats, RawMesh, check_mesh_count, check_triangle_count, placed_meshes
from kiln_workers.scene.gltf_deform import skinned
from kiln_workers.scene.limits import MAX_TEXT_BYTES, NAME_LENGTH
from kiln_workers.scene.model import PunctualLight, Scene
from kiln_workers.scene.texture_files import Coat, TextureFiles
from kiln_workers.scene.xml_nodes import Node

MORE_UV: Final = 1
"""The set whose UV are tried as the light map's: the second, as in glTF and Unity."""


def read_collada(folder: Path, entry: str) -> Scene:
    """The scene of a Collada file of the bundle `folder`."""
    bundle = BundleFolder(folder, entry)
    document = Collada.parse(bundle.read(Path(entry).name, "scene", MAX_TEXT_BYTES), entry)
    return _Reader(document, bundle).read()


@dataclass(frozen=True)
class _Bound:
    """What an instance's `<bind_material>` says of a symbol."""

    target: Node | None
    sets: dict[str, int]
    """By what a texture calls its UV set: the geometry's set."""


@dataclass
class _Reader:
    document: Collada
    bundle: BundleFolder
    _parts: dict[Node, tuple[list[Part], bool]] = field(default_factory=dict)
    _warned: set[str] = field(default_factory=set)

    def read(self) -> Scene:
        document = self.document
        files = TextureFiles(self.bundle, document.notes)
        materials = Materials(document, files)
        placed = placed_nodes(document)
        meshes, notes = placed_meshes(self._instances(placed, materials))
        document.notes += notes
        lights = tuple(self._lights(placed))
        if document.root.child("library_animations", "animation") is not None:
            document.notes.append(f"'{document.where}': animations ignored; the scene is baked in its rest pose.")
        ignored = [f"'{document.where}': {what} ({count}) ignored." for what, count in sorted(document.ignored.items())]
        notes_in_order = tuple(dict.fromkeys([*document.notes, *ignored]))
        return Scene(meshes, tuple(materials.materials), tuple(files.images), lights, notes=notes_in_order)

    def _lights(self, placed: list[Placed]) -> Iterator[PunctualLight]:
        for item in placed:
            for instance in item.node.all("instance_light"):
                light = self.document.find(instance.attributes.get("url", ""), "light")
                found = None if light is None else read_light(self.document, light, item.matrix)
                if found is not None:
                    yield found

    def _instances(self, placed: list[Placed], materials: Materials) -> Iterator[tuple[RawMesh, Floats]]:
        """Every part of every instance with its transform; triangles are counted before anything is copied."""
        document, triangles, objects = self.document, 0, 0
        joints = Joints(placed)
        for item in placed:
            for instance in item.node.all("instance_geometry", "instance_controller"):
                geometry, skin = self._geometry(instance)
                if geometry is None:
                    continue
                if geometry not in self._parts:
                    self._parts[geometry] = geometry_parts(document, geometry), is_double_sided(geometry)
                parts, double_sided = self._parts[geometry]
                triangles += sum(len(part.faces) for part in parts)
                objects += len(parts)
                check_triangle_count(triangles, document.where)
                check_mesh_count(objects, document.where)
                pose = None if skin is None else read_skin(document, skin, instance, joints)
                bound = self._bound(instance)
                name = name_of(item.node) or name_of(geometry) or "mesh"
                for number, part in enumerate(parts):
                    title = f"{name}/{number}" if len(parts) > 1 else name
                    raw = self._raw(title, part, bound, materials, double_sided)
                    yield (raw, item.matrix) if pose is None else (self._posed(raw, part, pose), np.eye(4))

    def _geometry(self, instance: Node) -> tuple[Node | None, Node | None]:
        """The geometry of an instance, and its skin; controllers of controllers are followed."""
        if instance.tag == "instance_geometry":
            return self.document.need(instance, "url", "geometry"), None
        controller: Node | None = self.document.need(instance, "url", "controller")
        skin = None
        for _ in range(4):
            if controller is None:
                break
            inner = controller.child("skin") or controller.child("morph")
            if inner is None:
                break
            if inner.tag == "morph":
                self.document.ignored["morphs"] += 1
            else:
                skin = skin or inner
            geometry = self.document.find(inner.attributes.get("source", ""), "geometry")
            if geometry is not None:
                return geometry, skin
            controller = self.document.find(inner.attributes.get("source", ""), "controller")
        raise self.document.fail(instance, "names a controller without a geometry")

    def _posed(self, raw: RawMesh, part: Part, pose: Skin) -> RawMesh:
        if part.point.max(initial=0) >= len(pose.joints):
            detail = f"has weights for {len(pose.joints)} positions, and its mesh more"
            raise self.document.fail(self.document.root, detail)
        return skinned(raw, (pose.joints[part.point], pose.weights[part.point]), pose.matrices)

    def _bound(self, instance: Node) -> dict[str, _Bound]:
        out: dict[str, _Bound] = {}
        common = instance.child("bind_material", "technique_common")
        for node in common.all("instance_material") if common is not None else ():
            sets = {
                inner.attributes.get("semantic", ""): self.document.whole(inner, "input_set", 0)
                for inner in node.all("bind_vertex_input")
                if inner.attributes.get("input_semantic", "TEXCOORD") == "TEXCOORD"
            }
            target = self.document.find(node.attributes.get("target", ""), "material")
            out[node.attributes.get("symbol", "")] = _Bound(target, sets)
        return out

    def _raw(
        self, name: str, part: Part, bound: dict[str, _Bound], materials: Materials, double_sided: bool
    ) -> RawMesh:
        known = bound.get(part.symbol) or _Bound(self.document.find(part.symbol, "material"), {})
        if known.target is None and part.symbol and part.symbol not in self._warned:
            self._warned.add(part.symbol)
            shown = told(part.symbol, NAME_LENGTH)
            self.document.notes.append(
                f"'{self.document.where}': material '{shown}' is not defined; the default is used."
            )
        coat = materials.use(known.target, double_sided)
        uv = self._uv(part, coat, known.sets)
        sets = sorted(part.uv)
        return RawMesh(
            name=name,
            positions=part.positions,
            faces=part.faces,
            material=coat.index,
            normals=part.normals,
            uv=uv[0] if uv else None,
            lightmap_uv=part.uv[sets[MORE_UV]] if len(sets) > MORE_UV else None,
            more_uv=tuple(uv[1:]),
            colors=part.colors,
        )

    def _uv(self, part: Part, coat: Coat, sets: dict[str, int]) -> list[Floats]:
        """The UV sets that the material's textures use, in their order; the first set where it names none."""
        if not part.uv:
            return []
        first = min(part.uv)
        wanted = [sets.get(semantic, first) for semantic in coat.semantics] or [first]
        return [part.uv.get(number, part.uv[first]) for number in wanted]
