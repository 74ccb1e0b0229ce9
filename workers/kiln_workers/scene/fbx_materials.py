"""Materials of an FBX file as ufbx tells them: classic ones (Lambert, Phong) and those of physically based shaders.

Phong's exponent n becomes the roughness 1 - sqrt(n) / 10, as Blender's importer and exporter and ufbx have it. The
opacity of classic materials is 1 less TransparencyFactor times TransparentColor's luminance; where that leaves nothing,
the material is opaque, as its exporter meant the opposite. Colours are linear, as in Blender and FBX2glTF.
"""

from dataclasses import dataclass, field, replace
from typing import Any, Final

import numpy as np

from kiln_schemas.errors import InputError
from kiln_schemas.text import told
from kiln_workers.scene.container import Array
from kiln_workers.scene.limits import MAX_UV_SETS, NAME_LENGTH, check_count
from kiln_workers.scene.model import Material, TextureRef
from kiln_workers.scene.texture_files import Coat, TextureFiles, luminance

LAMBERT, PHONG = 1, 2
"""ufbx' numbers of the classic shaders; 0 is one that it does not know."""
CLASSIC: Final = (0, LAMBERT, PHONG)


@dataclass
class FbxMaterials:
    """Materials in the order of first use."""

    body: dict[str, Any]
    arrays: dict[str, Array]
    files: TextureFiles
    materials: list[Material] = field(default_factory=list)
    _known: dict[int | None, Coat] = field(default_factory=dict)

    def use(self, number: int | None) -> Coat:
        """The material `number` of the file, or the default one."""
        if number not in self._known:
            material, semantics = Material("default"), tuple[str, ...]()
            if number is not None:
                material, semantics = _Conversion(self, self.body["materials"][number]).result()
            self._known[number] = Coat(len(self.materials), semantics)
            self.materials.append(material)
        return self._known[number]


