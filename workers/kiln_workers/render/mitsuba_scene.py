"""The parsed scene as a Mitsuba scene: what the path tracer traces, and what a reference render shows.

Materials become `kiln_gltf` (see `gltf_bsdf`), glTF's own surface. The back of a single-sided material reflects
nothing: it is the inside of a solid. The environment's rows are doubled, because Mitsuba puts the first row at the pole
and `scene.model` half a row below it; on the doubled grid both agree at every row. A double-sided emitter becomes two
sheets back to back.
"""

from dataclasses import replace
from typing import Any, Final

import numpy as np

from kiln_workers.render.backend import select_variant, watertight
from kiln_workers.render.jit import dr, mi
from kiln_workers.render.materials import MaterialBuilder, vertex_attributes
from kiln_workers.scene.environment import MITSUBA_TURN
from kiln_workers.scene.geometry import Floats
from kiln_workers.scene.model import Environment, Float32, LightKind, Material, Mesh, PunctualLight, Scene
from kiln_workers.scene.precision import face_clearance

SHEET_GAP: Final = 2.0
"""Distance between the two sheets of a double-sided emitter, in clearances of its faces."""


def to_mitsuba(scene: Scene) -> Any:
    """The `mi.Scene` of a parsed scene (variant: the one selected, else `select_variant()`'s choice)."""
    if mi.variant() is None:
        select_variant()
    powers = _EmitterPowers(scene)
    parts: dict[str, Any] = {"type": "scene", **watertight()}
    materials = MaterialBuilder(scene)
    for number, mesh in enumerate(scene.meshes):
        if not len(mesh.faces):
            continue
        material = scene.materials[mesh.material]
        bsdf, weight = materials.bsdf(mesh), powers.mesh_weight(mesh)
        parts[f"mesh_{number}"] = _mesh(mesh, material, bsdf, materials.emitter(mesh, weight))
        if max(material.emission) > 0.0 and material.double_sided:
            back = back_sheet(mesh, SHEET_GAP * face_clearance(mesh.positions, mesh.faces))
            parts[f"mesh_{number}_back"] = _mesh(
                back, material, bsdf, materials.emitter(back, weight), turned_over=True
            )
    for number, light in enumerate(scene.lights):
        parts[f"light_{number}"] = _light(light, powers.light_weight(light))
    if scene.environment is not None:
        parts["environment"] = _environment(scene.environment, powers.environment_weight())
    return mi.load_dict(parts)


def mesh_number(shape: Any) -> int:
    """Index in `Scene.meshes` of a shape of `to_mitsuba`'s scene."""
    return int(shape.id().split("_")[1])


def scene_bounds(scene: Scene) -> tuple[Float32, Float32]:
    """Lower and upper corner [3] of all meshes; both zero in a scene without vertices."""
    corners = [mesh.positions for mesh in scene.meshes if len(mesh.positions)]
    if not corners:
        return np.zeros(3, np.float32), np.zeros(3, np.float32)
    low = np.min([points.min(axis=0) for points in corners], axis=0)
    high = np.max([points.max(axis=0) for points in corners], axis=0)
    return low.astype(np.float32), high.astype(np.float32)


def scene_diagonal(scene: Scene) -> float:
    """Length of the bounding box's diagonal in metres, at least 1e-6."""
    low, high = scene_bounds(scene)
    return max(float(np.linalg.norm(high.astype(np.float64) - low)), 1e-6)


def back_sheet(mesh: Mesh, gap: Floats) -> Mesh:
    """The mesh's faces turned over and moved `gap` [F] metres behind it, each on vertices of its own."""
    corners = mesh.positions[mesh.faces].astype(np.float64)  # [F, 3, 3]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal /= np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-30)
    order = mesh.faces[:, ::-1].reshape(-1)
    turned = mesh.with_vertices(order, np.arange(len(order), dtype=np.int32).reshape(-1, 3))
    return replace(
        turned,
        name=f"{mesh.name} (back)",
        positions=(corners - (gap[:, None] * normal)[:, None])[:, ::-1].reshape(-1, 3).astype(np.float32),
        normals=-turned.normals,
        # So that mapped normals are the front's, turned over.
        tangents=None if turned.tangents is None else -turned.tangents,
    )


