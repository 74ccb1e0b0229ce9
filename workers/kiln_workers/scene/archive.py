"""A parsed scene as bytes, for the way from the prepare task to the render tasks, and the hash that seeds them.

`unpack_scene` trusts nothing: shapes, index ranges and finite numbers are checked again, since a blob may come from
anybody who holds a worker's token. `scene_hash` covers what the light depends on and neither names nor notes.
"""

import hashlib
from collections.abc import Iterable
from dataclasses import asdict, replace
from typing import Any, Final

import numpy as np
from pydantic import BaseModel, Field, FiniteFloat, TypeAdapter, ValidationError

from kiln_schemas.errors import InputError
from kiln_workers.scene.container import Array, chunks, pack, unpack
from kiln_workers.scene.limits import MAX_UV_SETS
from kiln_workers.scene.model import Environment, Image, Material, Mesh, PunctualLight, Scene

KIND: Final = "scene"
MATERIALS: Final = TypeAdapter(list[Material])
LIGHTS: Final = TypeAdapter(list[PunctualLight])


class _MeshEntry(BaseModel):
    name: str
    material: int
    more_uv: int = Field(default=0, ge=0, le=MAX_UV_SETS)


class _ImageEntry(BaseModel):
    name: str
    srgb: bool


class _EnvironmentEntry(BaseModel):
    scale: float
    rotation_deg: float


class _Body(BaseModel):
    meshes: list[_MeshEntry]
    images: list[_ImageEntry]
    environment: _EnvironmentEntry | None
    notes: list[str]
    origin: tuple[FiniteFloat, FiniteFloat, FiniteFloat]


def pack_scene(scene: Scene) -> bytes:
    """The scene as bytes; the same scene gives the same bytes."""
    return pack(KIND, *_parts(scene))


def unpack_scene(data: bytes) -> Scene:
    """The scene of `pack_scene`'s bytes, arrays read-only; InputError if they are anything else."""
    body, arrays = unpack(KIND, data)
    try:
        entries = _Body.model_validate(body)
        materials = MATERIALS.validate_python(body.get("materials"))
        lights = LIGHTS.validate_python(body.get("lights"))
    except ValidationError as error:
        first = error.errors()[0]
        raise _broken(f"{'.'.join(str(part) for part in first['loc'])}: {first['msg']}") from None
    images = tuple(
        Image(entry.name, _image_pixels(arrays, f"image{i}"), entry.srgb) for i, entry in enumerate(entries.images)
    )
    environment = None
    if entries.environment is not None:
        pixels = _floats(arrays, "environment", (None, None, 3))
        environment = Environment(pixels, entries.environment.scale, entries.environment.rotation_deg)
    scene = Scene(
        meshes=tuple(_mesh(arrays, i, entry) for i, entry in enumerate(entries.meshes)),
        materials=tuple(materials),
        images=images,
        lights=tuple(lights),
        environment=environment,
        notes=tuple(entries.notes),
        origin=entries.origin,
    )
    _check_references(scene)
    return scene


def scene_hash(scene: Scene, settings: BaseModel | None = None) -> str:
    """sha256 over all that the light depends on: geometry, light-map UV, materials, textures, lights, environment.

    Names, notes and the origin are left out. `settings`, where given, are hashed with it.
    """
    bare = replace(
        scene,
        meshes=tuple(replace(mesh, name="") for mesh in scene.meshes),
        materials=tuple(replace(material, name="") for material in scene.materials),
        images=tuple(replace(image, name="") for image in scene.images),
        lights=tuple(replace(light, name="") for light in scene.lights),
        notes=(),
        origin=(0.0, 0.0, 0.0),
    )
    digest = hashlib.sha256()
    for piece in chunks(KIND, *_parts(bare)):
        digest.update(piece)
    if settings is not None:
        digest.update(settings.model_dump_json().encode())
    return digest.hexdigest()


