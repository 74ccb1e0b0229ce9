"""Charts between the unwrapper and the packer: laid straight, slimmed and cut where they are too long, as pieces.

A kerb of 400 m beside a room would else decide the scale of the whole light map, or take most of its texels. Its chart
gets a lower scale of its own and is cut across into pieces that fit; the faces on a cut are split there, the same way
on both sides.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from kiln_workers.scene.geometry import Floats, Ints
from kiln_workers.scene.model import Mesh
from kiln_workers.scene.unwrap import Unwrapped

LONG_SHARE: Final = 0.125
"""Part of the light map that a chart longer than its side may take."""
ANGLES: Final = 64
"""Angles within a quarter turn at which a chart's bounding box is tried."""


@dataclass(frozen=True)
class Pieces:
    """All charts of a scene, [C] of them, mesh after mesh."""

    corners: Floats  # [F, 3, 2] metres, the faces of each chart together, its lower bounds at 0
    start: Ints  # [C + 1] first face of each chart in `corners`
    extent: Floats  # [C, 2] metres
    area: Floats  # [C] square metres
    mesh: Ints  # [C]
    centre: Floats  # [C, 3] metres, world
    normal: Floats  # [C, 3] sum of the faces' normals times twice their areas
    rigid: npt.NDArray[np.bool_]  # [C] not to be turned


def straightened(part: Unwrapped) -> Unwrapped:
    """Every chart turned so that its bounding box is smallest, and moved so that its lower bounds are 0."""
    order = np.argsort(part.chart, kind="stable")
    first = np.searchsorted(part.chart[order], np.arange(part.charts))
    uv = part.uv[order]
    uv -= np.repeat(uv[first], np.diff(first, append=len(uv)), axis=0)
    angle = np.linspace(0.0, 0.5 * np.pi, ANGLES, endpoint=False)
    best, turn = np.full(part.charts, np.inf), np.zeros(part.charts)
    for value in angle:
        size = [
            np.maximum.reduceat(along, first) - np.minimum.reduceat(along, first)
            for along in (uv @ [np.cos(value), np.sin(value)], uv @ [-np.sin(value), np.cos(value)])
        ]
        better = size[0] * size[1] < best * (1.0 - 1e-6)
        best, turn = np.where(better, size[0] * size[1], best), np.where(better, value, turn)
    cosine, sine = np.cos(turn)[part.chart[order]], np.sin(turn)[part.chart[order]]
    out = np.zeros_like(uv)
    out[order] = np.stack([cosine * uv[:, 0] + sine * uv[:, 1], -sine * uv[:, 0] + cosine * uv[:, 1]], axis=1)
    return replace(part, uv=out - _bounds(out, part.chart, part.charts)[0][part.chart])


def slimmed(part: Unwrapped, scale: float, side: float, padding: int) -> Unwrapped:
    """The part with long charts made smaller, so that none takes the whole of a light map of `side` texels.

    A chart longer than the side is drawn at a scale of its own, lower than `scale` texels a metre, at which its texels
    and the padding beside them are LONG_SHARE of the light map: length s (width s + 1 + padding) = share. A chart that
    may not be cut is made as long as the side instead.
    """
    low, high = _bounds(part.uv, part.chart, part.charts)
    length, width = (high - low).max(axis=1), (high - low).min(axis=1)
    long = length * scale > side
    if not long.any():
        return part
    room, rows = LONG_SHARE * side * side, 1.0 + padding
    square = np.maximum(length * width, 1e-300)
    own = (np.sqrt((length * rows) ** 2 + 4.0 * square * room) - length * rows) / (2.0 * square)
    own = np.where(own * width < 1e-6, room / np.maximum(length * rows, 1e-300), own)
    own = side / np.maximum(length, 1e-300) if part.whole else np.maximum(own, side / np.maximum(length, 1e-300))
    factor = np.where(long, np.minimum(own / scale, 1.0), 1.0)
    return replace(part, uv=part.uv * factor[part.chart][:, None])


def cut_long(part: Unwrapped, longest: float) -> Unwrapped:
    """The part with every chart that is longer than `longest` metres cut across into equal pieces; `part` is uncut."""
    low, high = _bounds(part.uv, part.chart, part.charts)
    extent = high - low
    pieces = np.maximum(np.ceil(extent.max(axis=1) / longest).astype(np.int64), 1)
    if part.whole or pieces.max() == 1:
        return part
    along = np.where((extent[:, 0] >= extent[:, 1])[part.chart], part.uv[:, 0], part.uv[:, 1])
    # `along` in pieces, so that the cuts of all charts are at whole numbers.
    along = along * (pieces / np.maximum(extent.max(axis=1), 1e-300))[part.chart]
    last = pieces[part.chart[part.faces[:, 0]]] - 1
    begin = np.clip(np.floor(along[part.faces].min(axis=1)).astype(np.int64), 0, last)
    end = np.clip(np.ceil(along[part.faces].max(axis=1)).astype(np.int64) - 1, begin, last)
    whole = np.flatnonzero(begin == end)
    corners = [_Corners(part.faces[whole], part.faces[whole], np.zeros((len(whole), 3)), begin[whole])]
    corners += [
        _slice(part.faces[face], along, int(begin[face]), int(end[face])) for face in np.flatnonzero(begin < end)
    ]
    a, b = (np.concatenate([getattr(item, name) for item in corners]) for name in ("one", "other"))
    share = np.concatenate([item.share for item in corners])
    piece = np.concatenate([item.piece for item in corners])
    chart = np.unique(part.chart[a[:, 0]] * int(pieces.max()) + piece, return_inverse=True)[1].reshape(-1)
    rows = np.column_stack([np.repeat(chart, 3), a.reshape(-1), b.reshape(-1), share.reshape(-1).view(np.int64)])
    _, first, number = np.unique(rows, axis=0, return_index=True, return_inverse=True)
    a, b, share = a.reshape(-1)[first], b.reshape(-1)[first], share.reshape(-1)[first]
    uv = part.uv[a] + share[:, None] * (part.uv[b] - part.uv[a])
    new_chart = np.repeat(chart, 3)[first]
    cut = replace(
        part,
        vertex=part.vertex[a],
        other=part.vertex[b],
        share=share,
        faces=number.reshape(-1, 3).astype(np.int64),
        chart=new_chart,
        uv=uv,
    )
    return replace(cut, uv=uv - _bounds(uv, new_chart, cut.charts)[0][new_chart])


