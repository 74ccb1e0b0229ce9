"""Reader of Wavefront OBJ with MTL materials, by the format's public description (Wavefront, "Object Files").

An own reader, as general ones open whatever file a material library names and drop textures in silence. Polygons become
fans; vertices are split where position, texture and normal indices differ. MTL's physically based keys (Pr, Pm) are
used where present; otherwise Phong's exponent gives alpha^2 = 2 / (Ns + 2) (Walter et al. 2007, section 5.1), without
highlight roughness 1. `Ke` is radiance.
"""

import array
import io
from collections.abc import Collection, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final, TypeAlias

import numpy as np

from kiln_schemas.errors import InputError
from kiln_schemas.tasks import PATH_LENGTH
from kiln_schemas.text import told
from kiln_workers.scene.bundle import BundleFolder
from kiln_workers.scene.geometry import RawMesh, check_mesh_count, check_triangle_count, place, unique_names
from kiln_workers.scene.gltf_materials import make_image
from kiln_workers.scene.limits import MAX_ENTRIES, MAX_TEXT_BYTES, NAME_LENGTH, check_count
from kiln_workers.scene.model import Image, Material, Mesh, Scene, TextureRef

DEFAULT = Material("default")
MAP_LENGTH: Final = 2 * PATH_LENGTH
READ_KEYS: Final = frozenset({"Kd", "Ke", "Ks", "Ns", "Pm", "Pr", "map_Kd", "map_Ke"})


WIDTHS: Final = {"v": 3, "vt": 2, "vn": 3}
Doubles: TypeAlias = "array.array[float]"
Numbers: TypeAlias = "array.array[int]"


@dataclass
class _Group:
    """Faces of one object and material: corners as flat (position, texture, normal) indices, -1 where absent."""

    name: str
    material: str
    corners: Numbers = field(default_factory=lambda: array.array("i"))


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
    textures = _Textures()
    known = _read_libraries(bundle, parsed.libraries, set(parsed.materials), textures, notes)
    missing = sorted({name for name in parsed.materials if name and name not in known})
    notes += [
        f"'{entry}': material '{told(name, NAME_LENGTH)}' is not defined; the default is used." for name in missing
    ]
    materials = tuple(known.get(name, DEFAULT) for name in parsed.materials)
    meshes: list[Mesh] = []
    for raw in parsed.meshes:
        mesh, said = place(raw)
        notes += said
        meshes += [mesh] if mesh is not None else []
    return Scene(tuple(meshes), materials, tuple(textures.images), notes=tuple(notes))


def parse_obj(data: bytes, where: str) -> ObjFile:
    """Meshes of an OBJ file, one for each object and material; InputError names the line at fault."""
    vectors: dict[str, Doubles] = {key: array.array("d") for key in WIDTHS}
    groups: dict[tuple[str, str], _Group] = {}
    libraries: list[str] = []
    name, material = Path(where).stem, ""
    triangles = 0
    for number, key, rest in _lines(data):
        try:
            if key in vectors:
                row = [float(word) for word in rest.split(maxsplit=WIDTHS[key])[: WIDTHS[key]]]
                if len(row) < WIDTHS[key]:
                    raise ValueError("too few numbers")
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
                fan = _fan([_corner(word, vectors) for word in words])
                if (name, material) not in groups:
                    check_mesh_count(len(groups) + 1, where)
                    groups[name, material] = _Group(name, material)
                groups[name, material].corners.extend(fan)
        except (ValueError, IndexError):
            raise InputError(
                f"line {number}: this '{key}' statement is not understood", where=where, remedy="Export it again."
            ) from None
    numbers: dict[str, int] = {}
    for group in groups.values():
        numbers.setdefault(group.material, len(numbers))
    arrays = {key: np.array(flat, dtype=np.float64).reshape(-1, WIDTHS[key]) for key, flat in vectors.items()}
    names = unique_names(group.name for group in groups.values())
    meshes = [
        _mesh(group, name, numbers[group.material], arrays) for name, group in zip(names, groups.values(), strict=True)
    ]
    return ObjFile(meshes, list(numbers), libraries)


def _lines(data: bytes) -> Iterator[tuple[int, str, str]]:
    """Number, keyword and the rest of every statement; a line that ends with a backslash goes on in the next."""
    joined, first = "", 0
    for number, line in enumerate(io.TextIOWrapper(io.BytesIO(data), "utf-8", errors="replace"), start=1):
        first = first or number
        line = line.rstrip("\n")
        if line.endswith("\\"):
            joined += line[:-1] + " "
            continue
        key, _, rest = (joined + line).split("#", 1)[0].strip().partition(" ")
        if key:
            yield first, key, rest.strip()
        joined, first = "", 0


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


def _fan(corners: list[tuple[int, int, int]]) -> list[int]:
    if len(corners) < 3:
        raise ValueError("a face has three corners or more")
    return [
        index
        for i in range(1, len(corners) - 1)
        for corner in (corners[0], corners[i], corners[i + 1])
        for index in corner
    ]


