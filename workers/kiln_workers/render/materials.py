"""Materials of the scene model as Mitsuba's objects: `kiln_gltf` surfaces, emitters, and what both look up.

A mesh's first UV set is Mitsuba's own; further sets and the vertices' colours are mesh attributes, which `kiln_lookup`
and Mitsuba's `mesh_attribute` read. So each texture is looked up by its own set, in surfaces and in emitters alike.
"""

from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any, Final

import numpy as np

from kiln_workers.render import textures
from kiln_workers.render.emitters import register_emitters
from kiln_workers.render.gltf_bsdf import register_bsdfs
from kiln_workers.render.jit import dr, mi
from kiln_workers.scene.images import linear_pixels
from kiln_workers.scene.model import Float32, Material, Mesh, Scene, TextureRef

MIN_ROUGHNESS: Final = 0.05
"""Below this the GGX peak outgrows float32 and no sampler finds it; alpha 0.0025 is a mirror at any image size here."""


LIGHTMAP: Final = "vertex_lightmap"
"""The attribute that holds a vertex' place in the light map: u, v, and -1 where the faces are turned over, else 1."""

ROUND: Final = 0.9999
"""Cosine between a vertex's normal and its face's from which on the two are the same: 0.8 degrees."""


def vertex_attributes(mesh: Mesh, material: Material, turned_over: bool) -> dict[str, Float32]:
    """What a mesh carries beside Mitsuba's own attributes: values [V, 1 or 3] by name."""
    out: dict[str, Float32] = {}
    for number, uv in enumerate(mesh.more_uv, start=1):
        out[_uv_name(number)] = np.concatenate([uv, np.zeros_like(uv[:, :1])], axis=1)
    if mesh.colors is not None:
        out["vertex_tint"], out["vertex_alpha"] = mesh.colors[:, :3], mesh.colors[:, 3:]
    if mesh.tangents is not None:
        out["vertex_tangent"], out["vertex_hand"] = mesh.tangents[:, :3], mesh.tangents[:, 3:]
    if rounded_emitter(mesh, material):
        out["vertex_rounded"] = mesh.normals
    if mesh.lightmap_uv is not None:
        side = np.full_like(mesh.lightmap_uv[:, :1], -1.0 if turned_over else 1.0)
        out[LIGHTMAP] = np.concatenate([mesh.lightmap_uv, side], axis=1)
    return out


def rounded_emitter(mesh: Mesh, material: Material) -> bool:
    """Whether a mesh glows and its normals are not those of its faces: such a surface is told them as an attribute."""
    if max(material.emission) <= 0.0:
        return False
    corners = mesh.positions[mesh.faces].astype(np.float64)  # [F, 3, 3]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(normal, axis=-1, keepdims=True)
    off = np.einsum("fcd,fd->fc", mesh.normals[mesh.faces].astype(np.float64), normal) < ROUND * length
    return bool((off & (length > 0.0)).any())


def _uv_name(number: int) -> str:
    return f"vertex_uv{number}"


