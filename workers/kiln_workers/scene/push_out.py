"""Move texels' points that lie inside other geometry to the nearest free place on their tangent plane.

A texel's point is one sample of a small square of surface; where a pillar stands on that square, the point may be under
it and would see nothing but the pillar's inside (Rakhteenko 2018, "Baking artifact-free lightmaps"). From each point
eight rays run along the surface over half a texel. One that meets a back face first has left a solid: just past that
hit is a candidate, and the nearest candidate that sees no back face within half a texel itself is taken. A path to
a candidate crosses no front face, and a candidate behind a thin wall or floor sees that wall's back, so nothing leaks.
Points without a good candidate stay; the render task counts the back faces that they see and marks them invalid.
Double-sided materials have no back face.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from kiln_workers.render.backend import Device, select_variant
from kiln_workers.scene.geometry import Floats, Ints, face_normals
from kiln_workers.scene.model import Scene
from kiln_workers.scene.texel_map import TexelMap, TexelState

DIRECTIONS: Final = 8
REACH_TEXELS: Final = 0.5
BIAS_TEXELS: Final = 0.01
"""Distance kept from surfaces, in texels; at least `BIAS_EXTENT` of the scene's size, which float32 resolves."""
BIAS_EXTENT: Final = 2e-6


def push_out(scene: Scene, texels: TexelMap, device: Device = "auto") -> TexelMap:
    """The map with points that see back faces along the surface moved out, where there is a place to go."""
    row, column = np.nonzero(texels.state == TexelState.VALID)
    if not len(row):
        return texels
    position = texels.position[row, column].astype(np.float64)
    normal = texels.normal[row, column].astype(np.float64)
    size = texels.texel_size[row, column].astype(np.float64)
    moved, place = _free_places(_BackFaces(scene, device), position, normal, size)
    out = texels.position.copy()
    out[row[moved], column[moved]] = place
    return replace(texels, position=out)


def tangent_directions(normal: Floats) -> Floats:
    """Eight unit directions [N, 8, 3] across `normal` [N, 3], 45 degrees apart."""
    least = np.eye(3)[np.argmin(np.abs(normal), axis=1)]
    side = np.cross(normal, least)
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    other = np.cross(normal, side)
    angle = 2.0 * np.pi * np.arange(DIRECTIONS) / DIRECTIONS
    return np.asarray(np.cos(angle)[:, None] * side[:, None] + np.sin(angle)[:, None] * other[:, None])


def _free_places(tracer: "_BackFaces", position: Floats, normal: Floats, size: Floats) -> tuple[Ints, Floats]:
    """Which points have to move, and where to."""
    bias = np.maximum(BIAS_TEXELS * size, BIAS_EXTENT * tracer.extent)
    distance = _back_face_distances(tracer, position, normal, size, bias)  # [N, 8]
    inside = np.flatnonzero(np.isfinite(distance).any(axis=1))
    position, normal, size, bias = position[inside], normal[inside], size[inside], bias[inside]
    distance, directions = distance[inside], tangent_directions(normal)
    place = np.full((len(inside), 3), np.nan)
    order = np.argsort(distance, axis=1, kind="stable")
    for rank in range(DIRECTIONS):
        which = np.arange(len(inside))
        step = distance[which, order[:, rank]]
        open_ = np.flatnonzero(np.isnan(place[:, 0]) & np.isfinite(step))
        if not len(open_):
            break
        direction = directions[open_, order[open_, rank]]
        candidate = position[open_] + (step[open_] + bias[open_])[:, None] * direction
        seen = _back_face_distances(tracer, candidate, normal[open_], size[open_], bias[open_])
        free = ~np.isfinite(seen).any(axis=1)
        place[open_[free]] = candidate[free]
    found = ~np.isnan(place[:, 0])
    return inside[found], place[found]


def _back_face_distances(tracer: "_BackFaces", position: Floats, normal: Floats, size: Floats, bias: Floats) -> Floats:
    """Metres [N, 8] along the tangent directions to a back face that is the first hit within half a texel, else inf."""
    origin = position + bias[:, None] * normal
    directions = tangent_directions(normal)
    rays = directions.reshape(-1, 3)
    reach = np.repeat(REACH_TEXELS * size, DIRECTIONS)
    return tracer.distances(np.repeat(origin, DIRECTIONS, axis=0), rays, reach).reshape(-1, DIRECTIONS)


class _BackFaces:
    """Rays against the scene's bare triangles."""

    def __init__(self, scene: Scene, device: Device) -> None:
        select_variant(device)
        import mitsuba as mi  # after the variant is set, and not where no ray is traced

        self._mi: Any = mi
        offsets = np.cumsum([0] + [len(mesh.positions) for mesh in scene.meshes])
        positions = np.concatenate([mesh.positions for mesh in scene.meshes])
        faces = np.concatenate([mesh.faces + offset for mesh, offset in zip(scene.meshes, offsets, strict=False)])
        self._normals = face_normals(positions, faces)
        self._two_sided = np.repeat(
            [scene.materials[mesh.material].double_sided for mesh in scene.meshes],
            [len(mesh.faces) for mesh in scene.meshes],
        )
        self.extent = float(np.abs(positions).max())
        shape = mi.Mesh("scene", len(positions), len(faces))
        parameters = mi.traverse(shape)
        parameters["vertex_positions"] = positions.ravel()
        parameters["faces"] = faces.astype(np.uint32).ravel()
        parameters.update()
        self._scene = mi.load_dict({"type": "scene", "shape": shape})

    def distances(self, origin: Floats, direction: Floats, reach: Floats) -> Floats:
        """Distance [N] of the first hit if it is a back face within `reach` [N], else inf."""
        mi = self._mi
        ray = mi.Ray3f(
            o=mi.Point3f(*_columns(origin)),
            d=mi.Vector3f(*_columns(direction)),
            maxt=mi.Float(reach.astype(np.float32)),
            time=0.0,
            wavelengths=mi.Color0f(),
        )
        hit = self._scene.ray_intersect_preliminary(ray, coherent=False)
        valid = np.array(hit.is_valid())
        face = np.where(valid, np.array(hit.prim_index), 0).astype(np.int64)
        away = np.einsum("nd,nd->n", direction, self._normals[face]) > 0.0
        return np.where(valid & away & ~self._two_sided[face], np.array(hit.t), np.inf)


def _columns(vectors: Floats) -> Sequence[npt.NDArray[np.float32]]:
    return [np.ascontiguousarray(vectors[:, axis], dtype=np.float32) for axis in range(3)]
