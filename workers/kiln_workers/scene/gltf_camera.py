"""The first perspective camera of a glTF file, in world space: where its author looks from.

glTF 2.0, section 3.10: a camera looks along -Z of its node, +Y is up, and `yfov` is vertical and in radians. What is no
usable camera (an orthographic one, one that Blender's exporter has scaled to nothing) is passed over: a scene bakes
without one.
"""

import math
from typing import Any

import numpy as np
from pydantic import ValidationError

from kiln_schemas.camera import Camera
from kiln_workers.scene.geometry import Floats
from kiln_workers.scene.gltf import placed_nodes
from kiln_workers.scene.gltf_buffers import split_glb
from kiln_workers.scene.gltf_document import parse_document


def gltf_camera(data: bytes, entry: str) -> Camera | None:
    """The camera of a glTF file, its target 1 m before it; None where it has none."""
    text, _ = split_glb(data, entry)
    document = parse_document(text, entry)
    for placed in placed_nodes(document, entry):
        index = placed.node.camera
        if isinstance(index, int) and 0 <= index < len(document.cameras):
            camera = _camera(document.cameras[index], placed.matrix)
            if camera is not None:
                return camera
    return None


def _camera(part: Any, matrix: Floats) -> Camera | None:
    try:
        return camera_at(matrix, float(part["perspective"]["yfov"]))
    except (KeyError, TypeError, ValueError):
        return None


def camera_at(matrix: Floats, vertical: float) -> Camera | None:
    """The camera of a node, `vertical` radians of view high; None where that is no usable camera."""
    position, forward, up = matrix[:3, 3], -matrix[:3, 2], matrix[:3, 1]
    lengths = np.linalg.norm(forward), np.linalg.norm(up)
    if min(lengths) == 0.0:
        return None
    forward, up = forward / lengths[0], up / lengths[1]
    try:
        return Camera.model_validate(
            {
                "position": position.tolist(),
                "target": (position + forward).tolist(),
                "up": up.tolist(),
                "fov_deg": math.degrees(vertical),
            }
        )
    except ValidationError:
        return None
