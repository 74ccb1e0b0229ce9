"""The parsed scene: triangles in world space, glTF metallic-roughness materials, lights, environment.

Every reader (glTF, OBJ, PLY, Mitsuba XML) produces this model and every later stage (texel map, renderer,
packager) reads only this, so no stage knows the input format. Instances are flattened: each
copy of a mesh becomes its own Mesh because each needs its own part of the light map.
"""

from dataclasses import dataclass, field, replace
from enum import StrEnum

import numpy as np
import numpy.typing as npt

Float32 = npt.NDArray[np.float32]
Int32 = npt.NDArray[np.int32]


@dataclass(frozen=True)
class Image:
    """A texture as stored in the file: row 0 at the top (glTF's v = 0)."""

    name: str
    pixels: npt.NDArray[np.uint8] | Float32  # [H, W, 1..4]
    srgb: bool  # colour data to be linearised; False for metallic-roughness and float images


@dataclass(frozen=True)
class TextureRef:
    """A texture lookup; `offset`, `scale` and `rotation` as in KHR_texture_transform."""

    image: int
    wrap: tuple[str, str] = ("repeat", "repeat")  # each of repeat, clamp, mirror
    offset: tuple[float, float] = (0.0, 0.0)
    scale: tuple[float, float] = (1.0, 1.0)
    rotation: float = 0.0  # radians, as KHR_texture_transform
    uv_set: int = 0  # of `Mesh.uv_sets`


@dataclass(frozen=True)
class Material:
    """glTF metallic-roughness. `emission` is in radiance (emissiveFactor times emissive strength).

    Alpha is base colour's times its texture's and the vertex colour's. It is a test where `alpha_cutoff` is a number,
    an opacity where `blend` is set, and else plays no part.
    """

    name: str
    base_color: tuple[float, float, float, float] = (0.8, 0.8, 0.8, 1.0)  # linear
    base_color_texture: TextureRef | None = None  # multiplies
    metallic: float = 0.0
    roughness: float = 1.0  # perceptual; GGX alpha = roughness^2
    metallic_roughness_texture: TextureRef | None = None  # G = roughness, B = metallic; multiplies
    emission: tuple[float, float, float] = (0.0, 0.0, 0.0)
    emission_texture: TextureRef | None = None  # multiplies
    double_sided: bool = False
    alpha_cutoff: float | None = None
    blend: bool = False
    transmission: float = 0.0  # KHR_materials_transmission: the part of the dielectric's base that lets light through
    transmission_texture: TextureRef | None = None  # R; multiplies
    ior: float = 1.5  # KHR_materials_ior
    specular: float = 1.0  # KHR_materials_specular
    specular_color: tuple[float, float, float] = (1.0, 1.0, 1.0)
    clearcoat: float = 0.0  # KHR_materials_clearcoat
    normal_texture: TextureRef | None = None
    normal_scale: float = 1.0
    occlusion_texture: TextureRef | None = None  # for viewers alone: the bake has true occlusion
    occlusion_strength: float = 1.0

    @property
    def textures(self) -> tuple[TextureRef, ...]:
        """All look-ups of the material."""
        references = (
            self.base_color_texture,
            self.metallic_roughness_texture,
            self.emission_texture,
            self.transmission_texture,
            self.normal_texture,
            self.occlusion_texture,
        )
        return tuple(reference for reference in references if reference is not None)

    @property
    def lets_light_pass(self) -> bool:
        """Whether light may go straight through: an alpha test, an opacity or transmission."""
        return self.alpha_cutoff is not None or self.is_veil

    @property
    def is_veil(self) -> bool:
        """Whether it may let a part of the light pass, not all or nothing."""
        return self.blend or self.transmission > 0.0

    @property
    def dielectric_f0(self) -> tuple[float, float, float]:
        """Reflectance of the dielectric at normal incidence (KHR_materials_ior, _specular); a coat's 0.04 is added."""
        ratio = ((self.ior - 1.0) / (self.ior + 1.0)) ** 2
        coat = 0.04 * self.clearcoat
        red, green, blue = (min(ratio * colour, 1.0) * self.specular for colour in self.specular_color)
        return red + (1.0 - red) * coat, green + (1.0 - green) * coat, blue + (1.0 - blue) * coat

    @property
    def dielectric_f90(self) -> float:
        """Reflectance of the dielectric at grazing incidence; a coat's is 1."""
        return self.specular + (1.0 - self.specular) * self.clearcoat


