"""Light-map UVs for every mesh: keep the scene's own set where it is a unique one, else unwrap all with xatlas.

A set is usable if every mesh has it, it lies in [0, 1], every face has an area in it, and no two faces overlap. Overlap is
tested on the faces' interiors, not on shared texels: on a grid four times finer than the light map, a sample
deep inside two faces is overlap, so edges that charts or neighbours share are not. Overlap of up to one texel in all
passes, as exporters round. Instances that share one set overlap by this test, so a scene with them is unwrapped.

Unwrapping makes one atlas page for the whole scene with one scale (metres a texel), the finest for which all charts fit
with `padding` empty texels between them; it is found by bisection and is the same on every run.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
import numpy.typing as npt
import xatlas

from kiln_schemas.errors import InputError
from kiln_schemas.settings import LightmapSettings, UvPolicy
from kiln_workers.scene.geometry import Floats, face_areas
from kiln_workers.scene.model import Mesh, Scene
from kiln_workers.scene.raster import interior_samples

UV_TOLERANCE: Final = 1e-4
OVERSAMPLING: Final = 4
SAMPLES: Final = (512, 4096)
"""Bounds of the overlap test's grid side."""
OVERLAP_TEXELS: Final = 1.0
FLAT_SHARE: Final = 1e-3
"""Part of a mesh's area that may have no area in the light map."""
FIT_STEPS: Final = 7
SMALLEST_SHARE: Final = 0.02
"""The scale is given up below this part of what a full atlas would have."""
BRUTE_FORCE_TEXELS: Final = 256
"""Up to this resolution charts are packed by trying every place."""


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
        pairs, counts = np.unique(
            np.stack([mesh_of[previous[clash]], mesh_of[face[clash]]], axis=1), axis=0, return_counts=True
        )
        for (a, b), count in zip(pairs, counts, strict=True):
            key = (int(min(a, b)), int(max(a, b)))
            shared[key] = shared.get(key, 0) + int(count)
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
    atlas, scale = _fitted_atlas(scene.meshes, settings)
    meshes, notes = [], []
    for index, mesh in enumerate(scene.meshes):
        vertex, faces, uv = atlas[index]
        pages, charts = atlas.get_mesh_vertex_assignment(index)
        if (pages.astype(np.int64)[faces] != 0).any():
            raise InputError(
                "has faces that the unwrapper could not flatten",
                where=f"mesh '{mesh.name}'",
                remedy="Give the mesh a light-map UV (TEXCOORD_1) of its own.",
            )
        meshes.append(
            replace(
                mesh,
                positions=mesh.positions[vertex],
                normals=mesh.normals[vertex],
                faces=faces.astype(np.int32),
                uv=None if mesh.uv is None else mesh.uv[vertex],
                lightmap_uv=_page_uv(uv, atlas, settings.resolution),
            )
        )
        why = reasons.get(mesh.name, "asked for" if not reasons else "another mesh has to be")
        why = f"its set {why}" if mesh.name in reasons else why
        notes.append(f"Mesh '{mesh.name}': unwrapped into {len(np.unique(charts))} charts ({why}).")
    notes.append(f"Light map: one texel is {1.0 / scale:.3g} m wide.")
    return replace(scene, meshes=tuple(meshes), notes=(*scene.notes, *notes))


def _fitted_atlas(meshes: Sequence[Mesh], settings: LightmapSettings) -> tuple[xatlas.Atlas, float]:
    """The atlas of one page at the finest scale found, and that scale in texels a metre."""
    side = settings.resolution
    area = sum(float(face_areas(mesh.positions, mesh.faces).sum()) for mesh in meshes)
    full = side / np.sqrt(area)
    low, high = 0.0, full
    best: xatlas.Atlas | None = None
    scale, best_scale = 0.75 * full, 0.0
    for _ in range(FIT_STEPS):
        atlas = _packed(meshes, settings, scale)
        if atlas.atlas_count == 1:
            best, best_scale, low = atlas, scale, scale
        else:
            high = scale
        scale = 0.5 * (low + high) if low > 0.0 else 0.6 * scale
    while best is None and scale > SMALLEST_SHARE * full:
        atlas = _packed(meshes, settings, scale)
        best, best_scale = (atlas, scale) if atlas.atlas_count == 1 else (None, 0.0)
        scale *= 0.6
    if best is None:
        raise InputError(
            f"{atlas.chart_count} charts with {settings.padding} texels between them do not fit into"
            f" {side} x {side} texels",
            where="lightmap.resolution",
            remedy="Raise lightmap.resolution, or give the scene a light-map UV with fewer charts.",
        )
    return best, best_scale


def _packed(meshes: Sequence[Mesh], settings: LightmapSettings, texels_per_metre: float) -> xatlas.Atlas:
    atlas = xatlas.Atlas()
    for mesh in meshes:
        atlas.add_mesh(mesh.positions, mesh.faces.astype(np.uint32), mesh.normals)
    options = xatlas.PackOptions()
    options.resolution = settings.resolution
    options.padding = settings.padding
    options.texels_per_unit = texels_per_metre
    options.bilinear = True
    options.bruteForce = settings.resolution <= BRUTE_FORCE_TEXELS
    options.create_image = False
    atlas.generate(xatlas.ChartOptions(), options)
    return atlas


def _page_uv(uv: npt.NDArray[np.float32], atlas: xatlas.Atlas, resolution: int) -> npt.NDArray[np.float32]:
    """xatlas divides by the page's own size, which may differ from the light map's."""
    size = np.array([atlas.width, atlas.height], dtype=np.float64)
    return np.clip(uv * size / resolution, 0.0, 1.0).astype(np.float32)


def _clipped(mesh: Mesh) -> npt.NDArray[np.float32]:
    assert mesh.lightmap_uv is not None
    return np.clip(mesh.lightmap_uv, 0.0, 1.0)


def _uv_corners(mesh: Mesh) -> Floats:
    assert mesh.lightmap_uv is not None
    return mesh.lightmap_uv.astype(np.float64)[mesh.faces]


def _uv_areas(mesh: Mesh) -> Floats:
    a, b, c = np.moveaxis(_uv_corners(mesh), 1, 0)
    return np.asarray(0.5 * np.abs((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]))
