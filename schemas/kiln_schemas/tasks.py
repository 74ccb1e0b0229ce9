"""What a worker is given (payloads) and what it hands back (results), per kind of task.

All data between tasks travel as content-addressed blobs through the coordinator, except the
light-field store, which workers write and read directly at `store_url`.
"""

from collections.abc import Sequence
from enum import StrEnum
from typing import Annotated, Final, Literal

from pydantic import Field, TypeAdapter, ValidationError

from kiln_schemas.base import Contract, Count, Id, Magnitude, Name, Real, Seconds, Url, Word
from kiln_schemas.errors import InputError, Problem
from kiln_schemas.gates import MOST_CAMERAS, Cameras, GateResult, Gates
from kiln_schemas.settings import LARGEST_SIDE, SMALLEST_SIDE, BakeSettings, Function
from kiln_schemas.text import Line, Log, Note, Told

Sha256 = Annotated[str, Field(pattern=r"^[0-9a-f]{64}$", max_length=64)]
PATH_LENGTH: Final = 512
BundlePath = Annotated[str, Field(min_length=1, max_length=PATH_LENGTH)]
Number = Annotated[int, Field(ge=0, lt=2**31)]
"""A count or an index that the database holds in 32 bits."""
Bytes = Annotated[int, Field(ge=0, lt=2**63)]
MOST_TILES: Final = 65536
"""Of a job; the coordinator's configuration may allow fewer."""
MOST_PLACEMENTS: Final = 65536
MOST_NOTES: Final = 1001
"""Of a scene: a thousand, and one that tells how many are left out."""
MOST_POINTS: Final = 10_000
"""Of a curve."""
MOST_FILES: Final = 4096
"""Of a bundle, and of a package."""
TILE_TEXELS: Final = 64 * 64
Texel = Annotated[int, Field(ge=0, lt=8192)]
"""A row or a column of the light map."""
Between = Annotated[tuple[Sha256, ...], Field(max_length=3)]
Renders = Annotated[tuple["RenderResult", ...], Field(max_length=MOST_TILES)]


class TaskKind(StrEnum):
    """The stages of a bake; a worker offers some of them."""

    PREPARE = "prepare"
    RENDER = "render"
    FIT = "fit"
    REFINE = "refine"
    PACKAGE = "package"


class EnvironmentRef(Contract):
    """The distant illumination: an equirectangular HDR or EXR of the bundle."""

    file: BundlePath
    scale: float = Field(default=1.0, gt=0, le=1e6)
    rotation_deg: float = Field(default=0.0, ge=-360, le=360)
    """About +Y, counter-clockwise seen from above."""


class Bundle(Contract):
    """A scene as a set of blobs: relative POSIX paths to hashes."""

    entry: BundlePath
    files: dict[BundlePath, Sha256] = Field(min_length=1, max_length=MOST_FILES)
    environment: EnvironmentRef | None = None


class Block(Contract):
    """A square of the light map that is refined as one task: first row and column, texels along each side."""

    row: Texel
    column: Texel
    size: int = Field(ge=1, le=256)


def tile_label(row: int, column: int) -> str:
    """The label of the task that renders the tile with this first row and column."""
    return f"tile {row},{column}"


class Tile(Contract):
    """A square of the light map: first row and column, texels along each side, texels that have a surface point."""

    row: Texel
    column: Texel
    size: int = Field(ge=1, le=64)
    texels: int = Field(ge=0, le=TILE_TEXELS)

    @property
    def label(self) -> str:
        """The label of the task that renders it."""
        return tile_label(self.row, self.column)


class PreparePayload(Contract):
    kind: Literal[TaskKind.PREPARE] = TaskKind.PREPARE
    bundle: Bundle
    settings: BakeSettings
    store_url: Url


class RenderPayload(Contract):
    kind: Literal[TaskKind.RENDER] = TaskKind.RENDER
    scene: Sha256
    texel_map: Sha256
    between: Between = ()
    """Texel maps of the between points, one a kind (`PrepareResult.between`)."""
    fine: Sha256 | None = None
    """The texel map of the irradiance map (`PrepareResult.fine`)."""
    cache: Sha256 | None = None
    """The radiance cache (`PrepareResult.cache`)."""
    tile: Tile
    settings: BakeSettings
    store_url: Url


class FitPayload(Contract):
    kind: Literal[TaskKind.FIT] = TaskKind.FIT
    function: Function
    texel_map: Sha256
    renders: Renders
    settings: BakeSettings
    store_url: Url


