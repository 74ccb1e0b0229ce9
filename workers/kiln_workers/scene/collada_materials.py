"""Materials of a Collada file: `<constant>`, `<lambert>`, `<phong>` and `<blinn>` of the common profile.

Phong's exponent n is of R.V, which is close to 4 n of N.H; Blinn's is of N.H. An exponent of N.H gives
alpha^2 = 2 / (n + 2) (Walter et al. 2007, section 5.1); without a highlight the roughness is 1. Opacity is that of the
section "Determining Transparency" of the specification; where three channels have different ones, their luminance's.
Colours are linear, as Blender, assimp and COLLADA2GLTF have them; textures are sRGB.
"""

from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np

from kiln_workers.scene.collada_document import Collada, name_of
from kiln_workers.scene.limits import MAX_UV_SETS, check_count
from kiln_workers.scene.model import Material, TextureRef
from kiln_workers.scene.texture_files import Coat, TextureFiles, luminance
from kiln_workers.scene.xml_nodes import Node

SHADERS: Final = ("phong", "blinn", "lambert", "constant")
WRAP: Final = {"WRAP": "repeat", "MIRROR": "mirror", "CLAMP": "clamp", "BORDER": "clamp", "NONE": "clamp"}
WHITE: Final = (1.0, 1.0, 1.0, 1.0)
Colour = tuple[float, float, float, float]


@dataclass
class Materials:
    """Materials in the order of first use."""

    document: Collada
    files: TextureFiles
    materials: list[Material] = field(default_factory=list)
    _known: dict[Node | None, Coat] = field(default_factory=dict)
    _double: dict[int, int] = field(default_factory=dict)

    def use(self, target: Node | None, double_sided: bool) -> Coat:
        """The `<material>`, or the default one; seen from both sides where the geometry says so."""
        if target not in self._known:
            if target is None:
                self._known[target] = Coat(len(self.materials))
                self.materials.append(Material("default"))
            else:
                material, semantics = _Conversion(self.document, self.files, target).result()
                self._known[target] = Coat(len(self.materials), semantics)
                self.materials.append(material)
        coat = self._known[target]
        if double_sided and not self.materials[coat.index].double_sided:
            if coat.index not in self._double:
                self._double[coat.index] = len(self.materials)
                self.materials.append(replace(self.materials[coat.index], double_sided=True))
            return replace(coat, index=self._double[coat.index])
        return coat


def is_double_sided(node: Node) -> bool:
    """Whether an exporter's `<extra>` says that the back is seen too."""
    marks = (inner for extra in node.below() if extra.tag == "extra" for inner in extra.below())
    return any(inner.tag == "double_sided" and inner.text.strip() in ("1", "true") for inner in marks)


