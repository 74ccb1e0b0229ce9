"""The light map of a scene: its size, and UVs for every mesh, kept, packed by object or unwrapped.

- Where the sets of all meshes together are one atlas (`uv_faults`), they are kept as they are.
- Where each mesh has a set without a fault but they overlap each other, as Unity, Blender and Bakery make them, each
  set stays as it is and gets a scale and an offset of its own: the meshes are packed as wholes, by their area.
- All other meshes are unwrapped (`unwrap`).

Packing makes one atlas for the whole scene with one scale (metres a texel): the finest for which all fits with
`padding` empty texels between charts (`packing`). `lightmap.resolution=auto` takes as many texels as
`lightmap.density` asks for, and as give most of the surface charts of more than a texel or two.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from kiln_schemas.errors import InputError
from kiln_schemas.settings import AUTO, LARGEST_SIDE, LightmapSettings, UvPolicy
from kiln_schemas.tasks import Placement
from kiln_workers.scene.charts import gather, points, straightened
from kiln_workers.scene.geometry import Floats, face_areas
from kiln_workers.scene.model import Mesh, Scene
from kiln_workers.scene.packing import Layout, fewest_charts, lay_out, lay_out_at, side_for
from kiln_workers.scene.unwrap import Unwrapped, cut_into_charts
from kiln_workers.scene.uv_faults import find_faults, uv_areas

STEP: Final = 8
"""A chosen resolution is a multiple of it."""
FILL: Final = 0.6
"""Part of an atlas that packed charts fill, about: a first guess."""
GROWTH: Final = 1.2
CLEAR_TEXELS: Final = 4.0
"""A chart of fewer texels along its longer side shows little more than one light."""
CLEAR_SHARE: Final = 0.75
"""Part of the surface whose charts `auto` wants larger than that."""
OWN_RESOLUTION: Final = 128
"""Resolution at which a mesh's own set is tested, as long as that of the atlas is not known."""


@dataclass(frozen=True)
class Lightmap:
    """A scene with a light-map UV on every mesh, and its light map's size."""

    scene: Scene
    resolution: int
    placements: tuple[Placement, ...] = ()
    """Scale and offset of each mesh whose own set was packed as a whole."""


def assign_lightmap_uv(scene: Scene, settings: LightmapSettings) -> Scene:
    """The scene with a light-map UV on every mesh (`make_lightmap`)."""
    return make_lightmap(scene, settings).scene


def make_lightmap(scene: Scene, settings: LightmapSettings, *, may_cut: bool = True) -> Lightmap:
    """A light map for the scene; notes say per mesh what was done and why.

    `may_cut`: whether faces of charts that are longer than the light map may be split. InputError where the charts
    find no room, or `settings.uv` is `keep` and the scene's own sets cannot be kept.
    """
    if settings.uv is UvPolicy.UNWRAP:
        return _packed(scene, settings, {mesh.name: "" for mesh in scene.meshes}, may_cut)
    side = _side_of_kept(scene.meshes, settings)
    faults = find_faults(scene.meshes, side)
    if not faults:
        notes = [f"Mesh '{mesh.name}': its own light-map UV is kept." for mesh in scene.meshes]
        kept = tuple(replace(mesh, lightmap_uv=_clipped(mesh)) for mesh in scene.meshes)
        if settings.resolution == AUTO:
            notes.append(f"Light map: {side} x {side} texels ({_wish(settings)}).")
        return Lightmap(replace(scene, meshes=kept, notes=(*scene.notes, *notes)), side)
    if settings.uv is UvPolicy.KEEP:
        raise InputError(
            f"its light-map UV (TEXCOORD_1) {faults[0].reason}",
            where=f"mesh '{faults[0].mesh}'",
            remedy="Mend the set, or let it be unwrapped (lightmap.uv=auto).",
        )
    reasons = {
        fault.mesh: f"its own light-map UV {fault.reason}"
        for mesh in scene.meshes
        for fault in find_faults([mesh], OWN_RESOLUTION)
    }
    return _packed(scene, settings, reasons, may_cut)


