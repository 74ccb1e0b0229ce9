"""Wavefront material libraries (MTL), by the format's public description (Wavefront, "Object Files").

MTL's physically based keys (Pr, Pm) are used where present; otherwise Phong's exponent gives alpha^2 = 2 / (Ns + 2)
(Walter et al. 2007, section 5.1), without highlight roughness 1. `Ke` is radiance. `d` (or `Tr` = 1 - d) and `map_d`
are opacity, by which the surface is blended. `norm` is a normal map. Map statements
keep `-o`, `-s` and `-clamp`; other options play no part.
"""

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np

from kiln_schemas.errors import InputError
from kiln_schemas.tasks import PATH_LENGTH
from kiln_schemas.text import told
from kiln_workers.scene.bundle import BundleFolder
from kiln_workers.scene.gltf_materials import make_image
from kiln_workers.scene.images import linear_pixels
from kiln_workers.scene.limits import MAX_ENTRIES, MAX_TEXT_BYTES, NAME_LENGTH, check_count
from kiln_workers.scene.model import Image, Material, TextureRef
from kiln_workers.scene.text_lines import statements
from kiln_workers.scene.texture_files import with_alpha

MAP_LENGTH: Final = 2 * PATH_LENGTH
NUMBER_KEYS: Final = {"kd", "ke", "ks", "ns", "pm", "pr", "d", "tr", "ni"}
SPELLED: Final = {"kd": "Kd", "ke": "Ke", "ks": "Ks", "ns": "Ns", "pm": "Pm", "pr": "Pr", "tr": "Tr"}
MAP_KEYS: Final = {"map_kd", "map_ke", "map_d", "norm"}
SILENT: Final = {"illum", "ka", "tf", "sharpness", "map_ka", "map_aat"}
"""What a path tracer has no use for."""
OPTIONS: Final = {"o": 3, "s": 3, "t": 3, "mm": 2}
"""Numbers that an option takes at the most; all others take one word."""


@dataclass
class MaterialLibrary:
    """Materials and their images, in the order of first use; each file is decoded once."""

    bundle: BundleFolder
    used: Collection[str]
    notes: list[str]
    materials: dict[str, Material] = field(default_factory=dict)
    images: list[Image] = field(default_factory=list)
    _known: dict[tuple[str, bool], int] = field(default_factory=dict)

    def read(self, libraries: list[str]) -> None:
        """The materials in `used` that the libraries define."""
        bundle = self.bundle
        for library in dict.fromkeys(name for line in libraries for name in _library_names(line, bundle)):
            name = bundle.name(library)
            if not bundle.holds(library):
                shown = told(library, NAME_LENGTH)
                self.notes.append(f"'{bundle.origin}': the material library '{shown}' is missing; defaults are used.")
                continue
            inner = BundleFolder(bundle.folder, name)
            for title, table in _tables(bundle.read(library, "material library", MAX_TEXT_BYTES), name).items():
                if title in self.used:
                    self.materials[title] = self._material(told(title, NAME_LENGTH), table, inner)

    def _material(self, title: str, table: Mapping[str, str], bundle: BundleFolder) -> Material:
        def numbers(key: str, default: tuple[float, ...]) -> tuple[float, ...]:
            return _numbers(title, key, table.get(key), default)

        other = sorted(key for key in table if key not in NUMBER_KEYS | MAP_KEYS | SILENT)
        if other:
            self.notes.append(f"Material '{title}': {', '.join(told(key, 40) for key in other)} ignored.")
        red, green, blue = (min(value, 1.0) for value in numbers("kd", (0.8, 0.8, 0.8)))
        glow = numbers("ke", (0.0, 0.0, 0.0))
        shiny = max(numbers("ks", (0.0, 0.0, 0.0))) > 0.0 and "ns" in table
        phong = (2.0 / (numbers("ns", (0.0,))[0] + 2.0)) ** 0.25 if shiny else 1.0
        opacity = numbers("d", (1.0 - min(numbers("tr", (0.0,))[0], 1.0),))[0]
        material = Material(
            name=title,
            base_color=(red, green, blue, min(opacity, 1.0)),
            base_color_texture=self._texture(table.get("map_kd"), title, bundle),
            metallic=min(numbers("pm", (0.0,))[0], 1.0),
            roughness=min(numbers("pr", (phong,))[0], 1.0),
            emission=(glow[0], glow[1], glow[2]),
            emission_texture=self._texture(table.get("map_ke"), title, bundle) if max(glow) > 0.0 else None,
            blend=opacity < 1.0 or "map_d" in table,
            normal_texture=self._texture(table.get("norm"), title, bundle, srgb=False),
        )
        return self._with_opacity(material, table.get("map_d"), title, bundle)

    def _with_opacity(self, material: Material, line: str | None, title: str, bundle: BundleFolder) -> Material:
        """The material with `map_d` as the alpha of its base colour's texture."""
        base = material.base_color_texture
        if line is None:
            # An image's own alpha is no opacity in MTL.
            return material if base is None or not material.blend else self._opaque(material, base)
        cover = self._texture(line, title, bundle, srgb=False)
        assert cover is not None
        if base is not None and replace(base, image=0) != replace(cover, image=0):
            self.notes.append(
                f"Material '{title}': map_d is laid out as map_Kd; its own -o, -s and -clamp are ignored."
            )
        image = self.images[cover.image]
        pixels = linear_pixels(image)
        # An image with alpha is opacity by that, any other by its value.
        value = pixels[..., 3] if image.pixels.shape[2] in (2, 4) else pixels[..., :3].mean(axis=2)
        colour = np.ones((1, 1, 4), np.float32) if base is None else linear_pixels(self.images[base.image])
        merged = with_alpha(colour, value, f"material '{title}'")
        self.images.append(Image(f"{title} with map_d", merged, False))
        return replace(material, base_color_texture=replace(base or cover, image=len(self.images) - 1))

    def _opaque(self, material: Material, base: TextureRef) -> Material:
        image = self.images[base.image]
        if image.pixels.shape[2] not in (2, 4):
            return material
        colours = np.ascontiguousarray(image.pixels[..., :-1])
        self.images.append(Image(image.name, colours, image.srgb))  # type: ignore[arg-type]
        return replace(material, base_color_texture=replace(base, image=len(self.images) - 1))

    def _texture(self, line: str | None, title: str, bundle: BundleFolder, srgb: bool = True) -> TextureRef | None:
        """The texture of a map statement, with its offset, scale and clamping."""
        if not line:
            return None
        options, name = _map_statement(line, bundle, title)
        path = bundle.name(name)
        key = (path, srgb)
        if key not in self._known:
            data = bundle.read(name, "texture")
            image = make_image(data, name, srgb, f"material '{title}', texture '{name}'", self.images)
            self._known[key] = len(self.images)
            self.images.append(image)
        # A look-up at (u, v) reads the image at (u, v) * s + o, v upwards; the model's v is downwards.
        (s, t), (du, dv) = options.scale, options.offset
        wrap = "clamp" if options.clamp else "repeat"
        return TextureRef(self._known[key], (wrap, wrap), (du, 1.0 - t - dv), (s, t))