@dataclass(frozen=True)
class Mesh:
    """One instance of a primitive, in world space, wound counter-clockwise around its outward side."""

    name: str
    positions: Float32  # [V, 3] metres
    normals: Float32  # [V, 3] unit shading normals
    faces: Int32  # [F, 3]
    material: int
    uv: Float32 | None = None  # [V, 2] the first set that textures use, v downwards
    lightmap_uv: Float32 | None = None  # [V, 2] in the light-map atlas, v downwards
    more_uv: tuple[Float32, ...] = ()  # [V, 2] each: the sets after `uv`
    colors: Float32 | None = None  # [V, 4] linear RGBA, multiplies the base colour
    tangents: Float32 | None = None  # [V, 4] unit, w the handedness; where the material has a normal map

    @property
    def uv_sets(self) -> tuple[Float32, ...]:
        """The sets that `TextureRef.uv_set` counts."""
        return () if self.uv is None else (self.uv, *self.more_uv)

    def uv_of(self, reference: TextureRef | None) -> Float32 | None:
        """The coordinates [V, 2] of a look-up; None where there is no look-up or the mesh lacks the set."""
        if reference is None or reference.uv_set >= len(self.uv_sets):
            return None
        return self.uv_sets[reference.uv_set]

    def with_vertices(self, vertices: npt.NDArray[np.integer], faces: Int32) -> "Mesh":
        """The mesh with `vertices` [V'] picked from its own, and `faces` that count them."""

        def picked(values: Float32 | None) -> Float32 | None:
            return None if values is None else values[vertices]

        return replace(
            self,
            positions=self.positions[vertices],
            normals=self.normals[vertices],
            faces=faces,
            uv=picked(self.uv),
            lightmap_uv=picked(self.lightmap_uv),
            more_uv=tuple(values[vertices] for values in self.more_uv),
            colors=picked(self.colors),
            tangents=picked(self.tangents),
        )


class LightKind(StrEnum):
    POINT = "point"
    SPOT = "spot"
    DIRECTIONAL = "directional"


@dataclass(frozen=True)
class PunctualLight:
    """KHR_lights_punctual in world space. Point and spot: W/sr; directional: W/m^2 across the beam."""

    name: str
    kind: LightKind
    intensity: tuple[float, float, float]  # colour times intensity
    position: tuple[float, float, float] = (0.0, 0.0, 0.0)
    direction: tuple[float, float, float] = (0.0, 0.0, -1.0)  # unit, the way the light travels
    inner_cone: float = 0.0  # radians, half angles
    outer_cone: float = np.pi / 4


@dataclass(frozen=True)
class Environment:
    """Distant illumination, equirectangular. Row 0 is +Y.

    With u = (column + 1/2)/W, v = (row + 1/2)/H, theta = pi v (from +Y), phi = 2 pi u: before rotation the
    direction is (-sin theta cos phi, cos theta, -sin theta sin phi), so the image's centre column looks at +X and what
    is to the right of it at +Z, as three.js (`equirectUv`), Blender and viewers of glTF have it. Mitsuba's `envmap`
    stands a quarter turn away. `rotation_deg` turns the image about +Y, counter-clockwise seen from above.
    """

    pixels: Float32  # [H, W, 3] linear radiance, scale NOT applied
    scale: float = 1.0
    rotation_deg: float = 0.0


@dataclass(frozen=True)
class Scene:
    """All that the light depends on."""

    meshes: tuple[Mesh, ...]
    materials: tuple[Material, ...]
    images: tuple[Image, ...] = ()
    lights: tuple[PunctualLight, ...] = ()
    environment: Environment | None = None
    notes: tuple[str, ...] = field(default=(), compare=False)
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Where the user's file has this scene's (0, 0, 0), in metres (`scene.origin`)."""

    @property
    def triangles(self) -> int:
        return sum(len(mesh.faces) for mesh in self.meshes)

    @property
    def has_light(self) -> bool:
        """Whether anything emits: an emissive material in use, a punctual light, or a non-black environment."""
        emits = any(max(self.materials[mesh.material].emission) > 0.0 for mesh in self.meshes)
        lit = any(max(light.intensity) > 0.0 for light in self.lights)
        return emits or lit or (self.environment is not None and float(self.environment.pixels.max()) > 0.0)
