"""Cut meshes into flat charts with uvunwrap, in a process of its own that may die without taking the task along.

Each mesh is unwrapped by itself, moved to the origin and brought to one size, so that neither its scale nor its place
matters (float32 would lose a marble at 10 km, and absolute thresholds would drop the faces of a screw). Its faces are
given as a surface (`manifold`). Faces that the unwrapper leaves out or turns into a line, needles mostly, become charts
of their own, each flattened as it is: no mesh is refused for them. docs/design/atlas.md has the unwrappers that were
compared. Only the charts are used; packing is ours (`packing`).
"""

import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from kiln_schemas.errors import InternalError
from kiln_workers.scene.container import Array, pack, unpack
from kiln_workers.scene.geometry import Floats, Ints, face_areas, smooth_normals
from kiln_workers.scene.manifold import surface_corners
from kiln_workers.scene.model import Mesh

KIND: Final = "unwrap"
ATTEMPTS: Final = 3
SIZE: Final = 1024.0
"""Units along the longest side of a mesh when it is unwrapped; a texel of the unwrapper is one of them."""
MAX_CHART_ANGLE: Final = 80.0
"""Degrees between a face and its chart's mean normal, at most."""
PARTED: Final = 0.02
"""Units by which vertices of one place are moved apart, far less than the unwrapper's texel."""
AREA_RATIO: Final = (0.2, 5.0)
"""Bounds of a face's area in its chart over its own area; faces beyond are flattened by themselves."""


@dataclass(frozen=True)
class Unwrapped:
    """A mesh cut along its charts' borders.

    Vertex v is `vertex[v]` of the original mesh, or the point between it and `other[v]` at `share[v]` of the way: where
    a long chart is cut into pieces, its faces are cut as well.
    """

    vertex: Ints  # [V']
    faces: Ints  # [F', 3]
    uv: Floats  # [V', 2] metres, true to scale within each chart
    chart: Ints  # [V'] number of the chart, 0 ... n-1 within the mesh
    other: Ints  # [V']
    share: Floats  # [V']
    loose: int = 0
    """Faces that the unwrapper left out."""
    rigid: bool = False
    """Whether its charts may only be scaled and moved when they are packed, not turned."""
    whole: bool = False
    """Whether its charts may not be cut."""

    @property
    def charts(self) -> int:
        return int(self.chart.max()) + 1


def cut_into_charts(meshes: Sequence[Mesh]) -> list[Unwrapped]:
    """The charts of every mesh."""
    arrays: dict[str, Array] = {}
    for i, mesh in enumerate(meshes):
        arrays |= {f"p{i}": mesh.positions, f"f{i}": mesh.faces}
    _, out = unpack(KIND, _in_child(pack(KIND, {"meshes": len(meshes)}, arrays)))
    return [_cut(mesh, out[f"u{i}"], out[f"c{i}"].astype(np.int64)) for i, mesh in enumerate(meshes)]


def _cut(mesh: Mesh, corner_uv: Floats, face_chart: Ints) -> Unwrapped:
    """The mesh with one vertex for each of its vertices and charts; uv [F, 3, 2] in metres, chart -1: none."""
    area = face_areas(mesh.positions, mesh.faces)
    a, b, c = np.moveaxis(corner_uv, 1, 0)
    flat = 0.5 * np.abs((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0])
    loose = (face_chart < 0) | (flat < AREA_RATIO[0] * area) | (flat > AREA_RATIO[1] * area)
    corner_uv = np.where(loose[:, None, None], flattened(mesh.positions, mesh.faces), corner_uv)
    face_chart = np.where(loose, face_chart.max(initial=0) + 1 + np.arange(len(loose)), face_chart)
    chart = np.repeat(np.unique(face_chart, return_inverse=True)[1].reshape(-1), 3)
    corners = np.column_stack([mesh.faces.reshape(-1), chart, corner_uv.reshape(-1, 2).view(np.int64)])
    _, first, number = np.unique(corners, axis=0, return_index=True, return_inverse=True)
    vertex = mesh.faces.reshape(-1)[first].astype(np.int64)
    return Unwrapped(
        vertex=vertex,
        faces=number.reshape(-1, 3).astype(np.int64),
        uv=corner_uv.reshape(-1, 2)[first],
        chart=chart[first],
        other=vertex,
        share=np.zeros(len(vertex)),
        loose=int(loose.sum()),
    )


