"""Light-map UVs for every mesh: keep the scene's own set where it is a unique one, else unwrap all.

A set is usable if every mesh has it, it lies in [0, 1], every face has an area in it, and no two faces overlap. Overlap
is tested on the faces' interiors, not on shared texels: on a grid four times finer than the light map, a sample
deep inside two faces is overlap, so edges that charts or neighbours share are not. Overlap of up to one texel in all
passes, as exporters round. Instances that share one set overlap by this test, so a scene with them is unwrapped.

Unwrapping makes one atlas for the whole scene with one scale (metres a texel): xatlas cuts the charts (`unwrap`), and
`packing` finds the finest scale for which all fit with `padding` empty texels between them.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
import numpy.typing as npt

from kiln_schemas.errors import InputError
from kiln_schemas.settings import LightmapSettings, UvPolicy
from kiln_workers.scene.geometry import Floats, Ints, face_areas
from kiln_workers.scene.limits import MAX_COVERAGE
from kiln_workers.scene.model import Mesh, Scene
from kiln_workers.scene.packing import Chart, bounding_turn, pack_charts
from kiln_workers.scene.raster import interior_samples
from kiln_workers.scene.unwrap import Unwrapped, cut_into_charts

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


def assign_lightmap_uv(scene: Scene, settings: LightmapSettings) -> Scene:
    """The scene with a light-map UV on every mesh; notes say per mesh what was done and why."""
    if settings.uv is UvPolicy.UNWRAP:
        return _unwrapped(scene, settings, {})
    faults = find_faults(scene.meshes, settings.resolution)
    if not faults:
        notes = tuple(f"Mesh '{mesh.name}': its own light-map UV is kept." for mesh in scene.meshes)
        kept = tuple(replace(mesh, lightmap_uv=_clipped(mesh)) for mesh in scene.meshes)
        return replace(scene, meshes=kept, notes=scene.notes + notes)
    if settings.uv is UvPolicy.KEEP:
        raise InputError(
            f"its light-map UV (TEXCOORD_1) {faults[0].reason}",
            where=f"mesh '{faults[0].mesh}'",
            remedy="Mend the set, or let it be unwrapped (lightmap.uv=auto).",
        )
    return _unwrapped(scene, settings, {fault.mesh: fault.reason for fault in faults})


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
    flat = _uv_areas(mesh) < 1e-12
    if area[flat].sum() > FLAT_SHARE * area.sum():
        return Fault(mesh.name, f"has {int(flat.sum())} faces without area")
    return None


def _overlaps(meshes: Sequence[Mesh], resolution: int) -> list[Fault]:
    areas = [float(_uv_areas(mesh).sum()) for mesh in meshes]
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


def _unwrapped(scene: Scene, settings: LightmapSettings, reasons: dict[str, str]) -> Scene:
    parts = cut_into_charts(scene.meshes)
    counts = [int(part.chart.max()) + 1 for part in parts]
    room = (settings.resolution + settings.padding) ** 2 // (1 + settings.padding) ** 2
    if sum(counts) > room:
        raise _too_many_charts(sum(counts), settings)
    flat = [piece for part in parts for piece in _flat_pieces(part)]
    packed = pack_charts([piece.chart for piece in flat], settings.resolution, settings.padding)
    if packed is None:
        raise _too_many_charts(len(flat), settings)
    scale, places = packed
    meshes, notes, done = [], [], 0
    for mesh, part, count in zip(scene.meshes, parts, counts, strict=True):
        uv = np.zeros((len(part.vertex), 2))
        for piece, place in zip(flat[done : done + count], places[done : done + count], strict=True):
            uv[piece.vertices] = (piece.uv[:, ::-1] if place.turned else piece.uv) * scale + place.origin
        done += count
        meshes.append(_split(mesh, part, np.clip(uv / settings.resolution, 0.0, 1.0)))
        default = "another mesh has to be" if reasons else "as asked"
        why = f"its own light-map UV {reasons[mesh.name]}" if mesh.name in reasons else default
        notes.append(f"Mesh '{mesh.name}': unwrapped into {count} chart{'s' if count > 1 else ''} ({why}).")
    notes.append(f"Light map: a texel is {1.0 / scale:.3g} m wide.")
    return replace(scene, meshes=tuple(meshes), notes=(*scene.notes, *notes))


def _too_many_charts(count: int, settings: LightmapSettings) -> InputError:
    return InputError(
        f"{count} charts with {settings.padding} texels between them do not fit into"
        f" {settings.resolution} x {settings.resolution} texels",
        where="lightmap.resolution",
        remedy="Raise lightmap.resolution, or give the scene a light-map UV with fewer charts.",
    )


@dataclass(frozen=True)
class _Piece:
    """A chart with the vertices of the cut mesh that it holds."""

    vertices: Ints
    uv: Floats  # [len(vertices), 2] metres, lower bounds at 0, turned to the smallest bounding box
    chart: Chart


def _flat_pieces(part: Unwrapped) -> list[_Piece]:
    face_chart = part.chart[part.faces[:, 0]]
    pieces = []
    for number in range(int(part.chart.max()) + 1):
        vertices = np.flatnonzero(part.chart == number)
        uv = part.uv[vertices] @ bounding_turn(part.uv[vertices]).T
        uv -= uv.min(axis=0)
        local = np.searchsorted(vertices, part.faces[face_chart == number])
        pieces.append(_Piece(vertices, uv, Chart(uv[local])))
    return pieces


def _split(mesh: Mesh, part: Unwrapped, lightmap_uv: Floats) -> Mesh:
    return replace(
        mesh,
        positions=mesh.positions[part.vertex],
        normals=mesh.normals[part.vertex],
        faces=part.faces.astype(np.int32),
        uv=None if mesh.uv is None else mesh.uv[part.vertex],
        lightmap_uv=lightmap_uv.astype(np.float32),
    )


def _clipped(mesh: Mesh) -> npt.NDArray[np.float32]:
    assert mesh.lightmap_uv is not None
    return np.clip(mesh.lightmap_uv, 0.0, 1.0)


def _uv_corners(mesh: Mesh) -> Floats:
    assert mesh.lightmap_uv is not None
    return mesh.lightmap_uv.astype(np.float64)[mesh.faces]


def _uv_areas(mesh: Mesh) -> Floats:
    a, b, c = np.moveaxis(_uv_corners(mesh), 1, 0)
    return np.asarray(0.5 * np.abs((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]))
