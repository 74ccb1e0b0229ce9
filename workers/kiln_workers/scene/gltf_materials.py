"""Materials, textures and images of a glTF file as the scene model has them; only what a mesh uses is read.

One image may be used as colour (sRGB) and as data (linear); it is then kept twice. The UV sets that a material's
textures use are numbered in the order of their first use. Colours of 16-bit images are linearised here, since the
model's float images are linear. Extensions: docs/scene-input.md says what each becomes.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np

from kiln_schemas.errors import InputError
from kiln_schemas.text import told
from kiln_workers.scene.gltf_buffers import GltfBuffers
from kiln_workers.scene.gltf_document import (
    Clearcoat,
    Document,
    EmissiveStrength,
    Ior,
    MaterialPart,
    P,
    Specular,
    SpecularGlossiness,
    TextureInfo,
    TextureSource,
    TextureTransform,
    Transmission,
    parse_extension,
    pick,
)
from kiln_workers.scene.images import LOW_RANGE, decode_image, linear_pixels, linearised
from kiln_workers.scene.limits import MAX_IMAGE_BYTES, MAX_UV_SETS, NAME_LENGTH, check_count
from kiln_workers.scene.model import Image, Material, TextureRef

WRAP: Final = {10497: "repeat", 33071: "clamp", 33648: "mirror"}
DEFAULT_MATERIAL: Final = MaterialPart(name="default")
READ_BY_MATERIALS: Final = frozenset(
    {
        "KHR_materials_clearcoat",
        "KHR_materials_emissive_strength",
        "KHR_materials_ior",
        "KHR_materials_pbrSpecularGlossiness",
        "KHR_materials_specular",
        "KHR_materials_transmission",
        "KHR_materials_unlit",
    }
)
SOURCES: Final = ("KHR_texture_basisu", "EXT_texture_webp")
"""Extensions that name a texture's image; they go before its own `source`, which is for readers without them."""

INFINITE_IOR: Final = 1e9
"""KHR_materials_ior: 0 stands for a reflectance of 1."""


@dataclass
class MaterialTable:
    """Materials in the order of first use, and the images that they need."""

    document: Document
    buffers: GltfBuffers
    notes: list[str]
    materials: list[Material] = field(default_factory=list)
    images: list[Image] = field(default_factory=list)
    _known: dict[int | None, tuple[int, list[int]]] = field(default_factory=dict)
    _image_index: dict[tuple[int, bool], int] = field(default_factory=dict)

    def use(self, index: int | None, mesh: str) -> tuple[int, list[int]]:
        """Position in `materials` of the document's material `index`, and the TEXCOORD sets that it reads, in order."""
        if index not in self._known:
            where = f"mesh '{mesh}'"
            part = DEFAULT_MATERIAL if index is None else pick(self.document.materials, index, "material", where)
            sets: list[int] = []
            material = _Conversion(self, part, part.name or f"material {index}", sets).material()
            self._known[index] = (len(self.materials), sets or [0])
            self.materials.append(material)
        return self._known[index]

    def image(self, index: int, srgb: bool, where: str) -> int:
        """Position in `images` of the document's image `index`, read as colour or as data."""
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