def _parts(scene: Scene) -> tuple[dict[str, Any], dict[str, Array]]:
    arrays: dict[str, Array] = {}
    for i, mesh in enumerate(scene.meshes):
        arrays[f"mesh{i}.positions"] = mesh.positions
        arrays[f"mesh{i}.normals"] = mesh.normals
        arrays[f"mesh{i}.faces"] = mesh.faces
        if mesh.uv is not None:
            arrays[f"mesh{i}.uv"] = mesh.uv
        if mesh.lightmap_uv is not None:
            arrays[f"mesh{i}.lightmap_uv"] = mesh.lightmap_uv
        if mesh.colors is not None:
            arrays[f"mesh{i}.colors"] = mesh.colors
        if mesh.tangents is not None:
            arrays[f"mesh{i}.tangents"] = mesh.tangents
        arrays |= {f"mesh{i}.uv{number}": values for number, values in enumerate(mesh.more_uv, start=1)}
    for i, image in enumerate(scene.images):
        arrays[f"image{i}"] = image.pixels
    environment = None
    if scene.environment is not None:
        arrays["environment"] = scene.environment.pixels
        environment = {
            "scale": float(scene.environment.scale),
            "rotation_deg": float(scene.environment.rotation_deg),
        }
    body = {
        "meshes": [
            {"name": mesh.name, "material": mesh.material, "more_uv": len(mesh.more_uv)} for mesh in scene.meshes
        ],
        "materials": [asdict(material) for material in scene.materials],
        "images": [{"name": image.name, "srgb": image.srgb} for image in scene.images],
        "lights": [asdict(light) for light in scene.lights],
        "environment": environment,
        "notes": list(scene.notes),
        "origin": list(scene.origin),
    }
    return body, arrays


def _mesh(arrays: dict[str, Array], index: int, entry: _MeshEntry) -> Mesh:
    key = f"mesh{index}"
    positions = _floats(arrays, f"{key}.positions", (None, 3))
    count = len(positions)
    faces = _array(arrays, f"{key}.faces", (None, 3), "<i4")
    if faces.size and (faces.min() < 0 or faces.max() >= count):
        raise _broken(f"{key}.faces names vertices that are not there")
    return Mesh(
        name=entry.name,
        positions=positions,
        normals=_floats(arrays, f"{key}.normals", (count, 3)),
        faces=faces,
        material=entry.material,
        uv=_floats(arrays, f"{key}.uv", (count, 2)) if f"{key}.uv" in arrays else None,
        lightmap_uv=_floats(arrays, f"{key}.lightmap_uv", (count, 2)) if f"{key}.lightmap_uv" in arrays else None,
        more_uv=tuple(_floats(arrays, f"{key}.uv{number}", (count, 2)) for number in range(1, 1 + entry.more_uv)),
        colors=_floats(arrays, f"{key}.colors", (count, 4)) if f"{key}.colors" in arrays else None,
        tangents=_floats(arrays, f"{key}.tangents", (count, 4)) if f"{key}.tangents" in arrays else None,
    )


def _check_references(scene: Scene) -> None:
    _check_range("a mesh's material", (mesh.material for mesh in scene.meshes), len(scene.materials))
    references = [reference for material in scene.materials for reference in material.textures]
    _check_range("a texture's image", (reference.image for reference in references), len(scene.images))
    _check_range("a texture's UV set", (reference.uv_set for reference in references), MAX_UV_SETS)


def _check_range(what: str, values: Iterable[int], count: int) -> None:
    for value in values:
        if not 0 <= value < count:
            raise _broken(f"{what} is {value} of {count}")


def _image_pixels(arrays: dict[str, Array], name: str) -> Array:
    pixels = _array(arrays, name, (None, None, None), None)
    if pixels.dtype.str not in ("|u1", "<f4") or not 1 <= pixels.shape[2] <= 4 or pixels.size == 0:
        raise _broken(f"{name} is no image")
    return pixels


def _floats(arrays: dict[str, Array], name: str, shape: tuple[int | None, ...]) -> Array:
    array = _array(arrays, name, shape, "<f4")
    if not np.isfinite(array).all():
        raise _broken(f"{name} holds values that are not finite")
    return array


def _array(arrays: dict[str, Array], name: str, shape: tuple[int | None, ...], dtype: str | None) -> Array:
    array = arrays.get(name)
    if array is None:
        raise _broken(f"{name} is missing")
    fits = len(array.shape) == len(shape) and all(b is None or a == b for a, b in zip(array.shape, shape, strict=True))
    if not fits or (dtype is not None and array.dtype.str != dtype):
        raise _broken(f"{name} has shape {array.shape} and type {array.dtype}")
    return array


def _broken(detail: str) -> InputError:
    return InputError(f"the bytes are not a scene: {detail}", where=KIND, remedy="Run the prepare task again.")
