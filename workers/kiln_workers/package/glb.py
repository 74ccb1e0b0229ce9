"""`scene.glb`: the baked scene as binary glTF 2.0 with the light-map UV set as TEXCOORD_1.

Meshes are already flattened to world space (`scene.model`), so every node is an identity with one mesh, and the
vertices of the GLB are those that were baked. Those of a scene far from the origin are about a point amid it; a node
above all others moves them to where the user had them. Textures are embedded as PNG. The first UV set of the textures
is TEXCOORD_0, further ones are TEXCOORD_2 and so on; vertex colours are COLOR_0, and meshes with a
normal map have TANGENT, the user's or ours. Extensions used:
KHR_texture_transform, KHR_lights_punctual, KHR_materials_emissive_strength, _transmission, _ior, _specular and
_clearcoat; all optional to a reader. Written with pygltflib because trimesh loses TEXCOORD_1.
"""

from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import pygltflib as gltf

from kiln_schemas import __version__
from kiln_schemas.errors import InternalError
from kiln_workers.package import png
from kiln_workers.package.colour import quantise, srgb_decode, srgb_encode
from kiln_workers.scene.model import Image, LightKind, Material, Mesh, PunctualLight, Scene, TextureRef

_WRAP: Final = {"repeat": gltf.REPEAT, "clamp": gltf.CLAMP_TO_EDGE, "mirror": gltf.MIRRORED_REPEAT}
_FLOAT_TYPES: Final = {2: gltf.VEC2, 3: gltf.VEC3, 4: gltf.VEC4}


@dataclass
class _Writer:
    """The document under construction, its binary chunk, and what was already embedded."""

    scene: Scene
    document: gltf.GLTF2 = field(default_factory=gltf.GLTF2)
    blob: bytearray = field(default_factory=bytearray)
    images: dict[tuple[int, bool], tuple[int, float]] = field(default_factory=dict)
    samplers: dict[tuple[str, str], int] = field(default_factory=dict)
    textures: dict[tuple[int, int], int] = field(default_factory=dict)
    extensions: set[str] = field(default_factory=set)

    def view(self, data: bytes, target: int | None = None) -> int:
        """Append bytes to the binary chunk at a multiple of four; the index of their buffer view."""
        self.blob += bytes(-len(self.blob) % 4)
        view = gltf.BufferView(buffer=0, byteOffset=len(self.blob), byteLength=len(data), target=target)
        self.blob += data
        self.document.bufferViews.append(view)
        return len(self.document.bufferViews) - 1

    def vertices(self, values: npt.NDArray[np.float32], *, bounds: bool = False) -> int:
        """The accessor of a vertex attribute [V, 2 to 4]."""
        values = np.ascontiguousarray(values, dtype="<f4")
        accessor = gltf.Accessor(
            bufferView=self.view(values.tobytes(), gltf.ARRAY_BUFFER),
            componentType=gltf.FLOAT,
            count=len(values),
            type=_FLOAT_TYPES[values.shape[1]],
        )
        if bounds:
            accessor.min, accessor.max = values.min(axis=0).tolist(), values.max(axis=0).tolist()
        self.document.accessors.append(accessor)
        return len(self.document.accessors) - 1

    def indices(self, faces: npt.NDArray[np.int32], vertices: int) -> int:
        """The accessor of faces [F, 3]; 16 bits where they suffice (65535 would restart the primitive)."""
        short = vertices < 65535
        values = np.ascontiguousarray(faces.reshape(-1), dtype="<u2" if short else "<u4")
        accessor = gltf.Accessor(
            bufferView=self.view(values.tobytes(), gltf.ELEMENT_ARRAY_BUFFER),
            componentType=gltf.UNSIGNED_SHORT if short else gltf.UNSIGNED_INT,
            count=len(values),
            type=gltf.SCALAR,
        )
        self.document.accessors.append(accessor)
        return len(self.document.accessors) - 1

    def image(self, index: int, colour: bool) -> tuple[int, float]:
        """The embedded image for a use as colour (sRGB) or data (linear), and the factor that it was divided by."""
        key = (index, colour)
        if key not in self.images:
            data, scale = encode_image(self.scene.images[index], colour)
            name = self.scene.images[index].name
            self.document.images.append(gltf.Image(bufferView=self.view(data), mimeType="image/png", name=name))
            self.images[key] = (len(self.document.images) - 1, scale)
        return self.images[key]

    def texture(self, ref: TextureRef, colour: bool) -> tuple[gltf.TextureInfo, float]:
        """A texture lookup, and the factor that the image was divided by."""
        image, scale = self.image(ref.image, colour)
        if ref.wrap not in self.samplers:
            self.document.samplers.append(
                gltf.Sampler(
                    magFilter=gltf.LINEAR,
                    minFilter=gltf.LINEAR_MIPMAP_LINEAR,
                    wrapS=_WRAP[ref.wrap[0]],
                    wrapT=_WRAP[ref.wrap[1]],
                )
            )
            self.samplers[ref.wrap] = len(self.document.samplers) - 1
        key = (image, self.samplers[ref.wrap])
        if key not in self.textures:
            self.document.textures.append(gltf.Texture(source=image, sampler=key[1]))
            self.textures[key] = len(self.document.textures) - 1
        info = gltf.TextureInfo(index=self.textures[key], texCoord=_tex_coord(ref.uv_set))
        transform: dict[str, Any] = {}
        if ref.offset != (0.0, 0.0):
            transform["offset"] = [float(x) for x in ref.offset]
        if ref.scale != (1.0, 1.0):
            transform["scale"] = [float(x) for x in ref.scale]
        if ref.rotation != 0.0:
            transform["rotation"] = float(ref.rotation)
        if transform:
            info.extensions = {"KHR_texture_transform": transform}
            self.extensions.add("KHR_texture_transform")
        return info, scale


