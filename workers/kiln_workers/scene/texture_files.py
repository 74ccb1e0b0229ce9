"""Textures of Collada and FBX files: found in the bundle by the end of their path, each decoded once.

A texture that is not there is left out with a note: the paths in these files are those of another machine.
"""

import hashlib
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np

from kiln_schemas.errors import InputError
from kiln_schemas.formats import ends_of_path
from kiln_schemas.text import told
from kiln_workers.scene.bundle import BundleFolder
from kiln_workers.scene.gltf_materials import make_image
from kiln_workers.scene.images import linear_pixels
from kiln_workers.scene.limits import MAX_ENTRIES, MAX_IMAGE_BYTES, NAME_LENGTH, check_count
from kiln_workers.scene.model import Float32, Image, Material, TextureRef

LUMINANCE: Final = np.array([0.212671, 0.715160, 0.072169], np.float32)


@dataclass(frozen=True)
class Coat:
    """A material as a mesh needs it."""

    index: int
    """In the scene's materials."""
    semantics: tuple[str, ...] = ()
    """What its textures call their UV sets, in the order that `TextureRef.uv_set` counts."""


@dataclass
class TextureFiles:
    """The images of a scene in the order of first use."""

    bundle: BundleFolder
    notes: list[str]
    images: list[Image] = field(default_factory=list)
    _known: dict[tuple[str, bool, bytes], int | None] = field(default_factory=dict)

    def image(self, reference: str, srgb: bool, where: str, content: bytes = b"") -> int | None:
        """Position in `images` of the texture that a file names, or has as `content`; None where it is not there."""
        key = (reference, srgb, hashlib.sha256(content).digest())
        if key not in self._known:
            check_count(len(self._known), MAX_ENTRIES, "textures", self.bundle.origin)
            name = None if content else self._found(reference)
            shown = told(reference.replace("\\", "/").rpartition("/")[2] or reference, NAME_LENGTH)
            if name is None and not content:
                self.notes.append(f"{where}: its texture '{shown}' is not beside the file, and left out.")
                self._known[key] = None
                return None
            data = content or self.bundle.read(str(name), "texture")
            self._known[key] = len(self.images)
            self.images.append(make_image(data, shown, srgb, f"{where}, texture '{shown}'", self.images))
        return self._known[key]

    def with_opacity(self, material: Material, cover: TextureRef, invert: bool, by_alpha: bool) -> Material:
        """The material whose base colour's texture has the opacity of another as its alpha.

        That is its alpha, or else its luminance, less than 1 by it where `invert` is set.
        """
        base = material.base_color_texture
        if base is not None and replace(base, image=0) != replace(cover, image=0):
            self.notes.append(f"Material '{material.name}': its opacity's texture is laid out as its colour's.")
        pixels = linear_pixels(self.images[cover.image])
        value = pixels[..., 3] if by_alpha else luminance(pixels)
        colour = np.ones((1, 1, 4), np.float32) if base is None else linear_pixels(self.images[base.image])
        merged = with_alpha(colour, 1.0 - value if invert else value, f"material '{material.name}'")
        self.images.append(Image(f"{material.name} with opacity", merged, False))
        return replace(material, base_color_texture=replace(base or cover, image=len(self.images) - 1))

    def combined(
        self, name: str, rough: TextureRef | None, metal: TextureRef | None, invert: bool
    ) -> TextureRef | None:
        """One texture of roughness (G, 1 less it where `invert` is set) and metallic (B) from one of each."""
        reference = rough or metal
        if reference is None:
            return None
        if rough is not None and metal is not None and replace(rough, image=0) != replace(metal, image=0):
            self.notes.append(f"Material '{name}': its metallic texture is laid out as its roughness'.")
        green, blue = (
            np.ones((1, 1), np.float32) if part is None else luminance(linear_pixels(self.images[part.image]))
            for part in (rough, metal)
        )
        green = 1.0 - green if invert and rough is not None else green
        height, width = (int(size) for size in np.maximum(green.shape, blue.shape))
        check_count(height * width * 12, MAX_IMAGE_BYTES, "bytes in its textures", f"material '{name}'")
        parts = [_scaled(part[..., None], height, width) for part in (np.ones((1, 1), np.float32), green, blue)]
        self.images.append(
            Image(f"{name} roughness, metallic", np.concatenate(parts, axis=2).astype(np.float32), False)
        )
        return replace(reference, image=len(self.images) - 1)

    def is_normal_map(self, reference: TextureRef) -> bool:
        """Whether an image holds normals, which are of length 1 and look upwards, not heights."""
        pixels = linear_pixels(self.images[reference.image])[..., :3] * 2.0 - 1.0
        length = np.linalg.norm(pixels, axis=2)
        return bool(np.median(np.abs(length - 1.0)) < 0.1 and np.median(pixels[..., 2]) > 0.5)

    def _found(self, reference: str) -> str | None:
        for name in ends_of_path(reference):
            try:
                if self.bundle.holds(name):
                    return name
            except InputError:  # no name of a bundle
                continue
        return None


def with_alpha(colour: Float32, alpha: Float32, where: str) -> Float32:
    """Linear RGBA of `colour` [h, w, 4] with `alpha` [H, W], at the larger of both sizes."""
    height, width = (int(size) for size in np.maximum(alpha.shape, colour.shape[:2]))
    check_count(height * width * 16, MAX_IMAGE_BYTES, "bytes in its textures", where)
    parts = [_scaled(colour[..., :3], height, width), _scaled(alpha[..., None], height, width)]
    return np.concatenate(parts, axis=2).astype(np.float32)


def luminance(colours: Float32) -> Float32:
    """Of linear colours [..., 3 or 4] (ITU-R BT.709)."""
    return np.asarray(colours[..., :3] @ LUMINANCE)


def _scaled(pixels: Float32, height: int, width: int) -> Float32:
    """[height, width, C] of an image, each pixel repeated or the nearest taken."""
    rows = np.arange(height) * pixels.shape[0] // height
    columns = np.arange(width) * pixels.shape[1] // width
    return np.asarray(pixels[rows[:, None], columns])