@dataclass(frozen=True)
class _Corners:
    """Faces whose corners lie at `share` of the way from vertex `one` to vertex `other`, each in a piece."""

    one: Ints  # [F, 3]
    other: Ints  # [F, 3]
    share: Floats  # [F, 3]
    piece: Ints  # [F]


def _slice(face: Ints, along: Floats, begin: int, end: int) -> _Corners:
    """A face sliced at the whole numbers begin + 1 ... end of `along`, each slice as a fan of triangles."""
    faces, pieces = [], []
    for piece in range(begin, end + 1):
        low = piece if piece > begin else -np.inf
        high = piece + 1 if piece < end else np.inf
        outline: list[tuple[int, int, float]] = []
        for i in range(3):
            a, b = int(face[i]), int(face[(i + 1) % 3])
            if low <= along[a] <= high:
                outline.append((a, a, 0.0))
            # The same numbers whichever way the edge runs, so that the neighbour is cut at the same point.
            one, other = min(a, b), max(a, b)
            crossed = [cut for cut in (low, high) if min(along[a], along[b]) < cut < max(along[a], along[b])]
            for cut in sorted(crossed, reverse=bool(along[a] > along[b])):
                outline.append((one, other, float((cut - along[one]) / (along[other] - along[one]))))
        for i in range(1, len(outline) - 1):
            faces.append((outline[0], outline[i], outline[i + 1]))
            pieces.append(piece)
    table = np.array(faces, dtype=np.float64).reshape(-1, 3, 3)
    return _Corners(
        table[..., 0].astype(np.int64), table[..., 1].astype(np.int64), table[..., 2].copy(), np.array(pieces)
    )


def gather(meshes: Sequence[Mesh], parts: Sequence[Unwrapped]) -> Pieces:
    """The charts of all parts, one part a mesh, as pieces to be packed."""
    corners, sizes, extents, areas, centres, normals = [], [], [], [], [], []
    for mesh, part in zip(meshes, parts, strict=True):
        chart = part.chart[part.faces[:, 0]]
        order = np.argsort(chart, kind="stable")
        count = np.bincount(chart, minlength=part.charts)
        first = np.cumsum(count) - count
        flat = part.uv[part.faces[order]]
        a, b, c = np.moveaxis(flat, 1, 0)
        flat_area = 0.5 * np.abs((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0])
        world = points(mesh.positions, part)[part.faces[order]]
        cross = np.cross(world[:, 1] - world[:, 0], world[:, 2] - world[:, 0])
        corners.append(flat)
        sizes.append(count)
        extents.append(_bounds(part.uv, part.chart, part.charts)[1])
        areas.append(np.add.reduceat(flat_area, first))
        centres.append(np.add.reduceat(world.mean(axis=1), first) / count[:, None])
        normals.append(np.add.reduceat(cross, first))
    return Pieces(
        corners=np.concatenate(corners),
        start=np.cumsum([0, *np.concatenate(sizes)]),
        extent=np.concatenate(extents),
        area=np.concatenate(areas),
        mesh=np.repeat(np.arange(len(parts)), [part.charts for part in parts]),
        centre=np.concatenate(centres),
        normal=np.concatenate(normals),
        rigid=np.repeat([part.rigid for part in parts], [part.charts for part in parts]),
    )


def points(values: npt.NDArray[Any], part: Unwrapped) -> Floats:
    """A vertex attribute [V, ...] of the original mesh at the part's vertices [V', ...], in float64."""
    one, other = values[part.vertex].astype(np.float64), values[part.other].astype(np.float64)
    share = part.share.reshape(-1, *[1] * (values.ndim - 1))
    return np.asarray(one + share * (other - one))


def _bounds(uv: Floats, chart: Ints, charts: int) -> tuple[Floats, Floats]:
    """Lower and upper bounds [C, 2] of each chart."""
    low, high = np.full((charts, 2), np.inf), np.full((charts, 2), -np.inf)
    np.minimum.at(low, chart, uv)
    np.maximum.at(high, chart, uv)
    return low, high