def encode_glb(scene: Scene) -> bytes:
    """The scene as GLB bytes; every mesh must have its light-map UV."""
    writer = _Writer(scene)
    document = writer.document
    document.asset = gltf.Asset(version="2.0", generator=f"lightkiln {__version__}")
    for material in scene.materials:
        document.materials.append(_material(writer, material))
    for mesh in scene.meshes:
        document.meshes.append(_mesh(writer, mesh))
        document.nodes.append(gltf.Node(mesh=len(document.meshes) - 1, name=mesh.name))
    if scene.lights:
        document.extensions = {"KHR_lights_punctual": {"lights": [_light(light) for light in scene.lights]}}
        document.nodes += [_light_node(number, light) for number, light in enumerate(scene.lights)]
        writer.extensions.add("KHR_lights_punctual")
    roots = list(range(len(document.nodes)))
    if any(scene.origin):
        document.nodes.append(gltf.Node(name="origin", translation=list(scene.origin), children=roots))
        roots = [len(document.nodes) - 1]
    document.scenes = [gltf.Scene(nodes=roots)]
    document.scene = 0
    document.extensionsUsed = sorted(writer.extensions)
    writer.blob += bytes(-len(writer.blob) % 4)
    document.buffers = [gltf.Buffer(byteLength=len(writer.blob))]
    document.set_binary_blob(bytes(writer.blob))
    return b"".join(document.save_to_bytes())


def encode_image(image: Image, colour: bool) -> tuple[bytes, float]:
    """PNG bytes of an image for use as colour (stored as sRGB) or data (stored linear), and its scale.

    Values above 1, which only float images have, are divided by the scale, their maximum; the caller multiplies it
    back where glTF has a place for it (emissive strength).
    """
    pixels = image.pixels if image.pixels.ndim == 3 else image.pixels[..., None]
    if pixels.dtype == np.uint8 and image.srgb == colour:
        return png.encode(pixels.astype(np.uint8)), 1.0
    values = pixels.astype(np.float64) / (255.0 if pixels.dtype == np.uint8 else 1.0)
    opaque = values.shape[2] - (values.shape[2] + 1) % 2  # channels before the alpha channel, if any
    if image.srgb:
        values[..., :opaque] = srgb_decode(values[..., :opaque])
    scale = max(1.0, float(values[..., :opaque].max(initial=0.0)))
    values[..., :opaque] /= scale
    if colour:
        values[..., :opaque] = srgb_encode(values[..., :opaque])
    return png.encode(quantise(values)), scale