class _EmitterPowers:
    """Probabilities by which next-event estimation picks emitters: half by radiant power, half uniform.

    Power alone would starve a dim lamp that is close; uniform alone wastes half the samples on small panels.
    """

    def __init__(self, scene: Scene) -> None:
        self.scene = scene
        self.radius = 0.5 * scene_diagonal(scene)
        powers = [self._mesh(mesh) for mesh in scene.meshes if max(scene.materials[mesh.material].emission) > 0.0]
        powers += [self._light(light) for light in scene.lights]
        if scene.environment is not None:
            powers.append(self._environment())
        self.mean = sum(powers) / max(len(powers), 1)

    def mesh_weight(self, mesh: Mesh) -> float:
        return self._weight(self._mesh(mesh))

    def light_weight(self, light: PunctualLight) -> float:
        return self._weight(self._light(light))

    def environment_weight(self) -> float:
        return self._weight(self._environment())

    def _weight(self, power: float) -> float:
        return 0.5 + 0.5 * power / self.mean if self.mean > 0.0 else 1.0

    def _mesh(self, mesh: Mesh) -> float:
        corners = mesh.positions[mesh.faces].astype(np.float64)
        cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        area = 0.5 * float(np.linalg.norm(cross, axis=-1).sum())
        return float(np.mean(self.scene.materials[mesh.material].emission)) * area * np.pi

    def _light(self, light: PunctualLight) -> float:
        solid_angle = {
            LightKind.POINT: 4.0 * np.pi,
            LightKind.SPOT: 2.0 * np.pi * (1.0 - np.cos(light.outer_cone)),
            LightKind.DIRECTIONAL: np.pi * self.radius**2,
        }
        return float(np.mean(light.intensity) * solid_angle[light.kind])

    def _environment(self) -> float:
        environment = self.scene.environment
        if environment is None:
            return 0.0
        rows = np.sin(np.pi * (np.arange(len(environment.pixels)) + 0.5) / len(environment.pixels))
        mean = float((environment.pixels.mean(axis=(1, 2)) * rows).sum() / rows.sum())
        return environment.scale * mean * np.pi * 4.0 * np.pi * self.radius**2


def _mesh(mesh: Mesh, material: Material, bsdf: Any, emitter: Any | None, turned_over: bool = False) -> Any:
    properties = mi.Properties()
    properties["bsdf"] = bsdf
    if emitter is not None:
        properties["emitter"] = emitter
    # Emitters are flat: Mitsuba converts areas to solid angles with the interpolated normal, which would be biased.
    # Their surfaces get these normals as an attribute (`rounded_emitter`).
    smooth = emitter is None
    out = mi.Mesh(
        mesh.name, len(mesh.positions), len(mesh.faces), properties, smooth, has_vertex_texcoords=mesh.uv is not None
    )
    parameters = mi.traverse(out)
    parameters["vertex_positions"] = mi.Float(np.ravel(mesh.positions).astype(np.float32))
    parameters["faces"] = mi.UInt32(np.ravel(mesh.faces).astype(np.uint32))
    if smooth:
        parameters["vertex_normals"] = mi.Float(np.ravel(mesh.normals).astype(np.float32))
    if mesh.uv is not None:
        parameters["vertex_texcoords"] = mi.Float(np.ravel(mesh.uv).astype(np.float32))
    parameters.update()
    for name, values in vertex_attributes(mesh, material, turned_over).items():
        out.add_attribute(name, values.shape[1], np.ravel(values).astype(np.float32))
    dr.eval(parameters["vertex_positions"])
    return out


def _light(light: PunctualLight, weight: float) -> dict[str, Any]:
    intensity = {"type": "rgb", "value": list(light.intensity)}
    if light.kind is LightKind.DIRECTIONAL:
        travel = list(light.direction)
        return {"type": "directional", "direction": travel, "irradiance": intensity, "sampling_weight": weight}
    if light.kind is LightKind.POINT:
        return {"type": "point", "position": list(light.position), "intensity": intensity, "sampling_weight": weight}
    return {
        "type": "kiln_spot",
        **{channel: float(value) for channel, value in zip(("red", "green", "blue"), light.intensity, strict=True)},
        "position": mi.ScalarPoint3f(*light.position),
        "direction": mi.ScalarVector3f(*light.direction),
        "inner_cone": float(light.inner_cone),
        "outer_cone": float(light.outer_cone),
        "sampling_weight": weight,
    }


def _environment(environment: Environment, weight: float) -> dict[str, Any]:
    turn = mi.ScalarTransform4f().rotate([0.0, 1.0, 0.0], environment.rotation_deg - MITSUBA_TURN)
    return {
        "type": "envmap",
        "bitmap": mi.Bitmap(doubled_rows(environment.pixels)),
        "scale": environment.scale,
        "to_world": turn,
        "sampling_weight": weight,
    }


def doubled_rows(pixels: Float32) -> Float32:
    """Rows at v = k / 2H, k = 0 ... 2H [2H + 1, W, 3]: odd ones are the image's own, even ones the mean around them."""
    padded = np.concatenate([pixels[:1], pixels, pixels[-1:]]).astype(np.float32)
    out = np.empty((2 * len(pixels) + 1, *pixels.shape[1:]), np.float32)
    out[1::2] = pixels
    out[0::2] = 0.5 * (padded[:-1] + padded[1:])
    return out
