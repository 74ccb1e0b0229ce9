"""Meshes of a Collada geometry: `<triangles>`, `<polylist>`, `<polygons>` with holes, strips and fans.

Each primitive counts its data with several indices a corner; corners whose indices are the same become one vertex. v
grows upwards in Collada and downwards in the model; colours are sRGB, as exporters write and three.js reads them.
"""

from dataclasses import dataclass, field

import numpy as np

from kiln_schemas.text import QUOTE_LENGTH, told
from kiln_workers.scene.collada_document import Collada
from kiln_workers.scene.geometry import Floats, Ints, check_triangle_count
from kiln_workers.scene.images import linearised
from kiln_workers.scene.polygons import FAN, STRIP, cut, listed_faces, triangulated
from kiln_workers.scene.xml_nodes import Node

SURFACES = ("triangles", "polylist", "polygons", "trifans", "tristrips")
LINES = ("lines", "linestrips")


@dataclass
class Part:
    """The faces of a geometry that have one material, in the geometry's space."""

    symbol: str
    """What the instance's `<bind_material>` calls the material."""
    faces: Ints  # [F, 3]
    positions: Floats  # [V, 3]
    point: Ints  # [V] which of the geometry's positions each is
    normals: Floats | None = None  # [V, 3]
    uv: dict[int, Floats] = field(default_factory=dict)  # [V, 2] by set, v downwards
    colors: Floats | None = None  # [V, 4] linear RGBA


@dataclass(frozen=True)
class _Input:
    semantic: str
    offset: int
    set: int
    rows: Floats  # [N, C]


def geometry_parts(document: Collada, geometry: Node) -> list[Part]:
    """The parts of a `<geometry>`; what is no mesh is counted among the ignored."""
    mesh = geometry.child("mesh")
    if mesh is None:
        other = next((node.tag for node in geometry.all("convex_mesh", "spline", "brep")), "nothing")
        document.ignored[f"geometries of {other}"] += 1
        return []
    out = []
    for primitive in mesh.children:
        if primitive.tag in LINES:
            document.ignored["primitives of lines"] += 1
        elif primitive.tag in SURFACES:
            part = _part(document, primitive)
            out += [part] if part is not None else []
    return out


def _part(document: Collada, primitive: Node) -> Part | None:
    inputs = _inputs(document, primitive)
    points = next((part for part in inputs if part.semantic == "POSITION"), None)
    if points is None or points.rows.shape[1] < 3:
        document.ignored["primitives without positions"] += 1
        return None
    corners, faces = _faces(document, primitive, inputs, points)  # [C, K], [F, 3]
    if not len(faces):
        return None
    offsets = sorted({part.offset for part in inputs})
    rows, compact = np.unique(corners[:, offsets][faces.reshape(-1)], axis=0, return_inverse=True)

    def picked(part: _Input) -> Ints:
        return rows[:, offsets.index(part.offset)]

    out = Part(
        symbol=primitive.attributes.get("material", ""),
        faces=compact.reshape(-1, 3),
        positions=points.rows[picked(points), :3],
        point=picked(points),
    )
    for part in inputs:
        values = part.rows[picked(part)]
        if part.semantic == "NORMAL" and part.rows.shape[1] == 3 and out.normals is None:
            out.normals = values
        elif part.semantic in ("TEXCOORD", "UV") and part.rows.shape[1] >= 2:
            out.uv.setdefault(part.set, values[:, :2] * [1.0, -1.0] + [0.0, 1.0])
        elif part.semantic == "COLOR" and part.rows.shape[1] >= 3 and out.colors is None:
            alpha = values[:, 3:4] if values.shape[1] > 3 else np.ones((len(values), 1))
            colours = linearised(np.clip(values[:, :3], 0.0, 1.0).astype(np.float32))
            out.colors = np.concatenate([colours, np.clip(alpha, 0.0, 1.0)], axis=1).astype(np.float64)
    return out