class RefinePayload(Contract):
    """Find the lobes of a block by the coherent descent (`kiln_workers.fit.solvers.joint`)."""

    kind: Literal[TaskKind.REFINE] = TaskKind.REFINE
    block: Block
    texel_map: Sha256
    between: Between = ()
    renders: Renders
    """Of the tiles within the block and `conventions.REFINE_HALO` texels around it."""
    fits: tuple["FitResult", ...] = Field(max_length=len(Function))
    """What the descent of each function starts from."""
    settings: BakeSettings
    store_url: Url


class PackagePayload(Contract):
    kind: Literal[TaskKind.PACKAGE] = TaskKind.PACKAGE
    job_id: Id
    job_name: Name
    bundle: Bundle
    prepare: "PrepareResult"
    renders: Renders
    fits: tuple["FitResult", ...] = Field(max_length=len(Function))
    refines: tuple["RefineResult", ...] = Field(default=(), max_length=MOST_TILES)
    """One a block; none where the network's lobes are final."""
    settings: BakeSettings
    store_url: Url
    gates: Gates = Gates()
    cameras: Cameras = Field(default_factory=dict)


Payload = Annotated[
    PreparePayload | RenderPayload | FitPayload | RefinePayload | PackagePayload, Field(discriminator="kind")
]


class Placement(Contract):
    """Where the whole light-map UV set of a mesh lies in the light map: uv' = uv * scale + offset."""

    mesh: Name
    scale: Magnitude
    offset: tuple[Real, Real]


class PrepareResult(Contract):
    kind: Literal[TaskKind.PREPARE] = TaskKind.PREPARE
    scene: Sha256
    """The parsed scene (`kiln_workers.scene.archive`)."""
    texel_map: Sha256
    """The texel map (`kiln_workers.scene.texels`)."""
    between: Between = ()
    """Texel maps of the points half-way between texels: to the right, below, and the corner; none where unused."""
    fine: Sha256 | None = None
    """The texel map of the irradiance map; None where the light map has no finer one (`lightmap.irradiance_scale`)."""
    cache: Sha256 | None = None
    """What diffuse surfaces receive (`kiln_workers.stages.radiance_cache`); None where paths do without."""
    scene_hash: Sha256
    """Hash of all that the light depends on; render seeds derive from it."""
    resolution: int | None = Field(default=None, ge=SMALLEST_SIDE, le=LARGEST_SIDE)
    """Texels along each side of the light map; None in results from before it could be chosen (`auto`)."""
    placements: tuple[Placement, ...] = Field(default=(), max_length=MOST_PLACEMENTS)
    """Of meshes whose own light-map UV was packed as a whole, the first of them."""
    tiles: tuple[Tile, ...] = Field(max_length=MOST_TILES)
    """Only tiles with at least one texel."""
    has_environment: bool
    has_light: bool
    triangles: Count
    notes: tuple[Note, ...] = Field(default=(), max_length=MOST_NOTES)
    """What was decided for the user: per-mesh unwrapping, ignored features, dropped faces."""
    seconds: Seconds


class RenderResult(Contract):
    kind: Literal[TaskKind.RENDER] = TaskKind.RENDER
    tile: Tile
    paths: Count
    overflows: Count
    """Values clamped to the fp16 range."""
    invalid: Count
    """Texels that see mostly back faces; filled from their neighbours when packaging."""
    invalid_texels: tuple[Annotated[int, Field(ge=0, lt=TILE_TEXELS)], ...] = Field(default=(), max_length=TILE_TEXELS)
    """Those texels, as row-major indices inside the tile."""
    seconds: Seconds


class FitMetrics(Contract):
    """Errors as defined in docs/mathematics.md (`log_mse`: no jitter, exposure-normalised)."""

    log_mse: Magnitude
    log_mse_zero: Magnitude
    """log_mse of P = 0."""
    log_mse_rel: Magnitude
    texels: Count
    signal: bool
    """False where the function is zero everywhere, or too weak beside the irradiance to be fitted: it is left out."""


class CurvePoint(Contract):
    step: Count
    loss: Real
    """The jittered training loss, not the error."""


class FitResult(Contract):
    kind: Literal[TaskKind.FIT] = TaskKind.FIT
    function: Function
    weights: Sha256
    exposure: Magnitude
    metrics: FitMetrics
    curve: tuple[CurvePoint, ...] = Field(max_length=MOST_POINTS)
    steps: Count
    seconds: Seconds


