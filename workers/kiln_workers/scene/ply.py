"""Reader of PLY (ASCII and binary, either byte order): one mesh, with normals, texture coordinates and colours.

By Turk's description of the format (1994); an own reader, as general ones refuse binary files whose faces differ in
their number of corners. A PLY file has no material: the surface is plaster of roughness 1 (the model's default), or of
its vertices' colours, which are sRGB, as scanners write and three.js and Blender read them.
"""

import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

import numpy as np

from kiln_schemas.errors import InputError
from kiln_schemas.text import told
from kiln_workers.scene.bundle import BundleFolder
from kiln_workers.scene.container import Array
from kiln_workers.scene.geometry import Floats, Ints, RawMesh, check_triangle_count, place
from kiln_workers.scene.images import linearised
from kiln_workers.scene.limits import MAX_VERTICES, check_count
from kiln_workers.scene.model import Material, Scene
from kiln_workers.scene.polygons import triangulated

TYPES: Final = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2",
    "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4",
    "double": "f8", "float64": "f8",
}  # fmt: skip
FORMATS: Final = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
COLOURS: Final = (("red", "green", "blue"), ("r", "g", "b"), ("diffuse_red", "diffuse_green", "diffuse_blue"))
MAX_HEADER: Final = 1 << 16


@dataclass
class _Property:
    """A number, or where `count` is a type, a list of numbers."""

    name: str
    kind: str
    count: str = ""


@dataclass
class _Element:
    name: str
    length: int
    properties: list[_Property] = field(default_factory=list)

    @property
    def least_bytes(self) -> int:
        """Bytes of a row whose lists are empty."""
        return sum(np.dtype(part.count or part.kind).itemsize for part in self.properties)


@dataclass
class _Table:
    """An element's rows: numbers [N] by name, and lists by name as all their items [M] and their lengths [N]."""

    numbers: dict[str, Array] = field(default_factory=dict)
    lists: dict[str, tuple[Array, Ints]] = field(default_factory=dict)


def read_ply(folder: Path, entry: str) -> Scene:
    """The scene of a PLY file."""
    data = BundleFolder(folder, entry).read(Path(entry).name, "scene")
    raw = parse_ply(data, entry)
    mesh, notes = place(raw)
    material = Material("default") if raw.colors is None else Material("default", (1.0, 1.0, 1.0, 1.0))
    return Scene((mesh,) if mesh is not None else (), (material,), notes=tuple(notes))


def parse_ply(data: bytes, where: str, material: int = 0) -> RawMesh:
    """The mesh of a PLY file; InputError names `where` if it cannot be read."""
    data = data.removeprefix(b"\xef\xbb\xbf")
    order, elements, start = _header(data, where)
    try:
        tables = _ascii(data[start:], elements) if not order else _binary(data, start, order, elements)
    except (ValueError, IndexError, OverflowError):
        raise InputError(
            "cannot be read as PLY: a row is cut off, or has what is no number", where=where, remedy="Export it again."
        ) from None
    vertex = tables.get("vertex", _Table()).numbers
    positions = _columns(vertex, ("x", "y", "z"))
    if positions is None:
        raise InputError("has no vertices with x, y and z", where=where, remedy="Export it again.")
    face = tables.get("face", _Table()).lists
    corners, sizes = face.get("vertex_indices", face.get("vertex_index", (np.zeros(0), np.zeros(0, np.int64))))
    corners = corners.astype(np.int64)
    check_triangle_count(int(np.maximum(sizes - 2, 0).sum()), where)
    if len(corners) and (corners.min() < 0 or corners.max() >= len(positions)):
        raise InputError(
            f"a face names vertex {corners[(corners < 0) | (corners >= len(positions))][0]} of {len(positions)}",
            where=where,
            remedy="Export it again.",
        )
    keep = sizes >= 3
    corners, sizes = corners[np.repeat(keep, sizes)], sizes[keep]
    uv = _columns(vertex, ("s", "t"), ("u", "v"), ("texture_u", "texture_v"))
    return RawMesh(
        name=Path(where).stem,
        positions=positions,
        faces=corners[triangulated(positions[corners], sizes)],
        material=material,
        normals=_columns(vertex, ("nx", "ny", "nz")),
        uv=None if uv is None else uv * [1.0, -1.0] + [0.0, 1.0],
        colors=_colours(vertex),
    )


def _header(data: bytes, where: str) -> tuple[str, list[_Element], int]:
    """Byte order (empty for ASCII), elements, and where the body begins."""
    found = re.search(rb"\nend_header[ \t]*\r?\n", data[:MAX_HEADER])
    if not data.startswith(b"ply") or found is None:
        raise InputError("is no PLY file: its header is missing", where=where, remedy="Export it again.")
    order, elements = None, list[_Element]()
    for line in data[: found.start()].decode("latin-1").splitlines():
        words = line.split()
        try:
            if words[:1] == ["format"]:
                order = FORMATS[words[1]]
            elif words[:1] == ["element"]:
                elements.append(_Element(words[1], int(words[2])))
            elif words[:2] == ["property", "list"]:
                elements[-1].properties.append(_Property(words[4], TYPES[words[3]], TYPES[words[2]]))
            elif words[:1] == ["property"]:
                elements[-1].properties.append(_Property(words[2], TYPES[words[1]]))
        except (KeyError, IndexError, ValueError):
            raise InputError("a line of its header is not understood", where=where, remedy="Export it again.") from None
    if order is None:
        raise InputError("its header names no format", where=where, remedy="Export it again.")
    body = len(data) - found.end()
    for element in elements:
        check_count(element.length, MAX_VERTICES, f"rows of {told(element.name, 40)}", where)
        # A row of text takes a character a number and one between them.
        least = element.least_bytes if order else 2 * len(element.properties) - 1
        if element.length < 0 or element.length * max(least, 1) > body + 1:
            raise InputError(
                f"is cut off: its header tells of {element.length} rows, {body} bytes follow",
                where=where,
                remedy="Export it again.",
            )
    return order, elements, found.end()


