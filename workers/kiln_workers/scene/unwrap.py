"""Cut meshes into flat charts with xatlas, in a process of its own.

xatlas 0.0.11 runs its charts on a thread pool that now and then (about one call in a hundred, measured) takes the whole
process down. So the call is made by `python -m kiln_workers.scene.unwrap`, pinned to one core, where the pool
has no other thread and no crash was seen, and a process that dies is started again. Only the charts are used; packing
is ours (`packing`), as xatlas keeps twice the padding and wastes small atlases.
"""

import os
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from kiln_schemas.errors import InputError, InternalError
from kiln_workers.scene.container import Array, pack, unpack
from kiln_workers.scene.geometry import Floats, Ints, face_areas
from kiln_workers.scene.model import Mesh

KIND: Final = "unwrap"
ATTEMPTS: Final = 5
CHART_TEXELS: Final = 1 << 18
"""xatlas rounds charts to its own texels; with so many for the whole scene the rounding is small."""


@dataclass(frozen=True)
class Unwrapped:
    """A mesh cut along its charts' borders."""

    vertex: Ints  # [V'] the original vertex of each new one
    faces: Ints  # [F', 3]
    uv: Floats  # [V', 2] metres, true to scale within each chart
    chart: Ints  # [V'] number of the chart, 0 ... n-1 within the mesh; -1 where it could not be flattened


def cut_into_charts(meshes: Sequence[Mesh]) -> list[Unwrapped]:
    """The charts of every mesh; InputError names a mesh that cannot be flattened."""
    arrays: dict[str, Array] = {}
    for i, mesh in enumerate(meshes):
        arrays |= {f"p{i}": mesh.positions, f"n{i}": mesh.normals, f"f{i}": mesh.faces}
    _, out = unpack(KIND, _in_child(pack(KIND, {"meshes": len(meshes)}, arrays)))
    parts = [
        Unwrapped(
            out[f"v{i}"].astype(np.int64),
            out[f"f{i}"].astype(np.int64),
            out[f"u{i}"].astype(np.float64),
            out[f"c{i}"].astype(np.int64),
        )
        for i in range(len(meshes))
    ]
    for mesh, part in zip(meshes, parts, strict=True):
        if len(part.faces) != len(mesh.faces) or (part.chart[part.faces] < 0).any():
            raise InputError(
                "has faces that cannot be flattened",
                where=f"mesh '{mesh.name}'",
                remedy="Give the scene a light-map UV (TEXCOORD_1) of its own.",
            )
    return parts


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
    import xatlas  # here, so that the parent never loads it

    body, arrays = unpack(KIND, request)
    count = int(body["meshes"])
    area = sum(float(face_areas(arrays[f"p{i}"], arrays[f"f{i}"]).sum()) for i in range(count))
    scale = float(np.sqrt(CHART_TEXELS / area))
    atlas = xatlas.Atlas()
    for i in range(count):
        atlas.add_mesh(arrays[f"p{i}"], arrays[f"f{i}"].astype(np.uint32), arrays[f"n{i}"])
    options = xatlas.PackOptions()
    options.padding, options.texels_per_unit = 0, scale
    options.bilinear = options.bruteForce = options.create_image = False
    atlas.generate(xatlas.ChartOptions(), options)
    out: dict[str, Array] = {}
    for i in range(count):
        vertex, faces, uv = atlas[i]
        pages, charts = (values.astype(np.int64) for values in atlas.get_mesh_vertex_assignment(i))
        flat = pages < 2**31
        number = np.full(len(charts), -1, dtype=np.int64)
        number[flat] = np.unique(charts[flat], return_inverse=True)[1].reshape(-1)
        metres = uv.astype(np.float64) * [atlas.width, atlas.height] / scale
        out |= {f"v{i}": vertex.astype(np.int64), f"f{i}": faces.astype(np.int64), f"u{i}": metres, f"c{i}": number}
    return pack(KIND, {}, out)


if __name__ == "__main__":
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
    sys.stdout.buffer.write(_charts(sys.stdin.buffer.read()))
