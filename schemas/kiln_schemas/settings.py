"""What a user may choose about a bake: settings, presets and `key=value` overrides.

A preset is a complete set of settings; overrides name a field by its dotted path
(`render.samples=64`). Every bound is stated here and nowhere else.
"""

from collections.abc import Mapping, Sequence
from enum import StrEnum
from typing import Annotated, Any, Final, Literal

from pydantic import Field, PlainValidator, ValidationError, WithJsonSchema, field_validator, model_validator
from pydantic_core import PydanticCustomError

from kiln_schemas.base import Contract, Word
from kiln_schemas.errors import InputError


class Function(StrEnum):
    """The two spherical functions that are baked per texel."""

    LIGHT_FIELD = "light_field"
    """Incident radiance without the directly seen environment, three channels."""
    VISIBILITY = "visibility"
    """Illumination-weighted environment visibility W_E (light-field paper, eq. 7), three channels."""


class UvPolicy(StrEnum):
    """What to do about the light-map UV set."""

    AUTO = "auto"
    """Keep TEXCOORD_1 where it is unique and inside [0, 1]; unwrap otherwise."""
    KEEP = "keep"
    """The scene's set is final: refuse the scene where it is missing, overlaps or leaves [0, 1]."""
    UNWRAP = "unwrap"
    """Always unwrap."""


class Solver(StrEnum):
    """How the lobes of both functions are found."""

    COHERENT = "coherent"
    """Gradient descent on all lobes at once, at texels and between them; on few texels of the light map first."""
    CNN = "cnn"
    """The network's own output (Currius et al. 2020)."""


AUTO: Final = "auto"
SMALLEST_SIDE: Final = 8
LARGEST_SIDE: Final = 8192


def _side(value: object) -> int | str:
    """Texels along a side, or AUTO."""
    if value == AUTO:
        return AUTO
    if isinstance(value, str) and value.strip().isdecimal() and len(value) < 20:
        value = int(value)
    if not isinstance(value, int) or isinstance(value, bool) or not SMALLEST_SIDE <= value <= LARGEST_SIDE:
        raise PydanticCustomError(
            "side", f"must be 'auto' or a whole number of texels from {SMALLEST_SIDE} to {LARGEST_SIDE}"
        )
    return value


Resolution = Annotated[
    int | Literal["auto"],
    PlainValidator(_side),
    WithJsonSchema(
        {"anyOf": [{"type": "integer", "minimum": SMALLEST_SIDE, "maximum": LARGEST_SIDE}, {"const": AUTO}]}
    ),
]


