"""glTF metallic-roughness materials at surface points, evaluated without the renderer.

Textures are linearised, then filtered bilinearly with their wrap modes (glTF 2.0, section 3.8.4). The renderer
evaluates the same materials through Mitsuba; agreement of the two is a check of both.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from kiln_workers.render.textures import linear_pixels, uv_matrix
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


def evaluate(scene: Scene, material: Ints, uv: Floats) -> Reflectance:
    """Parameters of the materials `material` [P] at texture coordinates `uv` [P, 2]."""
    count = len(material)
    out = Reflectance(
        np.zeros((count, 3), np.float32),
        np.zeros(count, np.float32),
        np.zeros(count, np.float32),
        np.zeros((count, 3), np.float32),
        np.zeros(count, np.bool_),
    )
    for number in np.unique(material):
        at = material == number
        _evaluate_one(scene, scene.materials[number], uv[at], at, out)
    return out


def _evaluate_one(scene: Scene, material: Material, uv: Floats, at: npt.NDArray[np.bool_], out: Reflectance) -> None:
    base, glossy = material.base_color_texture, material.metallic_roughness_texture
    colour = 1.0 if base is None else look_up(scene.images[base.image], base, uv)[:, :3]
    out.base_color[at] = np.clip(np.asarray(material.base_color[:3]) * colour, 0.0, 1.0)
    texture = np.ones((len(uv), 4)) if glossy is None else look_up(scene.images[glossy.image], glossy, uv)
    out.roughness[at] = np.clip(material.roughness * texture[:, 1], 0.0, 1.0)
    out.metallic[at] = np.clip(material.metallic * texture[:, 2], 0.0, 1.0)
    glow = material.emission_texture
    out.emission[at] = np.asarray(material.emission) * (
        1.0 if glow is None else look_up(scene.images[glow.image], glow, uv)[:, :3]
    )
    out.double_sided[at] = material.double_sided


def look_up(image: Image, reference: TextureRef, uv: Floats) -> Floats:
    """Linear RGBA [P, 4] of a texture at coordinates [P, 2], bilinear."""
    pixels = linear_pixels(image).astype(np.float64)
    matrix = uv_matrix(reference)
    at = (uv @ matrix[:2, :2].T + matrix[:2, 2]) * (pixels.shape[1], pixels.shape[0]) - 0.5
    low = np.floor(at).astype(np.int64)
    weight = at - low
    columns = [_wrapped(low[:, 0] + k, pixels.shape[1], reference.wrap[0]) for k in (0, 1)]
    rows = [_wrapped(low[:, 1] + k, pixels.shape[0], reference.wrap[1]) for k in (0, 1)]
    across = weight[:, :1]
    top = pixels[rows[0], columns[0]] * (1.0 - across) + pixels[rows[0], columns[1]] * across
    bottom = pixels[rows[1], columns[0]] * (1.0 - across) + pixels[rows[1], columns[1]] * across
    return np.asarray(top * (1.0 - weight[:, 1:]) + bottom * weight[:, 1:])


def _wrapped(index: Ints, size: int, mode: str) -> Ints:
    """Pixel numbers under a wrap mode: clamp, mirror or repeat."""
    if mode == "clamp":
        return np.clip(index, 0, size - 1)
    if mode == "mirror":
        folded = index % (2 * size)
        return np.where(folded < size, folded, 2 * size - 1 - folded)
    return index % size
