"""Tangents of meshes whose material has a normal map: the file's own, else made from the map's coordinates.

Made as MikkTSpace does (Mikkelsen 2008, "Simulation of Wrinkled Surfaces Revisited", which glTF 2.0, 3.7.2.1 asks for):
each face's dP/du is laid into the plane of a corner's normal and weighed by the corner's angle; corners that agree in
place, normal, coordinates and handedness share the sum. A vertex whose faces are of both hands (a mirrored half begins
there) becomes two. The coordinates are those on the image, after KHR_texture_transform: a turned map turns the bumps.
We deviate where faces of one hand touch in a vertex alone: MikkTSpace keeps them apart.
"""

from collections.abc import Iterator
from dataclasses import replace
from typing import Final

import numpy as np
import numpy.typing as npt

from kiln_workers.scene.geometry import corner_angles, unit
from kiln_workers.scene.lookup import Floats, Ints, transformed
from kiln_workers.scene.model import Mesh, Scene

LEAST_TANGENT: Final = 0.5
"""A vertex whose tangent from the file is shorter has none."""
BLOCK: Final = 1 << 17
"""Faces that are worked on at once: bounds memory."""


def with_tangents(scene: Scene) -> Scene:
    """The scene with tangents on every mesh whose normal map can be looked up, and on no other."""
    return replace(scene, meshes=tuple(_with_tangents(scene, mesh) for mesh in scene.meshes))


def _with_tangents(scene: Scene, mesh: Mesh) -> Mesh:
    reference = scene.materials[mesh.material].normal_texture
    uv = mesh.uv_of(reference)
    if reference is None or uv is None:
        return replace(mesh, tangents=None)
    if mesh.tangents is not None and np.linalg.norm(mesh.tangents[:, :3], axis=1).min(initial=1.0) > LEAST_TANGENT:
        return mesh
    return made(mesh, transformed(uv, reference))


def made(mesh: Mesh, uv: Floats) -> Mesh:
    """The mesh with tangents along growing u; `uv` [V, 2] are coordinates on the image, v down."""
    hand = _hands(mesh, uv)
    both = 2 * mesh.faces.reshape(-1).astype(np.int64) + np.repeat(hand, 3)
    pair, corner = np.unique(both, return_inverse=True)
    group = _groups(mesh, uv, pair)
    corner = corner.reshape(-1, 3)
    tangent = _sums(mesh, uv, group[corner])[group]
    normal = mesh.normals[pair // 2].astype(np.float64)
    tangent -= np.einsum("vd,vd->v", tangent, normal)[:, None] * normal
    lost = np.linalg.norm(tangent, axis=1) < 1e-9
    tangent = np.where(lost[:, None], _across(normal), tangent)
    sign = np.where(pair % 2 == 1, -1.0, 1.0)[:, None]
    out = mesh.with_vertices(pair // 2, corner.astype(np.int32))
    return replace(out, tangents=np.concatenate([unit(tangent), sign], axis=1).astype(np.float32))


def _sums(mesh: Mesh, uv: Floats, group: Ints) -> Floats:
    """Sum [G, 3] of the faces' tangents over the corners [F, 3] of each group."""
    total = np.zeros((int(group.max(initial=-1)) + 1, 3))
    for part in _blocks(mesh):
        corners = mesh.positions[mesh.faces[part]].astype(np.float64)  # [B, 3, 3]
        normals = mesh.normals[mesh.faces[part]].astype(np.float64)
        along = _face_tangents(corners, uv[mesh.faces[part]])[0][:, None]
        share = unit(
            along - np.einsum("fcd,fcd->fc", np.broadcast_to(along, normals.shape), normals)[..., None] * normals
        )
        np.add.at(total, group[part], share * corner_angles(corners)[..., None])
    return total


def _blocks(mesh: Mesh) -> Iterator[slice]:
    """The mesh's faces, BLOCK at a time."""
    return (slice(at, at + BLOCK) for at in range(0, len(mesh.faces), BLOCK))


def _face_tangents(corners: Floats, uv: Floats) -> tuple[Floats, npt.NDArray[np.bool_], npt.NDArray[np.bool_]]:
    """Of faces [F, 3, 3]: unit dP/du [F, 3], whether their coordinates [F, 3, 2] are mirrored, or have no area [F]."""
    e1, e2 = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    (du1, dv1), (du2, dv2) = (uv[:, 1] - uv[:, 0]).T, (uv[:, 2] - uv[:, 0]).T
    area = du1 * dv2 - du2 * dv1
    size = np.maximum(np.abs(uv - uv[:, :1]).max(axis=(1, 2)), 1e-30)
    flat = np.abs(area) < 1e-12 * size * size
    along = np.sign(area)[:, None] * (e1 * dv2[:, None] - e2 * dv1[:, None])
    # v grows downwards: coordinates that are not mirrored run clockwise.
    return np.where(flat[:, None], 0.0, unit(along)), area > 0.0, flat


def _hands(mesh: Mesh, uv: Floats) -> Ints:
    """1 for mirrored faces [F], else 0; a face whose coordinates have no area is as others at its first corner."""
    mirrored, flat = (np.zeros(len(mesh.faces), bool) for _ in range(2))
    for part in _blocks(mesh):
        corners = mesh.positions[mesh.faces[part]].astype(np.float64)
        _, mirrored[part], flat[part] = _face_tangents(corners, uv[mesh.faces[part]])
    known = np.zeros(len(mesh.positions), bool)
    known[mesh.faces[mirrored & ~flat].reshape(-1)] = True
    known[mesh.faces[~mirrored & ~flat].reshape(-1)] = False
    return np.where(flat, known[mesh.faces[:, 0]], mirrored).astype(np.int64)


def _groups(mesh: Mesh, uv: Floats, pair: Ints) -> Ints:
    """Number of the tangent that each pair of vertex and hand shares with those at its place.

    Pairs are told apart by a hash of 64 bits of their place, normal, coordinates and hand (SplitMix's constant).
    """
    vertex = pair // 2
    key = (pair % 2).astype(np.uint64)
    for values in (mesh.positions, mesh.normals, uv):
        for column in values.T:
            bits = (column[vertex].astype(np.float32) + np.float32(0.0)).view(np.uint32)
            key = (key ^ bits) * np.uint64(0x9E3779B97F4A7C15)
            key ^= key >> np.uint64(29)
    return np.unique(key, return_inverse=True)[1].reshape(-1)


def _across(normal: Floats) -> Floats:
    """Some vectors [V, 3] across unit normals [V, 3]."""
    other = np.where(np.abs(normal[:, :1]) < 0.9, (1.0, 0.0, 0.0), (0.0, 1.0, 0.0))
    return np.cross(other, normal)
