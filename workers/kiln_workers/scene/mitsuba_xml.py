"""Reader of Mitsuba 3 scenes in XML, as far as they fit the glTF model; every other plugin is refused by name.

Shapes obj, ply, rectangle, cube, sphere and disk; BSDFs diffuse, conductor, roughconductor, plastic, roughplastic,
principled and twosided; emitters area, envmap, constant, point, spot and directional. Cameras, films and integrators
play no part. The XML is parsed without document types (`xml_nodes`) and all files lie in the bundle.
"""

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Final

import numpy as np

from kiln_schemas.errors import InputError
from kiln_schemas.text import quoted
from kiln_workers.scene.bundle import BundleFolder
from kiln_workers.scene.environment import MITSUBA_TURN, read_environment
from kiln_workers.scene.geometry import check_mesh_count, check_triangle_count, place, unique_names
from kiln_workers.scene.limits import MAX_TEXT_BYTES, check_count
from kiln_workers.scene.mitsuba_plugins import shape_meshes, surface_material
from kiln_workers.scene.mitsuba_values import OBJECT_TAGS, VALUE_TAGS, Plugin, substituted
from kiln_workers.scene.model import Environment, LightKind, Material, Mesh, PunctualLight, Scene
from kiln_workers.scene.xml_nodes import Node, parse_xml

IGNORED_TAGS: Final = frozenset({"sensor", "integrator", "film", "sampler", "rfilter"})
MAX_INCLUDES: Final = 64
"""Files that are included, over all; so a file may not include itself for ever."""
MAX_VARIABLES: Final = 256


def read_mitsuba_xml(folder: Path, entry: str) -> Scene:
    """The scene of a Mitsuba 3 XML file of the bundle `folder`."""
    reader = _Reader(BundleFolder(folder, entry))
    return reader.read()


