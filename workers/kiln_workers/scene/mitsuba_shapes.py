"""Mitsuba's shapes as triangles in their own space, with Mitsuba's normals and texture coordinates.

Rectangles and cubes are exact; spheres, disks and cylinders are divided into `STEPS` sectors, fewer in a scene of many.
Mitsuba's v counts from the first row of an image, as `model` has it. A file without normals gets smooth ones, weighted
by angle (Thuermer and Wuethrich 1998), unless `face_normals` is set.
"""

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np

from kiln_workers.scene.bundle import BundleFolder
from kiln_workers.scene.geometry import Floats, Ints, RawMesh, corner_angles, face_normals
from kiln_workers.scene.limits import MAX_FILE_BYTES, MAX_TEXT_BYTES
from kiln_workers.scene.mitsuba_tree import Plugin
from kiln_workers.scene.obj import parse_obj
from kiln_workers.scene.ply import parse_ply
from kiln_workers.scene.serialized import parse_serialized

STEPS: Final = 64
"""Sectors around a sphere, disk or cylinder; a sphere has half as many rings."""
LEAST_STEPS: Final = 12
MANY: Final = 64
"""Curved shapes beyond which each has fewer sectors."""
FILES: Final = ("obj", "ply", "serialized")


def sectors(curved: int) -> int:
    """Sectors for each of so many curved shapes: their triangles together stay as many as `MANY` have."""
    return STEPS if curved <= MANY else max(LEAST_STEPS, 4 * int(STEPS * (MANY / curved) ** 0.5 / 4))


def shape_meshes(plugin: Plugin, folder: Path, steps: int = STEPS) -> list[RawMesh]:
    """The triangles of a shape in its own space; InputError for a shape that is not read."""
    if plugin.kind in FILES:
        meshes = _file_meshes(plugin, folder)
    elif plugin.kind in PRIMITIVES:
        meshes = [PRIMITIVES[plugin.kind](plugin, steps)]
    else:
        raise plugin.fail("this shape is not read", f"Use {', '.join((*FILES, *PRIMITIVES))}.")
    if plugin.flag("face_normals"):
        meshes = [replace(mesh, normals=None) for mesh in meshes]
    elif plugin.kind in FILES:
        meshes = [replace(mesh, normals=angle_normals(mesh)) if mesh.normals is None else mesh for mesh in meshes]
    return [flipped(mesh) for mesh in meshes] if plugin.flag("flip_normals") else meshes


def flipped(mesh: RawMesh) -> RawMesh:
    """The mesh with its other side outwards."""
    normals = None if mesh.normals is None else -mesh.normals
    return replace(mesh, faces=mesh.faces[:, ::-1], normals=normals)


def angle_normals(mesh: RawMesh) -> Floats | None:
    """Vertex normals [V, 3]: those of the faces around, weighted by their angles; None for a mesh that is damaged."""
    faces = mesh.faces
    if not len(faces) or faces.min() < 0 or faces.max() >= len(mesh.positions):
        return None
    total = np.zeros_like(mesh.positions)
    with np.errstate(all="ignore"):  # `place` refuses what is not finite
        weighted = face_normals(mesh.positions, faces)[:, None] * corner_angles(mesh.positions[faces])[..., None]
    np.add.at(total, faces, weighted)
    return total


def _file_meshes(plugin: Plugin, folder: Path) -> list[RawMesh]:
    name = plugin.text("filename")
    if not name:
        raise plugin.fail("it has no filename")
    most = MAX_TEXT_BYTES if plugin.kind == "obj" else MAX_FILE_BYTES
    data = BundleFolder(folder, "").read(name, "mesh file", most)
    if plugin.kind == "serialized":
        meshes, upward = [parse_serialized(data, plugin.whole("shape_index", 0), name)], False
    elif plugin.kind == "ply":
        meshes, upward = [parse_ply(data, name)], True
    else:
        meshes, upward = parse_obj(data, name).meshes, True
    # Both parsers have turned v over already, as Mitsuba does for OBJ alone.
    turn = upward != plugin.flag("flip_tex_coords", plugin.kind == "obj")
    return [replace(mesh, uv=_turned(mesh.uv)) if turn else mesh for mesh in meshes]


def _turned(uv: Floats | None) -> Floats | None:
    return None if uv is None else uv * [1.0, -1.0] + [0.0, 1.0]


def _rectangle(plugin: Plugin, steps: int) -> RawMesh:
    corners = np.array([[-1.0, -1.0, 0.0], [1.0, -1.0, 0.0], [1.0, 1.0, 0.0], [-1.0, 1.0, 0.0]])
    return RawMesh("rectangle", corners, np.array([[0, 1, 2], [0, 2, 3]]), 0, None, 0.5 * corners[:, :2] + 0.5)


