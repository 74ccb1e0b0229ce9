"""The camera that a scene file's author looks from, where the file has one and its format is read for it."""

from collections.abc import Callable, Mapping
from pathlib import PurePosixPath
from typing import Final

from kiln_schemas.camera import Camera
from kiln_workers.scene.collada_camera import collada_camera
from kiln_workers.scene.fbx_camera import fbx_camera
from kiln_workers.scene.gltf_camera import gltf_camera

CAMERAS: Final[Mapping[str, Callable[[bytes, str], Camera | None]]] = {
    ".glb": gltf_camera,
    ".gltf": gltf_camera,
    ".dae": collada_camera,
    ".fbx": fbx_camera,
}


def file_camera(data: bytes, entry: str) -> Camera | None:
    """The first perspective camera of a scene file in world space; None where it has none."""
    reader = CAMERAS.get(PurePosixPath(entry).suffix.lower())
    return None if reader is None else reader(data, entry)
