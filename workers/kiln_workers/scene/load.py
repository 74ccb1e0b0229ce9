"""One door for scenes: the reader is chosen by the entry's suffix, the environment is added, and the whole is checked.

glTF and GLB are the main format; OBJ, PLY, STL, OFF, Collada, FBX and Mitsuba XML become the same model.
"""

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path, PurePosixPath
from typing import Final

from kiln_schemas.errors import InputError
from kiln_schemas.formats import CONVERTERS
from kiln_schemas.tasks import EnvironmentRef
from kiln_workers.scene.collada import read_collada
from kiln_workers.scene.environment import load_environment
from kiln_workers.scene.fbx import read_fbx
from kiln_workers.scene.gltf import read_gltf
from kiln_workers.scene.limits import READING_S, deadline
from kiln_workers.scene.mitsuba_xml import read_mitsuba_xml
from kiln_workers.scene.model import Scene
from kiln_workers.scene.obj import read_obj
from kiln_workers.scene.origin import about_own_centre
from kiln_workers.scene.ply import read_ply
from kiln_workers.scene.solids import read_off, read_stl
from kiln_workers.scene.tangents import with_tangents

READERS: Final[Mapping[str, Callable[[Path, str], Scene]]] = {
    ".gltf": read_gltf,
    ".glb": read_gltf,
    ".obj": read_obj,
    ".ply": read_ply,
    ".xml": read_mitsuba_xml,
    ".stl": read_stl,
    ".off": read_off,
    ".dae": read_collada,
    ".fbx": read_fbx,
}


def load_scene(folder: Path, entry: str, environment: EnvironmentRef | None = None) -> Scene:
    """The scene `entry` of the bundle in `folder` under `environment`; InputError says what is wrong with it."""
    reader = READERS.get(PurePosixPath(entry).suffix.lower())
    if reader is None:
        suffix = PurePosixPath(entry).suffix
        remedy = CONVERTERS.get(suffix.lower(), f"Use one of {', '.join(READERS)}.")
        raise InputError(f"'{suffix}' is not a scene format that is read", where=entry, remedy=remedy)
    with deadline(READING_S, entry, "read", "Simplify it, or save it as GLB."):
        return _read(reader, folder, entry, environment)


def _read(reader: Callable[[Path, str], Scene], folder: Path, entry: str, environment: EnvironmentRef | None) -> Scene:
    scene = with_tangents(about_own_centre(reader(folder, entry)))
    if not scene.triangles:
        raise InputError("has no faces", where=entry, remedy="Export at least one mesh with triangles of some area.")
    if environment is None:
        return scene
    loaded, notes = load_environment(folder, environment, entry)
    if scene.environment is not None:
        notes = [f"'{entry}': its own environment is replaced by '{environment.file}'.", *notes]
    return replace(scene, environment=loaded, notes=(*scene.notes, *notes))


def check_light(scene: Scene) -> Scene:
    """The scene unchanged if anything in it emits; InputError otherwise (the prepare task asks this)."""
    if not scene.has_light:
        raise InputError(
            "nothing in the scene emits light",
            where="scene",
            remedy="Add an environment (--env), an emissive material or a light.",
        )
    return scene
