"""Mitsuba's textures as images and look-ups of the scene model.

A bitmap's rows count from v = 0, as `model` has it. `to_uv` has to be a scale and then a rotation, as
KHR_texture_transform has it: a shear is left out with a note. A checkerboard becomes an image.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Final

import numpy as np

from kiln_schemas.text import quoted
from kiln_workers.scene.bundle import BundleFolder
from kiln_workers.scene.geometry import Floats
from kiln_workers.scene.images import LOW_RANGE, decode_image, linear_pixels
from kiln_workers.scene.limits import MAX_IMAGE_BYTES, check_count
from kiln_workers.scene.mitsuba_tree import Colour, Plugin
from kiln_workers.scene.model import Float32, Image, TextureRef

WRAPS: Final = ("repeat", "mirror", "clamp")
CHECKS: Final = 256
"""Pixels along a side of a checkerboard's two by two fields."""
CONSTANTS: Final = {"rawconstant": "value", "srgb": "color", "uniform": "value"}
"""Textures that are one colour, and what they call it."""
VERTEX_COLOURS: Final = "vertex_color"
LUMINANCE: Final = np.array([0.212671, 0.715160, 0.072169])


@dataclass(frozen=True, eq=False)
class Value:
    """A colour or, where `image` is, an image times it; `lookup` says how it is looked up."""

    colour: Colour
    image: Image | None = None
    lookup: TextureRef = TextureRef(0)  # noqa: RUF009 (it is frozen)
    painted: bool = False  # the vertices' colours multiply

    def pixels(self) -> Float32:
        """Linear colours [H, W, 3] with the factor; of one pixel where there is no image."""
        factor = np.array(self.colour, dtype=np.float32)
        return np.broadcast_to(factor, (1, 1, 3)) if self.image is None else linear_pixels(self.image)[..., :3] * factor

    @property
    def mean(self) -> Colour:
        """The mean colour."""
        if self.image is None:
            return self.colour
        red, green, blue = (float(x) for x in self.pixels().mean(axis=(0, 1), dtype=np.float64))
        return red, green, blue

    @property
    def level(self) -> float:
        """The mean luminance: what Mitsuba takes a texture for where it needs a number."""
        return float(LUMINANCE @ self.mean / LUMINANCE.sum())

    def mapped(self, change: Callable[[Floats], Floats]) -> "Value":
        """The value with all its linear colours [..., 3] changed."""
        if self.image is None:
            red, green, blue = (float(x) for x in change(np.array(self.colour)))
            return replace(self, colour=(red, green, blue))
        pixels = change(self.pixels().astype(np.float64)).astype(np.float32)
        return replace(self, colour=(1.0, 1.0, 1.0), image=Image(self.image.name, pixels, False))


def number(value: float) -> Value:
    """A value that is one number."""
    return Value((value, value, value))


