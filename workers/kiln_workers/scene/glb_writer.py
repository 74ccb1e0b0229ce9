"""Writes a scene of the model as a GLB file: meshes in world space with both UV sets, materials, emission.

For the bundled examples. Textures, punctual lights and the environment are not written; a scene that has textures or
lights is refused rather than written without them. Files pass the Khronos validator: accessors have bounds, buffer
views have targets, and everything is aligned to four bytes.
"""

import struct
from typing import Final

import numpy as np
import pygltflib as gl

from kiln_workers.scene.container import Array
from kiln_workers.scene.model import Material, Scene

EMISSIVE_STRENGTH: Final = "KHR_materials_emissive_strength"
TYPES: Final = {1: "SCALAR", 2: "VEC2", 3: "VEC3"}


def glb_bytes(scene: Scene, generator: str) -> bytes:
    """The GLB file of a scene without textures and punctual lights."""
    if scene.images or scene.lights:
        raise ValueError("textures and punctual lights are not written")
    document = gl.GLTF2(asset=gl.Asset(version="2.0", generator=generator), scene=0)
    document.scenes = [gl.Scene(nodes=list(range(len(scene.meshes))))]
    document.materials = [_material(material) for material in scene.materials]
    if any(max(material.emission) > 1.0 for material in scene.materials):
        document.extensionsUsed = [EMISSIVE_STRENGTH]
    binary = bytearray()
    for index, mesh in enumerate(scene.meshes):
        attributes = gl.Attributes(
            POSITION=_append(document, binary, mesh.positions, gl.ARRAY_BUFFER, bounds=True),
            NORMAL=_append(document, binary, mesh.normals, gl.ARRAY_BUFFER),
        )
        if mesh.uv is not None:
            attributes.TEXCOORD_0 = _append(document, binary, mesh.uv, gl.ARRAY_BUFFER)
        if mesh.lightmap_uv is not None:
            attributes.TEXCOORD_1 = _append(document, binary, mesh.lightmap_uv, gl.ARRAY_BUFFER)
        wide = len(mesh.positions) > 65535
        faces = mesh.faces.reshape(-1, 1).astype(np.uint32 if wide else np.uint16)
        primitive = gl.Primitive(
            attributes=attributes,
            indices=_append(document, binary, faces, gl.ELEMENT_ARRAY_BUFFER),
            material=mesh.material,
        )
        document.meshes.append(gl.Mesh(name=mesh.name, primitives=[primitive]))
        document.nodes.append(gl.Node(name=mesh.name, mesh=index))
    document.buffers = [gl.Buffer(byteLength=len(binary))]
    return _container(document.to_json(separators=(",", ":"), indent=None).encode(), bytes(binary))


def _append(document: gl.GLTF2, binary: bytearray, values: Array, target: int, bounds: bool = False) -> int:
    data = np.ascontiguousarray(values).tobytes()
    document.bufferViews.append(gl.BufferView(buffer=0, byteOffset=len(binary), byteLength=len(data), target=target))
    binary += data + b"\0" * (-len(data) % 4)
    component = {"f": gl.FLOAT, "u": gl.UNSIGNED_INT if values.itemsize == 4 else gl.UNSIGNED_SHORT}[values.dtype.kind]
    accessor = gl.Accessor(
        bufferView=len(document.bufferViews) - 1,
        componentType=component,
        count=len(values),
        type=TYPES[values.shape[1]],
    )
    if bounds:
        accessor.min = [float(x) for x in values.min(axis=0)]
        accessor.max = [float(x) for x in values.max(axis=0)]
    document.accessors.append(accessor)
    return len(document.accessors) - 1


def _material(material: Material) -> gl.Material:
    strength = max(*material.emission, 1.0)
    out = gl.Material(
        name=material.name,
        pbrMetallicRoughness=gl.PbrMetallicRoughness(
            baseColorFactor=list(material.base_color),
            metallicFactor=material.metallic,
            roughnessFactor=material.roughness,
        ),
        emissiveFactor=[channel / strength for channel in material.emission],
        doubleSided=material.double_sided,
    )
    out.alphaCutoff = None
    if strength > 1.0:
        out.extensions = {EMISSIVE_STRENGTH: {"emissiveStrength": strength}}
    return out


def _container(text: bytes, binary: bytes) -> bytes:
    text += b" " * (-len(text) % 4)
    parts = struct.pack("<II", len(text), 0x4E4F534A) + text + struct.pack("<II", len(binary), 0x004E4942) + binary
    return b"glTF" + struct.pack("<II", 2, 12 + len(parts)) + parts
