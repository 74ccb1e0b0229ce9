"""From the light-map UVs to the texel map: conservative rasterisation of all charts (light-field paper, section 4).

A texel that a chart's triangle touches gets the point of that chart closest to the texel's centre, so bilinear
interpolation on the surface never needs a texel without a point. Where several triangles touch one texel, one
that contains the centre wins, else the nearest. `alpha` is the material's roughness at that point, squared, at least
0.002 (Filament's bound for perceptual roughness, 0.045, squared): narrower lobes are mirrors to every later stage. The
shading normal is the interpolated one, or the mean of the normal map's over the texel (`texel_surface`).

Terminator of smooth normals: paths start from the point that Hanika 2021 ("Hacking the Shadow Terminator", Ray Tracing
Gems II, chapter 4) gives: the flat triangle's point is lifted to the interpolation of its projections on the vertices'
tangent planes, where those lie above it. It follows the surface that the normals pretend, so facets do not shadow each
other. Limited to half a texel, and to half of the way to whatever lies there; flat-shaded and concave faces are not
moved.

A point never lies on an edge of its triangle: where the edge is a room's corner, the point would lie in the next wall's
plane, rays towards that wall would start on it, and what is beyond the wall would be seen. So it keeps `INSET_TEXELS`
from the edges, and lies as far above the triangle as float32 needs to tell that it does.
"""

from functools import cached_property
from typing import Final

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from kiln_schemas.errors import InputError
from kiln_workers.render.backend import Device
from kiln_workers.scene.bands import bands
from kiln_workers.scene.container import Array
from kiln_workers.scene.geometry import Floats, Ints, face_areas, face_normals
from kiln_workers.scene.model import Mesh, Scene
from kiln_workers.scene.precision import face_clearance
from kiln_workers.scene.push_out import BareTriangles, push_out
from kiln_workers.scene.raster import kept_inside, touched_squares
from kiln_workers.scene.texel_map import TexelMap, TexelState, joined
from kiln_workers.scene.texel_surface import CopiesOfMaps, TexelSurface

MIN_COSINE: Final = 0.05
"""A shading normal is bent towards the geometric one until their cosine is at least this."""
INSET_TEXELS: Final = 0.02
"""Distance of a texel's point from the edges of its triangle, in texels; at least `INSET_CLEARANCES` clearances."""
INSET_CLEARANCES: Final = 4.0
NARROW_HANDICAP: Final = 0.2
"""Texels that a triangle too narrow for its points' inset has to be nearer than others to be taken."""


def build_texel_map(scene: Scene, resolution: int, device: Device = "auto") -> TexelMap:
    """The texel map of a scene whose meshes have light-map UVs, points pushed out of other geometry."""
    maker = TexelMaker(scene, resolution, device)
    return joined(maker.pushed(rows) for rows in bands(maker.shape))


def rasterise_texels(scene: Scene, resolution: int, device: Device = "auto") -> TexelMap:
    """The texel map before points are pushed out of other geometry."""
    maker = TexelMaker(scene, resolution, device)
    return joined(maker.rasterised(rows) for rows in bands(maker.shape))


