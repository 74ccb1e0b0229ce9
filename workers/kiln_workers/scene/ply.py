"""Reader of PLY (ASCII and binary, either byte order) through trimesh: one mesh, with normals and texture coordinates.

A PLY file has no material; the surface is white plaster of roughness 1 (the model's default).
"""

import io
import re
from pathlib import Path
from typing import Any

import numpy as np
from trimesh.exchange.ply import load_ply
from trimesh.geometry import triangulate_quads

from kiln_schemas.errors import InputError
from kiln_workers.scene.bundle import BundleFolder
from kiln_workers.scene.geometry import Floats, RawMesh, check_triangle_count, place
from kiln_workers.scene.model import Material, Scene


def read_ply(folder: Path, entry: str) -> Scene:
    """The scene of a PLY file."""
    data = BundleFolder(folder, entry).read(Path(entry).name, "scene")
    mesh, notes = place(parse_ply(data, entry))
    return Scene((mesh,) if mesh is not None else (), (Material("default"),), notes=tuple(notes))


def parse_ply(data: bytes, where: str, material: int = 0) -> RawMesh:
    """The mesh of a PLY file; InputError names `where` if it cannot be read."""
    _check_header(data, where)
    try:
        parsed = load_ply(io.BytesIO(data), skip_materials=True)
        faces = np.asarray(triangulate_quads(parsed.get("faces", [])), dtype=np.int64).reshape(-1, 3)
    except Exception as error:  # trimesh raises whatever its parsing meets, and quotes it
        raise InputError(
            f"cannot be read as PLY ({type(error).__name__})", where=where, remedy="Export it again."
        ) from None
    positions = np.asarray(parsed.get("vertices", np.zeros((0, 3))), dtype=np.float64).reshape(-1, 3)
    check_triangle_count(len(faces), where)
    vertex = parsed.get("metadata", {}).get("_ply_raw", {}).get("vertex", {}).get("data")
    uv = _columns(vertex, ("s", "t"), ("u", "v"), ("texture_u", "texture_v"))
    normals = _columns(vertex, ("nx", "ny", "nz"))
    return RawMesh(
        name=Path(where).stem,
        positions=positions,
        faces=faces,
        material=material,
        normals=normals if normals is not None and len(normals) == len(positions) else None,
        uv=uv * [1.0, -1.0] + [0.0, 1.0] if uv is not None and len(uv) == len(positions) else None,
    )


def _check_header(data: bytes, where: str) -> None:
    """Hold the counts in the header to the bytes that there are, before anything is made of that size."""
    header, end, body = data.partition(b"end_header")
    counts = [int(count) for count in re.findall(rb"^\s*element\s+\S+\s+(\d{1,18})\s*$", header, re.MULTILINE)]
    if end and sum(counts) > len(body):  # an element has a byte at least
        raise InputError(
            f"is cut off: its header tells of {sum(counts)} elements, {len(body)} bytes follow",
            where=where,
            remedy="Export it again.",
        )


def _columns(vertex: Any, *choices: tuple[str, ...]) -> Floats | None:
    """The first of `choices` whose properties the vertices have, as columns."""
    for names in choices:
        try:
            return np.stack([np.asarray(vertex[name], dtype=np.float64).reshape(-1) for name in names], axis=1)
        except (KeyError, IndexError, TypeError, ValueError):
            continue
    return None