class RefineResult(Contract):
    kind: Literal[TaskKind.REFINE] = TaskKind.REFINE
    block: Block
    lobes: Sha256
    """Lobes [T, N, 7] of each function in scene units, of the block's T valid texels row by row (`stages.refine`)."""
    texels: Count
    steps: Count
    seconds: Seconds


class Artifact(Contract):
    name: Annotated[
        str, Field(pattern=r"^[A-Za-z0-9_-][A-Za-z0-9_.-]*(/[A-Za-z0-9_-][A-Za-z0-9_.-]*)*$", max_length=200)
    ]
    """No part begins with a dot, so that none leads out of a folder or hides in it."""
    sha256: Sha256
    size: Bytes
    media_type: Annotated[str, Field(pattern=r"^[a-z0-9.+-]+/[a-z0-9.+-]+(; charset=utf-8)?$", max_length=100)]


class PackageResult(Contract):
    kind: Literal[TaskKind.PACKAGE] = TaskKind.PACKAGE
    artifacts: tuple[Artifact, ...] = Field(max_length=MOST_FILES)
    gates: tuple[GateResult, ...] = Field(default=(), max_length=MOST_CAMERAS + 2)
    """One of each gate of the payload, met or not."""
    seconds: Seconds


Result = Annotated[PrepareResult | RenderResult | FitResult | RefineResult | PackageResult, Field(discriminator="kind")]


class Progress(Contract):
    """How far a running attempt is; `done` of `total` in the unit of its kind."""

    done: float = Field(ge=0, le=1e15)
    total: float = Field(ge=1e-6, le=1e15)
    unit: Word
    message: Note = ""
    loss: Real | None = None


Lease = Annotated[str, Field(max_length=64, repr=False)]
"""The secret of an attempt: the claim hands it out, and all that is said of the attempt has to show it."""
Tag = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]{0,62}$", max_length=63)]
Tags = Annotated[tuple[Tag, ...], Field(max_length=32)]


NAME_LENGTH: Final = 128
"""Of a worker's name, at most."""


class WorkerRegistration(Contract):
    name: Line = Field(min_length=1, max_length=NAME_LENGTH)
    kinds: tuple[TaskKind, ...] = Field(min_length=1, max_length=32)
    memory_bytes: int = Field(gt=0, lt=2**63)
    threads: int = Field(gt=0, lt=2**31)
    device: Line = Field(max_length=256)
    version: Line = Field(max_length=64)
    tags: Tags = ()
    """What it is good for beyond its kinds: jobs may require some."""


class WorkerWelcome(Contract):
    worker_id: Id
    heartbeat_s: Seconds
    """Beat at least this often while a task runs."""


class ClaimRequest(Contract):
    kinds: tuple[TaskKind, ...] = Field(min_length=1, max_length=32)
    wait_s: float = Field(default=25.0, ge=0, le=30)
    """Long-poll: how long the coordinator may hold the request while there is nothing to do."""


class Claim(Contract):
    """A task handed to a worker under a fence: every later call carries `attempt` and `lease`."""

    task_id: Id
    job_id: Id
    attempt: Number
    lease: Lease
    payload: Payload
    checkpoint: Sha256 | None = None
    """The last checkpoint that an earlier attempt published."""


class Heartbeat(Contract):
    task_id: Id
    attempt: Number
    lease: Lease = ""
    progress: Progress | None = None
    log: Log = ""
    """Lines written since the last beat."""


class HeartbeatReply(Contract):
    stop: bool
    """The attempt is no longer wanted: drop the work."""
    reason: Told = ""


LOST_AT_ONCE: Final = 1024
Labels = Annotated[tuple[Annotated[str, Field(max_length=64)], ...], Field(max_length=LOST_AT_ONCE)]


class Commit(Contract):
    attempt: Number
    lease: Lease = ""
    result: Result


class Failure(Contract):
    attempt: Number
    lease: Lease = ""
    problem: Problem
    retryable: bool
    log: Log = ""
    lost: Labels = ()
    """With the code `tiles-lost`: labels of the render tasks whose tiles are to be rendered again."""


class Checkpoint(Contract):
    attempt: Number
    lease: Lease = ""
    sha256: Sha256


def read_tags(words: Sequence[str]) -> tuple[str, ...]:
    """Tags of the command line; InputError where one is none."""
    try:
        return TypeAdapter(Tags).validate_python(tuple(dict.fromkeys(words)))
    except ValidationError as error:
        raise InputError(
            f"'{error.errors()[0]['input']}' is refused as a tag",
            where="--tag",
            remedy="Use letters, digits and . _ -, at most 63 of them and at most 32 tags.",
        ) from None
