"""Move texels' points that lie inside other geometry to the nearest free place on their tangent plane.

A texel's point is one sample of a small square of surface; where a pillar stands on that square, the point may be under
it and would see nothing but the pillar's inside (Rakhteenko 2018, "Baking artifact-free lightmaps"). From each point
eight rays run along the surface over half a texel. One that meets a back face first has left a solid: just past that
hit is a candidate, and the nearest candidate that sees no back face within half a texel itself is taken. A path to
a candidate crosses no front face, a candidate behind a thin wall or floor sees that wall's back, and a candidate lies
on the texel's own mesh, so nothing leaks.
Points without a good candidate stay; the render task marks those that lie inside something invalid. Only faces with one
side push: a double-sided one may as well be the wall of a room.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from kiln_workers.render.backend import Device, select_variant, watertight
from kiln_workers.scene.geometry import Floats, Ints, face_normals
from kiln_workers.scene.model import Scene
from kiln_workers.scene.texel_map import TexelMap, TexelState

Bools = npt.NDArray[np.bool_]

DIRECTIONS: Final = 8
REACH_TEXELS: Final = 0.5
BIAS_TEXELS: Final = 0.01
"""Distance kept from surfaces, in texels; at least a few steps of float32."""
SURFACE_TEXELS: Final = 0.25
"""A candidate lies no further than this above the mesh that its texel belongs to."""


def push_out(texels: TexelMap, triangles: "BareTriangles") -> TexelMap:
    """The map with points that see back faces along the surface moved out, where there is a place to go.

    `texels` may be some rows of the light map: no point depends on another. `triangles` are the whole scene's.
    """
    row, column = np.nonzero(texels.state == TexelState.VALID)
    points = _Points(
        texels.position[row, column].astype(np.float64),
        texels.normal[row, column].astype(np.float64),
        texels.texel_size[row, column].astype(np.float64),
        texels.mesh[row, column].astype(np.int64),
    )
    moved, place = _free_places(triangles, points)
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


@dataclass(frozen=True)
class _Points:
    """N texels' points."""

    position: Floats  # [N, 3]
    normal: Floats  # [N, 3]
    size: Floats  # [N] metres
    mesh: Ints  # [N]

    @property
    def bias(self) -> Floats:
        """Metres [N] kept from surfaces."""
        steps = np.spacing(np.abs(self.position).max(axis=1).astype(np.float32)).astype(np.float64)
        return np.asarray(np.maximum(BIAS_TEXELS * self.size, 8.0 * steps))

    def take(self, rows: Ints, position: Floats | None = None) -> "_Points":
        """Some of them, at other positions where these are given."""
        at = self.position[rows] if position is None else position
        return _Points(at, self.normal[rows], self.size[rows], self.mesh[rows])


def _free_places(triangles: "BareTriangles", points: _Points) -> tuple[Ints, Floats]:
    """Which points have to move, and where to."""
    distance = _back_face_distances(triangles, points)  # [N, 8]
    inside = np.flatnonzero(np.isfinite(distance).any(axis=1))
    distance, points = distance[inside], points.take(inside)
    directions = tangent_directions(points.normal)
    place = np.full((len(inside), 3), np.nan)
    order = np.argsort(distance, axis=1, kind="stable")
    for rank in range(DIRECTIONS):
        step = distance[np.arange(len(inside)), order[:, rank]]
        open_ = np.flatnonzero(np.isnan(place[:, 0]) & np.isfinite(step))
        if not len(open_):
            break
        direction = directions[open_, order[open_, rank]]
        candidate = points.position[open_] + (step[open_] + points.bias[open_])[:, None] * direction
        there = points.take(open_, candidate)
        free = _on_own_mesh(triangles, there) & ~np.isfinite(_back_face_distances(triangles, there)).any(axis=1)
        place[open_[free]] = candidate[free]
    found = ~np.isnan(place[:, 0])
    return inside[found], place[found]


def _on_own_mesh(triangles: "BareTriangles", points: _Points) -> Bools:
    """Whether the first surface below each point [N] is its own mesh, and near."""
    origin = points.position + points.bias[:, None] * points.normal
    below = triangles.nearest(origin, -points.normal, points.bias + SURFACE_TEXELS * points.size)
    return np.asarray(np.isfinite(below.distance) & (below.mesh == points.mesh))


def _back_face_distances(triangles: "BareTriangles", points: _Points) -> Floats:
    """Metres [N, 8] along the tangent directions to a back face that is the first hit within half a texel, else inf."""
    origin = np.repeat(points.position + points.bias[:, None] * points.normal, DIRECTIONS, axis=0)
    rays = tangent_directions(points.normal).reshape(-1, 3)
    met = triangles.nearest(origin, rays, np.repeat(REACH_TEXELS * points.size, DIRECTIONS))
    return np.where(met.back & ~met.double_sided, met.distance, np.inf).reshape(-1, DIRECTIONS)


@dataclass(frozen=True)
class Met:
    """What N rays met first."""

    distance: Floats  # [N] metres; inf where nothing
    face: Ints  # [N] in the list of all meshes' faces
    mesh: Ints  # [N]
    back: Bools  # [N] whether from behind
    double_sided: Bools  # [N]


class BareTriangles:
    """Rays against the scene's triangles, without materials."""

    def __init__(self, scene: Scene, device: Device) -> None:
        select_variant(device)
        import mitsuba as mi  # after the variant is set, and not where no ray is traced

        self._mi: Any = mi
        offsets = np.cumsum([0] + [len(mesh.positions) for mesh in scene.meshes])
        positions = np.concatenate([mesh.positions for mesh in scene.meshes])
        faces = np.concatenate([mesh.faces + offset for mesh, offset in zip(scene.meshes, offsets, strict=False)])
        self._normals = face_normals(positions, faces)
        self._mesh = np.repeat(np.arange(len(scene.meshes)), [len(mesh.faces) for mesh in scene.meshes])
        self._double_sided = np.array([scene.materials[mesh.material].double_sided for mesh in scene.meshes], bool)
        shape = mi.Mesh("scene", len(positions), len(faces))
        parameters = mi.traverse(shape)
        parameters["vertex_positions"] = positions.ravel()
        parameters["faces"] = faces.astype(np.uint32).ravel()
        parameters.update()
        self._scene = mi.load_dict({"type": "scene", "shape": shape, **watertight()})

    def nearest(self, origin: Floats, direction: Floats, reach: Floats) -> Met:
        """The first surfaces on rays [N, 3] within `reach` [N] metres."""
        mi = self._mi
        ray = mi.Ray3f(
            o=mi.Point3f(*_columns(origin)),
            d=mi.Vector3f(*_columns(direction)),
            maxt=mi.Float(reach.astype(np.float32)),
            time=0.0,
            wavelengths=mi.Color0f(),
        )
        hit = self._scene.ray_intersect_preliminary(ray, coherent=False)
        valid = np.array(hit.is_valid()).astype(bool)
        face = np.where(valid, np.array(hit.prim_index), 0).astype(np.int64)
        back = np.einsum("nd,nd->n", direction, self._normals[face]) > 0.0
        distance = np.where(valid, np.array(hit.t), np.inf).astype(np.float64)
        return Met(distance, face, self._mesh[face], valid & back, self._double_sided[self._mesh[face]])


def _columns(vectors: Floats) -> Sequence[npt.NDArray[np.float32]]:
    return [np.ascontiguousarray(vectors[:, axis], dtype=np.float32) for axis in range(3)]
