"""The parsed scene: triangles in world space, glTF metallic-roughness materials, lights, environment.

Every reader (glTF, OBJ, PLY, Mitsuba XML) produces this model and every later stage (texel map, renderer,
packager) reads only this, so no stage knows the input format. Instances are flattened: each
copy of a mesh becomes its own Mesh because each needs its own part of the light map.
"""

from dataclasses import dataclass, field
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


@dataclass(frozen=True)
class Material:
    """glTF metallic-roughness. `emission` is in radiance (emissiveFactor times emissive strength)."""

    name: str
    base_color: tuple[float, float, float, float] = (0.8, 0.8, 0.8, 1.0)  # linear
    base_color_texture: TextureRef | None = None  # multiplies
    metallic: float = 0.0
    roughness: float = 1.0  # perceptual; GGX alpha = roughness^2
    metallic_roughness_texture: TextureRef | None = None  # G = roughness, B = metallic; multiplies
    emission: tuple[float, float, float] = (0.0, 0.0, 0.0)
    emission_texture: TextureRef | None = None  # multiplies
    double_sided: bool = False
    alpha_cutoff: float | None = None  # None: opaque (BLEND is treated as cutoff 0.5, with a note)


@dataclass(frozen=True)
class Mesh:
    """One instance of a primitive, in world space, wound counter-clockwise around its outward side."""

    name: str
    positions: Float32  # [V, 3] metres
    normals: Float32  # [V, 3] unit shading normals
    faces: Int32  # [F, 3]
    material: int
    uv: Float32 | None = None  # [V, 2] TEXCOORD_0, v downwards
    lightmap_uv: Float32 | None = None  # [V, 2] in the light-map atlas, v downwards


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
    direction is (sin theta sin phi, cos theta, -sin theta cos phi), so the image's centre column looks at +Z, as
    Mitsuba's `envmap` has it. `rotation_deg` turns the image about +Y, counter-clockwise seen from above.
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
