"""Reader of Wavefront OBJ with MTL materials, by the format's public description (Wavefront, "Object Files").

An own reader, as general ones open whatever file a material library names and drop textures in silence. Vertices are
split where position, texture and normal indices differ; colours behind their coordinates (`v x y z r g b`) are sRGB, as
MeshLab and ZBrush write and three.js and Blender read them. The material libraries are `mtl`'s.
"""

import array
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Final, TypeAlias

import numpy as np

from kiln_schemas.errors import InputError
from kiln_schemas.text import told
from kiln_workers.scene.bundle import BundleFolder
from kiln_workers.scene.geometry import RawMesh, check_mesh_count, check_triangle_count, place, unique_names
from kiln_workers.scene.images import linearised
from kiln_workers.scene.limits import MAX_TEXT_BYTES, NAME_LENGTH
from kiln_workers.scene.model import Material, Mesh, Scene
from kiln_workers.scene.mtl import MaterialLibrary
from kiln_workers.scene.polygons import triangulated
from kiln_workers.scene.text_lines import statements

DEFAULT: Final = Material("default")
WIDTHS: Final = {"v": 3, "vt": 2, "vn": 3}
Doubles: TypeAlias = "array.array[float]"
Numbers: TypeAlias = "array.array[int]"


@dataclass
class _Group:
    """Faces of one object and material: corners as flat (position, texture, normal) indices, -1 where absent."""

    name: str
    material: str
    corners: Numbers = field(default_factory=lambda: array.array("i"))
    sizes: Numbers = field(default_factory=lambda: array.array("i"))  # corners of each polygon


@dataclass
class ObjFile:
    """A parsed OBJ file, materials not yet read."""

    meshes: list[RawMesh]  # `material` indexes `materials`
    materials: list[str]
    libraries: list[str]


def read_obj(folder: Path, entry: str) -> Scene:
    """The scene of an OBJ file and its material libraries."""
    bundle = BundleFolder(folder, entry)
    parsed = parse_obj(bundle.read(Path(entry).name, "scene", MAX_TEXT_BYTES), entry)
    notes: list[str] = []
    library = MaterialLibrary(bundle, set(parsed.materials), notes)
    library.read(parsed.libraries)
    known = library.materials
    missing = sorted({name for name in parsed.materials if name and name not in known})
    notes += [
        f"'{entry}': material '{told(name, NAME_LENGTH)}' is not defined; the default is used." for name in missing
    ]
    painted = any(raw.colors is not None for raw in parsed.meshes)
    default = replace(DEFAULT, base_color=(1.0, 1.0, 1.0, 1.0)) if painted else DEFAULT
    materials = tuple(known.get(name, default) for name in parsed.materials)
    meshes: list[Mesh] = []
    for raw in parsed.meshes:
        mesh, said = place(raw)
        notes += said
        meshes += [mesh] if mesh is not None else []
    return Scene(tuple(meshes), materials, tuple(library.images), notes=tuple(notes))


def parse_obj(data: bytes, where: str) -> ObjFile:
    """Meshes of an OBJ file, one for each object and material; InputError names the line at fault."""
    vectors: dict[str, Doubles] = {key: array.array("d") for key in WIDTHS}
    groups: dict[tuple[str, str], _Group] = {}
    libraries: list[str] = []
    name, material = Path(where).stem, ""
    triangles = 0
    colours: Doubles = array.array("d")
    for number, key, rest in statements(data):
        try:
            if key in vectors:
                words = rest.split(maxsplit=7)
                row = [float(word) for word in words[: WIDTHS[key]]]
                if len(row) < WIDTHS[key]:
                    raise ValueError("too few numbers")
                if key == "v" and len(words) in (6, 7):
                    # Vertices before the first that has a colour are white.
                    colours.extend([1.0] * (len(vectors["v"]) - len(colours)))
                    colours.extend([float(word) for word in words[len(words) - 3 :]])
                vectors[key].extend(row)
            elif key in ("o", "g"):
                name = rest or name
            elif key == "usemtl":
                material = rest
            elif key == "mtllib":
                libraries.append(rest)
            elif key == "f":
                words = rest.split()
                triangles += max(len(words) - 2, 0)
                check_triangle_count(triangles, where)
                if len(words) < 3:
                    raise ValueError("a face has three corners or more")
                corners = [index for word in words for index in _corner(word, vectors)]
                if (name, material) not in groups:
                    check_mesh_count(len(groups) + 1, where)
                    groups[name, material] = _Group(name, material)
                groups[name, material].corners.extend(corners)
                groups[name, material].sizes.append(len(words))
        except (ValueError, IndexError):
            raise InputError(
                f"line {number}: this '{key}' statement is not understood", where=where, remedy="Export it again."
            ) from None
    numbers: dict[str, int] = {}
    for group in groups.values():
        numbers.setdefault(group.material, len(numbers))
    arrays = {key: np.array(flat, dtype=np.float64).reshape(-1, WIDTHS[key]) for key, flat in vectors.items()}
    if colours:
        painted = np.ones_like(arrays["v"])
        painted.reshape(-1)[: len(colours)] = colours
        arrays["colour"] = linearised(np.clip(painted, 0.0, 1.0).astype(np.float32)).astype(np.float64)
    names = unique_names(group.name for group in groups.values())
    meshes = [
        _mesh(group, name, numbers[group.material], arrays) for name, group in zip(names, groups.values(), strict=True)
    ]
    return ObjFile(meshes, list(numbers), libraries)


def _corner(word: str, vectors: dict[str, Doubles]) -> tuple[int, int, int]:
    parts = [*word.split("/"), "", ""][:3]
    found = []
    for part, key in zip(parts, WIDTHS, strict=True):
        count = len(vectors[key]) // WIDTHS[key]
        index = int(part) if part else 0
        resolved = index - 1 if index > 0 else count + index if index < 0 else -1
        if part and not 0 <= resolved < count:
            raise IndexError(part)
        found.append(resolved)
    return found[0], found[1], found[2]


def _mesh(
    group: _Group, name: str, material: int, arrays: dict[str, np.ndarray[tuple[int, int], np.dtype[np.float64]]]
) -> RawMesh:
    flat = np.array(group.corners, dtype=np.int64).reshape(-1, 3)
    triangles = triangulated(arrays["v"][flat[:, 0]], np.array(group.sizes, dtype=np.int64))
    corners, faces = np.unique(flat[triangles.reshape(-1)], axis=0, return_inverse=True)
    uv = colors = None
    if (corners[:, 1] >= 0).all():
        uv = arrays["vt"][corners[:, 1]] * [1.0, -1.0] + [0.0, 1.0]  # v upwards in OBJ
    if "colour" in arrays:
        colors = np.concatenate([arrays["colour"][corners[:, 0]], np.ones((len(corners), 1))], axis=1)
    return RawMesh(
        name=name,
        positions=arrays["v"][corners[:, 0]],
        faces=faces.reshape(-1, 3),
        material=material,
        normals=arrays["vn"][corners[:, 2]] if (corners[:, 2] >= 0).all() else None,
        uv=uv,
        colors=colors,
    )
