"""Which tasks a job consists of: pure functions from results to planned tasks.

A method is a sequence of stages. The tasks of a stage are planned when the result that determines them is
there, and released when every task of the stage before has completed. `sg_lightfield` (Currius et al. 2020)
is the first method: prepare > render (one task a tile) > fit (one task a function) > refine (one task a block of the
light map, unless the network's lobes are final) > package.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from itertools import product
from typing import Any, Final

from kiln_schemas.errors import InputError, TooLarge
from kiln_schemas.gates import VISIBILITY_LOG_MSE_REL, Gates
from kiln_schemas.settings import BakeSettings, Function, Solver
from kiln_schemas.tasks import Block, PrepareResult, TaskKind


@dataclass(frozen=True)
class Planned:
    """A task to be. `spec` is the part of its payload that no other row holds."""

    kind: TaskKind
    label: str
    spec: dict[str, Any] = field(default_factory=dict)
    ready: bool = False
    """Whether it may run at once; otherwise it waits for the stage before."""


@dataclass(frozen=True)
class Method:
    """A task graph: its name and its stages in order."""

    name: str
    stages: tuple[TaskKind, ...]

    def stage_after(self, kind: TaskKind) -> TaskKind | None:
        """The stage after `kind`, of which a job may have no task; None after the last."""
        place = self.stages.index(kind) + 1
        return self.stages[place] if place < len(self.stages) else None


SG_LIGHTFIELD: Final = Method(
    name="sg_lightfield", stages=(TaskKind.PREPARE, TaskKind.RENDER, TaskKind.FIT, TaskKind.REFINE, TaskKind.PACKAGE)
)

METHODS: Final[Mapping[str, Method]] = {SG_LIGHTFIELD.name: SG_LIGHTFIELD}

PRIORITY: Final[Mapping[TaskKind, int]] = {
    TaskKind.PREPARE: 0,
    TaskKind.RENDER: 1,
    TaskKind.FIT: 2,
    TaskKind.REFINE: 3,
    TaskKind.PACKAGE: 4,
}
"""Later stages first: a job that is nearly done finishes before another begins."""


def plan_job() -> list[Planned]:
    """The tasks known when a job is submitted."""
    return [Planned(TaskKind.PREPARE, "scene", ready=True)]


def plan_after_prepare(result: PrepareResult, settings: BakeSettings, gates: Gates, most_tiles: int) -> list[Planned]:
    """Render tasks (ready); fit tasks, refine tasks and the package task (waiting).

    InputError where there is nothing to bake, the tiles do not fit the light map or a gate has nothing to measure;
    TooLarge where there are more than `most_tiles` tiles or blocks.
    """
    _check_prepared(result, settings, most_tiles)
    if gates.visibility_log_mse_rel is not None and not result.has_environment:
        raise InputError(
            "the scene has no environment, so no visibility is baked",
            where=f"gates.{VISIBILITY_LOG_MSE_REL}",
            remedy="Leave the gate out, or pass an environment with --env.",
        )
    renders = [
        Planned(TaskKind.RENDER, tile.label, {"tile": tile.model_dump(mode="json")}, ready=True)
        for tile in sorted(result.tiles, key=lambda tile: (tile.row, tile.column))
    ]
    functions = [Function.LIGHT_FIELD] + ([Function.VISIBILITY] if result.has_environment else [])
    fits = [Planned(TaskKind.FIT, function.value, {"function": function.value}) for function in functions]
    blocks = plan_blocks(result, settings) if settings.fit.solver is Solver.COHERENT else []
    if len(blocks) > most_tiles:
        raise TooLarge(
            f"{len(blocks)} blocks to refine are more than {most_tiles}",
            where="fit.block",
            remedy="Raise fit.block or lower lightmap.resolution.",
        )
    refines = [
        Planned(TaskKind.REFINE, f"block {block.row},{block.column}", {"block": block.model_dump(mode="json")})
        for block in blocks
    ]
    return [*renders, *fits, *refines, Planned(TaskKind.PACKAGE, "package")]


def plan_blocks(result: PrepareResult, settings: BakeSettings) -> list[Block]:
    """Squares of `fit.block` texels, row by row, that a tile touches."""
    size, resolution = settings.fit.block, settings.lightmap.side(result.resolution)
    places = set()
    for tile in result.tiles:
        rows = range(tile.row // size, (min(tile.row + tile.size, resolution) - 1) // size + 1)
        columns = range(tile.column // size, (min(tile.column + tile.size, resolution) - 1) // size + 1)
        places |= set(product(rows, columns))
    return [Block(row=row * size, column=column * size, size=size) for row, column in sorted(places)]


def _check_prepared(result: PrepareResult, settings: BakeSettings, most_tiles: int) -> None:
    if not result.tiles:
        raise InputError(
            "no texel of the light map lies on a surface",
            where="scene",
            remedy="Check that the scene has triangles and that its light-map UV set has an area.",
        )
    if not result.has_light:
        raise InputError(
            "the scene has no light: no emissive surface, no lamp and no environment",
            where="scene",
            remedy="Add an emissive material or a lamp, or pass an environment with --env.",
        )
    if len(result.tiles) > most_tiles:
        raise TooLarge(
            f"{len(result.tiles)} render tiles are more than {most_tiles}",
            where="lightmap.tile",
            remedy="Raise lightmap.tile or lower lightmap.resolution.",
        )
    places = {(tile.row, tile.column) for tile in result.tiles}
    resolution = settings.lightmap.side(result.resolution)
    outside = [tile for tile in result.tiles if max(tile.row, tile.column) >= resolution or tile.texels == 0]
    if len(places) < len(result.tiles) or outside:
        raise InputError(
            f"the prepared tiles overlap, are empty or leave the light map of {resolution} x {resolution} texels",
            where="prepare",
        )
