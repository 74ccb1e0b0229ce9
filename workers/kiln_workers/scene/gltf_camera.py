"""The first perspective camera of a glTF file, in world space: where its author looks from.

glTF 2.0, section 3.10: a camera looks along -Z of its node, +Y is up, and `yfov` is vertical and in radians. What is no
usable camera (an orthographic one, one that Blender's exporter has scaled to nothing) is passed over: a scene bakes
without one.
"""

import math
from typing import Any, Final

import numpy as np
from pydantic import ValidationError

from kiln_schemas.camera import Camera
from kiln_workers.scene.gltf import placed_nodes
from kiln_workers.scene.gltf_buffers import split_glb
from kiln_workers.scene.gltf_document import parse_document

SUFFIXES: Final = (".glb", ".gltf")


def gltf_camera(data: bytes, entry: str) -> Camera | None:
    """The camera of a scene file, its target 1 m before it; None where it has none, or is no glTF file."""
    if not entry.lower().endswith(SUFFIXES):
        return None
    text, _ = split_glb(data, entry)
    document = parse_document(text, entry)
    for placed in placed_nodes(document, entry):
        index = placed.node.camera
        if isinstance(index, int) and 0 <= index < len(document.cameras):
            camera = _camera(document.cameras[index], placed.matrix)
            if camera is not None:
                return camera
    return None


def _camera(part: Any, matrix: np.ndarray[Any, np.dtype[np.float64]]) -> Camera | None:
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
                "fov_deg": math.degrees(part["perspective"]["yfov"]),
            }
        )
    except (KeyError, TypeError, ValidationError):
        return None
