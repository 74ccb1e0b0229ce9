"""`manifest.json`: what a package holds, how it was made and how good it is."""

from typing import Annotated, Any

from pydantic import Field

from kiln_schemas.base import FLOAT32_MAX, Contract, Count, Id, Magnitude, Name, Seconds
from kiln_schemas.camera import Camera, CameraName
from kiln_schemas.gates import MOST_CAMERAS, GateResult
from kiln_schemas.settings import BakeSettings
from kiln_schemas.tasks import (
    MOST_FILES,
    MOST_NOTES,
    MOST_PLACEMENTS,
    Artifact,
    BundlePath,
    EnvironmentRef,
    FitMetrics,
    Placement,
    Sha256,
)
from kiln_schemas.text import Note, Told


class ManifestMetrics(Contract):
    """Errors per function; a function that was left out is None and `left_out` says why."""

    light_field: FitMetrics | None
    visibility: FitMetrics | None


class ReferenceView(Contract):
    """Where a path-traced picture of the package was seen from, for comparison."""

    camera: Camera
    white: float = Field(gt=0.0, le=FLOAT32_MAX)
    """Luminance that it shows as white."""
    flip: float | None = Field(default=None, ge=0.0, le=1.0)
    """Mean HDR-FLIP of the package's picture against it."""
    noise_floor: float | None = Field(default=None, ge=0.0, le=1.0)
    """What a package without any error would measure, for the noise of the path-traced picture."""
    samples: Count | None = None
    """Paths a pixel of the path-traced picture."""
    width: Count | None = None
    height: Count | None = None


Figures = Annotated[dict[Name, Any], Field(max_length=64)]
"""Figures by name. Nobody sends them to a coordinator: they are in a file, and its readers bound that."""


class Manifest(Contract):
    """The package's table of contents; written last, so a package with a manifest is whole."""

    format_version: Count
    generator: Name
    job_id: Id
    job_name: Name
    settings: BakeSettings
    scene_hash: Sha256
    inputs: dict[BundlePath, Sha256] = Field(max_length=MOST_FILES)
    """The bundle's files."""
    environment: EnvironmentRef | None
    """Which of them is the distant illumination, its scale and rotation."""
    seeds: dict[Name, Count] = Field(max_length=16)
    exposure: dict[Name, Magnitude] = Field(max_length=16)
    """Factor per function by which radiance was multiplied before the loss; amplitudes are in scene units again."""
    metrics: ManifestMetrics
    gates: tuple[GateResult, ...] = Field(default=(), max_length=MOST_CAMERAS + 2)
    """The quality gates that the job stated, measured."""
    views: dict[CameraName, ReferenceView] = Field(default_factory=dict, max_length=MOST_CAMERAS)
    """Of `gates/NAME_reference.png`, by NAME: those of FLIP gates, else the one of `package.pictures`."""
    left_out: dict[Name, Told] = Field(default_factory=dict, max_length=64)
    """Artifact or function to the reason why it is absent."""
    textures: dict[Name, Figures] = Field(max_length=64)
    """Per KTX2 file: width, height, layers, lobes, channel meanings, `normalised` for environment_u; `environment.exr`
    with its projection and orientation."""
    lightmap: Figures
    """Resolution, texels covered, valid, invalid, charts, `speck_share` (the part of the covered texels that lies in
    charts of four texels or fewer), worst texel size in metres."""
    placements: tuple[Placement, ...] = Field(default=(), max_length=MOST_PLACEMENTS)
    """Scale and offset of the meshes whose own light-map UV was packed as a whole."""
    stage_seconds: dict[Name, Seconds] = Field(max_length=16)
    overflows: Count
    versions: dict[Name, Name] = Field(max_length=64)
    notes: tuple[Note, ...] = Field(max_length=MOST_NOTES)
    files: tuple[Artifact, ...] = Field(max_length=MOST_FILES)
    """Every other file of the package with its sha256."""
