"""Move a scene to where float32 resolves it: about a point amid its own vertices, which the scene remembers.

Float32 tells places apart that differ by a 10 millionth of their distance from the origin: by half a metre in the
coordinates of maps (UTM). Readers place vertices in float64; here a round point amid them is subtracted before they
become float32. Everything after that works with coordinates about that point (`Scene.origin`); the package's
`scene.glb` moves them back by a node's translation, which is a decimal number. A scene that lies about the origin stays
where it is, to the last bit.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import numpy as np

from kiln_schemas.camera import Camera
from kiln_workers.scene.geometry import Floats, sound_faces
from kiln_workers.scene.model import Mesh, Scene

MIDDLE: Final = (25.0, 50.0, 75.0)
"""Percentiles of the vertices, axis by axis: a stray mesh far away is no part of the middle."""

NEAR: Final = 64.0
"""A scene whose middle is within half as many of its extents stays where it is: that costs 5 of float32's 24 bits."""

Point = tuple[float, float, float]


def about_own_centre(scene: Scene) -> Scene:
    """The scene in float32 about `origin`, a round point amid its vertices, or (0, 0, 0) where that is near enough."""
    origin = round_centre([np.asarray(mesh.positions, np.float64) for mesh in scene.meshes])
    notes = list(scene.notes)
    meshes = []
    for mesh in scene.meshes:
        positions = (np.asarray(mesh.positions, np.float64) - origin).astype(np.float32)
        sound = sound_faces(positions.astype(np.float64), mesh.faces.astype(np.int64))
        dropped = len(sound) - int(sound.sum())
        if dropped:
            notes.append(
                f"Mesh '{mesh.name}': {dropped} face{'s' if dropped > 1 else ''} too small for its place dropped."
            )
        if sound.any():
            meshes.append(_without(replace(mesh, positions=positions), sound))
    x, y, z = (float(value) for value in origin)
    if origin.any():
        notes.append(f"The scene lies far from the origin; it is baked about ({x:g}, {y:g}, {z:g}).")
    lights = tuple(replace(light, position=less(light.position, (x, y, z))) for light in scene.lights)
    return replace(scene, meshes=tuple(meshes), lights=lights, notes=tuple(notes), origin=(x, y, z))


def round_centre(positions: Sequence[Floats]) -> Floats:
    """A multiple of a power of two near the middle [3] of all vertices; zero where that is within NEAR extents."""
    if not any(len(points) for points in positions):
        return np.zeros(3)
    low, middle, high = np.percentile(np.concatenate(positions), MIDDLE, axis=0)
    extent = max(float((high - low).max()), 1e-30)
    unit = 2.0 ** np.ceil(np.log2(NEAR * extent))
    return np.asarray(np.round(middle / unit) * unit)


def local_camera(camera: Camera, origin: Point) -> Camera:
    """A camera that was given in the user's coordinates, about `origin`."""
    return camera.model_copy(update={"position": less(camera.position, origin), "target": less(camera.target, origin)})


def less(point: Sequence[float], origin: Point) -> Point:
    """The point about `origin`."""
    x, y, z = (float(a) - b for a, b in zip(point, origin, strict=True))
    return x, y, z


def _without(mesh: Mesh, sound: np.ndarray[tuple[int], np.dtype[np.bool_]]) -> Mesh:
    """The mesh with its sound faces [F] only; vertices that none of them uses stay."""
    return mesh if sound.all() else replace(mesh, faces=mesh.faces[sound])
