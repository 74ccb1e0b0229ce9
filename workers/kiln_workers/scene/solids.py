"""Readers of STL (binary and ASCII) and OFF: bare triangles, of plaster of roughness 1 (the model's default).

STL by the description of 3D Systems (1989): no units and no vertices shared; normals are taken from the faces, as
writers leave wrong ones. OFF by that of Geomview: polygons of any shape, colours ignored.
"""

from pathlib import Path
from typing import Final

import numpy as np

from kiln_schemas.errors import InputError
from kiln_workers.scene.bundle import BundleFolder
from kiln_workers.scene.geometry import RawMesh, check_triangle_count, place
from kiln_workers.scene.limits import MAX_TEXT_BYTES, MAX_VERTICES, check_count
from kiln_workers.scene.model import Material, Scene
from kiln_workers.scene.polygons import triangulated

STL_HEAD: Final = 84
STL_FACE: Final = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attributes", "<u2")])


def read_stl(folder: Path, entry: str) -> Scene:
    """The scene of an STL file."""
    data = BundleFolder(folder, entry).read(Path(entry).name, "scene")
    count = int.from_bytes(data[80:STL_HEAD], "little")
    # Binary files may begin with `solid` too; their length gives them away.
    if len(data) >= STL_HEAD and len(data) == STL_HEAD + count * STL_FACE.itemsize:
        check_triangle_count(count, entry)
        return _triangles(np.frombuffer(data, STL_FACE, count, STL_HEAD)["corners"].astype(np.float64), entry)
    return _triangles(_ascii_stl(data, entry), entry)


def _triangles(corners: np.ndarray[tuple[int, ...], np.dtype[np.float64]], entry: str) -> Scene:
    corners = corners.reshape(-1, 3)
    return _scene(corners, np.arange(len(corners)).reshape(-1, 3), entry)


def _ascii_stl(data: bytes, where: str) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    check_count(len(data), MAX_TEXT_BYTES, "bytes", where, "Save it in binary form.")
    lines = [line.split() for line in data.removeprefix(b"\xef\xbb\xbf").splitlines()]
    rows = [words[1:] for words in lines if words[:1] == [b"vertex"]]
    if not rows or len(rows) % 3 or lines[0][:1] != [b"solid"]:
        raise InputError("is neither binary nor ASCII STL, or is cut off", where=where, remedy="Export it again.")
    check_triangle_count(len(rows) // 3, where)
    try:
        return np.array(rows, dtype=np.float64).reshape(-1, 3)
    except ValueError:
        raise InputError("has a vertex that is not three numbers", where=where, remedy="Export it again.") from None


def read_off(folder: Path, entry: str) -> Scene:
    """The scene of an OFF file."""
    data = BundleFolder(folder, entry).read(Path(entry).name, "scene", MAX_TEXT_BYTES)
    lines = [line.split(b"#")[0].split() for line in data.removeprefix(b"\xef\xbb\xbf").splitlines()]
    words = [words for words in lines if words]
    try:
        if words[0][0] != b"OFF":
            raise ValueError("it does not begin with OFF")
        head, rest = (words[0][1:], words[1:]) if len(words[0]) > 1 else (words[1], words[2:])
        vertices, faces = int(head[0]), int(head[1])
        check_count(vertices, MAX_VERTICES, "vertices", entry)
        check_triangle_count(faces, entry)
        if len(rest) < vertices + faces:
            raise ValueError(f"{vertices} vertices and {faces} faces are announced, {len(rest)} lines follow")
        positions = np.array([row[:3] for row in rest[:vertices]], dtype=np.float64).reshape(-1, 3)
        polygons = [np.array(row[1 : 1 + int(row[0])], np.int64) for row in rest[vertices : vertices + faces]]
    except (ValueError, IndexError) as error:
        raise InputError(f"cannot be read as OFF: {error}", where=entry, remedy="Export it again.") from None
    polygons = [polygon for polygon in polygons if len(polygon) >= 3]
    corners = np.concatenate(polygons) if polygons else np.zeros(0, np.int64)
    check_triangle_count(len(corners) - 2 * len(polygons), entry)
    if len(corners) and (corners.min() < 0 or corners.max() >= vertices):
        raise InputError(f"a face names a vertex that is not one of {vertices}", where=entry, remedy="Export it again.")
    sizes = np.array([len(polygon) for polygon in polygons], dtype=np.int64)
    return _scene(positions, corners[triangulated(positions[corners], sizes)], entry)


def _scene(
    positions: np.ndarray[tuple[int, ...], np.dtype[np.float64]],
    faces: np.ndarray[tuple[int, ...], np.dtype[np.int64]],
    entry: str,
) -> Scene:
    mesh, notes = place(RawMesh(Path(entry).stem, positions, faces, 0))
    return Scene((mesh,) if mesh is not None else (), (Material("default"),), notes=tuple(notes))
