"""Lamps that see only the backs of one-sided faces: a room turned inside out, which bakes black, is to be told of.

The back of a one-sided face reflects nothing (glTF 2.0, 3.9.6: it is not rendered). From each lamp rays go out in all
directions that it shines in; where all that they meet are backs, its light is lost.
"""

from collections.abc import Iterator, Sequence
from typing import Final

import numpy as np

from kiln_workers.render.backend import Device
from kiln_workers.scene.geometry import Floats, face_areas, face_normals
from kiln_workers.scene.model import LightKind, Mesh, Scene
from kiln_workers.scene.precision import face_clearance
from kiln_workers.scene.push_out import BareTriangles

RAYS: Final = 512
"""Of each lamp."""

MOST_LAMPS: Final = 100
"""That are looked at; a scene turned inside out shows it at its first lamps."""


def lamp_notes(scene: Scene, device: Device = "auto") -> tuple[str, ...]:
    """A sentence if lamps (emissive meshes, point and spot lights) shine on nothing but backs."""
    lost, seen = [], 0
    triangles: BareTriangles | None = None
    for name, origin, direction in _rays(scene):
        triangles = triangles or BareTriangles(scene, device)
        met = triangles.nearest(origin, direction, np.full(len(origin), 1e30))
        hits = np.isfinite(met.distance)
        backs = hits & met.back & ~met.double_sided
        seen += 1
        if hits.any() and (backs == hits).all():
            lost.append(name)
    if not lost:
        return ()
    others = scene.environment is not None or any(light.kind is LightKind.DIRECTIONAL for light in scene.lights)
    begin = "Nothing in the scene is lit: all" if len(lost) == seen and not others else "All"
    named = f"the light '{lost[0]}'" + (f" and {len(lost) - 1} others" if len(lost) > 1 else "")
    return (
        f"{begin} that {named} shine{'s' if len(lost) == 1 else ''} on are the backs of one-sided faces, "
        "which reflect nothing: turn these faces round, or make their material double-sided.",
    )


def _rays(scene: Scene) -> Iterator[tuple[str, Floats, Floats]]:
    """Name, origins [RAYS, 3] and unit directions [RAYS, 3] of each lamp."""
    random = np.random.default_rng(0)
    lamps: Sequence[Mesh] = [mesh for mesh in scene.meshes if max(scene.materials[mesh.material].emission) > 0.0]
    for mesh in lamps[:MOST_LAMPS]:
        yield mesh.name, *_mesh_rays(mesh, random)
    for light in scene.lights[:MOST_LAMPS]:
        if light.kind is LightKind.DIRECTIONAL or max(light.intensity) <= 0.0:
            continue
        direction = _sphere(random)
        if light.kind is LightKind.SPOT:
            axis = np.asarray(light.direction, np.float64)
            tight = axis + np.tan(min(0.5 * light.outer_cone, 1.4)) * direction
            direction = tight / np.linalg.norm(tight, axis=1, keepdims=True)
        yield light.name, np.tile(np.asarray(light.position, np.float64), (RAYS, 1)), direction


def _mesh_rays(mesh: Mesh, random: np.random.Generator) -> tuple[Floats, Floats]:
    """Rays off points of a mesh, distributed by area and cosine."""
    area = face_areas(mesh.positions, mesh.faces)
    face = random.choice(len(area), RAYS, p=area / area.sum())
    weight = random.dirichlet(np.ones(3), RAYS)
    normal = face_normals(mesh.positions, mesh.faces[face])
    point = np.einsum("rk,rkc->rc", weight, mesh.positions[mesh.faces[face]].astype(np.float64))
    direction = normal + 0.999 * _sphere(random)
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    return point + 2.0 * face_clearance(mesh.positions, mesh.faces[face])[:, None] * normal, direction


def _sphere(random: np.random.Generator) -> Floats:
    """Unit directions [RAYS, 3], uniform."""
    out = random.normal(size=(RAYS, 3))
    return np.asarray(out / np.linalg.norm(out, axis=1, keepdims=True))