class LightmapSettings(Contract):
    """The light map: one atlas for the whole scene."""

    resolution: Resolution = Field(
        default="auto",
        description="texels along each side; auto: as many as `density` and the charts need, from `least` to `most`",
    )
    density: float = Field(default=8.0, gt=0, le=1e6, description="texels a metre that `auto` aims at")
    least: int = Field(default=32, ge=SMALLEST_SIDE, le=LARGEST_SIDE, description="texels a side that `auto` begins at")
    most: int = Field(
        default=512,
        ge=SMALLEST_SIDE,
        le=LARGEST_SIDE,
        description="texels a side that `auto` ends at, unless the charts find no room in them",
    )
    irradiance_scale: int = Field(
        default=1, ge=1, le=8, description="irradiance texels along each side of a texel: contact shadows need them"
    )
    padding: int = Field(default=2, ge=1, le=16, description="empty texels between charts when unwrapping")
    uv: UvPolicy = UvPolicy.AUTO
    tile: int = Field(default=16, ge=4, le=64, description="texels along each side of a render tile")

    def side(self, chosen: int | None) -> int:
        """Texels along each side: the number in the settings, or at `auto` what the prepare task chose."""
        if self.resolution != AUTO:
            return self.resolution
        if chosen is None:
            raise InputError("the prepare task chose no resolution", where="lightmap.resolution")
        return chosen

    def irradiance_side(self, side: int) -> int:
        """Texels along each side of the irradiance map of a light map of `side`: a multiple, at most LARGEST_SIDE."""
        return side * min(self.irradiance_scale, max(LARGEST_SIDE // side, 1))

    @model_validator(mode="after")
    def _bounds_in_order(self) -> "LightmapSettings":
        if self.least > self.most:
            raise PydanticCustomError("bounds", f"least is {self.least}, which is more than most, {self.most}")
        return self


class RenderSettings(Contract):
    """Path tracing of the local light fields."""

    image_size: int = Field(ge=16, le=256, description="pixels along each side of a light-field image")
    samples: int = Field(
        default=16,
        ge=1,
        le=65536,
        description="paths per light-field pixel, in the mean: more of them where it is noisy",
    )
    irradiance_samples: int = Field(
        default=1024, ge=1, le=1_000_000, description="paths per texel of the irradiance map"
    )
    between_samples: int = Field(
        default=16, ge=0, le=65536, description="paths per pixel of the sparse light fields between texels; 0: none"
    )
    radiance_cache: bool = Field(
        default=True, description="end paths of light fields at diffuse surfaces, whose light is taken from a map of it"
    )
    max_depth: int = Field(default=6, ge=0, le=64, description="scattering events on a path, at most")

    @field_validator("image_size")
    @classmethod
    def _pools_four_times(cls, value: int) -> int:
        if value % 16:
            raise ValueError("must be a multiple of 16 (the network halves the image four times)")
        return value


class FitSettings(Contract):
    """How images become lobes: by the coherent descent or by the network."""

    solver: Solver = Solver.COHERENT
    lobes: int = Field(ge=1, le=64, description="spherical Gaussians per texel")
    steps: int = Field(ge=1, le=1_000_000, description="optimiser steps of the light field's network (solver cnn)")
    start_steps: int = Field(
        default=600, ge=1, le=1_000_000, description="steps of the coherent descent on few texels of the light map"
    )
    visibility_steps: int = Field(
        default=1000, ge=1, le=1_000_000, description="optimiser steps of the visibility's network (solver cnn)"
    )
    batch: int = Field(default=32, ge=1, le=1024, description="texels per step")
    learning_rate: float = Field(default=1e-3, gt=0, le=1)
    window: int = Field(default=4096, ge=1, le=1_000_000, description="texels in the shuffle window")
    refine_steps: int = Field(
        default=800, ge=1, le=1_000_000, description="steps of the coherent descent on all texels"
    )
    visibility_refine_steps: int = Field(
        default=200, ge=1, le=1_000_000, description="the same for the visibility, which is far easier"
    )
    block: int = Field(default=32, ge=8, le=256, description="texels along each side of a refine task's block")
    checkpoint_s: float = Field(default=60.0, ge=1.0, le=3600.0, description="seconds between checkpoints")

    def steps_key(self, function: Function) -> str:
        """Which field says how many steps a function's network is trained for."""
        return "visibility_steps" if function is Function.VISIBILITY else "steps"

    def refine_steps_key(self, function: Function) -> str:
        """Which field says how many steps the descent on all texels takes."""
        return "visibility_refine_steps" if function is Function.VISIBILITY else "refine_steps"


class PackagedScene(StrEnum):
    """Which form of the scene a package holds."""

    FLAT = "flat"
    """scene.glb: flattened to world space, as it was baked."""
    ORIGINAL = "original"
    """The user's own glTF file with TEXCOORD_1 as well, in original.glb."""


class PackageSettings(Contract):
    """What is written besides the textures."""

    scene: PackagedScene = Field(
        default=PackagedScene.FLAT, description="original: the user's own glTF file with TEXCOORD_1 as well"
    )

    environment_size: int = Field(
        default=128,
        ge=16,
        le=1024,
        description="side of the GGX cube's largest mip",
    )
    supercompress: bool = Field(default=True, description="Zstandard inside the lobe textures")
    denoise: bool = Field(
        default=False, description="take noise out of the irradiance: mean error as of two to four times the paths"
    )
    pictures: bool = Field(
        default=True, description="compare a picture of the package with a path-traced one where no gate does"
    )


class BakeSettings(Contract):
    """Everything that determines a bake, apart from the scene and the environment."""

    preset: Word
    seed: int = Field(default=0, ge=0, le=2**32 - 1)
    lightmap: LightmapSettings
    render: RenderSettings
    fit: FitSettings
    package: PackageSettings = PackageSettings()


PRESETS: Final[Mapping[str, BakeSettings]] = {
    "draft": BakeSettings(
        preset="draft",
        lightmap=LightmapSettings(density=1.4, least=32, most=128, irradiance_scale=4, tile=8),
        render=RenderSettings(image_size=32, irradiance_samples=512),
        fit=FitSettings(lobes=8, steps=1000, visibility_steps=250),
        package=PackageSettings(environment_size=64),
    ),
    "preview": BakeSettings(
        preset="preview",
        lightmap=LightmapSettings(density=2.8, least=64, most=256, irradiance_scale=4),
        render=RenderSettings(image_size=64),
        fit=FitSettings(lobes=16, steps=2500, visibility_steps=300),
    ),
    "production": BakeSettings(
        preset="production",
        lightmap=LightmapSettings(density=22.0, least=512, most=1024, irradiance_scale=2),
        render=RenderSettings(image_size=128, irradiance_samples=4096, max_depth=8),
        fit=FitSettings(lobes=16, steps=60_000, visibility_steps=24_000),
        package=PackageSettings(environment_size=256),
    ),
}


def make_settings(preset: str, overrides: Sequence[str] = ()) -> BakeSettings:
    """The settings of a preset with `dotted.key=value` overrides applied; InputError names what is wrong."""
    if preset not in PRESETS:
        raise InputError(f"'{preset}' is not a preset", where="preset", remedy=f"Choose one of {', '.join(PRESETS)}.")
    tree = PRESETS[preset].model_dump(mode="json")
    for override in overrides:
        key, equals, value = override.partition("=")
        if not equals:
            raise InputError(f"'{override}' has no '='", where="--set", remedy="Write it as key=value.")
        _assign(tree, key.strip(), value.strip())
    return parse_settings(tree)


def parse_settings(tree: Mapping[str, Any]) -> BakeSettings:
    """Validate a settings document; InputError names the first field at fault, its value and its bound."""
    try:
        return BakeSettings.model_validate(tree)
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(str(part) for part in first["loc"]) or "settings"
        raise InputError(
            f"{first.get('input')!r} is refused: {first['msg']}", where=where, remedy="See `lightkiln bake --help`."
        ) from None


def setting_keys() -> list[str]:
    """All dotted keys that `--set` takes."""
    return [".".join(path) for path in _leaves(PRESETS["draft"].model_dump(mode="json"))]


def _leaves(tree: Mapping[str, Any], prefix: tuple[str, ...] = ()) -> list[tuple[str, ...]]:
    out: list[tuple[str, ...]] = []
    for key, value in tree.items():
        out += _leaves(value, (*prefix, key)) if isinstance(value, dict) else [(*prefix, key)]
    return out


def _assign(tree: dict[str, Any], key: str, value: str) -> None:
    if key not in setting_keys() or key == "preset":
        raise InputError(
            f"'{key}' is not a setting", where="--set", remedy=f"Settings: {', '.join(setting_keys()[1:])}."
        )
    *path, leaf = key.split(".")
    node = tree
    for part in path:
        node = node[part]
    node[leaf] = value
