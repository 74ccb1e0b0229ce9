"""Reader of Mitsuba scenes in XML, of versions 0.5 to 3: the counterpart of every plugin in the glTF model.

`mitsuba_files` checks the files and makes one document of them, Mitsuba's own parser reads it (`mitsuba_tree`), and
`mitsuba_shapes`, `mitsuba_textures`, `mitsuba_surfaces` and `mitsuba_emitters` convert. What is approximated or ignored
is named in a note, a plugin without a counterpart is refused by name. docs/scene-input.md lists all of them.
"""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np

from kiln_workers.scene.geometry import Floats, RawMesh, check_mesh_count, check_triangle_count, place, unique_names
from kiln_workers.scene.mitsuba_emitters import ENVIRONMENTS, LAMPS, environment, lamp
from kiln_workers.scene.mitsuba_files import read_document
from kiln_workers.scene.mitsuba_shapes import CURVED, STEPS, flipped, sectors, shape_meshes
from kiln_workers.scene.mitsuba_surfaces import Surface, Surfaces
from kiln_workers.scene.mitsuba_textures import Textures, Value, number
from kiln_workers.scene.mitsuba_tree import Plugin, parse_document
from kiln_workers.scene.model import Environment, Material, Mesh, PunctualLight, Scene
from kiln_workers.scene.tangents import with_tangents

DEFAULT: Final = Surface("default", number(0.5), specular=0.0)
"""What Mitsuba gives a shape without a BSDF."""


def read_mitsuba_xml(folder: Path, entry: str) -> Scene:
    """The scene of a Mitsuba XML file of the bundle `folder`."""
    document = read_document(folder, entry)
    return _Reader(folder, document.notes).read(parse_document(document))


