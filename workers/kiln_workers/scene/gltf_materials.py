"""Materials, textures and images of a glTF file as the scene model has them; only what a mesh uses is read.

One image may be used as colour (sRGB) and as data (linear); it is then kept twice. The model has one UV set a mesh, so
where a material's textures use several sets the base colour's wins, with a note. Colours of 16-bit images
are linearised here, since the model's float images are linear.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np

from kiln_schemas.errors import InputError
from kiln_schemas.text import told
from kiln_workers.scene.gltf_buffers import GltfBuffers
from kiln_workers.scene.gltf_document import (
    Document,
    EmissiveStrength,
    MaterialPart,
    TextureInfo,
    TextureTransform,
    parse_extension,
    pick,
)
from kiln_workers.scene.images import LOW_RANGE, decode_image
from kiln_workers.scene.limits import MAX_IMAGE_BYTES, NAME_LENGTH
from kiln_workers.scene.model import Float32, Image, Material, TextureRef

WRAP: Final = {10497: "repeat", 33071: "clamp", 33648: "mirror"}
DEFAULT_MATERIAL: Final = MaterialPart(name="default")
READ_BY_MATERIALS: Final = frozenset({"KHR_materials_emissive_strength", "KHR_materials_unlit"})


@dataclass
class MaterialTable:
    """Materials in the order of first use, and the images that they need."""

    document: Document
    buffers: GltfBuffers
    notes: list[str]
    materials: list[Material] = field(default_factory=list)
    images: list[Image] = field(default_factory=list)
    _known: dict[int | None, tuple[int, int]] = field(default_factory=dict)
    _image_index: dict[tuple[int, bool], int] = field(default_factory=dict)

    def use(self, index: int | None, mesh: str) -> tuple[int, int]:
        """Position in `materials` of the document's material `index`, and the TEXCOORD set that it reads."""
        if index not in self._known:
            where = f"mesh '{mesh}'"
            part = DEFAULT_MATERIAL if index is None else pick(self.document.materials, index, "material", where)
            name = part.name or f"material {index}"
            material, uv_set = self._convert(part, name)
            self._known[index] = (len(self.materials), uv_set)
            self.materials.append(material)
        return self._known[index]

    def _convert(self, part: MaterialPart, name: str) -> tuple[Material, int]:
        pbr = part.pbr_metallic_roughness
        where = f"material '{name}'"
        strength = parse_extension(
            EmissiveStrength, part.extensions.get("KHR_materials_emissive_strength", {}), where
        ).emissive_strength
        self._note_ignored(part, name)
        used = [pbr.base_color_texture, pbr.metallic_roughness_texture, part.emissive_texture]
        sets = [_uv_set(info, where) for info in used if info is not None]
        if len(set(sets)) > 1:
            self.notes.append(
                f"Material '{name}': its textures use several UV sets; TEXCOORD_{sets[0]} is used for all."
            )
        if part.alpha_mode == "BLEND":
            self.notes.append(f"Material '{name}': blended transparency is baked as a cut-out at alpha 0.5.")
        cutoff = {"OPAQUE": None, "MASK": part.alpha_cutoff, "BLEND": 0.5}[part.alpha_mode]
        red, green, blue = (factor * strength for factor in part.emissive_factor)
        material = Material(
            name=name,
            base_color=pbr.base_color_factor,
            base_color_texture=self._texture(pbr.base_color_texture, True, where),
            metallic=pbr.metallic_factor,
            roughness=pbr.roughness_factor,
            metallic_roughness_texture=self._texture(pbr.metallic_roughness_texture, False, where),
            emission=(red, green, blue),
            emission_texture=self._texture(part.emissive_texture, True, where) if max(red, green, blue) > 0 else None,
            double_sided=part.double_sided,
            alpha_cutoff=cutoff,
        )
        return material, sets[0] if sets else 0

    def _note_ignored(self, part: MaterialPart, name: str) -> None:
        if part.normal_texture is not None:
            self.notes.append(f"Material '{name}': its normal map is not baked.")
        if "KHR_materials_unlit" in part.extensions:
            self.notes.append(f"Material '{name}': unlit; baked as a lit surface of its base colour.")
        for extension in sorted(set(part.extensions) - READ_BY_MATERIALS):
            self.notes.append(f"Material '{name}': {told(extension, NAME_LENGTH)} ignored.")

    def _texture(self, info: TextureInfo | None, srgb: bool, where: str) -> TextureRef | None:
        if info is None:
            return None
        texture = pick(self.document.textures, info.index, "texture", where)
        if texture.source is None:
            only = told(", ".join(sorted(texture.extensions)), NAME_LENGTH) or "nothing"
            raise InputError(
                f"texture {info.index} has no PNG or JPEG source ({only} instead)",
                where=where,
                remedy="Export textures as PNG or JPEG.",
            )
        wrap = (10497, 10497)
        if texture.sampler is not None:
            sampler = pick(self.document.samplers, texture.sampler, "sampler", where)
            wrap = (sampler.wrap_s, sampler.wrap_t)
        transform = parse_extension(TextureTransform, _transform(info), where)
        return TextureRef(
            image=self._image(texture.source, srgb, where),
            wrap=(WRAP[wrap[0]], WRAP[wrap[1]]),
            offset=transform.offset,
            scale=transform.scale,
            rotation=transform.rotation,
        )

    def _image(self, index: int, srgb: bool, where: str) -> int:
        key = (index, srgb)
        if key not in self._image_index:
            part = pick(self.document.images, index, "image", where)
            file = part.uri if part.uri and not part.uri.startswith("data:") else ""
            name = part.name or file or f"image {index}"
            if part.uri is not None:
                data: bytes | memoryview = self.buffers.file(part.uri, "texture")
            elif part.buffer_view is not None:
                data = self.buffers.view(part.buffer_view)
            else:
                raise InputError(f"image {index} has neither a URI nor a buffer view", where=where)
            self._image_index[key] = len(self.images)
            self.images.append(make_image(bytes(data), name, srgb, f"{where}, texture '{name}'", self.images))
        return self._image_index[key]


def make_image(data: bytes, name: str, srgb: bool, where: str, others: Sequence[Image]) -> Image:
    """Decode a texture: 8-bit images stay as stored, all others become linear floats; `others` are there already."""
    decoded = decode_image(data, where, MAX_IMAGE_BYTES - sum(other.pixels.nbytes for other in others))
    if decoded.pixels.dtype == np.uint8:
        return Image(name, decoded.pixels, srgb)
    pixels = np.asarray(decoded.pixels, dtype=np.float32)
    if not np.isfinite(pixels).all():
        raise InputError("holds values that are not finite", where=where, remedy="Save it again.")
    encoded = srgb and decoded.format in LOW_RANGE
    return Image(name, linearised(pixels) if encoded else pixels, srgb=False)


def linearised(pixels: Float32) -> Float32:
    """sRGB-encoded [H, W, C] to linear (IEC 61966-2-1); a second or fourth channel is alpha and stays."""
    colours = pixels.shape[2] - (pixels.shape[2] + 1) % 2
    out = pixels.copy()
    part = pixels[..., :colours]
    out[..., :colours] = np.where(part <= 0.04045, part / 12.92, ((part + 0.055) / 1.055) ** 2.4)
    return out


def _uv_set(info: TextureInfo, where: str) -> int:
    override = parse_extension(TextureTransform, _transform(info), where).tex_coord
    return info.tex_coord if override is None else override


def _transform(info: TextureInfo) -> dict[str, Any]:
    return info.extensions.get("KHR_texture_transform", {})