@dataclass
class MaterialBuilder:
    """Mitsuba's surfaces and emitters of a scene; meshes that are alike share a surface."""

    scene: Scene
    _known: dict[tuple[int, ...], Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        register_emitters()
        register_bsdfs()
        _register_textures(mi.variant())

    def bsdf(self, mesh: Mesh) -> Any:
        """The surface of a mesh."""
        material = self.scene.materials[mesh.material]
        key: tuple[int, ...] = (
            mesh.material,
            len(mesh.uv_sets),
            int(mesh.colors is not None),
            int(mesh.tangents is not None),
            int(rounded_emitter(mesh, material)),
            int(_tested_by_vertices(material, mesh)),
        )
        if any(reference.wrap[0] != reference.wrap[1] for reference in material.textures):
            key = (*key, id(mesh))  # its textures are unrolled over this mesh's coordinates
        if key not in self._known:
            self._known[key] = self._surface(material, mesh)
        return self._known[key]

    def emitter(self, mesh: Mesh, weight: float) -> Any | None:
        """The area emitter of a mesh; None where it does not glow."""
        material = self.scene.materials[mesh.material]
        if max(material.emission) <= 0.0:
            return None
        opacity = self._opacity(material, mesh)
        if opacity == 0.0:
            return None
        factor, uv = np.asarray(material.emission, np.float32), mesh.uv_of(material.emission_texture)
        tinted = mesh.colors is not None and material.blend
        if uv is None and opacity == 1.0 and not tinted:
            radiance = {"type": "rgb", "value": list(material.emission)}
            return mi.load_dict({"type": "area", "radiance": radiance, "sampling_weight": weight})
        emitter: dict[str, Any] = {"type": "kiln_area", "sampling_weight": weight}
        if uv is None or material.emission_texture is None:
            emitter["radiance"] = _constant(factor)
        else:
            pixels = linear_pixels(self.scene.images[material.emission_texture.image])[..., :3]
            emitter["radiance"] = _lookup(np.maximum(pixels * factor, 0.0), material.emission_texture, mesh)
        if opacity != 1.0:
            emitter["opacity"] = _uniform(opacity) if isinstance(opacity, float) else opacity
        if tinted:
            emitter["tint_alpha"] = mi.load_dict({"type": "mesh_attribute", "name": "vertex_alpha"})
        out = mi.load_dict(emitter)
        out.set_mesh(mesh)
        return out

    def _surface(self, material: Material, mesh: Mesh) -> Any:
        surface: dict[str, Any] = {"type": "kiln_gltf", "f90": material.dielectric_f90}
        surface |= {f"f0_{channel}": value for channel, value in zip("rgb", material.dielectric_f0, strict=True)}
        surface |= self._reflectance(material, mesh)
        if material.double_sided:
            surface["double_sided"] = True
        if rounded_emitter(mesh, material):
            surface["rounded"] = True
        if mesh.colors is not None:
            surface["tint"] = mi.load_dict({"type": "mesh_attribute", "name": "vertex_tint"})
        if material.lets_light_pass:
            opacity = self._opacity(material, mesh)
            surface["opacity"] = _uniform(opacity) if isinstance(opacity, float) else opacity
            if mesh.colors is not None and material.blend:
                surface["tint_alpha"] = mi.load_dict({"type": "mesh_attribute", "name": "vertex_alpha"})
        if material.transmission > 0.0:
            surface["transmission"] = self._channel(material.transmission, material.transmission_texture, 0, mesh, 0.0)
        reference = material.normal_texture
        if reference is not None and mesh.tangents is not None and mesh.uv_of(reference) is not None:
            pixels = linear_pixels(self.scene.images[reference.image])[..., :3]
            surface |= {"normal_map": _lookup(pixels, reference, mesh), "normal_scale": float(material.normal_scale)}
        return mi.load_dict(surface)

    def _reflectance(self, material: Material, mesh: Mesh) -> dict[str, Any]:
        factor, base = np.clip(np.asarray(material.base_color[:3], np.float32), 0.0, 1.0), material.base_color_texture
        glossy = material.metallic_roughness_texture
        if base is None or mesh.uv_of(base) is None:
            colour = mi.load_dict({"type": "rgb", "value": factor.tolist()})
        else:
            pixels = linear_pixels(self.scene.images[base.image])[..., :3] * factor
            colour = _lookup(np.clip(pixels, 0.0, 1.0), base, mesh)
        return {
            "base_color": colour,
            "roughness": self._channel(material.roughness, glossy, 1, mesh, MIN_ROUGHNESS),
            "metallic": self._channel(material.metallic, glossy, 2, mesh, 0.0),
        }

    def _channel(self, factor: float, reference: TextureRef | None, channel: int, mesh: Mesh, least: float) -> Any:
        """A factor times one channel of a texture, between `least` and 1."""
        if reference is None or mesh.uv_of(reference) is None:
            return _uniform(float(np.clip(factor, least, 1.0)))
        pixels = linear_pixels(self.scene.images[reference.image])[..., channel : channel + 1]
        return _lookup(np.clip(pixels * np.float32(factor), least, 1.0), reference, mesh)

    def _opacity(self, material: Material, mesh: Mesh) -> Any:
        """How much of a surface is there: a number, or a texture (of zeros and ones for an alpha test)."""
        if not (material.blend or material.alpha_cutoff is not None):
            return 1.0
        factor, reference = float(material.base_color[3]), material.base_color_texture
        if _tested_by_vertices(material, mesh):
            alpha = _uniform(factor)
            if reference is not None and mesh.uv_of(reference) is not None:
                alpha = _lookup(linear_pixels(self.scene.images[reference.image])[..., 3:] * factor, reference, mesh)
            return mi.load_dict(
                {"type": "kiln_alpha_test", "alpha": alpha, "cutoff": float(material.alpha_cutoff or 0)}
            )
        if reference is None or mesh.uv_of(reference) is None:
            if material.alpha_cutoff is not None:
                return 1.0 if factor >= material.alpha_cutoff else 0.0
            return float(np.clip(factor, 0.0, 1.0))
        alpha = linear_pixels(self.scene.images[reference.image])[..., 3] * np.float32(factor)
        if material.alpha_cutoff is None:
            return _lookup(np.clip(alpha, 0.0, 1.0)[..., None], reference, mesh)
        tested = textures.thresholded(alpha, material.alpha_cutoff, reference.wrap)
        return _lookup(tested, reference, mesh, nearest=True)


def _tested_by_vertices(material: Material, mesh: Mesh) -> bool:
    """Whether an alpha test depends on the vertices' alpha."""
    return material.alpha_cutoff is not None and mesh.colors is not None and bool((mesh.colors[:, 3] != 1.0).any())


def _uniform(value: float) -> Any:
    return mi.load_dict({"type": "uniform", "value": value})


def _constant(colour: Float32) -> Any:
    return mi.load_dict(textures.bitmap(np.broadcast_to(colour, (2, 2, 3)), TextureRef(0), None))


def _lookup(pixels: Float32, reference: TextureRef, mesh: Mesh, nearest: bool = False) -> Any:
    """Linear `pixels` [H, W, 1 or 3] as a texture that is looked up by the reference's own UV set."""
    texture = mi.load_dict(textures.bitmap(pixels, reference, mesh.uv_of(reference), nearest))
    if reference.uv_set == 0:
        return texture
    return mi.load_dict({"type": "kiln_lookup", "texture": texture, "coordinates": _uv_name(reference.uv_set)})


@lru_cache(maxsize=4)
def _register_textures(variant: str) -> None:
    class KilnLookup(mi.Texture):  # type: ignore[misc]
        """A texture at the coordinates that a mesh attribute has."""

        def __init__(self, properties: Any) -> None:
            super().__init__(properties)
            self.texture = properties["texture"]
            self.coordinates = str(properties["coordinates"])

        def _moved(self, si: Any, active: Any) -> Any:
            at = si.shape.eval_attribute_3(self.coordinates, si, active)
            moved = mi.SurfaceInteraction3f(si)
            moved.uv = mi.Point2f(at.x, at.y)
            return moved

        def eval(self, si: Any, active: Any = True) -> Any:
            return self.texture.eval(self._moved(si, active), active)

        def eval_1(self, si: Any, active: Any = True) -> Any:
            return self.texture.eval_1(self._moved(si, active), active)

        def eval_3(self, si: Any, active: Any = True) -> Any:
            return self.texture.eval_3(self._moved(si, active), active)

        def to_string(self) -> str:
            return "KilnLookup[]"

    mi.register_texture("kiln_lookup", KilnLookup)

    class KilnAlphaTest(mi.Texture):  # type: ignore[misc]
        """1 where a texture times the vertices' alpha reaches the cutoff, else 0."""

        def __init__(self, properties: Any) -> None:
            super().__init__(properties)
            self.alpha, self.cutoff = properties["alpha"], float(properties["cutoff"])

        def eval_1(self, si: Any, active: Any = True) -> Any:
            alpha = self.alpha.eval_1(si, active) * si.shape.eval_attribute_1("vertex_alpha", si, active)
            return dr.select(alpha >= self.cutoff, mi.Float(1.0), mi.Float(0.0))

        def eval(self, si: Any, active: Any = True) -> Any:
            return mi.Color3f(self.eval_1(si, active))

        def to_string(self) -> str:
            return "KilnAlphaTest[]"

    mi.register_texture("kiln_alpha_test", KilnAlphaTest)