def _ascii(body: bytes, elements: list[_Element]) -> dict[str, _Table]:
    words, at = np.array(body.split(), dtype=np.bytes_), 0
    out: dict[str, _Table] = {}
    for element in elements:
        table = out.setdefault(element.name, _Table())
        if not any(part.count for part in element.properties):
            width = len(element.properties)
            rows = words[at : at + element.length * width].astype(np.float64).reshape(element.length, width)
            table.numbers = {part.name: rows[:, number] for number, part in enumerate(element.properties)}
            at += element.length * width
            continue
        items: dict[str, list[Array]] = {part.name: [] for part in element.properties}
        for _ in range(element.length):
            for part in element.properties:
                count = 1
                if part.count:
                    count, at = int(words[at]), at + 1
                if count < 0 or at + count > len(words):
                    raise ValueError(f"a row of {element.name} is cut off")
                items[part.name].append(words[at : at + count])
                at += count
        _collect(table, element, items)
    return out


def _binary(data: bytes, at: int, order: str, elements: list[_Element]) -> dict[str, _Table]:
    out: dict[str, _Table] = {}
    for element in elements:
        table = out.setdefault(element.name, _Table())
        end = _uniform(data, at, order, element, table)
        at = _mixed(data, at, order, element, table) if end is None else end
    return out


def _uniform(data: bytes, at: int, order: str, element: _Element, table: _Table) -> int | None:
    """Read all rows at once, as if all were as long as the first; the end, or None where they are not."""
    lengths = _first_lengths(data, at, order, element)
    fields: list[tuple[str, str, tuple[int, ...]]] = []
    for number, part in enumerate(element.properties):
        fields += [(f"{number}n", order + part.count, ())] if part.count else []
        fields.append((f"{number}v", order + part.kind, (lengths[part.name],) if part.count else ()))
    kind = np.dtype(fields)
    end = at + element.length * kind.itemsize
    if end > len(data):
        return None
    rows = np.frombuffer(data, kind, element.length, at)
    for number, part in enumerate(element.properties):
        if part.count and not (rows[f"{number}n"] == lengths[part.name]).all():
            return None
    for number, part in enumerate(element.properties):
        values = rows[f"{number}v"]
        if part.count:
            table.lists[part.name] = (values.reshape(-1), np.full(element.length, lengths[part.name]))
        else:
            table.numbers[part.name] = values
    return end


def _mixed(data: bytes, at: int, order: str, element: _Element, table: _Table) -> int:
    """Read row after row; the end."""
    items: dict[str, list[Array]] = {part.name: [] for part in element.properties}
    for _ in range(element.length):
        for part in element.properties:
            count = 1
            if part.count:
                count = int(np.frombuffer(data, order + part.count, 1, at)[0])
                at += np.dtype(part.count).itemsize
            size = np.dtype(part.kind).itemsize
            if count < 0 or at + count * size > len(data):
                raise ValueError(f"a row of {element.name} is cut off")
            items[part.name].append(np.frombuffer(data, order + part.kind, count, at))
            at += count * size
    _collect(table, element, items)
    return at


def _first_lengths(data: bytes, at: int, order: str, element: _Element) -> dict[str, int]:
    """Lengths of the lists of an element's first row."""
    out: dict[str, int] = {}
    for part in element.properties if element.length else ():
        count = 1
        if part.count:
            count = out[part.name] = max(int(np.frombuffer(data, order + part.count, 1, at)[0]), 0)
            at += np.dtype(part.count).itemsize
        at += count * np.dtype(part.kind).itemsize
    return {part.name: out.get(part.name, 0) for part in element.properties}


def _collect(table: _Table, element: _Element, items: dict[str, list[Array]]) -> None:
    for part in element.properties:
        joined = np.concatenate(items[part.name]) if items[part.name] else np.zeros(0)
        values = joined.astype(np.float64)
        if part.count:
            table.lists[part.name] = (values, np.array([len(row) for row in items[part.name]], dtype=np.int64))
        else:
            table.numbers[part.name] = values


def _columns(vertex: dict[str, Array], *choices: tuple[str, ...]) -> Floats | None:
    """The first of `choices` whose properties the vertices have, as columns."""
    for names in choices:
        if all(name in vertex for name in names):
            return np.stack([vertex[name].astype(np.float64) for name in names], axis=1)
    return None


def _colours(vertex: dict[str, Array]) -> Floats | None:
    """Linear RGBA [V, 4] of the vertices' colours, which are bytes, or floats up to 1."""
    rgb = _columns(vertex, *COLOURS)
    if rgb is None:
        return None
    alpha = _columns(vertex, ("alpha",), ("a",))
    rgba = np.concatenate([rgb, np.full((len(rgb), 1), rgb.max(initial=1.0)) if alpha is None else alpha], axis=1)
    if rgba[:, :3].max(initial=0.0) > 1.0 or (alpha is not None and alpha.max(initial=0.0) > 1.0):
        rgba = rgba / 255.0
    if alpha is None:
        rgba[:, 3] = 1.0
    return linearised(np.clip(rgba, 0.0, 1.0).astype(np.float32)).astype(np.float64)