def _material(writer: _Writer, material: Material) -> gltf.Material:
    pbr = gltf.PbrMetallicRoughness(
        metallicFactor=_unit(material.metallic),
        roughnessFactor=_unit(material.roughness),
    )
    base = np.asarray(material.base_color, np.float64)
    if material.base_color_texture is not None:
        pbr.baseColorTexture, scale = writer.texture(material.base_color_texture, colour=True)
        base[:3] *= scale
    pbr.baseColorFactor = [_unit(x) for x in base]
    if material.metallic_roughness_texture is not None:
        pbr.metallicRoughnessTexture, _ = writer.texture(material.metallic_roughness_texture, colour=False)
    out = gltf.Material(name=material.name, pbrMetallicRoughness=pbr, doubleSided=material.double_sided)
    out.alphaMode = gltf.BLEND if material.blend else gltf.OPAQUE if material.alpha_cutoff is None else gltf.MASK
    out.alphaCutoff = None if material.alpha_cutoff is None else max(0.0, float(material.alpha_cutoff))
    emission = np.asarray(material.emission, np.float64)
    if material.emission_texture is not None and emission.max() > 0.0:
        out.emissiveTexture, scale = writer.texture(material.emission_texture, colour=True)
        emission = emission * scale
    strength = max(1.0, float(emission.max()))
    out.emissiveFactor = [_unit(x) for x in emission / strength]
    if material.normal_texture is not None:
        info, _ = writer.texture(material.normal_texture, colour=False)
        out.normalTexture = gltf.NormalMaterialTexture(**vars(info), scale=float(material.normal_scale))
    if material.occlusion_texture is not None:
        info, _ = writer.texture(material.occlusion_texture, colour=False)
        out.occlusionTexture = gltf.OcclusionTextureInfo(**vars(info), strength=_unit(material.occlusion_strength))
    out.extensions = _layers(writer, material)
    if strength > 1.0:
        out.extensions["KHR_materials_emissive_strength"] = {"emissiveStrength": strength}
    writer.extensions |= set(out.extensions)
    return out


def _layers(writer: _Writer, material: Material) -> dict[str, Any]:
    """The extensions of a material whose values are not the core's."""
    out: dict[str, Any] = {}
    if material.transmission > 0.0:
        out["KHR_materials_transmission"] = {"transmissionFactor": _unit(material.transmission)}
        if material.transmission_texture is not None:
            info, _ = writer.texture(material.transmission_texture, colour=False)
            out["KHR_materials_transmission"]["transmissionTexture"] = _plain(info)
    if material.ior != 1.5:
        # The extension writes an infinite index of refraction as 0.
        out["KHR_materials_ior"] = {"ior": 0.0 if material.ior >= 1e9 else float(material.ior)}
    if material.specular != 1.0 or material.specular_color != (1.0, 1.0, 1.0):
        out["KHR_materials_specular"] = {
            "specularFactor": _unit(material.specular),
            "specularColorFactor": [float(x) for x in material.specular_color],
        }
    if material.clearcoat > 0.0:
        out["KHR_materials_clearcoat"] = {"clearcoatFactor": _unit(material.clearcoat)}
    return out


def _plain(info: gltf.TextureInfo) -> dict[str, Any]:
    """A texture look-up inside an extension, which pygltflib takes as plain JSON."""
    out: dict[str, Any] = {"index": info.index, "texCoord": info.texCoord}
    return out | ({"extensions": info.extensions} if info.extensions else {})


def _tex_coord(uv_set: int) -> int:
    """The TEXCOORD of one of the mesh's UV sets; TEXCOORD_1 is the light map's."""
    return 0 if uv_set == 0 else uv_set + 1