def _packed(scene: Scene, settings: LightmapSettings, reasons: dict[str, str], may_cut: bool) -> Lightmap:
    """All meshes in one atlas: those in `reasons` unwrapped, the others as wholes with their own sets."""
    unwrapped = iter(cut_into_charts([mesh for mesh in scene.meshes if mesh.name in reasons]))
    parts = [
        replace(straightened(next(unwrapped)), whole=not may_cut) if mesh.name in reasons else _as_a_whole(mesh)
        for mesh in scene.meshes
    ]
    layout, why = _sized(scene.meshes, parts, settings)
    meshes, notes, placements = [], list(scene.notes), []
    for mesh, whole, part, texels in zip(scene.meshes, parts, layout.parts, layout.uv, strict=True):
        meshes.append(_split(mesh, part, np.clip(texels / layout.side, 0.0, 1.0)))
        if mesh.name in reasons:
            notes.append(_unwrap_note(mesh, whole, part, reasons[mesh.name]))
        else:
            placements.append(_placement(mesh, texels / layout.side))
            notes.append(f"Mesh '{mesh.name}': its own light-map UV is packed as it is, with a scale and an offset.")
    notes.append(f"Light map: {layout.side} x {layout.side} texels{why}. A texel is {1.0 / layout.scale:.3g} m wide.")
    if layout.merged:
        notes.append(
            f"Light map: {layout.merged} of {sum(part.charts for part in layout.parts)} charts are smaller than a texel"
            " and share one with a neighbour that faces the same way."
        )
    return Lightmap(replace(scene, meshes=tuple(meshes), notes=tuple(notes)), layout.side, tuple(placements))


def _unwrap_note(mesh: Mesh, whole: Unwrapped, part: Unwrapped, reason: str) -> str:
    charts = f"{whole.charts} chart{'s' if whole.charts > 1 else ''}"
    cuts = f", long ones cut into {part.charts} pieces" if part.charts > whole.charts else ""
    loose = (
        f"; {whole.loose} faces have a chart each, as they could not be flattened with others" if whole.loose else ""
    )
    return f"Mesh '{mesh.name}': unwrapped into {charts}{cuts} ({reason or 'as asked'}){loose}."


def _sized(meshes: Sequence[Mesh], parts: Sequence[Unwrapped], settings: LightmapSettings) -> tuple[Layout, str]:
    """The layout at the resolution that is asked for, or at a chosen one and why it was chosen."""
    if settings.resolution != AUTO:
        layout = lay_out(meshes, parts, settings.resolution, settings.padding)
        if layout is None:
            count = fewest_charts(meshes, parts)
            raise _too_small(settings.resolution, count, settings.padding, "Raise lightmap.resolution")
        return layout, ""
    pieces = gather(meshes, parts)
    order = np.argsort(pieces.extent.max(axis=1), kind="stable")
    covered = np.cumsum(pieces.area[order])
    small = int(np.searchsorted(covered, (1.0 - CLEAR_SHARE) * covered[-1]))
    clear = CLEAR_TEXELS / float(pieces.extent[order[min(small, len(order) - 1)]].max())
    scale = max(settings.density, clear)
    side = _rounded(scale * math.sqrt(covered[-1] / FILL), settings)
    while side < settings.most and lay_out_at(meshes, parts, side, settings.padding, scale) is None:
        side = min(_rounded(side * GROWTH, settings), settings.most)
    layout = lay_out(meshes, parts, side, settings.padding)
    why = _wish(settings, f"; {len(order)} charts want {clear:.3g}" if clear > settings.density else "")
    if layout is None:
        count = fewest_charts(meshes, parts)
        side = side_for(count, settings.padding)
        why = f"more than lightmap.most, {settings.most}, as {count} charts need them"
        if side <= LARGEST_SIDE:
            side = min(STEP * math.ceil(side / STEP), LARGEST_SIDE)
            layout = lay_out(meshes, parts, side, settings.padding)
        if layout is None:
            raise _too_small(LARGEST_SIDE, count, settings.padding, "Join objects")
    return layout, f" ({why})"


