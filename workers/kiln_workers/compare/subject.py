"""What is compared on: a light-field store, the package that was made from it, and the scene that was rendered.

The store holds what solvers are fitted to. Between points are traced afresh, so the scene is needed too: it is read
from the package's `scene.glb` (which keeps the light map's UV) and, where there is one, the environment's file. Store
and package carry the hash of the scene that was baked, and the manifest those of both files. The scene's hash is not
computed anew, because it covers the settings as the version that baked knew them.
"""

import hashlib
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final
from urllib.parse import unquote, urlsplit

from pydantic import ConfigDict

from kiln_schemas.base import Contract
from kiln_schemas.conventions import MANIFEST_JSON, SCENE_GLB
from kiln_schemas.errors import InputError, NotFound
from kiln_schemas.manifest import Manifest
from kiln_schemas.settings import BakeSettings, Function
from kiln_workers.scene.environment import place_environment, read_environment
from kiln_workers.scene.gltf import read_gltf
from kiln_workers.scene.model import Scene
from kiln_workers.scene.origin import about_own_centre
from kiln_workers.shade.package import read_manifest
from kiln_workers.store.light_field import LightFieldStore, open_named

KEPT: Final = ".lightkiln"
"""Folder inside a package's in which `lightkiln bake --keep` leaves its data."""

GROUP: Final = "zarr.json"
KEEP_REMEDY: Final = "Bake it with `lightkiln bake --keep`, or name the store with --store."


class _Record(Contract):
    """What is read of `bake.json`."""

    model_config = ConfigDict(extra="ignore")

    environment: str | None = None


@dataclass(frozen=True)
class Subject:
    """A bake, ready to be compared on."""

    folder: Path
    """The package."""
    manifest: Manifest
    store: LightFieldStore
    scene: Scene

    @property
    def settings(self) -> BakeSettings:
        return self.manifest.settings

    @property
    def exposure(self) -> float:
        """Factor from scene radiance to exposure-normalised radiance, as the bake had it."""
        return self.manifest.exposure[Function.LIGHT_FIELD.value]


def open_subject(named: str, package: Path | None, store: str | None, env: Path | None) -> Subject:
    """The subject that a package folder, a store's folder or a store's URL names; errors say what is missing."""
    folder = package or _package_of(named)
    manifest = read_manifest(folder)
    url = _store_url(named, folder, manifest, store)
    opened = open_named(url)
    if Function.LIGHT_FIELD not in opened.functions:
        raise InputError("the store has no light field", where=url)
    if Function.LIGHT_FIELD.value not in manifest.exposure:
        raise InputError("the package has no light field", where=str(folder), remedy="Bake a scene with light in it.")
    scene = _with_environment(_scene(folder, manifest), folder, manifest, env)
    if manifest.scene_hash != opened.attributes["scene_hash"]:
        raise InputError(
            "the store was rendered from another scene or with other settings",
            where=f"{url} and {folder}",
            remedy="Name the store and the package of the same bake.",
        )
    return Subject(folder, manifest, opened, scene)


def _package_of(named: str) -> Path:
    """The package folder that `named` is, or in which its store was kept."""
    path = _local(named)
    if path is not None and path.is_dir() and not (path / GROUP).is_file():
        return path
    if path is not None and not path.exists():
        raise NotFound(
            "there is no such folder", where=named, remedy="Name a package, a light-field store or a job's id."
        )
    for parent in () if path is None else path.absolute().parents:
        if parent.name == KEPT and (parent.parent / MANIFEST_JSON).is_file():
            return parent.parent
    raise NotFound(
        "the scene of this store is not known: it does not lie in the folder of a package",
        where=named,
        remedy="Name the package of the same bake with --package.",
    )


def _store_url(named: str, folder: Path, manifest: Manifest, store: str | None) -> str:
    """The store: the one named, or that which the bake left."""
    if store is not None:
        local = _local(store)
        return store if local is None else local.absolute().as_uri()
    path = _local(named)
    if path is None:
        return named
    if (path / GROUP).is_file():
        return path.absolute().as_uri()
    kept = folder / KEPT / "store" / f"{manifest.job_id}.zarr"
    if not (kept / GROUP).is_file():
        raise NotFound("the bake's light-field store was not kept", where=str(folder), remedy=KEEP_REMEDY)
    return kept.absolute().as_uri()


def _local(text: str) -> Path | None:
    """The path of a folder or a file:// URL; None for a bucket."""
    if "://" not in text:
        return Path(text)
    parts = urlsplit(text)
    return Path(unquote(parts.path)) if parts.scheme == "file" else None


def _scene(folder: Path, manifest: Manifest) -> Scene:
    """The package's scene, which has to be the file that the manifest names."""
    path = folder / SCENE_GLB
    if not path.is_file():
        raise NotFound("the scene is missing", where=str(path), remedy="Download the package again.")
    wanted = {file.name: file.sha256 for file in manifest.files}.get(SCENE_GLB)
    if hashlib.sha256(path.read_bytes()).hexdigest() != wanted:
        raise InputError("was changed since the bake", where=str(path), remedy="Download the package again.")
    scene = about_own_centre(read_gltf(folder, SCENE_GLB))
    for mesh in scene.meshes:
        if mesh.lightmap_uv is None:
            raise InputError("has no TEXCOORD_1", where=f"{folder / SCENE_GLB}: {mesh.name}")
    return scene


def _with_environment(scene: Scene, folder: Path, manifest: Manifest, env: Path | None) -> Scene:
    """The scene under the environment that the bake had; NotFound where its file cannot be found."""
    wanted = manifest.environment
    if wanted is None:
        return scene
    digest = manifest.inputs[wanted.file]
    for path in _environment_files(folder, wanted.file, digest, env):
        data = path.read_bytes() if path.is_file() else b""
        if hashlib.sha256(data).hexdigest() == digest:
            pixels, _ = read_environment(data, str(path))
            # The manifest does not name the entry; XML places environments in its own way.
            entry = next((name for name in manifest.inputs if name.endswith(".xml")), SCENE_GLB)
            return replace(scene, environment=place_environment(pixels, wanted.scale, wanted.rotation_deg, entry))
    if env is not None:
        raise InputError(f"is not the environment of this bake ({wanted.file})", where=str(env))
    raise NotFound(
        f"the scene's environment ({wanted.file}) is not in the package",
        where=str(folder),
        remedy="Name its file with --env.",
    )


def _environment_files(folder: Path, name: str, digest: str, env: Path | None) -> Iterator[Path]:
    """Where the environment's file may lie."""
    if env is not None:
        yield env
        return
    yield folder / KEPT / "blobs" / digest[:2] / digest
    yield folder / "scene" / name
    record = folder / "bake.json"
    if record.is_file():
        recorded = _Record.model_validate_json(record.read_text(encoding="utf-8")).environment
        if recorded is not None:
            yield Path(recorded)