class _Conversion:
    """One material on its way into the model."""

    def __init__(self, document: Collada, files: TextureFiles, target: Node) -> None:
        self.document = document
        self.files = files
        self.name = name_of(target)
        self.semantics: list[str] = []
        instance = target.child("instance_effect")
        effect = None if instance is None else document.find(instance.attributes.get("url", ""), "effect")
        self.effect = effect or Node("effect", {}, target.line)
        self.profile = self.effect.child("profile_COMMON") or Node("profile_COMMON", {}, target.line)
        self.technique = self.profile.child("technique") or Node("technique", {}, target.line)
        scopes = (self.effect, self.profile, self.technique)
        self.parameters = {node.attributes.get("sid", ""): node for scope in scopes for node in scope.all("newparam")}
        for node in instance.all("setparam") if instance is not None else ():
            self.parameters[node.attributes.get("ref", "")] = node
        self.shader = next(iter(self.technique.all(*SHADERS)), Node("lambert", {}, target.line))

    def result(self) -> tuple[Material, tuple[str, ...]]:
        """The material, and what its textures call their UV sets."""
        base, base_texture = self._value("diffuse", (0.8, 0.8, 0.8, 1.0))
        glow, glow_texture = self._value("emission", (0.0, 0.0, 0.0, 1.0))
        if glow_texture is None and self.shader.child("emission", "texture") is not None:
            glow = (0.0, 0.0, 0.0, 1.0)  # a texture that is not there does not make a lamp
        lit = self.shader.tag != "constant"
        red, green, blue = (min(channel, 1.0) if lit else 0.0 for channel in base[:3])
        material = Material(
            name=self.name,
            base_color=(red, green, blue, 1.0),
            base_color_texture=base_texture if lit else None,
            roughness=self._roughness(),
            emission=glow[:3],
            emission_texture=glow_texture,
            double_sided=is_double_sided(self.effect),
            normal_texture=self._normal_texture(),
        )
        if self._number("reflectivity", 0.0) > 0.0 and max(self._value("reflective", (0, 0, 0, 1))[0][:3]) > 0.0:
            self.files.notes.append(f"Material '{self.name}': reflective ignored.")
        material = self._with_opacity(material)
        return material, tuple(self.semantics)

    def _roughness(self) -> float:
        shiny, texture = self._value("specular", (0.0, 0.0, 0.0, 1.0))
        if self.shader.tag not in ("phong", "blinn") or (texture is None and max(shiny[:3]) == 0.0):
            return 1.0
        if texture is not None:
            self.files.notes.append(f"Material '{self.name}': its specular texture is ignored.")
        exponent = self._number("shininess", 0.0) * (4.0 if self.shader.tag == "phong" else 1.0)
        return float((2.0 / (exponent + 2.0)) ** 0.25)

    def _with_opacity(self, material: Material) -> Material:
        node = self.shader.child("transparent")
        if node is None and self.shader.child("transparency") is None:
            return material
        mode = "A_ONE" if node is None else node.attributes.get("opaque", "A_ONE")
        colour, texture = self._value("transparent", WHITE, srgb=mode.startswith("RGB"))
        factor = self._number("transparency", 1.0)
        by_alpha, invert = mode.startswith("A"), mode.endswith("ZERO")
        if texture is not None:
            if factor != 1.0:
                self.files.notes.append(f"Material '{self.name}': the transparency beside its texture is ignored.")
            return replace(self.files.with_opacity(material, texture, invert, by_alpha), blend=True)
        part = colour[3] if by_alpha else float(luminance(np.array(colour, np.float32)))
        opacity = min(1.0 - part * factor if invert else part * factor, 1.0)
        if opacity <= 0.0:
            self.files.notes.append(
                f"Material '{self.name}': would be invisible; taken as opaque, as its exporter meant the opposite."
            )
            return material
        return replace(material, base_color=(*material.base_color[:3], opacity), blend=opacity < 1.0)

    def _normal_texture(self) -> TextureRef | None:
        """The normal map in an exporter's `<bump>`; a height map is ignored."""
        bump = next((node for node in self.effect.below() if node.tag == "bump"), None)
        texture = None if bump is None else bump.child("texture")
        if bump is None or texture is None:
            return None
        if bump.attributes.get("bumptype") != "NORMALMAP":
            self.files.notes.append(f"Material '{self.name}': bump ignored.")
            return None
        return self._texture(texture, srgb=False)

    def _number(self, tag: str, default: float) -> float:
        node = self.shader.child(tag)
        value = self._colour(node, (default, 0.0, 0.0, 0.0)) if node is not None else (default,)
        return value[0]

    def _value(self, tag: str, default: Colour, srgb: bool = True) -> tuple[Colour, TextureRef | None]:
        """Colour and texture of an entry of the shader; one of them, as the other is white or none."""
        node = self.shader.child(tag)
        if node is None:
            return default, None
        texture = node.child("texture")
        if texture is not None:
            return WHITE, self._texture(texture, srgb)
        return self._colour(node, default), None

    def _colour(self, node: Node, default: Colour) -> Colour:
        """The `<color>`, `<float>` or `<param>` in an element, finite and not negative."""
        reference = node.child("param")
        if reference is not None:
            node = self.parameters.get(reference.attributes.get("ref", ""), node)
        inner = next(iter(node.all("color", "float", "float3", "float4")), None)
        if inner is None or not inner.text.strip():
            return default
        values = self.document.floats(inner)
        if len(values) not in (1, 3, 4) or not np.isfinite(values).all() or values.min() < 0.0:
            raise self.document.fail(inner, "is not one, three or four numbers of 0 or more")
        red, green, blue, alpha = (*values, 0.0, 0.0, 0.0)[:4] if len(values) == 1 else (*values, 1.0)[:4]
        return float(red), float(green), float(blue), float(alpha)

    def _texture(self, texture: Node, srgb: bool) -> TextureRef | None:
        sampler = self.parameters.get(texture.attributes.get("texture", ""))
        sampler = None if sampler is None else sampler.child("sampler2D")
        name = self._file(texture, sampler)
        image = None if name is None else self.files.image(name, srgb, f"Material '{self.name}'")
        if image is None:
            return None
        semantic = texture.attributes.get("texcoord", "")
        if semantic not in self.semantics:
            check_count(len(self.semantics) + 1, MAX_UV_SETS, "UV sets in its textures", f"material '{self.name}'")
            self.semantics.append(semantic)
        return self._laid_out(TextureRef(image, uv_set=self.semantics.index(semantic)), texture, sampler)

    def _laid_out(self, reference: TextureRef, texture: Node, sampler: Node | None) -> TextureRef:
        """With the sampler's wrap modes, and what Maya's exporters say of repetition and offset."""
        wraps = [sampler.child(tag) if sampler is not None else None for tag in ("wrap_s", "wrap_t")]
        first, second = (WRAP.get(node.text.strip(), "repeat") if node is not None else "repeat" for node in wraps)
        maya = next(
            (node for node in texture.below() if node.tag == "technique" and node.attributes.get("profile") == "MAYA"),
            Node("technique", {}, texture.line),
        )

        def number(tag: str, default: float) -> float:
            return self.document.float_of(maya.child(tag), default)

        if number("rotateUV", 0.0) or number("rotateFrame", 0.0):
            self.files.notes.append(f"Material '{self.name}': the rotation of its texture is ignored.")
        s, t = number("repeatU", 1.0), number("repeatV", 1.0)
        if not np.isfinite([s, t, number("offsetU", 0.0), number("offsetV", 0.0)]).all():
            raise self.document.fail(texture, "is laid out by what is no finite number")
        # v grows upwards in Collada: an image at (u, v) * s + offset, as in `mtl`.
        offset = (number("offsetU", 0.0), 1.0 - t - number("offsetV", 0.0))
        return replace(reference, wrap=(first, second), scale=(s, t), offset=offset)

    def _file(self, texture: Node, sampler: Node | None) -> str | None:
        """The path of a texture's image: by its sampler and surface (1.4), its sampler (1.5), or directly."""
        name = texture.attributes.get("texture", "")
        if sampler is not None:
            instance, source = sampler.child("instance_image"), sampler.child("source")
            if instance is not None:
                name = instance.attributes.get("url", "")
            elif source is not None:
                parameter = self.parameters.get(source.text.strip())
                inner = None if parameter is None else parameter.child("surface", "init_from")
                name = source.text.strip() if inner is None else inner.text.strip()
        image = self.document.find(name, "image")
        start = None if image is None else image.child("init_from")
        if start is not None:
            start = start.child("ref") or start
        if start is None or not start.text.strip():
            self.files.notes.append(f"Material '{self.name}': a texture without a file is left out.")
            return None
        return start.text.strip()