@dataclass
class _Conversion:
    """One material on its way into the model; `sets` collects the TEXCOORD sets that its textures use."""

    table: MaterialTable
    part: MaterialPart
    name: str
    sets: list[int]

    def material(self) -> Material:
        part, pbr = self.part, self.part.pbr_metallic_roughness
        self._note_ignored()
        strength = self._extension(EmissiveStrength, "KHR_materials_emissive_strength").emissive_strength
        red, green, blue = (factor * strength for factor in part.emissive_factor)
        out = Material(
            name=self.name,
            base_color=pbr.base_color_factor,
            base_color_texture=self._texture(pbr.base_color_texture, True),
            metallic=pbr.metallic_factor,
            roughness=pbr.roughness_factor,
            metallic_roughness_texture=self._texture(pbr.metallic_roughness_texture, False),
            emission=(red, green, blue),
            emission_texture=self._texture(part.emissive_texture, True) if max(red, green, blue) > 0 else None,
            double_sided=part.double_sided,
            alpha_cutoff=part.alpha_cutoff if part.alpha_mode == "MASK" else None,
            blend=part.alpha_mode == "BLEND",
            ior=self._extension(Ior, "KHR_materials_ior").ior or INFINITE_IOR,
            normal_texture=self._texture(part.normal_texture, False),
            normal_scale=1.0 if part.normal_texture is None else part.normal_texture.scale,
            occlusion_texture=self._texture(part.occlusion_texture, False),
            occlusion_strength=1.0 if part.occlusion_texture is None else part.occlusion_texture.strength,
        )
        return self._with_glossiness(self._with_layers(out))

    def _with_layers(self, material: Material) -> Material:
        """Transmission, specular and clearcoat; textures of the last two are taken by their mean, with a note."""
        transmission = self._extension(Transmission, "KHR_materials_transmission")
        if transmission.transmission_factor > 0.0:
            material = replace(
                material,
                transmission=transmission.transmission_factor,
                transmission_texture=self._texture(transmission.transmission_texture, False),
            )
        specular = self._extension(Specular, "KHR_materials_specular")
        red, green, blue = self._mean(specular.specular_color_texture, True, "specular colour")[:3]
        factor = specular.specular_color_factor
        coat = self._extension(Clearcoat, "KHR_materials_clearcoat")
        return replace(
            material,
            specular=specular.specular_factor * self._mean(specular.specular_texture, False, "specular")[3],
            specular_color=(factor[0] * red, factor[1] * green, factor[2] * blue),
            clearcoat=coat.clearcoat_factor * self._mean(coat.clearcoat_texture, False, "clearcoat")[0],
        )

    def _with_glossiness(self, material: Material) -> Material:
        """KHR_materials_pbrSpecularGlossiness in the place of metallic-roughness."""
        if "KHR_materials_pbrSpecularGlossiness" not in self.part.extensions:
            return material
        old = self._extension(SpecularGlossiness, "KHR_materials_pbrSpecularGlossiness")
        mean = self._mean(old.specular_glossiness_texture, True, "specular and glossiness")
        red, green, blue = (factor * part / 0.04 for factor, part in zip(old.specular_factor, mean[:3], strict=True))
        return replace(
            material,
            base_color=old.diffuse_factor,
            base_color_texture=self._texture(old.diffuse_texture, True),
            metallic=0.0,
            metallic_roughness_texture=None,
            roughness=1.0 - old.glossiness_factor * mean[3],
            specular_color=(red, green, blue),
        )

    def _note_ignored(self) -> None:
        part, notes = self.part, self.table.notes
        if "KHR_materials_unlit" in part.extensions:
            notes.append(f"Material '{self.name}': unlit; baked as a lit surface of its base colour.")
        for extension in sorted(set(part.extensions) - READ_BY_MATERIALS):
            notes.append(f"Material '{self.name}': {told(extension, NAME_LENGTH)} ignored.")

    def _extension(self, model: type[P], name: str) -> P:
        return parse_extension(model, self.part.extensions.get(name, {}), self._where)

    @property
    def _where(self) -> str:
        return f"material '{self.name}'"

    def _texture(self, info: TextureInfo | None, srgb: bool) -> TextureRef | None:
        if info is None:
            return None
        document, where = self.table.document, self._where
        texture = pick(document.textures, info.index, "texture", where)
        found = next((texture.extensions[name] for name in SOURCES if name in texture.extensions), None)
        source = texture.source if found is None else parse_extension(TextureSource, found, where).source
        if source is None:
            only = told(", ".join(sorted(texture.extensions)), NAME_LENGTH) or "nothing"
            raise InputError(
                f"texture {info.index} has no image that is read ({only} instead)",
                where=where,
                remedy="Export textures as PNG, JPEG, WebP or KTX2 with Basis Universal.",
            )
        wrap = (10497, 10497)
        if texture.sampler is not None:
            sampler = pick(document.samplers, texture.sampler, "sampler", where)
            wrap = (sampler.wrap_s, sampler.wrap_t)
        transform = parse_extension(TextureTransform, info.extensions.get("KHR_texture_transform", {}), where)
        return TextureRef(
            image=self.table.image(source, srgb, where),
            wrap=(WRAP[wrap[0]], WRAP[wrap[1]]),
            offset=transform.offset,
            scale=transform.scale,
            rotation=transform.rotation,
            uv_set=self._uv_set(info.tex_coord if transform.tex_coord is None else transform.tex_coord),
        )

    def _uv_set(self, number: int) -> int:
        """The place of TEXCOORD_`number` among the sets that the material uses."""
        if number not in self.sets:
            check_count(len(self.sets) + 1, MAX_UV_SETS, "UV sets in its textures", self._where)
            self.sets.append(number)
        return self.sets.index(number)

    def _mean(self, info: TextureInfo | None, srgb: bool, what: str) -> tuple[float, float, float, float]:
        """The mean linear RGBA of a texture that stands for all of it; ones where there is none."""
        sets = list(self.sets)
        reference = self._texture(info, srgb)
        self.sets[:] = sets
        if reference is None:
            return 1.0, 1.0, 1.0, 1.0
        self.table.notes.append(f"Material '{self.name}': its {what} texture is replaced by its mean.")
        red, green, blue, alpha = linear_pixels(self.table.images[reference.image]).mean(axis=(0, 1), dtype=np.float64)
        return float(red), float(green), float(blue), float(alpha)


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
