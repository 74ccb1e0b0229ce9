"""The first look at a scene for which nobody states a camera: the viewer's rule, on the scene that was baked.

1. Where walls stand around a place inside the scene's box, one looks from inside: across the middle of the free space,
   half-way between the floor and what is above, from near to what is behind. Of sixteen ways to look that one is taken
   whose picture shows most and farthest: what stands close before the eye counts little, an opening nothing.
2. Else from outside: from above the horizon, with all of the scene in the picture, from the side that shows most
   fronts of surfaces and fewest backs, which are black. Of sides that are nearly alike the front is taken (+Z).

A place is inside where of eight horizontal rays six hit the front of a surface, none hits the back of one, and the ray
down finds a floor. `service/kiln_service/viewer/page/first_camera.js` has the same rule for packages without pictures;
the constants are its own, and a test holds both against each other. In symmetrical rooms, where several views are worth
the same, rounding may let them choose different ones.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from kiln_schemas.camera import Camera
from kiln_workers.render.backend import select_variant
from kiln_workers.render.jit import dr, mi
from kiln_workers.render.mitsuba_scene import mesh_number, scene_bounds, to_mitsuba
from kiln_workers.scene.geometry import Floats
from kiln_workers.scene.model import Scene
from kiln_workers.shade.camera import camera_frame

Bools = npt.NDArray[np.bool_]

AROUND: Final = 8
WALLS: Final = 6
WAYS: Final = 16
PLAN: Final = (0.5, 0.25, 0.75)  # of the box's width and depth
HEIGHTS: Final = (0.35, 0.65)  # of its height
INSIDE_FOV: Final = 60.0
STAND: Final = 0.85  # of the way to what is behind
LOWER: Final = 0.15  # of the room's height is what one looks at below the eye,
STEEPEST: Final = 0.5  # but no more than of the way to it
OUTSIDE_FOV: Final = 45.0
MARGIN: Final = 1.05
ELEVATION: Final = 0.35  # radians
ALIKE: Final = 0.8  # of what the best side shows
SIDES: Final = (0.4, -0.4, 1.2, -1.2, 2.0, -2.0, 2.8, -2.8)  # radians from +Z towards +X
RASTER: Final = (8, 5)  # rays of a picture
UP: Final = np.array([0.0, 1.0, 0.0])
LEAST_SEEN: Final = 0.05
"""Share of the rays of a stated camera's picture that have to meet something."""


def first_camera(scene: Scene, aspect: float, stated: Camera | None = None) -> Camera:
    """The scene file's own camera `stated`, if it sees the scene; else the rule's, in world space."""
    surfaces = _Surfaces(scene)
    origin = np.asarray(scene.origin, np.float64)
    if stated is not None:
        distance, _ = surfaces.seen(_moved(stated, -origin), aspect)
        if np.isfinite(distance).mean() >= LEAST_SEEN:
            return stated
    low, high = (corner.astype(np.float64) for corner in scene_bounds(scene))
    camera = _inside(surfaces, low, high, aspect) or _outside(surfaces, low, high, aspect)
    return _moved(camera, origin)


@dataclass
class _Surfaces:
    """Rays against the scene's triangles."""

    scene: Scene

    def __post_init__(self) -> None:
        select_variant()
        self.traced = to_mitsuba(self.scene)
        shapes = self.traced.shapes()
        identifiers = [int(dr.reinterpret_array(mi.UInt32, mi.ShapePtr(shape))[0]) for shape in shapes]
        self.double_sided = np.zeros(max(identifiers, default=0) + 1, bool)
        for shape, identifier in zip(shapes, identifiers, strict=True):
            material = self.scene.materials[self.scene.meshes[mesh_number(shape)].material]
            self.double_sided[identifier] = material.double_sided

    def meet(self, start: Floats, towards: Floats) -> tuple[Floats, Bools]:
        """How far [N] each ray goes, infinitely where it meets nothing, and whether it ends at a surface's front."""
        start, towards = np.broadcast_arrays(start, towards)
        point, direction = (np.ascontiguousarray(a.reshape(-1, 3).T, np.float32) for a in (start, towards))
        si = self.traced.ray_intersect(mi.Ray3f(mi.Point3f(point), mi.Vector3f(direction)))
        dr.eval(si)
        valid = np.array(si.is_valid()).astype(bool)
        distance = np.where(valid, np.array(si.t, np.float64), np.inf)
        facing = np.einsum("dn,dn->n", np.array(si.n, np.float64), direction) < 0.0
        sided = self.double_sided[np.where(valid, np.array(dr.reinterpret_array(mi.UInt32, si.shape)), 0)]
        return distance, valid & (facing | sided)

    def seen(self, camera: Camera, aspect: float) -> tuple[Floats, Bools]:
        """What the rays of a camera's picture meet."""
        right, up, forward = camera_frame(camera)
        j, i = (index.ravel() for index in np.indices(RASTER[::-1]))
        slope = np.tan(np.radians(camera.fov_deg) / 2.0)
        x, y = (2.0 * (i + 0.5) / RASTER[0] - 1.0) * slope * aspect, (1.0 - 2.0 * (j + 0.5) / RASTER[1]) * slope
        towards = forward + x[:, None] * right + y[:, None] * up
        return self.meet(np.asarray(camera.position), towards / np.linalg.norm(towards, axis=-1, keepdims=True))