def _mesh(
    group: _Group, name: str, material: int, arrays: dict[str, np.ndarray[tuple[int, int], np.dtype[np.float64]]]
) -> RawMesh:
    corners, faces = np.unique(np.array(group.corners, dtype=np.int64).reshape(-1, 3), axis=0, return_inverse=True)
    uv = None
    if (corners[:, 1] >= 0).all():
        uv = arrays["vt"][corners[:, 1]] * [1.0, -1.0] + [0.0, 1.0]  # v upwards in OBJ
    return RawMesh(
        name=name,
        positions=arrays["v"][corners[:, 0]],
        faces=faces.reshape(-1, 3),
        material=material,
        normals=arrays["vn"][corners[:, 2]] if (corners[:, 2] >= 0).all() else None,
        uv=uv,
    )


@dataclass
class _Textures:
    """Images in the order of first use; each file is decoded once."""

    images: list[Image] = field(default_factory=list)
    known: dict[str, int] = field(default_factory=dict)

    def use(self, line: str | None, title: str, bundle: BundleFolder) -> TextureRef | None:
        """The texture of a map statement."""
        if not line:
            return None
        name = _map_file(line, bundle)
        path = bundle.name(name)
        if path not in self.known:
            data = bundle.read(name, "texture")
            image = make_image(data, name, True, f"material '{title}', texture '{name}'", self.images)
            self.known[path] = len(self.images)
            self.images.append(image)
        return TextureRef(self.known[path])


def _read_libraries(
    bundle: BundleFolder, libraries: list[str], used: Collection[str], textures: _Textures, notes: list[str]
) -> dict[str, Material]:
    """The materials in `used` that the libraries define."""
    materials: dict[str, Material] = {}
    for library in dict.fromkeys(name for line in libraries for name in _library_names(line, bundle)):
        name = bundle.name(library)
        if not bundle.holds(library):
            notes.append(
                f"'{bundle.origin}': the material library '{told(library, NAME_LENGTH)}' is missing; defaults are used."
            )
            continue
        inner = BundleFolder(bundle.folder, name)
        tables: dict[str, dict[str, str]] = {}
        current: dict[str, str] = {}
        for _, key, rest in _lines(bundle.read(library, "material library", MAX_TEXT_BYTES)):
            if key == "newmtl":
                current = tables.setdefault(rest, {})
                check_count(len(tables), MAX_ENTRIES, "materials", name)
            elif key in READ_KEYS:
                current[key] = rest
        for title, table in tables.items():
            if title in used:
                materials[title] = _material(told(title, NAME_LENGTH), table, inner, textures)
    return materials


def _library_names(line: str, bundle: BundleFolder) -> list[str]:
    """The names of an `mtllib` line: one that may hold spaces, or several; the files that there are decide."""
    return [line] if bundle.holds(line) else line.split()


def _material(title: str, table: dict[str, str], bundle: BundleFolder, textures: _Textures) -> Material:
    def numbers(key: str, default: tuple[float, ...]) -> tuple[float, ...]:
        if key not in table:
            return default
        try:
            values = tuple(float(word) for word in table[key].split())
        except ValueError:
            values = ()
        if len(values) not in (1, 3) or not np.isfinite(values).all() or min(values) < 0.0:
            raise InputError(
                f"'{key}' is not one or three numbers of 0 or more",
                where=f"material '{title}'",
                remedy="Mend the library.",
            )
        return values * 3 if len(values) == 1 and len(default) == 3 else values

    red, green, blue = (min(value, 1.0) for value in numbers("Kd", (0.8, 0.8, 0.8)))
    glow = numbers("Ke", (0.0, 0.0, 0.0))
    shiny = max(numbers("Ks", (0.0, 0.0, 0.0))) > 0.0 and "Ns" in table
    phong = (2.0 / (numbers("Ns", (0.0,))[0] + 2.0)) ** 0.25 if shiny else 1.0
    return Material(
        name=title,
        base_color=(red, green, blue, 1.0),
        base_color_texture=textures.use(table.get("map_Kd"), title, bundle),
        metallic=min(numbers("Pm", (0.0,))[0], 1.0),
        roughness=min(numbers("Pr", (phong,))[0], 1.0),
        emission=(glow[0], glow[1], glow[2]),
        emission_texture=textures.use(table.get("map_Ke"), title, bundle) if max(glow) > 0.0 else None,
    )


def _map_file(line: str, bundle: BundleFolder) -> str:
    """The file name of a map statement: behind its options the longest that is a file's, as names may hold spaces."""
    check_count(len(line), MAP_LENGTH, "characters in a map statement", bundle.origin)
    if not line.startswith("-"):
        return line
    words = line.split()
    names = [" ".join(words[start:]) for start in range(1, len(words))]
    return next((name for name in names if bundle.holds(name)), words[-1])
