"""Mitsuba's shapes as triangles and its BSDFs as metallic-roughness materials.

Mitsuba's `alpha` is GGX's (or Beckmann's) width; glTF's roughness is its square root. A conductor's colour at normal
incidence is ((eta - 1)^2 + k^2) / ((eta + 1)^2 + k^2); named metals use the RGB values of Lagarde 2014, "Feeding a
physically based shading model".
"""

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np

from kiln_schemas.text import quoted
from kiln_workers.scene.bundle import BundleFolder
from kiln_workers.scene.geometry import RawMesh
from kiln_workers.scene.limits import MAX_FILE_BYTES, MAX_TEXT_BYTES
from kiln_workers.scene.mitsuba_values import Colour, Plugin
from kiln_workers.scene.model import Material
from kiln_workers.scene.obj import parse_obj
from kiln_workers.scene.ply import parse_ply
from kiln_workers.scene.shapes import Cell, Surface, patch, sphere

METALS: Final[Mapping[str, Colour]] = {
    "none": (1.0, 1.0, 1.0),
    "Ag": (0.972, 0.960, 0.915),
    "Al": (0.913, 0.921, 0.925),
    "Au": (1.000, 0.766, 0.336),
    "Cr": (0.550, 0.556, 0.554),
    "Cu": (0.955, 0.637, 0.538),
}
SPHERE_STEPS: Final = 48
DISK_STEPS: Final = 64


def shape_meshes(plugin: Plugin, folder: Path, material: int) -> list[RawMesh]:
    """The triangles of a shape plugin in its own space."""
    if plugin.kind in ("obj", "ply"):
        meshes = _file_meshes(plugin, folder, material)
    elif plugin.kind in _PRIMITIVES:
        meshes = [replace(_PRIMITIVES[plugin.kind](plugin), material=material)]
    else:
        remedy = "Save it as PLY." if plugin.kind == "serialized" else f"Use obj, ply, {', '.join(_PRIMITIVES)}."
        raise plugin.fail("this shape is not read", remedy)
    if plugin.flag("face_normals"):
        meshes = [replace(mesh, normals=None) for mesh in meshes]
    if plugin.flag("flip_normals"):
        meshes = [_flipped(mesh) for mesh in meshes]
    return meshes


def surface_material(plugin: Plugin) -> tuple[Material, list[str]]:
    """The metallic-roughness material nearest to a BSDF plugin, and notes."""
    convert = _BSDFS.get(plugin.kind)
    if convert is None:
        raise plugin.fail("this BSDF is not read", f"Use one of {', '.join(_BSDFS)}.")
    return convert(plugin)


def _file_meshes(plugin: Plugin, folder: Path, material: int) -> list[RawMesh]:
    name = plugin.text("filename")
    most = MAX_TEXT_BYTES if plugin.kind == "obj" else MAX_FILE_BYTES
    data = BundleFolder(folder, f"shape '{plugin.kind}'").read(name, "mesh file", most)
    if plugin.kind == "ply":
        return [parse_ply(data, name, material)]
    return [replace(mesh, material=material) for mesh in parse_obj(data, name).meshes]


def _flipped(mesh: RawMesh) -> RawMesh:
    normals = None if mesh.normals is None else -mesh.normals
    return replace(mesh, faces=mesh.faces[:, ::-1], normals=normals)


def _from_surface(name: str, surface: Surface, steps: int) -> RawMesh:
    mesh = patch(name, surface, (steps, steps), Cell(0, 0, 1, 1), 0)
    normals, uv = mesh.normals.astype(np.float64), None if mesh.uv is None else mesh.uv.astype(np.float64)
    return RawMesh(name, mesh.positions.astype(np.float64), mesh.faces.astype(np.int64), 0, normals, uv)


def _rectangle(plugin: Plugin) -> RawMesh:
    corners = np.array([[-1.0, -1.0, 0.0], [1.0, -1.0, 0.0], [1.0, 1.0, 0.0], [-1.0, 1.0, 0.0]])
    uv = 0.5 * corners[:, :2] * [1.0, -1.0] + 0.5
    return RawMesh("rectangle", corners, np.array([[0, 1, 2], [0, 2, 3]]), 0, None, uv)


def _cube(plugin: Plugin) -> RawMesh:
    square = np.array([[-1.0, -1.0, 1.0], [1.0, -1.0, 1.0], [1.0, 1.0, 1.0], [-1.0, 1.0, 1.0]])
    # Cyclic permutations keep the winding; the opposite side is turned by half a circle about x.
    front = [np.roll(square, shift, axis=1) for shift in range(3)]
    back = [np.roll(square * [1.0, -1.0, -1.0], shift, axis=1) for shift in range(3)]
    faces = np.concatenate([np.array([[0, 1, 2], [0, 2, 3]]) + 4 * side for side in range(6)])
    uv = np.tile(0.5 * square[:, :2] * [1.0, -1.0] + 0.5, (6, 1))
    return RawMesh("cube", np.concatenate(front + back), faces, 0, None, uv)


def _sphere(plugin: Plugin) -> RawMesh:
    radius = plugin.number("radius", 1.0)
    if radius <= 0.0:
        raise plugin.fail(f"its radius is {radius}")
    return _from_surface("sphere", sphere(plugin.vector("center", (0.0, 0.0, 0.0)), radius), SPHERE_STEPS)