def stacked(values: Sequence[Value], notes: list[str], what: str) -> tuple[list[Float32], TextureRef]:
    """The pixels [H, W, 3] of values on one grid, and the look-up of all.

    An image that is looked up otherwise than the first one is replaced by its mean, with a note.
    """
    lookup = next((value.lookup for value in values if value.image is not None), values[0].lookup)
    grids = []
    for value in values:
        if value.image is not None and value.lookup != lookup:
            notes.append(f"{what}: a texture that is placed otherwise than the one beside it is replaced by its mean.")
            value = Value(value.mean)
        grids.append(value.pixels())
    height, width = (max(grid.shape[axis] for grid in grids) for axis in (0, 1))
    return [
        grid[np.arange(height) * len(grid) // height][:, np.arange(width) * grid.shape[1] // width] for grid in grids
    ], lookup


@dataclass
class Textures:
    """Reads textures of a scene; `images` are what the scene's materials look up."""

    folder: Path
    notes: list[str]
    images: list[Image] = field(default_factory=list)
    decoded: dict[tuple[str, bool], Image] = field(default_factory=dict)
    bytes_left: int = MAX_IMAGE_BYTES

    def value(self, plugin: Plugin, name: str, default: float) -> Value:
        """A reflectance or texture that belongs to a plugin."""
        texture = plugin.child(name)
        if texture is None:
            return Value(plugin.reflectance(name, default))
        return self.texture(texture)

    def texture(self, plugin: Plugin) -> Value:
        """A texture plugin; InputError for one that is not read."""
        if plugin.kind == "bitmap":
            return self._bitmap(plugin)
        if plugin.kind == "checkerboard":
            return self._checkerboard(plugin)
        if plugin.kind == "mesh_attribute" and plugin.text("name") == VERTEX_COLOURS:
            return replace(number(plugin.number("scale", 1.0)), painted=True)
        if plugin.kind in CONSTANTS:
            return Value(plugin.reflectance(CONSTANTS[plugin.kind], 1.0))
        raise plugin.fail("this texture is not read", "Use bitmap or checkerboard.")

    def emitted(self, plugin: Plugin) -> Value:
        """The radiance of an area light."""
        texture = plugin.child("radiance")
        return Value(plugin.radiance("radiance")) if texture is None else self.texture(texture)

    def reference(self, image: Image | None, lookup: TextureRef) -> TextureRef | None:
        """The look-up of an image, which joins `images`; None for None."""
        if image is None:
            return None
        found = next((at for at, known in enumerate(self.images) if known is image), None)
        if found is None:
            found = len(self.images)
            self.images.append(image)
            if not any(known is image for known in self.decoded.values()):
                self._count(image)
        return replace(lookup, image=found)

    def _count(self, image: Image) -> None:
        size = int(image.pixels.nbytes)
        check_count(size, self.bytes_left, "bytes when it is decoded beside the others", f"texture '{image.name}'")
        self.bytes_left -= size

    def _bitmap(self, plugin: Plugin) -> Value:
        name, raw = plugin.text("filename"), plugin.flag("raw")
        if not name:
            raise plugin.fail("it has no filename")
        if (name, raw) not in self.decoded:
            data = BundleFolder(self.folder, "").read(name, "texture")
            found = decode_image(data, name, self.bytes_left)
            image = Image(Path(name).stem, found.pixels, found.format in LOW_RANGE and not raw)
            self.decoded[name, raw] = image
            self._count(image)
        if plugin.text("filter_type", "bilinear") == "nearest":
            self.notes.append(f"Texture {quoted(name)}: looked up between pixels, not at the nearest.")
        wrap = plugin.text("wrap_mode", "repeat")
        if wrap not in WRAPS:
            raise plugin.fail(f"the wrap_mode {quoted(wrap)} is not known", f"Use one of {', '.join(WRAPS)}.")
        return Value((1.0, 1.0, 1.0), self.decoded[name, raw], self._lookup(plugin, wrap))

    def _checkerboard(self, plugin: Plugin) -> Value:
        colours = []
        for name, default in (("color0", 0.4), ("color1", 0.2)):
            value = self.value(plugin, name, default)
            if value.image is not None:
                self.notes.append(f"{plugin.label}: the texture '{name}' is replaced by its mean.")
            colours.append(np.array(value.mean))
        upper = np.arange(CHECKS) >= CHECKS // 2
        same = upper[:, None] == upper[None, :]
        pixels = np.where(same[..., None], colours[0], colours[1]).astype(np.float32)
        return Value((1.0, 1.0, 1.0), Image("checkerboard", pixels, False), self._lookup(plugin, "repeat"))

    def _lookup(self, plugin: Plugin, wrap: str) -> TextureRef:
        matrix = plugin.transform("to_uv")
        if not np.isfinite(matrix).all():
            raise plugin.fail("'to_uv' is not finite")
        linear = matrix[:2, :2]
        # KHR_texture_transform: uv' = T R S uv with R = ((c, s), (-s, c)) for v downwards.
        angle = float(np.arctan2(-linear[1, 0], linear[0, 0]))
        cosine, sine = np.cos(angle), np.sin(angle)
        rotation = np.array([[cosine, sine], [-sine, cosine]])
        scale = np.diag(rotation.T @ linear)
        if not np.allclose(rotation @ np.diag(scale), linear, atol=1e-4 * np.abs(linear).max()):
            self.notes.append(f"{plugin.label}: the shear of its to_uv is left out.")
        offset = (float(matrix[0, 3]), float(matrix[1, 3]))
        return TextureRef(0, (wrap, wrap), offset, (float(scale[0]), float(scale[1])), angle)
