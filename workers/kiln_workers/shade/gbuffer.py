"""The G-buffer: what a deferred renderer's first pass would write, ray-traced by Mitsuba.

Mitsuba says which triangle a ray meets and where; attributes are interpolated here from the scene's own vertices, so
the light-map coordinates are those of the package's `scene.glb` and nothing has passed through the renderer's UVs.
"""

from dataclasses import dataclass, replace
from typing import Final

import numpy as np
import numpy.typing as npt

from kiln_schemas.camera import Camera
from kiln_workers.render.backend import Device, select_variant
from kiln_workers.render.jit import dr, mi
from kiln_workers.render.mitsuba_scene import mesh_number
from kiln_workers.render.paths import PathTracer, off_surface
from kiln_workers.scene import normal_maps
from kiln_workers.scene.model import Float32, Mesh, Scene
from kiln_workers.scene.origin import local_camera
from kiln_workers.scene.precision import face_clearance
from kiln_workers.shade import material
from kiln_workers.shade.camera import pixel_directions

Bools = npt.NDArray[np.bool_]
Ints = npt.NDArray[np.int64]
Floats = npt.NDArray[np.float64]

MAX_LAYERS: Final = 16
"""Surfaces behind each other that let a part of the light pass; what is behind the last is not seen."""


@dataclass(frozen=True)
class GBuffer:
    """The samples of a picture [H, W, S]; surface arrays hold the P of them that met a surface, in order."""

    directions: Float32  # [H, W, S, 3] unit, from the eye
    hit: Bools  # [H, W, S]
    position: Float32  # [P, 3] metres
    normal: Float32  # [P, 3] unit shading normal, on the side of the eye
    view: Float32  # [P, 3] unit, to the eye
    lightmap_uv: Float32  # [P, 2]
    base_color: Float32  # [P, 3]
    metallic: Float32  # [P]
    alpha: Float32  # [P] GGX width
    emission: Float32  # [P, 3] radiance towards the eye
    reflects: Bools  # [P] False on the back of a single-sided surface, which is black
    specular_escapes: Bools  # [P] whether the ray in the specular direction leaves the scene
    dielectric: Float32  # [P, 4] F0 of the dielectric, and its F90
    opacity: Float32  # [P] how much of the surface is there
    transmission: Float32  # [P] the part of the dielectric's base that lets light through
    through: Float32  # [P, 3] the part of the light from behind that the eye sees
    behind: "GBuffer | None" = None  # what is seen through the points of which `through` is not 0

    def __len__(self) -> int:
        return len(self.position)

    def pixel_alpha(self) -> Float32:
        """GGX width of each pixel [H, W]; NaN where its samples differ by more than 1 %, or some met no surface."""
        alpha = np.full(self.hit.shape, np.nan, np.float32)
        alpha[self.hit] = self.alpha
        low, high = alpha.min(axis=2), alpha.max(axis=2)
        with np.errstate(invalid="ignore"):
            return np.where(high <= 1.01 * low, 0.5 * (low + high), np.float32(np.nan)).astype(np.float32)


def render_gbuffer(
    scene: Scene, camera: Camera, width: int, height: int, grid: int = 2, device: Device = "auto"
) -> GBuffer:
    """The G-buffer of a scene whose meshes have light-map UVs, with `grid`^2 samples a pixel."""
    select_variant(device)
    camera = local_camera(camera, scene.origin)
    directions = pixel_directions(camera, width, height, grid).astype(np.float32)
    tracer = PathTracer(scene, max_depth=0)
    count = directions[..., 0].size
    origins = np.broadcast_to(np.asarray(camera.position, np.float32), (count, 3))
    return _layer(scene, tracer, directions, origins, np.ones(count, np.bool_), MAX_LAYERS)


