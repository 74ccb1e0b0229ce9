"""glTF metallic-roughness materials at surface points, evaluated without the renderer.

Textures are linearised, then filtered bilinearly with their wrap modes (glTF 2.0, section 3.8.4). The renderer
evaluates the same materials through Mitsuba; agreement of the two is a check of both.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from kiln_workers.scene import lookup, normal_maps
from kiln_workers.scene.images import linear_pixels
from kiln_workers.scene.model import Float32, Image, Material, Scene, TextureRef

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]


@dataclass(frozen=True)
class Reflectance:
    """Material parameters of P points."""

    base_color: Float32  # [P, 3] linear
    metallic: Float32  # [P]
    roughness: Float32  # [P] perceptual; GGX alpha = roughness^2
    emission: Float32  # [P, 3] radiance
    double_sided: npt.NDArray[np.bool_]  # [P]
    normal: Floats  # [P, 3] vector of the normal map in its tangents' frame; (0, 0, 1) without a map
    dielectric: Float32  # [P, 4] F0 of the dielectric, and its F90
    opacity: Float32  # [P] how much of the surface is there: blended alpha, else 1
    transmission: Float32  # [P] the part of the dielectric's base that lets light through


def evaluate(scene: Scene, material: Ints, uv: Floats, tint: Floats) -> Reflectance:
    """Parameters of materials `material` [P] at coordinates `uv` [P, sets, 2] under vertex colours `tint` [P, 4]."""
    count = len(material)
    out = Reflectance(
        base_color=np.zeros((count, 3), np.float32),
        metallic=np.zeros(count, np.float32),
        roughness=np.zeros(count, np.float32),
        emission=np.zeros((count, 3), np.float32),
        double_sided=np.zeros(count, np.bool_),
        normal=np.tile([0.0, 0.0, 1.0], (count, 1)),
        dielectric=np.zeros((count, 4), np.float32),
        opacity=np.zeros(count, np.float32),
        transmission=np.zeros(count, np.float32),
    )
    for number in np.unique(material):
        at = material == number
        _evaluate_one(scene, scene.materials[number], uv[at], tint[at], at, out)
    return out


def _evaluate_one(
    scene: Scene, material: Material, uv: Floats, tint: Floats, at: npt.NDArray[np.bool_], out: Reflectance
) -> None:
    def texture(reference: TextureRef | None) -> Floats:
        if reference is None or reference.uv_set >= uv.shape[1]:
            return np.ones((len(uv), 4))
        return look_up(scene.images[reference.image], reference, uv[:, reference.uv_set])

    base = np.asarray(material.base_color) * texture(material.base_color_texture) * tint
    out.base_color[at] = np.clip(base[:, :3], 0.0, 1.0)
    glossy = texture(material.metallic_roughness_texture)
    out.roughness[at] = np.clip(material.roughness * glossy[:, 1], 0.0, 1.0)
    out.metallic[at] = np.clip(material.metallic * glossy[:, 2], 0.0, 1.0)
    out.emission[at] = np.asarray(material.emission) * texture(material.emission_texture)[:, :3]
    out.double_sided[at] = material.double_sided
    if material.normal_texture is not None and material.normal_texture.uv_set < uv.shape[1]:
        out.normal[at] = normal_maps.decoded(texture(material.normal_texture)[:, :3], material.normal_scale)
    out.dielectric[at] = (*material.dielectric_f0, material.dielectric_f90)
    out.opacity[at] = np.clip(base[:, 3], 0.0, 1.0) if material.blend else 1.0
    out.transmission[at] = np.clip(material.transmission * texture(material.transmission_texture)[:, 0], 0.0, 1.0)


def look_up(image: Image, reference: TextureRef, uv: Floats) -> Floats:
    """Linear RGBA [P, 4] of a texture at coordinates [P, 2], bilinear."""
    return lookup.look_up(linear_pixels(image), reference, uv)