def flattened(positions: Array, faces: Array) -> Floats:
    """Each face [F, 3] laid flat by itself: uv [F, 3, 2] in metres, the first edge along u."""
    a, b, c = (positions.astype(np.float64)[faces[:, corner]] for corner in range(3))
    length = np.linalg.norm(b - a, axis=1)
    along = (b - a) / np.maximum(length, 1e-300)[:, None]
    u = ((c - a) * along).sum(axis=1)
    v = np.linalg.norm(c - a - u[:, None] * along, axis=1)
    zero = np.zeros_like(u)
    return np.stack([np.stack([zero, zero], 1), np.stack([length, zero], 1), np.stack([u, v], 1)], axis=1)


def _in_child(request: bytes) -> bytes:
    for _ in range(ATTEMPTS):
        done = subprocess.run(
            [sys.executable, "-m", "kiln_workers.scene.unwrap"], input=request, capture_output=True, check=False
        )
        if done.returncode == 0:
            return done.stdout
        if done.returncode > 0:
            break
    tail = done.stderr.decode(errors="replace").strip().splitlines()[-1:]
    raise InternalError(f"the unwrapper ended with status {done.returncode} {' '.join(tail)}", where="lightmap.uv")


def _charts(request: bytes) -> bytes:
    """In the child: the charts of the meshes of `request`."""
    body, arrays = unpack(KIND, request)
    out: dict[str, Array] = {}
    for i in range(int(body["meshes"])):
        out[f"u{i}"], out[f"c{i}"] = _mesh_charts(arrays[f"p{i}"].astype(np.float64), arrays[f"f{i}"].astype(np.int64))
    return pack(KIND, {}, out)


def _mesh_charts(positions: Floats, faces: Ints) -> tuple[Floats, Ints]:
    """uv [F, 3, 2] in metres, and the chart of each face [F], -1 where the unwrapper gave it none."""
    import uvunwrap  # here, so that the parent never loads it

    low = positions[faces].min(axis=(0, 1))
    metres = float(np.ptp(positions[faces].reshape(-1, 3), axis=0).max()) / SIZE
    corner = surface_corners(positions, faces)
    mesh = uvunwrap.Mesh(_parted((positions[faces] - low) / metres, corner), corner.astype(np.uint32))
    options: dict[str, Any] = {"page_size": None, "texels_per_unit": 1.0, "padding": 0, "packing": "fast"}
    try:
        atlas = uvunwrap.generate([mesh], max_chart_angle=MAX_CHART_ANGLE, **options)
    except uvunwrap.UnwrapError:
        return np.zeros((len(faces), 3, 2)), np.full(len(faces), -1, dtype=np.int64)
    found = atlas.meshes[0]
    scale = np.array([atlas.width, atlas.height]) * (metres / atlas.texels_per_unit)
    uv = np.array(found.corner_uvs, dtype=np.float64).reshape(-1, 3, 2) * scale
    chart = np.array(found.chart, dtype=np.int64)[np.array(found.indices, dtype=np.int64).reshape(-1, 3)]
    return uv, np.asarray(chart.min(axis=1))


def _parted(corners: Floats, number: Ints) -> npt.NDArray[np.float32]:
    """Positions [N, 3] of the surface's vertices, whose numbers are at the corners [F, 3] of faces [F, 3, 3].

    uvunwrap welds vertices of one place. Those that are several, as where two sheets lie back to back, are moved apart
    along their normals.
    """
    surface = np.zeros((int(number.max()) + 1, 3))
    surface[number] = corners
    _, place, count = np.unique(surface, axis=0, return_inverse=True, return_counts=True)
    several = count[place.reshape(-1)] > 1
    surface[several] += PARTED * smooth_normals(surface, number)[several]
    return surface.astype(np.float32)


if __name__ == "__main__":
    sys.stdout.buffer.write(_charts(sys.stdin.buffer.read()))