def _disk(plugin: Plugin) -> RawMesh:
    angle = 2.0 * np.pi * np.arange(DISK_STEPS) / DISK_STEPS
    rim = np.stack([np.cos(angle), np.sin(angle), np.zeros(DISK_STEPS)], axis=1)
    positions = np.concatenate([np.zeros((1, 3)), rim])
    i = np.arange(DISK_STEPS)
    faces = np.stack([np.zeros_like(i), 1 + i, 1 + (i + 1) % DISK_STEPS], axis=1)
    return RawMesh("disk", positions, faces, 0, None, 0.5 * positions[:, :2] * [1.0, -1.0] + 0.5)


_PRIMITIVES: Final[Mapping[str, Callable[[Plugin], RawMesh]]] = {
    "rectangle": _rectangle,
    "cube": _cube,
    "sphere": _sphere,
    "disk": _disk,
}


def _roughness(plugin: Plugin, default: float) -> tuple[float, list[str]]:
    """glTF's roughness of a plugin's alpha, and notes."""
    alpha = plugin.number("alpha", default)
    u, v = plugin.number("alpha_u", alpha), plugin.number("alpha_v", alpha)
    if min(u, v) < 0.0:
        raise plugin.fail(f"its alpha is {min(u, v)}")
    notes = [] if u == v else [f"BSDF '{plugin.kind}': anisotropic roughness is baked as its geometric mean."]
    if default > 0.0 and plugin.text("distribution", "beckmann") == "beckmann":
        notes.append(f"BSDF '{plugin.kind}': the Beckmann distribution is baked as GGX of the same alpha.")
    return float(min(np.sqrt(np.sqrt(u * v)), 1.0)), notes


def _material(plugin: Plugin, colour: Colour, metallic: float, roughness: float) -> Material:
    red, green, blue = (min(max(value, 0.0), 1.0) for value in colour)
    return Material(plugin.kind, (red, green, blue, 1.0), metallic=metallic, roughness=roughness)


def _diffuse(plugin: Plugin) -> tuple[Material, list[str]]:
    return _material(plugin, plugin.colour("reflectance", (0.5, 0.5, 0.5)), 0.0, 1.0), []


def _conductor(plugin: Plugin) -> tuple[Material, list[str]]:
    roughness, notes = _roughness(plugin, 0.1 if plugin.kind == "roughconductor" else 0.0)
    if "eta" in plugin.values or "k" in plugin.values:
        eta = np.array(plugin.colour("eta", (0.0, 0.0, 0.0)))
        k = np.array(plugin.colour("k", (1.0, 1.0, 1.0)))
        facing = ((eta - 1.0) ** 2 + k**2) / ((eta + 1.0) ** 2 + k**2)
    else:
        metal = plugin.text("material", "Cu")
        if metal not in METALS:
            raise plugin.fail(
                f"the metal {quoted(metal)} is not known", f"Use one of {', '.join(METALS)}, or eta and k."
            )
        facing = np.array(METALS[metal])
    red, green, blue = (float(x) for x in facing * plugin.colour("specular_reflectance", (1.0, 1.0, 1.0)))
    return _material(plugin, (red, green, blue), 1.0, roughness), notes


def _plastic(plugin: Plugin) -> tuple[Material, list[str]]:
    roughness, notes = _roughness(plugin, 0.1 if plugin.kind == "roughplastic" else 0.0)
    return _material(plugin, plugin.colour("diffuse_reflectance", (0.5, 0.5, 0.5)), 0.0, roughness), notes


def _principled(plugin: Plugin) -> tuple[Material, list[str]]:
    if plugin.number("spec_trans", 0.0) > 0.0:
        raise plugin.fail("transmission is not baked", "Remove spec_trans.")
    read = {"base_color", "metallic", "roughness", "spec_trans"}
    other = sorted(set(plugin.values) - read)
    notes = [f"BSDF 'principled': {', '.join(map(quoted, other))} ignored."] if other else []
    metallic, roughness = plugin.number("metallic", 0.0), plugin.number("roughness", 0.5)
    if not (0.0 <= metallic <= 1.0 and 0.0 <= roughness <= 1.0):
        raise plugin.fail("metallic and roughness lie between 0 and 1")
    return _material(plugin, plugin.colour("base_color", (0.5, 0.5, 0.5)), metallic, roughness), notes


def _twosided(plugin: Plugin) -> tuple[Material, list[str]]:
    inner = [child for child in plugin.children if child.tag == "bsdf"]
    if len(inner) != 1:
        raise plugin.fail(f"it holds {len(inner)} BSDFs", "Use one BSDF for both sides.")
    if inner[0].kind == plugin.kind:
        raise plugin.fail("it holds another twosided BSDF", "Leave one of them out.")
    material, notes = surface_material(inner[0])
    return replace(material, double_sided=True), notes


_BSDFS: Final[Mapping[str, Callable[[Plugin], tuple[Material, list[str]]]]] = {
    "diffuse": _diffuse,
    "conductor": _conductor,
    "roughconductor": _conductor,
    "plastic": _plastic,
    "roughplastic": _plastic,
    "principled": _principled,
    "twosided": _twosided,
}