class TexelMaker:
    """Makes the texel map of a scene some rows at a time; no texel depends on another."""

    def __init__(self, scene: Scene, resolution: int, device: Device = "auto") -> None:
        self.shape: Final = (resolution, resolution)
        self._scene, self._device = scene, device
        self._faces = faces = _AllFaces(scene)
        self._flat = faces.lightmap_uv * resolution
        self._sizes, self._heights = faces.texel_size(resolution), faces.heights()
        self._clearance = face_clearance(faces.positions, faces.corners)
        self._inset = np.maximum(INSET_TEXELS * self._sizes, INSET_CLEARANCES * self._clearance)
        narrow = 1.0 / (1.0 / np.maximum(self._heights, 1e-300)).sum(axis=1) < 2.0 * self._inset
        self._handicap = np.where(narrow, NARROW_HANDICAP, 0.0)
        self._charts = faces.charts()
        self._copies = CopiesOfMaps()

    @cached_property
    def triangles(self) -> BareTriangles:
        """The scene for rays; made when the first ray is traced."""
        return BareTriangles(self._scene, self._device)

    def pushed(self, rows: slice) -> TexelMap:
        """These rows of the texel map, points pushed out of other geometry."""
        return self.push_out(self.rasterised(rows))

    def push_out(self, texels: TexelMap) -> TexelMap:
        """Rows of the map with their points pushed out of other geometry."""
        return push_out(texels, self.triangles) if texels.covered else texels

    def rasterised(self, rows: slice) -> TexelMap:
        """These rows of the texel map before that."""
        faces, width = self._faces, self.shape[1]
        touched = touched_squares(self._flat, width, self.shape[0], self._handicap, rows)
        corner = faces.corners[touched.face]  # [S, 3] rows of the vertex arrays
        weight = kept_inside(touched.barycentric, self._heights[touched.face], self._inset[touched.face])

        normal = faces.normal[touched.face]
        flat = np.einsum("sc,scd->sd", weight, faces.positions[corner])
        mesh = faces.mesh[touched.face]
        surface = TexelSurface(self._scene, touched.face, weight, self._flat, self._copies)
        shading = surface.shading_normals()
        size = self._sizes[touched.face]
        lift = terminator_offset(flat, weight, faces.positions[corner], faces.normals[corner])
        position = flat + self._clearance[touched.face, None] * normal
        position += self._free_lift(position, lift, 0.5 * size)

        grid = (rows.stop - rows.start, width)

        def spread(values: Floats | Ints, dtype: type, empty: int = 0) -> Array:
            out = np.full((grid[0] * grid[1], *values.shape[1:]), empty, dtype=dtype)
            out[touched.square - rows.start * width] = values
            return out.reshape(*grid, *values.shape[1:])

        return TexelMap(
            state=spread(np.full(len(mesh), TexelState.VALID), np.uint8),
            position=spread(position, np.float32),
            normal=spread(normal, np.float32),
            shading_normal=spread(bent_normals(shading, normal), np.float32),
            alpha=spread(surface.alpha(), np.float32),
            texel_size=spread(size, np.float32),
            mesh=spread(mesh, np.int32, -1),
            chart=spread(self._charts[touched.face], np.int32, -1),
        )

    def _free_lift(self, position: Floats, lift: Floats, longest: Floats) -> Floats:
        """Offsets [S, 3] cut to `longest` [S] metres, and to half of the way to the first surface they would meet."""
        length = np.linalg.norm(lift, axis=1)
        moved = np.flatnonzero(length > 0.0)
        out = np.zeros_like(lift)
        if len(moved):
            direction, reach = lift[moved] / length[moved, None], np.minimum(length[moved], longest[moved])
            met = self.triangles.nearest(position[moved], direction, 2.0 * reach).distance
            out[moved] = direction * np.minimum(reach, 0.5 * met)[:, None]
        return out


def terminator_offset(position: Floats, weight: Floats, corners: Floats, normals: Floats) -> Floats:
    """Hanika's offset [S, 3] of points with barycentrics `weight` [S, 3] in triangles [S, 3, 3] of unit `normals`.

    Hanika moves the point by sum_i w_i (t_i - min(0, t_i . n_i) n_i) with t_i = P - v_i; as sum_i w_i t_i = 0, that is
    - sum_i w_i min(0, t_i . n_i) n_i.
    """
    below = np.minimum(0.0, np.einsum("scd,scd->sc", position[:, None] - corners, normals))
    return np.asarray(-np.einsum("sc,scd->sd", weight * below, normals))


