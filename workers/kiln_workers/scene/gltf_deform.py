"""Where skins and morph targets put the vertices of a glTF mesh at rest (glTF 2.0, 3.7.2.2 and 3.7.3).

A morphed vertex is its own plus its targets' displacements by the weights of the node, or else of the mesh. A skinned
one is the weighted mean of where its joints take it: a joint's matrix is the joint node's transform to the world times
its inverse bind matrix. The transform of the node that has the mesh plays no part then.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from kiln_schemas.errors import InputError
from kiln_workers.scene.geometry import Floats, Ints, RawMesh
from kiln_workers.scene.gltf_buffers import GltfBuffers
from kiln_workers.scene.gltf_document import Primitive, Skin

Influences = tuple[Ints, Floats]
"""Joints [V, K] and weights [V, K], whose rows sum to 1."""


def morphed(
    values: Floats, key: str, primitive: Primitive, weights: Sequence[float], buffers: GltfBuffers, mesh: str
) -> Floats:
    """The attribute `key` [V, 3] with the displacements of the targets added."""
    out = values
    for number, (target, weight) in enumerate(zip(primitive.targets, weights, strict=False)):
        if key in target and weight != 0.0:
            moved = buffers.floats(target[key], 3, f"{key} of target {number} of mesh '{mesh}'")
            if len(moved) != len(values):
                raise InputError(
                    f"target {number} has {len(moved)} values of {key} for {len(values)} vertices",
                    where=f"mesh '{mesh}'",
                    remedy="Export it again.",
                )
            out = out + weight * moved
    return out


def influences(primitive: Primitive, buffers: GltfBuffers, mesh: str, count: int) -> Influences | None:
    """All JOINTS_n and WEIGHTS_n of a primitive; None where it has none."""
    joints, weights = [], []
    number = 0
    while f"JOINTS_{number}" in primitive.attributes and f"WEIGHTS_{number}" in primitive.attributes:
        joints.append(buffers.floats(primitive.attributes[f"JOINTS_{number}"], 4, f"JOINTS_{number} of '{mesh}'"))
        weights.append(buffers.floats(primitive.attributes[f"WEIGHTS_{number}"], 4, f"WEIGHTS_{number} of '{mesh}'"))
        number += 1
    if not joints:
        return None
    for values in (*joints, *weights):
        if len(values) != count:
            raise InputError(
                f"its joints or weights have {len(values)} values for {count} vertices",
                where=f"mesh '{mesh}'",
                remedy="Export it again.",
            )
    weight = np.concatenate(weights, axis=1)
    total = weight.sum(axis=1, keepdims=True)
    if not np.isfinite(weight).all() or (total <= 0.0).any():
        vertex = int(np.argmin(np.where(np.isfinite(total), total, -1.0)))
        raise InputError(
            f"the weights of vertex {vertex} sum to {total[vertex, 0]}",
            where=f"mesh '{mesh}'",
            remedy="Export it again.",
        )
    return np.concatenate(joints, axis=1).astype(np.int64), weight / total


def joint_matrices(skin: Skin, number: int, worlds: Mapping[int, Floats], buffers: GltfBuffers, where: str) -> Floats:
    """The matrices [J, 4, 4] of a skin's joints; `worlds` are the nodes' transforms to the world."""
    missing = [joint for joint in skin.joints if joint not in worlds]
    if missing:
        raise InputError(
            f"joint {missing[0]} of skin {number} is no node of the scene", where=where, remedy="Export it again."
        )
    world = np.stack([worlds[joint] for joint in skin.joints])
    if skin.inverse_bind_matrices is None:
        return world
    flat = buffers.floats(skin.inverse_bind_matrices, 16, f"inverse bind matrices of skin {number}")
    if len(flat) < len(world):
        raise InputError(
            f"skin {number} has {len(flat)} inverse bind matrices for {len(world)} joints",
            where=where,
            remedy="Export it again.",
        )
    with np.errstate(over="ignore", invalid="ignore"):  # `place` refuses what is not finite
        return np.asarray(world @ flat[: len(world)].reshape(-1, 4, 4).transpose(0, 2, 1))


def skinned(raw: RawMesh, influence: Influences, joints: Floats) -> RawMesh:
    """The mesh in world space where its joints [J, 4, 4] put it."""
    index, weight = influence
    if index.max(initial=0) >= len(joints):
        raise InputError(
            f"a vertex names joint {index.max()} of a skin of {len(joints)}",
            where=f"mesh '{raw.name}'",
            remedy="Export it again.",
        )
    matrix = np.zeros((len(raw.positions), 4, 4))
    with np.errstate(over="ignore", invalid="ignore"):
        for column in range(index.shape[1]):
            matrix += weight[:, column, None, None] * joints[index[:, column]]
        linear = matrix[:, :3, :3]
        positions = np.einsum("vij,vj->vi", linear, raw.positions) + matrix[:, :3, 3]
        mirrored = bool(np.median(np.linalg.det(linear)) < 0.0)
        normals = None
        if raw.normals is not None:
            a, b, c = linear[:, :, 0], linear[:, :, 1], linear[:, :, 2]
            cofactor = np.stack([np.cross(b, c), np.cross(c, a), np.cross(a, b)], axis=2)
            normals = np.einsum("vij,vj->vi", cofactor, raw.normals) * (-1.0 if mirrored else 1.0)
        tangents = None
        if raw.tangents is not None:
            along = np.einsum("vij,vj->vi", linear, raw.tangents[:, :3])
            tangents = np.concatenate([along, raw.tangents[:, 3:] * (-1.0 if mirrored else 1.0)], axis=1)
    faces = raw.faces[:, ::-1] if mirrored else raw.faces
    return replace(raw, positions=positions, normals=normals, faces=faces, tangents=tangents)