class _Reader:
    def __init__(self, folder: Path, notes: list[str]) -> None:
        self.folder = folder
        self.notes = notes
        self.textures = Textures(folder, notes)
        self.surfaces = Surfaces(self.textures)
        self.materials: dict[Material, int] = {}
        self.meshes: list[Mesh] = []
        self.lights: list[PunctualLight] = []
        self.environment: Environment | None = None
        self.triangles = 0
        self.steps = STEPS
        self.parts: dict[Plugin, list[RawMesh]] = {}  # of shapes in groups

    def read(self, plugins: list[Plugin]) -> Scene:
        """The scene of the plugins at its top."""
        curved = sum(child.kind in CURVED for plugin in plugins for child in (plugin, *plugin.all("shape")))
        self.steps = sectors(curved)
        if self.steps < STEPS:
            self.notes.append(f"{curved} spheres, disks and cylinders: {self.steps} sectors each, not {STEPS}.")
        for plugin in plugins:
            if plugin.tag == "shape" and plugin.kind == "shapegroup":
                _parts(plugin)
            elif plugin.tag == "shape":
                self._shape(plugin, np.eye(4))
            elif plugin.tag == "emitter":
                self._emitter(plugin)
        names = unique_names(mesh.name for mesh in self.meshes)
        meshes = tuple(replace(mesh, name=name) for mesh, name in zip(self.meshes, names, strict=True))
        notes = tuple(dict.fromkeys(self.notes))
        materials, images = tuple(self.materials), tuple(self.textures.images)
        return _with_mitsuba_tangents(Scene(meshes, materials, images, tuple(self.lights), self.environment, notes))

    def _shape(self, plugin: Plugin, outer: Floats, grouped: bool = False) -> None:
        with np.errstate(over="ignore", invalid="ignore"):  # `place` refuses what is not finite
            transform = outer @ plugin.transform()
        if plugin.kind == "instance":
            if grouped:
                raise plugin.fail("there are no instances within a shapegroup", "Put its shapes there.")
            groups = [child for child in plugin.all("shape") if child.kind == "shapegroup"]
            if len(groups) != 1:
                raise plugin.fail(f"it holds {len(groups)} shape groups", "Put one reference to a shapegroup in it.")
            for child in _parts(groups[0]):
                self._shape(child, transform, grouped=True)
        elif plugin.kind == "merge":
            for child in _parts(plugin):
                self._shape(child, transform, grouped)
        else:
            self._placed(plugin, transform, grouped)

    def _placed(self, plugin: Plugin, transform: Floats, grouped: bool) -> None:
        meshes = self.parts.get(plugin) or shape_meshes(plugin, self.folder, self.steps)
        if grouped:
            self.parts[plugin] = meshes
        for raw, material, painted in self._dressed(plugin, meshes):
            self.triangles += len(raw.faces)
            check_triangle_count(self.triangles, plugin.where)
            check_mesh_count(len(self.meshes) + 1, plugin.where)
            named = replace(
                raw,
                name=plugin.properties.id() or raw.name,
                material=self.materials.setdefault(material, len(self.materials)),
                colors=raw.colors if painted else None,
            )
            mesh, notes = place(named, transform)
            self.notes += notes
            self.meshes += [mesh] if mesh is not None else []

    def _dressed(self, plugin: Plugin, meshes: list[RawMesh]) -> Iterator[tuple[RawMesh, Material, bool]]:
        """The meshes of a shape with their materials, and whether their vertices' colours play a part."""
        surface = self._surface(plugin)
        emission = self._emission(plugin)
        if surface is None:
            self.notes.append(f"{plugin.label}: left out, its BSDF 'null' is no surface.")
            return
        for mesh in meshes:
            painted = surface.base.painted
            if emission is None or not surface.double_sided:
                yield mesh, self.surfaces.material(surface, emission), painted
                continue
            # A lamp shines from its front alone, whatever its BSDF does: two sheets.
            yield mesh, replace(self.surfaces.material(surface, emission), double_sided=False), painted
            yield flipped(mesh), replace(self.surfaces.material(surface), double_sided=False), painted

    def _surface(self, plugin: Plugin) -> Surface | None:
        bsdfs = plugin.all("bsdf")
        if len(bsdfs) > 1:
            raise plugin.fail(f"it has {len(bsdfs)} BSDFs", "Give it one.")
        return self.surfaces.surface(bsdfs[0]) if bsdfs else DEFAULT

    def _emission(self, plugin: Plugin) -> Value | None:
        emitters = plugin.all("emitter")
        if not emitters:
            return None
        if len(emitters) > 1 or emitters[0].kind != "area":
            raise emitters[0].fail("only one area emitter belongs to a shape")
        return self.textures.emitted(emitters[0])

    def _emitter(self, plugin: Plugin) -> None:
        if plugin.kind in ENVIRONMENTS:
            if self.environment is not None:
                raise plugin.fail("a scene has one environment", "Remove the others.")
            self.environment = environment(plugin, self.folder, self.notes)
        elif plugin.kind in LAMPS:
            self.lights.append(lamp(plugin, self.notes))
        elif plugin.kind != "area":  # which stands here for shapes that refer to it
            raise plugin.fail("this emitter is not read", f"Use area, {', '.join((*ENVIRONMENTS, *LAMPS))}.")


def _parts(plugin: Plugin) -> list[Plugin]:
    """The shapes in a shape, at least one."""
    parts = plugin.all("shape")
    if not parts:
        raise plugin.fail("it holds no shapes")
    return parts


def _with_mitsuba_tangents(scene: Scene) -> Scene:
    """The scene whose normal maps have green along n x dp/du, however v grows, as Mitsuba's `normalmap` has it."""
    scene = with_tangents(scene)

    def right_handed(mesh: Mesh) -> Mesh:
        if mesh.tangents is None:
            return mesh
        return replace(
            mesh, tangents=np.concatenate([mesh.tangents[:, :3], np.ones_like(mesh.tangents[:, 3:])], axis=1)
        )

    return replace(scene, meshes=tuple(map(right_handed, scene.meshes)))