@dataclass
class _Reader:
    bundle: BundleFolder
    variables: dict[str, str] = field(default_factory=dict)
    known: dict[str, Plugin] = field(default_factory=dict)
    materials: dict[Material, int] = field(default_factory=dict)
    meshes: list[Mesh] = field(default_factory=list)
    lights: list[PunctualLight] = field(default_factory=list)
    environment: Environment | None = None
    notes: list[str] = field(default_factory=list)
    triangles: int = 0
    includes: int = 0

    def read(self) -> Scene:
        for plugin in self._top_level(self.bundle):
            if plugin.tag == "shape":
                self._shape(plugin)
            elif plugin.tag == "emitter":
                self._emitter(plugin)
            elif plugin.tag != "bsdf":
                raise plugin.fail("this kind of object is not read")
        names = unique_names(mesh.name for mesh in self.meshes)
        meshes = tuple(replace(mesh, name=name) for mesh, name in zip(self.meshes, names, strict=True))
        return Scene(
            meshes, tuple(self.materials), (), tuple(self.lights), self.environment, tuple(dict.fromkeys(self.notes))
        )

    def _top_level(self, bundle: BundleFolder) -> list[Plugin]:
        where = bundle.origin
        root = parse_xml(bundle.read(Path(where).name, "scene", MAX_TEXT_BYTES), where)
        if root.tag != "scene":
            raise InputError(f"begins with {quoted(f'<{root.tag}>')}, not with <scene>", where=where)
        plugins: list[Plugin] = []
        for node in root.children:
            attributes = substituted(node, self.variables, where)
            if node.tag == "default":
                self.variables.setdefault(attributes.get("name", ""), attributes.get("value", ""))
                check_count(len(self.variables), MAX_VARIABLES, "variables", where)
            elif node.tag == "include":
                self.includes += 1
                check_count(self.includes, MAX_INCLUDES, "included files", where)
                inner = BundleFolder(bundle.folder, bundle.name(attributes.get("filename", "")))
                if not bundle.holds(attributes.get("filename", "")):
                    raise InputError(f"the included file '{inner.origin}' is missing", where=where, remedy="Add it.")
                plugins += self._top_level(inner)
            elif node.tag in OBJECT_TAGS:
                plugins.append(self._plugin(node, bundle))
            elif node.tag not in IGNORED_TAGS and node.tag not in VALUE_TAGS:
                raise InputError(
                    f"line {node.line}: {quoted(f'<{node.tag}>')} is not read", where=where, remedy="Remove it."
                )
        return plugins

    def _plugin(self, node: Node, bundle: BundleFolder) -> Plugin:
        where = bundle.origin
        attributes = substituted(node, self.variables, where)
        plugin = Plugin(node.tag, attributes.get("type", ""), node.line, where, attributes.get("name", ""))
        for child in node.children:
            inner = substituted(child, self.variables, where)
            if child.tag in OBJECT_TAGS:
                plugin.children.append(self._plugin(child, bundle))
            elif child.tag == "ref":
                target = self.known.get(inner.get("id", ""))
                if target is None:
                    raise plugin.fail(f"the reference {quoted(inner.get('id', ''))} names nothing before it")
                plugin.children.append(target)
            elif child.tag in VALUE_TAGS:
                steps = [Node(s.tag, substituted(s, self.variables, where), s.line) for s in child.children]
                plugin.values[inner.get("name", "")] = Node(child.tag, inner, child.line, steps)
            else:
                raise plugin.fail(f"{quoted(f'<{child.tag}>')} is not read")
        if "filename" in plugin.values:
            # Hold the name to the bundle now, relative to the file that names it.
            plugin.values["filename"].attributes["value"] = bundle.name(plugin.text("filename"))
        if "id" in attributes:
            self.known[attributes["id"]] = plugin
        return plugin

    def _shape(self, plugin: Plugin) -> None:
        material = Material("default", base_color=(0.5, 0.5, 0.5, 1.0))
        for child in plugin.children:
            if child.tag == "bsdf":
                material, notes = surface_material(child)
                self.notes += notes
            elif child.tag == "emitter" and child.kind != "area":
                raise child.fail("only an area emitter belongs to a shape")
            elif child.tag not in ("bsdf", "emitter"):
                raise child.fail("this is not read inside a shape")
        for child in plugin.children:
            if child.tag == "emitter":
                material = replace(material, emission=child.colour("radiance", (1.0, 1.0, 1.0)))
        number = self.materials.setdefault(material, len(self.materials))
        for raw in shape_meshes(plugin, self.bundle.folder, number):
            self.triangles += len(raw.faces)
            check_triangle_count(self.triangles, plugin.where)
            check_mesh_count(len(self.meshes) + 1, plugin.where)
            mesh, notes = place(raw, plugin.transform())
            self.notes += notes
            self.meshes += [mesh] if mesh is not None else []

    def _emitter(self, plugin: Plugin) -> None:
        if plugin.kind in ("envmap", "constant"):
            if self.environment is not None:
                raise plugin.fail("a scene has one environment", "Remove the others.")
            self.environment = self._environment(plugin)
        elif plugin.kind in ("point", "spot", "directional"):
            self.lights.append(_light(plugin))
        else:
            raise plugin.fail("this emitter is not read")

    def _environment(self, plugin: Plugin) -> Environment:
        if plugin.kind == "constant":
            radiance = np.array(plugin.colour("radiance", (1.0, 1.0, 1.0)), dtype=np.float32)
            return Environment(np.broadcast_to(radiance, (16, 32, 3)).copy())
        name = plugin.text("filename")
        pixels, notes = read_environment(BundleFolder(self.bundle.folder, plugin.kind).read(name, "environment"), name)
        self.notes += notes
        turn = plugin.transform()[:3, :3]
        about_y = np.array([[turn[0, 0], 0, turn[0, 2]], [0, 1, 0], [-turn[0, 2], 0, turn[0, 0]]])
        if not np.allclose(turn, about_y, atol=1e-5) or not np.isclose(
            np.hypot(turn[0, 0], turn[0, 2]), 1.0, atol=1e-5
        ):
            raise plugin.fail("its to_world is no rotation about +Y", "Turn the image itself.")
        rotation = float(np.rad2deg(np.arctan2(turn[0, 2], turn[0, 0])))
        return Environment(pixels, plugin.number("scale", 1.0), rotation + MITSUBA_TURN)


def _light(plugin: Plugin) -> PunctualLight:
    matrix = plugin.transform()
    forward = matrix[:3, :3] @ np.array([0.0, 0.0, 1.0])
    position = matrix[:3, 3]
    if plugin.kind == "point" and "position" in plugin.values:
        position = plugin.vector("position", (0.0, 0.0, 0.0))
    if plugin.kind == "directional" and "direction" in plugin.values:
        forward = plugin.vector("direction", (0.0, 0.0, 1.0))
    length = float(np.linalg.norm(forward))
    if length == 0.0:
        raise plugin.fail("it has no direction")
    x, y, z = (float(value) for value in forward / length)
    px, py, pz = (float(value) for value in position)
    cutoff = plugin.number("cutoff_angle", 20.0)
    return PunctualLight(
        name=plugin.kind,
        kind=LightKind(plugin.kind),
        intensity=plugin.colour("irradiance" if plugin.kind == "directional" else "intensity", (1.0, 1.0, 1.0)),
        position=(px, py, pz),
        direction=(x, y, z),
        inner_cone=float(np.deg2rad(plugin.number("beam_width", 0.75 * cutoff))),
        outer_cone=float(np.deg2rad(cutoff)),
    )