def _mesh(writer: _Writer, mesh: Mesh) -> gltf.Mesh:
    if mesh.lightmap_uv is None:
        raise InternalError("the mesh has no light-map UV", where=mesh.name)
    uv = np.zeros_like(mesh.lightmap_uv) if mesh.uv is None else mesh.uv
    attributes = gltf.Attributes(
        POSITION=writer.vertices(mesh.positions, bounds=True),
        NORMAL=writer.vertices(_unit_normals(mesh.normals)),
        TEXCOORD_0=writer.vertices(uv),
        TEXCOORD_1=writer.vertices(mesh.lightmap_uv),
    )
    for number, more in enumerate(mesh.more_uv, start=1):
        setattr(attributes, f"TEXCOORD_{_tex_coord(number)}", writer.vertices(more))
    if mesh.colors is not None:
        attributes.COLOR_0 = writer.vertices(mesh.colors)
    if mesh.tangents is not None:
        attributes.TANGENT = writer.vertices(_unit_tangents(mesh.tangents))
    indices = writer.indices(mesh.faces, len(mesh.positions))
    return gltf.Mesh(
        name=mesh.name,
        primitives=[
            gltf.Primitive(attributes=attributes, indices=indices, material=mesh.material, mode=gltf.TRIANGLES)
        ],
    )


def _light(light: PunctualLight) -> dict[str, Any]:
    """KHR_lights_punctual takes a colour in [0, 1] and one intensity; the scene model has their product."""
    peak = max(light.intensity)
    colour = [x / peak for x in light.intensity] if peak > 0.0 else [1.0, 1.0, 1.0]
    out: dict[str, Any] = {"name": light.name, "type": str(light.kind), "color": colour, "intensity": float(peak)}
    if light.kind is LightKind.SPOT:
        outer = min(max(light.outer_cone, 1e-3), np.pi / 2)
        inner = min(max(light.inner_cone, 0.0), outer * (1.0 - 1e-6))
        out["spot"] = {"innerConeAngle": float(inner), "outerConeAngle": float(outer)}
    return out


def _light_node(number: int, light: PunctualLight) -> gltf.Node:
    node = gltf.Node(name=light.name, translation=[float(x) for x in light.position])
    node.rotation = _rotation_to(np.asarray(light.direction, np.float64))
    node.extensions = {"KHR_lights_punctual": {"light": number}}
    return node


def _rotation_to(direction: npt.NDArray[np.float64]) -> list[float]:
    """The shortest rotation, as a quaternion (x, y, z, w), that turns -Z into `direction`."""
    x, y, z = direction / np.linalg.norm(direction)
    if z > 1.0 - 1e-9:
        return [0.0, 1.0, 0.0, 0.0]
    quaternion = np.array([y, -x, 0.0, 1.0 - z])  # (-Z) x direction, 1 + (-Z).direction
    return [float(c) for c in quaternion / np.linalg.norm(quaternion)]


def _unit_normals(normals: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
    """Normals at unit length to float32 precision, which glTF demands; a normal of length 0 becomes +Y."""
    return np.asarray(_unit_or(normals, (0.0, 1.0, 0.0)), np.float32)


def _unit_tangents(tangents: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
    """Tangents of unit length with a hand of 1 or -1, which glTF demands; a tangent of length 0 becomes +X."""
    hand = np.where(tangents[:, 3:] < 0.0, -1.0, 1.0)
    return np.asarray(np.concatenate([_unit_or(tangents[:, :3], (1.0, 0.0, 0.0)), hand], axis=1), np.float32)


def _unit_or(vectors: npt.NDArray[np.float32], otherwise: tuple[float, float, float]) -> npt.NDArray[np.float64]:
    """The vectors [V, 3] at unit length; `otherwise` in the place of those of length 0."""
    exact = vectors.astype(np.float64)
    length = np.linalg.norm(exact, axis=1, keepdims=True)
    return np.where(length > 0.0, exact / np.where(length > 0.0, length, 1.0), otherwise)


def _unit(value: float) -> float:
    return min(max(float(value), 0.0), 1.0)