def _wish(settings: LightmapSettings, more: str = "") -> str:
    bounds = f"between {settings.least} and {settings.most}"
    return f"lightmap.resolution=auto, {bounds}: {settings.density:g} texels a metre are aimed at{more}"


def _rounded(side: float, settings: LightmapSettings) -> int:
    """The next multiple of STEP, within the bounds of `auto`."""
    within = min(max(side, settings.least), settings.most)
    return min(max(STEP * math.ceil(within / STEP), settings.least), settings.most)


def _side_of_kept(meshes: Sequence[Mesh], settings: LightmapSettings) -> int:
    """The resolution with the scene's own sets: at `auto` texels of the wanted size, all faces taken together."""
    if settings.resolution != AUTO:
        return settings.resolution
    area = sum(float(face_areas(mesh.positions, mesh.faces).sum()) for mesh in meshes)
    flat = sum(float(uv_areas(mesh).sum()) for mesh in meshes if mesh.lightmap_uv is not None)
    return _rounded(settings.density * math.sqrt(area / flat) if flat > 0.0 else settings.least, settings)


def _too_small(side: int, charts: int, padding: int, remedy: str) -> InputError:
    need = side_for(charts, padding)
    return InputError(
        f"{charts} charts with {padding} texels between them need {need} x {need} texels, the light map has"
        f" {side} x {side}",
        where="lightmap.resolution",
        remedy=f"{remedy}, set lightmap.resolution=auto, or give the scene a light-map UV with fewer charts.",
    )


def _as_a_whole(mesh: Mesh) -> Unwrapped:
    """The mesh with its own set as one chart that is neither turned nor cut, true to scale on the whole."""
    assert mesh.lightmap_uv is not None
    uv = _clipped(mesh).astype(np.float64)
    uv = uv - uv.min(axis=0)
    area = float(face_areas(mesh.positions, mesh.faces).sum())
    vertex = np.arange(len(mesh.positions))
    return Unwrapped(
        vertex=vertex,
        faces=mesh.faces.astype(np.int64),
        uv=uv * math.sqrt(area / float(uv_areas(mesh).sum())),
        chart=np.zeros(len(vertex), dtype=np.int64),
        other=vertex,
        share=np.zeros(len(vertex)),
        rigid=True,
        whole=True,
    )


def _placement(mesh: Mesh, uv: Floats) -> Placement:
    """From the mesh's own set to the light map: uv' = uv * scale + offset."""
    assert mesh.lightmap_uv is not None
    own = _clipped(mesh).astype(np.float64)
    axis = int(np.argmax(np.ptp(own, axis=0)))
    scale = float(np.ptp(uv, axis=0)[axis] / np.ptp(own, axis=0)[axis])
    offset = uv.min(axis=0) - scale * own.min(axis=0)
    return Placement(mesh=mesh.name, scale=scale, offset=(float(offset[0]), float(offset[1])))


def _split(mesh: Mesh, part: Unwrapped, lightmap_uv: Floats) -> Mesh:
    """The mesh with the part's vertices: every array of the old vertices is taken over, interpolated on cuts."""
    count = len(mesh.positions)
    values = {item.name: getattr(mesh, item.name) for item in fields(mesh)}
    taken: dict[str, Any] = {
        name: points(value, part).astype(value.dtype)
        for name, value in values.items()
        if name != "faces" and isinstance(value, np.ndarray) and len(value) == count
    }
    length = np.linalg.norm(taken["normals"], axis=1, keepdims=True)
    between = (part.share > 0.0)[:, None] & (length > 1e-12)
    taken["normals"] = np.where(between, taken["normals"] / np.maximum(length, 1e-12), taken["normals"])
    taken["more_uv"] = tuple(points(values, part).astype(values.dtype) for values in mesh.more_uv)
    taken |= {"faces": part.faces.astype(np.int32), "lightmap_uv": lightmap_uv.astype(np.float32)}
    return replace(mesh, **taken)


def _clipped(mesh: Mesh) -> npt.NDArray[np.float32]:
    assert mesh.lightmap_uv is not None
    return np.clip(mesh.lightmap_uv, 0.0, 1.0)