# The sides of Mitsuba's cube: normal, and where u and v grow; their cross product points inward.
CUBE_SIDES: Final = (
    ((0, -1, 0), (0, 0, 1), (1, 0, 0)),
    ((0, 1, 0), (-1, 0, 0), (0, 0, -1)),
    ((1, 0, 0), (0, 1, 0), (0, 0, -1)),
    ((0, 0, 1), (0, 1, 0), (1, 0, 0)),
    ((-1, 0, 0), (0, 1, 0), (0, 0, 1)),
    ((0, 0, -1), (0, -1, 0), (1, 0, 0)),
)


def _cube(plugin: Plugin, steps: int) -> RawMesh:
    square = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    sides = [
        np.array(normal) + square[:, :1] * np.array(right) + square[:, 1:] * np.array(up)
        for normal, right, up in CUBE_SIDES
    ]
    faces = np.concatenate([np.array([[0, 2, 1], [0, 3, 2]]) + 4 * side for side in range(6)])
    return RawMesh("cube", np.concatenate(sides), faces, 0, None, np.tile(0.5 * square + 0.5, (6, 1)))


def _radius(plugin: Plugin) -> float:
    radius = plugin.number("radius", 1.0)
    if radius <= 0.0:
        raise plugin.fail(f"its radius is {radius}")
    return radius


def _grid(rows: int, columns: int) -> Ints:
    """Triangles of a grid of (rows + 1) x (columns + 1) vertices, wound so that columns x rows points outward."""
    first = (np.arange(rows)[:, None] * (columns + 1) + np.arange(columns)).reshape(-1)
    below = first + columns + 1
    return np.concatenate([np.stack([first, below, below + 1], 1), np.stack([first, below + 1, first + 1], 1)])


def _sphere(plugin: Plugin, steps: int) -> RawMesh:
    v, u = (grid.reshape(-1) for grid in np.meshgrid(_steps(steps // 2), _steps(steps), indexing="ij"))
    theta, phi = np.pi * v, 2.0 * np.pi * u
    normals = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], axis=1)
    positions = plugin.vector("center", (0.0, 0.0, 0.0)) + _radius(plugin) * normals
    faces = _grid(steps // 2, steps)
    # Half of the triangles at the poles have no area.
    upper, lower = faces[: len(faces) // 2], faces[len(faces) // 2 :]
    faces = np.concatenate([upper[:-steps], lower[steps:]])
    return RawMesh("sphere", positions, faces, 0, normals, np.stack([u, v], axis=1))


def _disk(plugin: Plugin, steps: int) -> RawMesh:
    v, u = (grid.reshape(-1) for grid in np.meshgrid(_steps(steps), np.array([0.0, 1.0]), indexing="ij"))
    positions = np.stack([u * np.cos(2.0 * np.pi * v), u * np.sin(2.0 * np.pi * v), np.zeros_like(u)], axis=1)
    sector = 2 * np.arange(steps)
    return RawMesh("disk", positions, np.stack([sector, sector + 1, sector + 3], 1), 0, None, np.stack([u, v], axis=1))


def _cylinder(plugin: Plugin, steps: int) -> RawMesh:
    radius = _radius(plugin)
    start, end = plugin.vector("p0", (0.0, 0.0, 0.0)), plugin.vector("p1", (0.0, 0.0, 1.0))
    length = float(np.linalg.norm(end - start))
    if length == 0.0:
        raise plugin.fail("its ends p0 and p1 are one point")
    v, u = (grid.reshape(-1) for grid in np.meshgrid(np.array([1.0, 0.0]), _steps(steps), indexing="ij"))
    s, t = _frame((end - start) / length)
    normals = np.cos(2.0 * np.pi * u)[:, None] * s + np.sin(2.0 * np.pi * u)[:, None] * t
    positions = start + v[:, None] * (end - start) + radius * normals
    return RawMesh("cylinder", positions, _grid(1, steps), 0, normals, np.stack([u, v], axis=1))


def _frame(n: Floats) -> tuple[Floats, Floats]:
    """Two directions across `n`, as Mitsuba's `coordinate_system` chooses them (Duff et al. 2017)."""
    sign = np.copysign(1.0, n[2])
    a = -1.0 / (sign + n[2])
    b = n[0] * n[1] * a
    s = np.array([sign * n[0] ** 2 * a + 1.0, sign * b, -sign * n[0]])
    return s, np.array([b, sign + n[1] ** 2 * a, -n[1]])


def _steps(count: int) -> Floats:
    return np.linspace(0.0, 1.0, count + 1)


CURVED: Final = ("sphere", "disk", "cylinder")
PRIMITIVES: Final[Mapping[str, Callable[[Plugin, int], RawMesh]]] = {
    "rectangle": _rectangle,
    "cube": _cube,
    "sphere": _sphere,
    "disk": _disk,
    "cylinder": _cylinder,
}
