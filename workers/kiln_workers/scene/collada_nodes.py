"""The nodes of a Collada scene with their transforms to the world, which is in metres with +Y up.

A node's transforms are applied in their order, the last one first to its content. `<instance_node>` stands for a copy
of a node that is elsewhere; copies of copies are counted, as a small file may ask for any number of them.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np

from kiln_schemas.errors import InputError, TooLarge
from kiln_schemas.text import quoted
from kiln_workers.scene.collada_document import MAX_DEPTH, Collada
from kiln_workers.scene.geometry import Floats
from kiln_workers.scene.limits import MAX_ENTRIES, check_count
from kiln_workers.scene.xml_nodes import Node

UP: Final = {
    "Y_UP": [[1, 0, 0], [0, 1, 0], [0, 0, 1]],
    "Z_UP": [[1, 0, 0], [0, 0, 1], [0, -1, 0]],
    "X_UP": [[0, -1, 0], [1, 0, 0], [0, 0, 1]],
}
"""Rows: which way of the file is right, up and towards the viewer."""


@dataclass(frozen=True)
class Placed:
    """A node with its transform to the world."""

    node: Node
    matrix: Floats  # [4, 4]


def metres(document: Collada) -> float:
    """The file's unit."""
    unit = document.root.child("asset", "unit")
    text = "1" if unit is None else unit.attributes.get("meter", "1").strip()
    try:
        value = float(text.replace(",", "."))
    except ValueError:
        value = 0.0
    if not 0.0 < value < 1e9:
        raise InputError(f"its unit is {quoted(text)} metres", where=document.where, remedy="Export it again.")
    return value


def to_world(document: Collada) -> Floats:
    """The transform [4, 4] from the file's unit and axes."""
    axis = document.root.child("asset", "up_axis")
    up = "Y_UP" if axis is None else axis.text.strip()
    if up not in UP:
        raise InputError(f"its up axis is {quoted(up)}", where=document.where, remedy="Export it again.")
    matrix = np.eye(4)
    matrix[:3, :3] = metres(document) * np.array(UP[up], dtype=np.float64)
    return matrix


def placed_nodes(document: Collada) -> list[Placed]:
    """All nodes of the file's scene, depth first."""
    instance = document.root.child("scene", "instance_visual_scene")
    scene = None if instance is None else document.find(instance.attributes.get("url", ""), "visual_scene")
    scene = scene or document.root.child("library_visual_scenes", "visual_scene")
    if scene is None:
        return []
    world = to_world(document)
    out: list[Placed] = []
    stack = [(node, world, 0) for node in reversed(scene.all("node"))]
    while stack:
        node, parent, depth = stack.pop()
        if depth > MAX_DEPTH:
            raise TooLarge("its nodes nest too deeply, or hold themselves", where=document.where, remedy="Simplify it.")
        with np.errstate(over="ignore", invalid="ignore"):
            matrix = parent @ _local_matrix(document, node)
        if not np.isfinite(matrix).all():
            raise document.fail(node, "has a transform that is not finite")
        out.append(Placed(node, matrix))
        check_count(len(out) + len(stack), MAX_ENTRIES, "nodes with all its instances", document.where)
        inner = [
            document.find(child.attributes.get("url", ""), "node") if child.tag == "instance_node" else child
            for child in node.all("node", "instance_node")
        ]
        stack += [(child, matrix, depth + 1) for child in reversed(inner) if child is not None]
    return out


def _local_matrix(document: Collada, node: Node) -> Floats:
    matrix = np.eye(4)
    for step in node.children:
        if step.tag == "skew":
            document.ignored["skews"] += 1
        elif step.tag in STEPS and step.text.strip():
            count, make = STEPS[step.tag]
            matrix = matrix @ make(document.floats(step, count))
    return matrix


def _translate(values: Floats) -> Floats:
    matrix = np.eye(4)
    matrix[:3, 3] = values
    return matrix


def _rotate(values: Floats) -> Floats:
    """Axis and degrees (Rodrigues)."""
    length = float(np.linalg.norm(values[:3]))
    matrix = np.eye(4)
    if length > 0.0:
        x, y, z = values[:3] / length
        cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        angle = np.deg2rad(values[3])
        matrix[:3, :3] += np.sin(angle) * cross + (1.0 - np.cos(angle)) * cross @ cross
    return matrix


def _look_at(values: Floats) -> Floats:
    """Eye, target and up: -Z looks at the target."""
    eye, target, up = values.reshape(3, 3)
    matrix = np.eye(4)
    back = eye - target
    right = np.cross(up, back)
    if np.linalg.norm(right) > 0.0:
        axes = [right, np.cross(back, right), back]
        matrix[:3, :3] = np.stack([axis / np.linalg.norm(axis) for axis in axes], axis=1)
    matrix[:3, 3] = eye
    return matrix


STEPS: Final = {
    "translate": (3, _translate),
    "rotate": (4, _rotate),
    "scale": (3, lambda values: np.diag([*values, 1.0])),
    "matrix": (16, lambda values: values.reshape(4, 4)),
    "lookat": (9, _look_at),
}
"""How many numbers a transform has, and its matrix."""
