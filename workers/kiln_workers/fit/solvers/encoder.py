"""The paper's network (`fit.train`) as a solver among the others."""

from typing import Final

import torch

from kiln_schemas.settings import PRESETS, FitSettings, Function
from kiln_workers.fit.field import TexelField
from kiln_workers.fit.lobes import amplitude_scale
from kiln_workers.fit.predict import Weights, predict
from kiln_workers.fit.solution import Lobes, OnEpoch, Solution, nobody
from kiln_workers.fit.solvers.stopwatch import Stopwatch
from kiln_workers.fit.source import ArraySource
from kiln_workers.fit.train import train

SETTINGS: Final = PRESETS["preview"].fit


def cnn(
    field: TexelField,
    lobes: int,
    on_epoch: OnEpoch = nobody,
    *,
    settings: FitSettings = SETTINGS,
    function: Function = Function.LIGHT_FIELD,
    seed: int = 0,
    start: Weights | None = None,
) -> Solution:
    """Trained on the field alone, for `settings.steps`, from `start` or from random weights.

    FitFailed where it does not clearly beat P = 0.
    """
    watch = Stopwatch(on_epoch)
    threads = torch.get_num_threads()
    asked = settings.model_copy(update={"lobes": lobes})
    source = ArraySource(field.images, field.normals)

    def listen(epoch: int, weights: Weights) -> None:
        watch.tell(epoch, lambda: _represent(field, weights, threads))

    outcome = train(
        source,
        asked,
        function,
        seed,
        threads=threads,
        exposure=field.exposure,
        on_epoch=listen,
        start=start,
    )
    solved = _represent(field, Weights.from_bytes(outcome.weights), threads)
    return Solution(solved, -(-outcome.steps * asked.batch // len(field)), watch.seconds)


def _represent(field: TexelField, weights: Weights, threads: int) -> Lobes:
    """The network's lobes of all texels, exposure-normalised."""
    lobes = torch.from_numpy(predict(weights, field.images, field.normals, threads=threads))
    return Lobes(lobes * amplitude_scale(field.exposure))
