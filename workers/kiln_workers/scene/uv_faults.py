"""What keeps a scene's own light-map UVs from being used.

A set is usable if it lies in [0, 1], every face has an area in it, and no two faces overlap. Overlap is tested on the
faces' interiors, not on shared texels: on a grid four times finer than the light map, a sample deep inside two faces
is overlap, so edges that charts or neighbours share are not. Overlap of up to one texel in all passes, as exporters
round.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from kiln_workers.scene.geometry import Floats, face_areas
from kiln_workers.scene.limits import MAX_COVERAGE
from kiln_workers.scene.model import Mesh
from kiln_workers.scene.raster import interior_samples

UV_TOLERANCE: Final = 1e-4
OVERSAMPLING: Final = 4
SAMPLES: Final = (256, 4096)
"""Bounds of the overlap test's grid side."""
OVERLAP_TEXELS: Final = 1.0
FLAT_SHARE: Final = 1e-3
"""Part of a mesh's area that may have no area in the light map."""


@dataclass(frozen=True)
class Fault:
    """Why a mesh's light-map UV is not usable."""

    mesh: str
    reason: str


def find_faults(meshes: Sequence[Mesh], resolution: int) -> list[Fault]:
    """What keeps the scene's own light-map UVs from being used, at most one fault a mesh."""
    faults = [fault for mesh in meshes if (fault := _own_fault(mesh)) is not None]
    if faults:
        return faults
    return _overlaps(meshes, resolution)


def _own_fault(mesh: Mesh) -> Fault | None:
    uv = mesh.lightmap_uv
    if uv is None:
        return Fault(mesh.name, "is missing")
    outside = ((uv < -UV_TOLERANCE) | (uv > 1.0 + UV_TOLERANCE)).any(axis=1)
    if outside.any():
        vertex = int(np.argmax(outside))
        return Fault(mesh.name, f"leaves [0, 1] at vertex {vertex} ({uv[vertex, 0]:.4g}, {uv[vertex, 1]:.4g})")
    area = face_areas(mesh.positions, mesh.faces)
    flat = uv_areas(mesh) < 1e-12
    if area[flat].sum() > FLAT_SHARE * area.sum():
        return Fault(mesh.name, f"has {int(flat.sum())} faces without area")
    return None


def _overlaps(meshes: Sequence[Mesh], resolution: int) -> list[Fault]:
    areas = [float(uv_areas(mesh).sum()) for mesh in meshes]
    if sum(areas) > MAX_COVERAGE:
        most = meshes[int(np.argmax(areas))]
        return [Fault(most.name, f"overlaps: all meshes' together cover the light map {sum(areas):.0f} times over")]
    size = int(np.clip(OVERSAMPLING * resolution, *SAMPLES))
    corners = np.concatenate([_uv_corners(mesh) for mesh in meshes]) * size
    mesh_of = np.repeat(np.arange(len(meshes)), [len(mesh.faces) for mesh in meshes])
    owner = np.full(size * size, -1, dtype=np.int64)
    shared: dict[tuple[int, int], int] = {}
    for face, sample in interior_samples(corners, size, margin=0.1):
        # Within a batch, all but the first face at a sample overlap it; then compare with earlier batches.
        order = np.argsort(sample, kind="stable")
        face, sample = face[order], sample[order]
        repeated = np.concatenate([[False], sample[1:] == sample[:-1]])
        taken = owner[sample] >= 0
        previous = np.where(taken, owner[sample], np.concatenate([face[:1], face[:-1]]))
        clash = repeated | taken
        pairs, counts = np.unique(mesh_of[previous[clash]] * len(meshes) + mesh_of[face[clash]], return_counts=True)
        for pair, count in zip(pairs.tolist(), counts.tolist(), strict=True):
            a, b = sorted(divmod(pair, len(meshes)))
            shared[a, b] = shared.get((a, b), 0) + count
        owner[sample[~clash]] = face[~clash]
    texels = {key: count * (resolution / size) ** 2 for key, count in shared.items()}
    if sum(texels.values()) <= OVERLAP_TEXELS:
        return []
    faults: dict[int, Fault] = {}
    for (a, b), area in sorted(texels.items(), key=lambda item: -item[1]):
        other = "itself" if a == b else f"mesh '{meshes[a].name}'"
        faults.setdefault(b, Fault(meshes[b].name, f"overlaps {other} over {area:.3g} texels"))
    return list(faults.values())


def _uv_corners(mesh: Mesh) -> Floats:
    assert mesh.lightmap_uv is not None
    return mesh.lightmap_uv.astype(np.float64)[mesh.faces]


def uv_areas(mesh: Mesh) -> Floats:
    """Areas [F] of the faces in the light map, whose own area is 1."""
    a, b, c = np.moveaxis(_uv_corners(mesh), 1, 0)
    return np.asarray(0.5 * np.abs((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]))