def bent_normals(shading: Floats, geometric: Floats) -> Floats:
    """Unit shading normals [S, 3] kept in the hemisphere of unit `geometric`; those that oppose it are replaced."""
    length = np.linalg.norm(shading, axis=1, keepdims=True)
    unit = np.divide(shading, length, out=geometric.copy(), where=length > 1e-12)
    cosine = np.einsum("sd,sd->s", unit, geometric)[:, None]
    lifted = unit + np.maximum(MIN_COSINE - cosine, 0.0) * geometric
    lifted = np.where(cosine < -0.5, geometric, lifted)
    return np.asarray(lifted / np.linalg.norm(lifted, axis=1, keepdims=True))


class _AllFaces:
    """The faces of all meshes in one list, in float64."""

    def __init__(self, scene: Scene) -> None:
        offsets = np.cumsum([0] + [len(mesh.positions) for mesh in scene.meshes])
        self.positions = np.concatenate([mesh.positions for mesh in scene.meshes]).astype(np.float64)
        self.normals = np.concatenate([mesh.normals for mesh in scene.meshes]).astype(np.float64)
        self.corners = np.concatenate(
            [mesh.faces.astype(np.int64) + offset for mesh, offset in zip(scene.meshes, offsets, strict=False)]
        )  # [F, 3]
        self.mesh = np.repeat(np.arange(len(scene.meshes)), [len(mesh.faces) for mesh in scene.meshes])
        self._flat_uv = np.concatenate([_lightmap_uv(mesh) for mesh in scene.meshes])
        self.lightmap_uv = self._flat_uv[self.corners].astype(np.float64)  # [F, 3, 2]
        self.normal = face_normals(self.positions, self.corners)

    def texel_size(self, resolution: int) -> Floats:
        """Metres along a texel's side for each face: the root of its area over its texels."""
        area = face_areas(self.positions, self.corners)
        a, b, c = (self.lightmap_uv[:, corner] * resolution for corner in range(3))
        texels = 0.5 * np.abs((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0])
        # A face of less than a hundredth of a texel is as good as one texel wide.
        return np.asarray(np.sqrt(area / np.where(texels > 0.01, texels, 1.0)))

    def heights(self) -> Floats:
        """Metres [F, 3] from each corner to the opposite edge."""
        points = self.positions[self.corners]
        edges = np.linalg.norm(points[:, [2, 0, 1]] - points[:, [1, 2, 0]], axis=2)
        return np.asarray(2.0 * face_areas(self.positions, self.corners)[:, None] / np.maximum(edges, 1e-300))

    def charts(self) -> Ints:
        """Chart number of each face: connected over edges whose ends agree in mesh, place and light-map UV."""
        place = np.concatenate([self.positions.astype(np.float32), self._flat_uv], axis=1) + np.float32(0.0)
        key = np.ascontiguousarray(place).view(np.int32).reshape(len(place), -1)
        owner = np.zeros(len(place), dtype=np.int32)
        owner[self.corners] = self.mesh[:, None]
        _, vertex = np.unique(np.column_stack([owner, key]), axis=0, return_inverse=True)
        corners = vertex.reshape(-1)[self.corners]
        edges = np.sort(corners[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
        _, edge = np.unique(edges, axis=0, return_inverse=True)
        face = np.repeat(np.arange(len(corners)), 3)
        # Faces and edges are the two sides of a bipartite graph.
        count = len(corners) + int(edge.max()) + 1
        graph = coo_array((np.ones(len(face), np.int8), (face, edge.reshape(-1) + len(corners))), shape=(count, count))
        return np.asarray(connected_components(graph, directed=False)[1][: len(corners)], dtype=np.int64)


def _lightmap_uv(mesh: Mesh) -> np.ndarray[tuple[int, ...], np.dtype[np.float32]]:
    if mesh.lightmap_uv is None:
        raise InputError("has no light-map UV", where=f"mesh '{mesh.name}'", remedy="Assign one first.")
    return mesh.lightmap_uv
