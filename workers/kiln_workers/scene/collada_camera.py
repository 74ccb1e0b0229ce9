"""The first perspective camera of a Collada file, in world space; it looks along -Z of its node, +Y is up."""

import math

import numpy as np

from kiln_schemas.camera import Camera
from kiln_workers.scene.collada_document import Collada
from kiln_workers.scene.collada_nodes import placed_nodes
from kiln_workers.scene.gltf_camera import camera_at
from kiln_workers.scene.xml_nodes import Node

ASPECT = 16.0 / 9.0
"""Of a camera that states a width and nothing else."""


def collada_camera(data: bytes, entry: str) -> Camera | None:
    """The camera, its target 1 m before it; None where the file has none."""
    document = Collada.parse(data, entry)
    for placed in placed_nodes(document):
        for instance in placed.node.all("instance_camera"):
            camera = document.find(instance.attributes.get("url", ""), "camera")
            shape = None if camera is None else camera.child("optics", "technique_common", "perspective")
            found = None if shape is None else camera_at(placed.matrix, _vertical(document, shape))
            if found is not None:
                return found
    return None


def _vertical(document: Collada, shape: Node) -> float:
    """The vertical field of view in radians."""
    height, width = (document.float_of(shape.child(tag), math.nan) for tag in ("yfov", "xfov"))
    aspect = document.float_of(shape.child("aspect_ratio"), ASPECT)
    if not math.isnan(height):
        return math.radians(height)
    return float(2.0 * np.arctan(np.tan(math.radians(width) / 2.0) / aspect)) if aspect > 0.0 else math.nan