class _Conversion:
    """One material on its way into the model."""

    def __init__(self, table: FbxMaterials, part: dict[str, Any]) -> None:
        self.table = table
        self.part = part
        self.name = told(part["name"], NAME_LENGTH)
        self.semantics: list[str] = []
        self.classic = part["shader"] in CLASSIC

    def result(self) -> tuple[Material, tuple[str, ...]]:
        """The material, and the names of the UV sets that its textures use."""
        base_texture = self._texture("base_color")
        glow_texture = self._texture("emission_color")
        base = self._colour("base_color", 0.8, base_texture is not None, self._number("base_factor", 1.0))
        lost = glow_texture is None and self.part["pbr"]["emission_color"]["texture"] >= 0
        glow = self._colour("emission_color", 0.0, glow_texture is not None, self._number("emission_factor", 1.0))
        metallic, roughness, combined = self._metallic_roughness()
        ior = self._number("specular_ior", 1.5)
        red, green, blue = (min(value, 1.0) for value in base)
        material = Material(
            name=self.name,
            base_color=(red, green, blue, 1.0),
            base_color_texture=base_texture,
            metallic=metallic,
            roughness=roughness,
            metallic_roughness_texture=combined,
            emission=(0.0, 0.0, 0.0) if lost else glow,  # a texture that is not there does not make a lamp
            emission_texture=glow_texture,
            double_sided=self.part["double_sided"],
            normal_texture=self._normal_texture(),
            ior=ior if ior >= 1.0 else 1.5,
            transmission=0.0 if self.classic else min(self._number("transmission_factor", 0.0), 1.0),
            clearcoat=0.0 if self.classic else min(self._number("coat_factor", 0.0), 1.0),
        )
        return self._with_opacity(material), tuple(self.semantics)

    def _metallic_roughness(self) -> tuple[float, float, TextureRef | None]:
        """Metallic, roughness, and both textures as one."""
        if self.classic:
            highlight = self._colour("specular_color", 0.0, False, self._number("specular_factor", 1.0))
            shiny = self.part["shader"] != LAMBERT and max(highlight) > 0.0
            return 0.0, min(self._number("roughness", 1.0), 1.0) if shiny else 1.0, None
        glossy = self.part["glossy"]
        name = "glossiness" if glossy else "roughness"
        rough, metal = self._texture(name, srgb=False), self._texture("metalness", srgb=False)
        value = min(self._number(name, 0.5), 1.0)
        roughness = 1.0 if rough is not None else 1.0 - value if glossy else value
        metallic = 1.0 if metal is not None else min(self._number("metalness", 0.0), 1.0)
        combined = self.table.files.combined(self.name, rough, metal, invert=glossy)
        return metallic, roughness, combined

    def _with_opacity(self, material: Material) -> Material:
        maps = self.part["fbx"] if self.classic else self.part["pbr"]
        names = ("transparency_color", "transparency_factor") if self.classic else ("opacity",)
        for name in names:
            cover = self._map_texture(maps[name], srgb=False)
            if cover is not None:
                by_alpha = self.table.files.images[cover.image].pixels.shape[2] in (2, 4)
                return replace(self.table.files.with_opacity(material, cover, False, by_alpha), blend=True)
        if self.classic:
            colour = np.array(self._checked(maps["transparency_color"]["value"]), np.float32)
            opacity = 1.0 - float(luminance(colour)) * self._checked(maps["transparency_factor"]["value"])[0]
            if not maps["transparency_color"]["has"]:
                opacity = 1.0
        else:
            opacity = self._number("opacity", 1.0)
        if opacity >= 1.0 - 1e-6:
            return material
        if opacity <= 1e-6:
            self.table.files.notes.append(
                f"Material '{self.name}': would be invisible; taken as opaque, as its exporter meant the opposite."
            )
            return material
        return replace(material, base_color=(*material.base_color[:3], opacity), blend=True)

    def _normal_texture(self) -> TextureRef | None:
        found = self._texture("normal_map", srgb=False)
        if found is None and self.part["fbx"]["bump"]["texture"] >= 0:
            # Exporters of games' programs put normal maps into Bump.
            found = self._map_texture(self.part["fbx"]["bump"], srgb=False)
            if found is not None and not self.table.files.is_normal_map(found):
                self.table.files.notes.append(f"Material '{self.name}': bump ignored.")
                return None
        return found

    def _number(self, name: str, default: float) -> float:
        entry = self.part["pbr"][name]
        return self._checked(entry["value"])[0] if entry["has"] else default

    def _colour(self, name: str, default: float, textured: bool, factor: float) -> tuple[float, float, float]:
        """Linear RGB; white where a texture has the colours."""
        entry = self.part["pbr"][name]
        red, green, blue = self._checked(entry["value"])[:3] if entry["has"] else [default] * 3
        return (factor, factor, factor) if textured else (red * factor, green * factor, blue * factor)

    def _checked(self, values: list[float]) -> list[float]:
        if min(values) < 0.0:
            raise InputError(
                "one of its numbers is negative or not finite", where=f"material '{self.name}'", remedy="Mend it."
            )
        return values

    def _texture(self, name: str, srgb: bool = True) -> TextureRef | None:
        return self._map_texture(self.part["pbr"][name], srgb)

    def _map_texture(self, entry: dict[str, Any], srgb: bool) -> TextureRef | None:
        number = entry["texture"]
        if number < 0:
            return None
        part = self.table.body["textures"][number]
        if part["layers"] > 1:
            self.table.files.notes.append(f"Material '{self.name}': of a layered texture, the first layer is taken.")
        content = self.table.arrays.get(f"t{number} content", np.zeros(0, np.uint8)).tobytes()
        image = self.table.files.image(part["file"], srgb, f"Material '{self.name}'", content)
        if image is None:
            return None
        if part["uv_set"] not in self.semantics:
            check_count(len(self.semantics) + 1, MAX_UV_SETS, "UV sets in its textures", f"material '{self.name}'")
            self.semantics.append(part["uv_set"])
        first, second = ("clamp" if clamped else "repeat" for clamped in part["clamp"])
        reference = TextureRef(image, (first, second), uv_set=self.semantics.index(part["uv_set"]))
        if part["transform"] is None:
            return reference
        matrix = np.array(part["transform"]).reshape(4, 4)
        if abs(matrix[0, 1]) + abs(matrix[1, 0]) > 1e-6:
            self.table.files.notes.append(f"Material '{self.name}': the rotation of its texture is ignored.")
        s, t = float(matrix[0, 0]), float(matrix[1, 1])
        return replace(reference, scale=(s, t), offset=(float(matrix[0, 3]), 1.0 - t - float(matrix[1, 3])))