@dataclass
class _Options:
    """What a map statement says of its texture's place."""

    offset: tuple[float, float] = (0.0, 0.0)
    scale: tuple[float, float] = (1.0, 1.0)
    clamp: bool = False


def _tables(data: bytes, where: str) -> dict[str, dict[str, str]]:
    """Statements by material; keys in lower case, as writers differ."""
    tables: dict[str, dict[str, str]] = {}
    current: dict[str, str] = {}
    for _, key, rest in statements(data):
        if key == "newmtl":
            current = tables.setdefault(rest, {})
            check_count(len(tables), MAX_ENTRIES, "materials", where)
        else:
            check_count(len(current), MAX_ENTRIES, "statements in a material", where)
            current[key.lower()] = rest
    return tables


def _numbers(title: str, key: str, text: str | None, default: tuple[float, ...]) -> tuple[float, ...]:
    if text is None:
        return default
    words = text.split()
    if key == "d" and words[:1] == ["-halo"]:
        words = words[1:]
    try:
        values = tuple(float(word) for word in words)
    except ValueError:
        values = ()
    if len(values) not in (1, 3) or not np.isfinite(values).all() or min(values) < 0.0:
        raise InputError(
            f"'{SPELLED.get(key, key)}' is not one or three numbers of 0 or more",
            where=f"material '{title}'",
            remedy="Mend the library.",
        )
    return values * 3 if len(values) == 1 and len(default) == 3 else values


def _map_statement(line: str, bundle: BundleFolder, title: str) -> tuple[_Options, str]:
    """Options and file name of a map statement; the name is the longest that is a file's, as it may hold spaces."""
    check_count(len(line), MAP_LENGTH, "characters in a map statement", bundle.origin)
    words = line.split()
    options, at = _Options(), 0
    while at < len(words) - 1 and words[at].startswith("-"):
        option = words[at][1:].lower()
        count = 0
        while option in OPTIONS and count < OPTIONS[option] and _is_number(words[at + 1 + count : at + 2 + count]):
            count += 1
        values = [float(word) for word in words[at + 1 : at + 1 + count]]
        if option == "o" and values:
            options.offset = (values[0], values[1] if count > 1 else 0.0)
        elif option == "s" and values:
            options.scale = (values[0], values[1] if count > 1 else 1.0)
        elif option == "clamp":
            options.clamp = words[at + 1].lower() == "on"
        at += 1 + (count if option in OPTIONS else 1)
    if not np.isfinite([*options.offset, *options.scale]).all():
        raise InputError(
            "an option of a map statement is not finite", where=f"material '{title}'", remedy="Mend the library."
        )
    rest = line if at == 0 else " ".join(words[at:])
    names = [rest, *(" ".join(words[start:]) for start in range(at + 1, len(words)))] if at else [line]
    return options, next((name for name in names if bundle.holds(name)), names[0])


def _is_number(words: list[str]) -> bool:
    try:
        return bool(words) and float(words[0]) is not None
    except ValueError:
        return False


def _library_names(line: str, bundle: BundleFolder) -> list[str]:
    """The names of an `mtllib` line: one that may hold spaces, or several; the files that there are decide."""
    return [line] if bundle.holds(line) else line.split()
