"""Run solvers on the chosen texels: one row a solver and number of lobes, each kept as soon as it is there."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import torch

from kiln_schemas import __version__
from kiln_schemas.conventions import LOBE_PARAMETERS
from kiln_workers.compare.cache import Cache, source_digest
from kiln_workers.compare.convergence import Recorder, epochs_to_tolerance
from kiln_workers.compare.result import Folds, Row
from kiln_workers.compare.targets import BetweenTargets
from kiln_workers.compare.texels import ChosenTexels
from kiln_workers.fit.field import TexelField
from kiln_workers.fit.network import pixel_centres
from kiln_workers.fit.solution import Lobes, Representation, Solver
from kiln_workers.fit.solvers.evaluate import errors_at_texels, errors_between, interp_ratio, radiance
from kiln_workers.fit.solvers.folds import FOLD_DEGREES, PERCENTILES, turns

Float32 = npt.NDArray[np.float32]

KIND: Final = "solution"
FOLD_EDGES_DEG: Final = (0.0, 1.0, 2.0, 4.0, 8.0, 15.0, 30.0, 60.0, 180.0)


@dataclass(frozen=True)
class Solved:
    """A row and what is needed to draw it."""

    row: Row
    lobes: Float32 | None  # [T, N, 7] exposure-normalised, rounded to fp16; None for other representations
    shown: Float32  # [R, R, 3] the predicted light field of the texel to show, exposure-normalised


@dataclass(frozen=True)
class Bench:
    """What all solvers are run on."""

    scene: str
    chosen: ChosenTexels
    targets: BetweenTargets
    shown: int
    """Number of the texel to show."""
    cache: Cache

    def key(self, solver: str, function: Solver, lobes: int) -> dict[str, Any]:
        """Everything that a solution depends on."""
        return {
            "version": __version__,
            "sources": source_digest(function),
            "scene": self.scene,
            "texels": self.chosen.digest,
            "targets": [len(self.targets), self.targets.samples, self.targets.noise],
            "solver": solver,
            "lobes": lobes,
        }


def texel_to_show(chosen: ChosenTexels) -> int:
    """The texel that a tenth of all exceed in signal: its light field has something in it, and it is no outlier."""
    nothing = Lobes(torch.zeros(len(chosen.field), 1, 7))
    signal = errors_at_texels(nothing, chosen.field).error
    return int(np.argsort(signal, kind="stable")[int(0.9 * (len(signal) - 1))])


def kept(bench: Bench, solver: str, function: Solver, lobes: int) -> Solved | None:
    """The solution of an earlier run, if there is one."""
    found = bench.cache.load(KIND, bench.key(solver, function, lobes))
    if found is None:
        return None
    body, arrays = found
    return Solved(Row.model_validate(body), _array(arrays, "lobes"), np.array(arrays["shown"]))


def solve(bench: Bench, solver: str, function: Solver, lobes: int) -> Solved:
    """Run one solver, measure what it gives, and keep it."""
    field, targets, key = bench.chosen.field, bench.targets, bench.key(solver, function, lobes)
    recorder = Recorder(field, targets)
    solution = function(field, lobes, on_epoch=recorder)
    made = solution.representation
    curve = recorder.finish(solution.epochs, made)
    at = errors_at_texels(made, field)
    between = errors_between(made, targets.points, targets.images, targets.normals, field.exposure)
    row = Row(
        scene=bench.scene,
        solver=solver,
        lobes=made.parameters.shape[1] if isinstance(made, Lobes) else lobes,
        texels=len(field),
        floats_per_texel=_floats_per_texel(made),
        epochs=solution.epochs,
        epochs_to_5_percent=epochs_to_tolerance(curve),
        seconds=solution.seconds,
        seconds_per_texel=solution.seconds / len(field),
        log_mse=at.log_mse,
        log_mse_rel=at.log_mse_rel,
        log_mse_between=between.log_mse,
        log_mse_between_rel=between.log_mse_rel,
        mse=errors_at_texels(made, field, radiance).log_mse,
        interp_ratio=interp_ratio(between, at) if at.log_mse > 0.0 else 0.0,
        folds=_folds(made, field) if isinstance(made, Lobes) else None,
        curve=curve,
    )
    solved = Solved(row, made.rounded().parameters.numpy() if isinstance(made, Lobes) else None, _shown(bench, made))
    arrays = {"shown": solved.shown} | ({} if solved.lobes is None else {"lobes": solved.lobes})
    bench.cache.save(KIND, key, row.model_dump(mode="json"), arrays)
    return solved


def _floats_per_texel(made: Representation) -> int:
    """Numbers that a texel has to hold: axes and sharpness that are the same for all texels need no room.

    The same up to fp16: descending on amplitudes alone carries the others through their parametrisation and back.
    """
    if not isinstance(made, Lobes):
        return made.floats_per_texel
    shape = made.parameters[..., :4]
    common = torch.allclose(shape, shape[:1].expand_as(shape), rtol=2.0**-11, atol=2.0**-11)
    return made.parameters.shape[1] * (LOBE_PARAMETERS - 4 if common else LOBE_PARAMETERS)


def _folds(lobes: Lobes, field: TexelField) -> Folds | None:
    """How lobes turn on flat charts; None where no chart is flat or nothing shines."""
    found = turns(lobes.rounded().parameters, field)
    if not found.energy.sum() > 0.0:
        return None
    p50, p90, p99 = (found.percentile(percent) for percent in PERCENTILES)
    return Folds(
        p50_deg=p50,
        p90_deg=p90,
        p99_deg=p99,
        above_15_deg=found.share_over(FOLD_DEGREES),
        histogram=tuple(found.histogram(np.array(FOLD_EDGES_DEG)).tolist()),
    )


def _shown(bench: Bench, made: Representation) -> Float32:
    corners = torch.full((1, 4), bench.shown, dtype=torch.int64)
    size = bench.chosen.field.image_size
    with torch.inference_mode():
        values = made.rounded().mixed(corners, torch.full((1, 4), 0.25)).values(pixel_centres(size))
    return np.asarray(values[0].clamp(min=0.0).reshape(size, size, 3).numpy(), np.float32)


def _array(arrays: Mapping[str, npt.NDArray[Any]], name: str) -> Float32 | None:
    return np.array(arrays[name]) if name in arrays else None
