"""Skins of a Collada file, where their joints stand at rest (COLLADA 1.4.1, "Skin Deformation (or Skinning)").

A vertex is the weighted mean of where its joints take it: by the skin's bind shape matrix, the joint's inverse bind
matrix, and the joint node's transform to the world. The node that has the controller plays no part.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from kiln_workers.scene.collada_document import Collada
from kiln_workers.scene.collada_nodes import Placed
from kiln_workers.scene.geometry import Floats, Ints
from kiln_workers.scene.limits import check_count
from kiln_workers.scene.xml_nodes import Node

MAX_JOINTS = 64
"""Of a vertex."""


@dataclass(frozen=True)
class Skin:
    """Joints and weights [P, K] of a geometry's positions, and the joints' matrices [J, 4, 4] to the world."""

    joints: Ints
    weights: Floats
    matrices: Floats


class Joints:
    """The nodes of a scene by their sids and ids."""

    def __init__(self, placed: Sequence[Placed]) -> None:
        self._by_name: dict[str, list[Placed]] = {}
        for item in placed:
            for name in {item.node.attributes.get("sid"), item.node.attributes.get("id")} - {None}:
                self._by_name.setdefault(str(name), []).append(item)
        self._below: dict[Node, set[Node]] = {}

    def world(self, name: str, roots: Sequence[Node]) -> Floats | None:
        """The transform of a joint, which is below one of the `roots` if there are two of its name."""
        found = self._by_name.get(name, [])
        if len(found) > 1:
            for root in roots:
                if root not in self._below:
                    self._below[root] = set(root.below())
            found = [item for item in found if any(item.node in self._below[root] for root in roots)] or found
        return found[0].matrix if found else None


def read_skin(document: Collada, skin: Node, instance: Node, nodes: Joints) -> Skin:
    """The `<skin>` of a controller's `instance`; InputError where it does not fit together."""
    shape = skin.child("bind_shape_matrix")
    bind = np.eye(4) if shape is None else document.floats(shape, 16).reshape(4, 4)
    inputs = {node.attributes.get("semantic"): node for node in (skin.child("joints") or skin).all("input")}
    names = document.words(document.need(inputs.get("JOINT", skin), "source", "source"))
    inverse = document.source(document.need(inputs.get("INV_BIND_MATRIX", skin), "source", "source"))
    if inverse.size != 16 * len(names):
        raise document.fail(skin, f"has {inverse.size} numbers of inverse bind matrices for {len(names)} joints")
    roots = [document.find(node.text.strip(), "node") for node in instance.all("skeleton")]
    found = [nodes.world(name, [root for root in roots if root is not None]) for name in names]
    worlds = [matrix for matrix in found if matrix is not None]
    if len(worlds) < len(names) or not names:
        raise document.fail(skin, f"has {len(names)} joints, of which {len(worlds)} are nodes of the scene")
    with np.errstate(over="ignore", invalid="ignore"):  # `place` refuses what is not finite
        matrices = np.stack(worlds) @ inverse.reshape(-1, 4, 4) @ bind
    joints, weights = _influences(document, skin)
    # Joint -1 is the bind shape itself.
    matrices = np.concatenate([matrices, bind[None]])
    if (joints < -1).any() or (joints >= len(names)).any():
        raise document.fail(skin, f"names a joint that is none of {len(names)}")
    return Skin(np.where(joints < 0, len(names), joints), weights, matrices)


def _influences(document: Collada, skin: Node) -> tuple[Ints, Floats]:
    """Joints and weights [P, K], whose rows sum to 1."""
    table = skin.child("vertex_weights")
    counts = None if table is None else table.child("vcount")
    values = None if table is None else table.child("v")
    if table is None or counts is None or values is None:
        raise document.fail(skin, "has no vertex weights")
    inputs = {node.attributes.get("semantic"): node for node in table.all("input")}
    if "JOINT" not in inputs or "WEIGHT" not in inputs:
        raise document.fail(table, "has no joints or no weights")
    source = document.source(document.need(inputs["WEIGHT"], "source", "source"))[:, 0]
    width = 1 + max(document.whole(node, "offset", 0) for node in table.all("input"))
    sizes, flat = document.ints(counts), document.ints(values)
    if (sizes < 0).any() or (sizes > len(flat)).any() or sizes.sum() * width != len(flat):
        raise document.fail(table, f"has {len(flat)} indices, and another sum of its <vcount>")
    most = int(sizes.max(initial=0))
    check_count(most, MAX_JOINTS, "joints at a vertex", document.where)
    rows = flat.reshape(-1, width)
    index = rows[:, document.whole(inputs["WEIGHT"], "offset", 0)]
    if len(index) and (index.min() < 0 or index.max() >= len(source)):
        raise document.fail(table, f"names a weight that is none of {len(source)}")
    joints = np.full((len(sizes), max(most, 1)), -1)
    weights = np.zeros((len(sizes), max(most, 1)))
    vertex = np.repeat(np.arange(len(sizes)), sizes)
    column = np.arange(len(vertex)) - np.repeat(np.cumsum(sizes) - sizes, sizes)
    joints[vertex, column] = rows[:, document.whole(inputs["JOINT"], "offset", 0)]
    weights[vertex, column] = source[index]
    total = weights.sum(axis=1, keepdims=True)
    sound = np.isfinite(total) & (total > 0.0)
    # A vertex without weights stays where the bind shape has it.
    joints = np.where(sound, joints, -1)
    return joints, np.where(sound, weights / np.where(sound, total, 1.0), np.eye(1, weights.shape[1]))
