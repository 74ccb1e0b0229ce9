"""The G-buffer: what a deferred renderer's first pass would write, ray-traced by Mitsuba.

Mitsuba says which triangle a ray meets and where; attributes are interpolated here from the scene's own vertices, so
the light-map coordinates are those of the package's `scene.glb` and nothing has passed through the renderer's UVs.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from kiln_schemas.camera import Camera
from kiln_workers.render.backend import Device, select_variant
from kiln_workers.render.jit import dr, mi
from kiln_workers.render.mitsuba_scene import mesh_number
from kiln_workers.render.paths import PathTracer, off_surface
from kiln_workers.scene.model import Float32, Mesh, Scene
from kiln_workers.scene.origin import local_camera
from kiln_workers.scene.precision import face_clearance
from kiln_workers.shade import material
from kiln_workers.shade.camera import pixel_directions

Bools = npt.NDArray[np.bool_]
Ints = npt.NDArray[np.int64]
Floats = npt.NDArray[np.float64]


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
    flat = directions.reshape(-1, 3)
    tracer = PathTracer(scene, max_depth=0)
    ray = mi.Ray3f(mi.Point3f(*camera.position), mi.Vector3f(np.ascontiguousarray(flat.T)))
    si = tracer.closest(ray, mi.Bool(True))
    dr.eval(si)
    hit = np.array(si.is_valid()).astype(bool)
    shapes = tracer.scene.shapes()
    identifiers = np.array([int(dr.reinterpret_array(mi.UInt32, mi.ShapePtr(shape))[0]) for shape in shapes])
    table = np.zeros(identifiers.max() + 1, np.int64)
    table[identifiers] = [mesh_number(shape) for shape in shapes]
    mesh = table[np.array(dr.reinterpret_array(mi.UInt32, si.shape))[hit]]
    surface = _interpolated(scene, mesh, np.array(si.prim_index)[hit].astype(np.int64), np.array(si.p).T[hit])
    return _gbuffer(scene, directions, hit, mesh, surface, tracer)


@dataclass(frozen=True)
class _Vertices:
    """Interpolated attributes of P points."""

    position: Floats  # [P, 3]
    normal: Floats  # [P, 3] interpolated, unit
    face_normal: Floats  # [P, 3] unit
    uv: Floats  # [P, 2]
    lightmap_uv: Floats  # [P, 2]
    clearance: Floats  # [P] metres


def _interpolated(scene: Scene, mesh: Ints, face: Ints, position: Float32) -> _Vertices:
    """Attributes at points [P, 3] that lie on triangles `face` [P] of meshes `mesh` [P]."""
    count = len(mesh)
    normal, face_normal, uv, lightmap_uv = (np.zeros((count, size)) for size in (3, 3, 2, 2))
    out = _Vertices(position.astype(np.float64), normal, face_normal, uv, lightmap_uv, np.zeros(count))
    for number in np.unique(mesh):
        at = mesh == number
        one = scene.meshes[number]
        corners = one.faces[face[at]]
        out.clearance[at] = face_clearance(one.positions, corners)
        weights, out.face_normal[at] = barycentric(one, corners, out.position[at])
        mean = np.einsum("pk,pkc->pc", weights, one.normals[corners].astype(np.float64))
        out.normal[at] = mean / np.maximum(np.linalg.norm(mean, axis=-1, keepdims=True), 1e-30)
        for target, values in ((out.uv, one.uv), (out.lightmap_uv, one.lightmap_uv)):
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
    reflectance = material.evaluate(scene, materials, surface.uv)
    view = -directions.reshape(-1, 3)[hit]
    front = np.einsum("pc,pc->p", surface.face_normal, view) > 0.0
    seen = front | reflectance.double_sided
    side = np.where(front, 1.0, -1.0)[:, None]
    face_normal, normal = side * surface.face_normal, side * surface.normal
    # Where the interpolated normal faces away from the eye the geometric one is taken, as the path tracer does.
    away = np.einsum("pc,pc->p", normal, view) <= 0.0
    normal[away] = face_normal[away]
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