def _layer(
    scene: Scene, tracer: PathTracer, directions: Float32, origins: Float32, active: Bools, layers: int
) -> GBuffer:
    """What the rays from `origins` [R, 3] meet first, and behind that, where it lets light pass, `layers` - 1 more."""
    flat = directions.reshape(-1, 3)
    point, towards = (np.ascontiguousarray(values.T.astype(np.float32)) for values in (origins, flat))
    ray = mi.Ray3f(mi.Point3f(point), mi.Vector3f(towards))
    # All that holds back any light is a surface here.
    si, _ = tracer.scattering(ray, mi.Float(1.0 - 1e-6), mi.Bool(active))
    onwards = tracer.beyond(si, ray.d)
    dr.eval(si, onwards)
    hit = np.array(si.is_valid()).astype(bool) & active
    shapes = tracer.scene.shapes()
    identifiers = np.array([int(dr.reinterpret_array(mi.UInt32, mi.ShapePtr(shape))[0]) for shape in shapes])
    table = np.zeros(identifiers.max() + 1, np.int64)
    table[identifiers] = [mesh_number(shape) for shape in shapes]
    mesh = table[np.array(dr.reinterpret_array(mi.UInt32, si.shape))[hit]]
    surface = _interpolated(scene, mesh, np.array(si.prim_index)[hit].astype(np.int64), np.array(si.p).T[hit])
    buffer = _gbuffer(scene, directions, hit, mesh, surface, tracer)
    passes = buffer.through.max(axis=1, initial=0.0) > 0.0
    if layers <= 1 or not passes.any():
        return buffer
    further = np.zeros_like(hit)
    further[hit] = passes
    behind = _layer(scene, tracer, directions, np.array(onwards).T, further, layers - 1)
    return replace(buffer, behind=behind)


@dataclass(frozen=True)
class _Vertices:
    """Interpolated attributes of P points."""

    position: Floats  # [P, 3]
    normal: Floats  # [P, 3] interpolated, unit
    face_normal: Floats  # [P, 3] unit
    lightmap_uv: Floats  # [P, 2]
    clearance: Floats  # [P] metres
    tint: Floats  # [P, 4] vertex colours, 1 where there are none
    uv: Floats  # [P, sets, 2] 0 where a mesh lacks a set
    tangent: Floats  # [P, 4] 0 where a mesh has none: then it has no normal map


def _interpolated(scene: Scene, mesh: Ints, face: Ints, position: Float32) -> _Vertices:
    """Attributes at points [P, 3] that lie on triangles `face` [P] of meshes `mesh` [P]."""
    count = len(mesh)
    sets = max((len(one.uv_sets) for one in scene.meshes), default=0)
    normal, face_normal, lightmap_uv = (np.zeros((count, size)) for size in (3, 3, 2))
    tint, uv, tangent = np.ones((count, 4)), np.zeros((count, sets, 2)), np.zeros((count, 4))
    out = _Vertices(position.astype(np.float64), normal, face_normal, lightmap_uv, np.zeros(count), tint, uv, tangent)
    for number in np.unique(mesh):
        at = mesh == number
        one = scene.meshes[number]
        corners = one.faces[face[at]]
        out.clearance[at] = face_clearance(one.positions, corners)
        weights, out.face_normal[at] = barycentric(one, corners, out.position[at])
        mean = np.einsum("pk,pkc->pc", weights, one.normals[corners].astype(np.float64))
        out.normal[at] = mean / np.maximum(np.linalg.norm(mean, axis=-1, keepdims=True), 1e-30)
        coordinates = [(out.uv[:, number], values) for number, values in enumerate(one.uv_sets)]
        attributes = (out.lightmap_uv, one.lightmap_uv), (out.tint, one.colors), (out.tangent, one.tangents)
        for target, values in (*coordinates, *attributes):
            if values is not None:
                target[at] = np.einsum("pk,pkc->pc", weights, values[corners].astype(np.float64))
    return out