def _inside(surfaces: _Surfaces, low: Floats, high: Floats, aspect: float) -> Camera | None:
    """The camera inside an enclosure, or None where none is found."""
    places = [low + np.array([x, y, z]) * (high - low) for y in HEIGHTS for x in PLAN for z in PLAN]
    place, most = None, 0.0
    for candidate in places:
        room = _room_at(surfaces, low, high, candidate)
        if room > most:
            place, most = candidate, room
    if place is None:
        return None
    cameras = [_across(surfaces, low, high, place, towards) for towards in _around(WAYS)]

    def far(camera: Camera) -> float:
        distance, front = surfaces.seen(camera, aspect)
        return float(np.sqrt(distance[front]).sum())

    return _most(cameras, far)


def _room_at(surfaces: _Surfaces, low: Floats, high: Floats, place: Floats) -> float:
    """How much room there is around a place: the mean way to what stands around; 0 where it is not inside."""
    towards = _around(AROUND)
    distance, front = surfaces.meet(place, np.concatenate([-UP[None], towards]))
    backs = ~front[1:] & np.isfinite(distance[1:])
    if not front[0] or front[1:].sum() < WALLS or backs.any():
        return 0.0
    return float(np.minimum(distance[1:], [_way_out(low, high, place, way) for way in towards]).mean())


def _across(surfaces: _Surfaces, low: Floats, high: Floats, place: Floats, towards: Floats) -> Camera:
    """The camera that looks across a place, from near to what is behind it."""
    distance, _ = surfaces.meet(place, -towards[None])
    back = min(float(distance[0]), _way_out(low, high, place, -towards))
    eye = place - STAND * back * towards
    (down, up), _ = surfaces.meet(eye, np.stack([-UP, UP]))
    floor, above = max(eye[1] - down, low[1]), min(eye[1] + up, high[1])
    eye[1] = (floor + above) / 2.0
    target = np.array([place[0], eye[1] - min(LOWER * (above - floor), STEEPEST * STAND * back), place[2]])
    return _camera(eye, target, INSIDE_FOV)


def _outside(surfaces: _Surfaces, low: Floats, high: Floats, aspect: float) -> Camera:
    def fronts(camera: Camera) -> float:
        distance, front = surfaces.seen(camera, aspect)
        return float(np.where(np.isfinite(distance), 2.0 * front - 1.0, 0.0).sum())

    return _most([_framing(low, high, side, aspect) for side in SIDES], fronts, ALIKE)


def _framing(low: Floats, high: Floats, side: float, aspect: float) -> Camera:
    """The camera on a side of a box that has it all in its picture."""
    centre = (low + high) / 2.0
    level = np.cos(ELEVATION)
    back = np.array([level * np.sin(side), np.sin(ELEVATION), level * np.cos(side)])
    right = np.cross(UP, back) / np.linalg.norm(np.cross(UP, back))
    up, slope = np.cross(back, right), np.tan(np.radians(OUTSIDE_FOV) / 2.0)
    corners = np.array([[x, y, z] for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])])
    at = corners - centre
    beside = np.maximum(np.abs(at @ up), np.abs(at @ right) / aspect) / slope
    distance = max(float((at @ back + MARGIN * beside).max()), 1e-6)
    return _camera(centre + distance * back, centre, OUTSIDE_FOV)


def _most(cameras: Sequence[Camera], worth: Callable[[Camera], float], alike: float = 1.0) -> Camera:
    """The first of those that are worth most, or nearly so."""
    worths = [worth(camera) for camera in cameras]
    best = max(worths)
    return next(camera for camera, one in zip(cameras, worths, strict=True) if one >= min(best, alike * best))


def _around(count: int) -> Floats:
    """Horizontal directions [count, 3], the first towards -Z, as somebody looks who stands in front."""
    angle = 2.0 * np.pi * np.arange(count) / count
    return np.stack([-np.sin(angle), np.zeros(count), -np.cos(angle)], axis=1)


def _way_out(low: Floats, high: Floats, place: Floats, towards: Floats) -> float:
    """How far it is from inside a box to its faces."""
    moving = np.abs(towards) >= 1e-9
    face = np.where(towards > 0.0, high, low)
    return float(((face - place)[moving] / towards[moving]).min())


def _camera(position: Floats, target: Floats, fov_deg: float) -> Camera:
    return Camera.model_validate({"position": position.tolist(), "target": target.tolist(), "fov_deg": fov_deg})


def _moved(camera: Camera, by: Floats) -> Camera:
    """The camera moved by a vector [3]."""
    update: dict[str, Any] = {
        name: (np.asarray(getattr(camera, name)) + by).tolist() for name in ("position", "target")
    }
    return Camera.model_validate({**camera.model_dump(), **update})
