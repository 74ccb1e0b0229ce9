"""The first perspective camera of an FBX file, in world space; it looks along +X of its node, +Y is up."""

import math

import numpy as np

from kiln_schemas.camera import Camera
from kiln_workers.scene.fbx import parse_fbx
from kiln_workers.scene.gltf_camera import camera_at


def fbx_camera(data: bytes, entry: str) -> Camera | None:
    """The camera, its target 1 m before it; None where the file has none."""
    body, _ = parse_fbx(data, entry)
    for node in body["nodes"]:
        camera = body["cameras"][node["camera"]] if node["camera"] >= 0 else None
        if camera is None or not camera["perspective"]:
            continue
        matrix = np.array(node["node_to_world"]).reshape(4, 4)
        x, y, z = matrix[:, 0].copy(), matrix[:, 1].copy(), matrix[:, 2].copy()
        matrix[:, 0], matrix[:, 1], matrix[:, 2] = z, y, -x
        found = camera_at(matrix, math.radians(camera["fov"]))
        if found is not None:
            return found
    return None
