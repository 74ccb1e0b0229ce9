"""Move sheets that lie back to back in one place apart, so that a ray meets the one that faces it first.

Modellers and voxel programs give a wall two faces in the same place, turned away from each other. Which of them a ray
meets there is chance, and the back of a one-sided face is black. So a one-sided face is moved along its own normal, by
as little as float32 tells apart, where another face that looks the other way or has two sides is in its place. The
other one need not have the same vertices: a few points of each face look for one.
"""

from dataclasses import replace
from itertools import pairwise
from typing import Final

import numpy as np
import numpy.typing as npt

from kiln_workers.render.backend import Device
from kiln_workers.scene.geometry import Floats, Ints, face_normals
from kiln_workers.scene.manifold import surface_corners
from kiln_workers.scene.model import Mesh, Scene
from kiln_workers.scene.precision import face_clearance
from kiln_workers.scene.push_out import BareTriangles

Bools = npt.NDArray[np.bool_]

PROBES: Final = np.array([[1, 1, 1], [8, 1, 1], [1, 8, 1], [1, 1, 8]]) / np.array([[3], [10], [10], [10]])
"""Barycentrics of the points at which a face looks for another."""

SAME_PLACE: Final = 2.0
"""Sheets nearer than this many clearances are in one place."""

GAP: Final = 3.0
"""Clearances by which each of them is moved."""

FOLD: Final = -0.9
"""Cosine between the normals of two faces below which they are two sheets that end at the same edge."""

SPLIT: Final = np.array([0.8326, 0.4507, 0.3222])
"""Faces are told apart by the side of this direction that they face, so that no common wall lies across it."""


def part_sheets(scene: Scene, device: Device = "auto") -> Scene:
    """The scene with back-to-back sheets moved apart, and a note where there were some."""
    faces = _Faces(scene)
    if faces.double_sided.all():
        return scene
    moved = np.zeros(len(faces.normal), bool)
    forward = faces.normal @ SPLIT > 0.0
    for side in (forward, ~forward):
        _mark(scene, faces, np.flatnonzero(side & ~faces.double_sided), faces.double_sided | ~side, moved, device)
    moved &= ~faces.double_sided
    if not moved.any():
        return scene
    meshes = tuple(
        _moved(mesh, moved[part], faces.normal[part], GAP * faces.clearance[part])
        for mesh, part in zip(scene.meshes, faces.parts, strict=True)
    )
    note = (
        f"{int(moved.sum())} faces lay back to back with others in one place; they were moved apart by "
        f"{2e6 * GAP * float(faces.clearance[moved].max()):.2g} micrometres or less."
    )
    return replace(scene, meshes=meshes, notes=(*scene.notes, note))


class _Faces:
    """All faces of a scene in one list."""

    def __init__(self, scene: Scene) -> None:
        ends = np.cumsum([0] + [len(mesh.faces) for mesh in scene.meshes])
        self.parts = [slice(a, b) for a, b in pairwise(ends)]
        self.corners = np.concatenate([mesh.positions[mesh.faces] for mesh in scene.meshes]).astype(np.float64)
        self.normal = np.concatenate([face_normals(mesh.positions, mesh.faces) for mesh in scene.meshes])
        self.clearance = np.concatenate([face_clearance(mesh.positions, mesh.faces) for mesh in scene.meshes])
        two = [scene.materials[mesh.material].double_sided for mesh in scene.meshes]
        self.double_sided = np.repeat(np.array(two, bool), np.diff(ends))


def _mark(scene: Scene, faces: _Faces, asking: Ints, others: Bools, moved: Bools, device: Device) -> None:
    """Set `moved` [F] at the faces `asking` that have one of `others` [F] in their place, and at these."""
    if not len(asking) or not others.any():
        return
    parts = [
        replace(mesh, faces=mesh.faces[others[part]]) for mesh, part in zip(scene.meshes, faces.parts, strict=True)
    ]
    triangles = BareTriangles(replace(scene, meshes=tuple(parts)), device)
    reach = SAME_PLACE * faces.clearance[asking]
    for probe in PROBES:
        point = np.einsum("k,fkc->fc", probe, faces.corners[asking])
        met = triangles.nearest(point + reach[:, None] * faces.normal[asking], -faces.normal[asking], 2.0 * reach)
        here = np.isfinite(met.distance)
        moved[asking[here]] = True
        moved[np.flatnonzero(others)[met.face[here]]] = True


def _moved(mesh: Mesh, moved: Bools, normal: Floats, gap: Floats) -> Mesh:
    """The mesh with its surface's vertices at the faces `moved` [F] moved so far that each of these moves by its gap.

    A vertex of the surface moves as one, however many vertices of the mesh it is, so that no faces come apart. Where
    the two sheets share a vertex of the mesh it becomes two.
    """
    if not moved.any():
        return mesh
    surface = surface_corners(mesh.positions.astype(np.float64), mesh.faces.astype(np.int64), FOLD)
    corners, mine = surface[moved], normal[moved]
    mean, most = np.zeros((int(surface.max()) + 1, 3)), np.zeros(int(surface.max()) + 1)
    for k in range(3):
        np.add.at(mean, corners[:, k], mine)
        np.maximum.at(most, corners[:, k], gap[moved])
    mean /= np.maximum(np.linalg.norm(mean, axis=1, keepdims=True), 1e-30)
    least = np.ones(len(mean))
    for k in range(3):
        np.minimum.at(least, corners[:, k], np.einsum("fc,fc->f", mean[corners[:, k]], mine))
    shift = (most / np.maximum(least, 0.2))[:, None] * mean
    vertices, number = np.unique(np.stack([mesh.faces, surface], axis=2).reshape(-1, 2), axis=0, return_inverse=True)
    parted = mesh.with_vertices(vertices[:, 0], number.reshape(-1, 3).astype(np.int32))
    return replace(parted, positions=(parted.positions + shift[vertices[:, 1]]).astype(np.float32))
