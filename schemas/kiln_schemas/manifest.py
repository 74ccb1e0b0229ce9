"""`manifest.json`: what a package holds, how it was made and how good it is."""

from typing import Any

from pydantic import Field

from kiln_schemas.base import Contract
from kiln_schemas.camera import Camera
from kiln_schemas.gates import GateResult
from kiln_schemas.settings import BakeSettings
from kiln_schemas.tasks import Artifact, EnvironmentRef, FitMetrics, Sha256


class ManifestMetrics(Contract):
    """Errors per function; a function that was left out is None and `left_out` says why."""

    light_field: FitMetrics | None
    visibility: FitMetrics | None


class ReferenceView(Contract):
    """Where a path-traced picture of the package was seen from, for comparison."""

    camera: Camera
    white: float = Field(gt=0.0)
    """Luminance that it shows as white."""


class Manifest(Contract):
    """The package's table of contents; written last, so a package with a manifest is whole."""

    format_version: int
    generator: str
    job_id: str
    job_name: str
    settings: BakeSettings
    scene_hash: Sha256
    inputs: dict[str, Sha256]
    """The bundle's files."""
    environment: EnvironmentRef | None
    """Which of them is the distant illumination, its scale and rotation."""
    seeds: dict[str, int]
    exposure: dict[str, float]
    """Factor per function by which radiance was multiplied before the loss; amplitudes are in scene units again."""
    metrics: ManifestMetrics
    gates: tuple[GateResult, ...] = ()
    """The quality gates that the job stated, measured."""
    views: dict[str, ReferenceView] = Field(default_factory=dict)
    """Of `gates/NAME_reference.png`, by NAME."""
    left_out: dict[str, str] = Field(default_factory=dict)
    """Artifact or function to the reason why it is absent."""
    textures: dict[str, dict[str, Any]]
    """Per KTX2 file: width, height, layers, lobes, channel meanings, `normalised` for environment_u; `environment.exr`
    with its projection and orientation."""
    lightmap: dict[str, Any]
    """Resolution, texels covered, valid, invalid, charts, worst texel size in metres."""
    stage_seconds: dict[str, float]
    overflows: int
    versions: dict[str, str]
    notes: tuple[str, ...]
    files: tuple[Artifact, ...]
    """Every other file of the package with its sha256."""