def barycentric(mesh: Mesh, corners: npt.NDArray[np.int32], points: Floats) -> tuple[Floats, Floats]:
    """Barycentric weights [P, 3] of points [P, 3] on triangles of vertices [P, 3], and unit face normals [P, 3]."""
    a, b, c = (mesh.positions[corners[:, k]].astype(np.float64) for k in range(3))
    normal = np.cross(b - a, c - a)
    square = np.maximum(np.einsum("pc,pc->p", normal, normal), 1e-60)
    v = np.einsum("pc,pc->p", np.cross(points - a, c - a), normal) / square
    w = np.einsum("pc,pc->p", np.cross(b - a, points - a), normal) / square
    v, w = np.clip(v, 0.0, 1.0), np.clip(w, 0.0, 1.0)
    weights = np.stack([np.maximum(1.0 - v - w, 0.0), v, w], axis=-1)
    weights /= weights.sum(axis=-1, keepdims=True)
    return weights, normal / np.sqrt(square)[:, None]


def _gbuffer(
    scene: Scene, directions: Float32, hit: Bools, mesh: Ints, surface: _Vertices, tracer: PathTracer
) -> GBuffer:
    """Materials added, normals turned to the eye, the specular direction followed."""
    materials = np.array([one.material for one in scene.meshes], np.int64)[mesh]
    reflectance = material.evaluate(scene, materials, surface.uv, surface.tint)
    view = -directions.reshape(-1, 3)[hit]
    front = np.einsum("pc,pc->p", surface.face_normal, view) > 0.0
    seen = front | reflectance.double_sided
    side = np.where(front, 1.0, -1.0)[:, None]
    face_normal, normal = side * surface.face_normal, side * surface.normal
    # Where the interpolated normal faces away from the eye the geometric one is taken, as the path tracer does.
    away = np.einsum("pc,pc->p", normal, view) <= 0.0
    normal[away] = face_normal[away]
    unmapped = normal.copy()
    bumpy = surface.tangent.any(axis=1)
    mapped = normal_maps.placed(normal[bumpy], (side * surface.tangent)[bumpy], reflectance.normal[bumpy])
    normal[bumpy] = normal_maps.facing(mapped, view[bumpy].astype(np.float64))
    # As `kiln_gltf.eval_null_transmission`.
    f0, f90 = reflectance.dielectric[:, :3].max(axis=1), reflectance.dielectric[:, 3]
    cosine = np.clip(np.abs(np.einsum("pc,pc->p", unmapped, view)), 0.0, 1.0)
    kept = reflectance.transmission * (1.0 - reflectance.metallic) * (1.0 - f0 - (f90 - f0) * (1.0 - cosine) ** 5)
    opacity = reflectance.opacity[:, None]
    return GBuffer(
        directions=directions,
        hit=hit.reshape(directions.shape[:3]),
        position=surface.position.astype(np.float32),
        normal=normal.astype(np.float32),
        view=view,
        lightmap_uv=surface.lightmap_uv.astype(np.float32),
        base_color=reflectance.base_color,
        metallic=reflectance.metallic,
        alpha=np.square(reflectance.roughness),
        emission=np.where(seen[:, None], reflectance.emission, 0.0).astype(np.float32),
        reflects=seen,
        specular_escapes=_escapes(tracer, surface.position, surface.clearance, face_normal, normal, view),
        dielectric=reflectance.dielectric,
        opacity=reflectance.opacity,
        transmission=reflectance.transmission,
        through=(1.0 - opacity + opacity * kept[:, None] * reflectance.base_color).astype(np.float32),
    )


def _escapes(
    tracer: PathTracer, position: Floats, clearance: Floats, face_normal: Floats, normal: Floats, view: Float32
) -> Bools:
    """Whether rays from points [P, 3] in their specular directions leave the scene; never into the surface itself."""
    specular = 2.0 * np.einsum("pc,pc->p", normal, view)[:, None] * normal - view
    p, n, d = (np.ascontiguousarray(values.T.astype(np.float32)) for values in (position, face_normal, specular))
    direction = mi.Vector3f(d)
    ray = mi.Ray3f(
        off_surface(mi.Point3f(p), mi.Normal3f(n), direction, mi.Float(clearance.astype(np.float32))), direction
    )
    above = dr.dot(mi.Normal3f(n), direction) > 0.0
    return np.array(above & ~tracer.blocked(ray, above)).astype(bool)