def _inputs(document: Collada, primitive: Node) -> list[_Input]:
    """The primitive's inputs, with those of `<vertices>` in the place of VERTEX."""
    out = []
    for node in primitive.all("input"):
        offset, number = document.whole(node, "offset", 0), document.whole(node, "set", 0)
        if node.attributes.get("semantic") != "VERTEX":
            source = document.need(node, "source", "source")
            out.append(_Input(node.attributes.get("semantic", ""), offset, number, document.source(source)))
            continue
        for inner in document.need(node, "source", "vertices").all("input"):
            source = document.need(inner, "source", "source")
            out.append(_Input(inner.attributes.get("semantic", ""), offset, number, document.source(source)))
    return out


def _faces(document: Collada, primitive: Node, inputs: list[_Input], points: _Input) -> tuple[Ints, Ints]:
    """The indices [C, K] of all corners, and triangles [F, 3] of corners."""
    rings = _rings(primitive)
    lists = [node for polygon in rings for node in polygon]
    flat, counts = document.lists(lists)
    width = 1 + max(document.whole(node, "offset", 0) for node in primitive.all("input"))
    if (counts % width).any():
        wrong = counts[np.flatnonzero(counts % width)[0]]
        raise document.fail(primitive, f"has a list of {wrong} indices, {width} to a corner")
    corners = flat.reshape(-1, width)
    check_triangle_count(len(corners) // (3 if primitive.tag == "triangles" else 1), document.where)
    for part in inputs:
        _check_range(document, primitive, corners[:, part.offset], part)
    places = points.rows[corners[:, points.offset], :3]
    if primitive.tag in ("triangles", "polylist"):
        return corners, _polygon_faces(places, np.arange(len(corners)), _sizes(document, primitive, len(corners)))
    sizes = counts // width
    starts = np.cumsum(sizes) - sizes
    outlines = np.cumsum([len(polygon) for polygon in rings], dtype=np.int64) - [len(polygon) for polygon in rings]
    parts: list[Ints] = []
    plain = np.zeros(len(sizes), np.bool_)
    for polygon, first in zip(rings, outlines, strict=True):
        if primitive.tag == "polygons" and len(polygon) == 1:
            plain[first] = True
            continue
        order = starts[first] + np.arange(sizes[first : first + len(polygon)].sum())
        if primitive.tag == "polygons":
            parts.append(order[cut(places[order], np.cumsum(sizes[first : first + len(polygon)]))])
        else:
            parts.append(listed_faces(order, FAN if primitive.tag == "trifans" else STRIP))
    used = np.flatnonzero(np.repeat(plain, sizes))
    parts.append(_polygon_faces(places[used], used, sizes[plain]))
    return corners, np.concatenate(parts)


def _rings(primitive: Node) -> list[list[Node]]:
    """The lists of a primitive: each polygon's outline with its holes behind it, or a strip, or all there is."""
    outlines = [(node, node) if node.tag == "p" else (node.child("p"), node) for node in primitive.all("p", "ph")]
    found = [[outline, *node.all("h")] for outline, node in outlines if outline is not None]
    return found[:1] if primitive.tag in ("triangles", "polylist") else found


def _sizes(document: Collada, primitive: Node, corners: int) -> Ints:
    """Corners of each polygon, three of each triangle."""
    if primitive.tag == "triangles":
        return np.full(corners // 3, 3)
    counts = primitive.child("vcount")
    sizes = document.ints(counts) if counts is not None else np.zeros(0, np.int64)
    if (sizes < 0).any() or (sizes > corners).any() or sizes.sum() != corners:
        raise document.fail(primitive, f"has {corners} corners, and another sum of its <vcount>")
    return sizes


def _polygon_faces(places: Floats, corners: Ints, sizes: Ints) -> Ints:
    """Triangles [F, 3] of polygons of `sizes`, whose `corners` and their `places` [C, 3] follow each other."""
    keep = sizes >= 3
    used = np.flatnonzero(np.repeat(keep, sizes))
    return corners[used][triangulated(places[used], sizes[keep])]


def _check_range(document: Collada, primitive: Node, index: Ints, part: _Input) -> None:
    if len(index) and (index.min() < 0 or index.max() >= len(part.rows)):
        wrong = index[(index < 0) | (index >= len(part.rows))][0]
        name = told(part.semantic, QUOTE_LENGTH)
        raise document.fail(primitive, f"names {name} {wrong} of {len(part.rows)}")
