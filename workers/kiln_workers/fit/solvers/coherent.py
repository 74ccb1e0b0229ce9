"""The coherent descent as a whole: lobes of few texels of the light map first (`Start`), then of all of them.

Blocks of the light map are refined apart from each other, with a margin of their neighbours' texels that is dropped
afterwards. They agree where they meet if both begin from the same lobes, and a descent ends lower if it begins near
its end. So a descent on few texels of the whole light map, one in STRIDE each way and at least one of each chart, with
images of at most `pooling.LARGEST` pixels a side, comes first; every other texel begins with the lobes of the nearest
of them in its chart. docs/design/fit.md compares this with the network as a start: the same error for a fraction of
the time.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final, Self

import numpy as np
import numpy.typing as npt
import torch
from scipy.spatial import KDTree
from torch import Tensor

from kiln_schemas.conventions import FORMAT_VERSION
from kiln_schemas.settings import FitSettings
from kiln_workers.fit.field import TexelField
from kiln_workers.fit.lobes import constrain, in_scene_units
from kiln_workers.fit.pooling import pooled, pooled_size
from kiln_workers.fit.solution import Lobes, OnEpoch, Solution, nobody
from kiln_workers.fit.solvers.encoder import SETTINGS
from kiln_workers.fit.solvers.joint import CoherentOptions, OnStep, descend, silent
from kiln_workers.fit.solvers.starts import shared_start
from kiln_workers.fit.solvers.stopwatch import Stopwatch
from kiln_workers.fit.source import Float32, Index
from kiln_workers.scene.container import pack, unpack

STRIDE: Final = 2
"""Texels each way from one texel of the start to the next, at least."""
MOST_TEXELS: Final = 16384
"""Texels of the start beside those that stand for a small chart, about: it is held in memory as a whole."""

_KIND: Final = "fit-start"
_APART: Final = 1e6
"""Between charts, in texels: more than any light map's diagonal."""


@dataclass(frozen=True)
class Start:
    """Lobes of C texels of the whole light map."""

    place: Index  # [C, 2] row and column in the light map
    chart: Index  # [C]
    lobes: Float32  # [C, N, 7] exposure-normalised
    exposure: float
    """Factor from scene radiance to exposure-normalised radiance."""
    signal: bool
    """False where the light field is zero everywhere: there is nothing to descend to."""

    def at(self, place: Index, chart: Index) -> Float32:
        """Lobes [T, N, 7] for texels at `place` [T, 2]: those of the nearest texel of the same `chart` [T]."""
        if not len(place):
            return np.empty((0, *self.lobes.shape[1:]), np.float32)
        _, nearest = KDTree(_apart(self.place, self.chart)).query(_apart(place, chart))
        return np.asarray(self.lobes[nearest])

    def to_bytes(self) -> bytes:
        """Deterministic bytes, without pickle."""
        header: Mapping[str, Any] = {"version": FORMAT_VERSION, "exposure": self.exposure, "signal": self.signal}
        return pack(_KIND, header, {"place": self.place, "chart": self.chart, "lobes": self.lobes})

    def in_scene_units(self, lobes: Float32) -> Float32:
        """Lobes [T, N, 7] as the store has radiance, amplitudes within fp16; dark ones where there is no signal."""
        return np.asarray(in_scene_units(torch.from_numpy(lobes), self.exposure, self.signal).numpy(), np.float32)

    @classmethod
    def from_bytes(cls, data: bytes) -> Self:
        """Read `to_bytes`; InputError where they are something else."""
        header, arrays = unpack(_KIND, data)
        lobes = np.asarray(arrays["lobes"], np.float32)
        return cls(arrays["place"], arrays["chart"], lobes, float(header["exposure"]), bool(header["signal"]))


def chosen_texels(place: Index, chart: Index) -> Index:
    """Which of the texels at `place` [T, 2] of `chart` [T] the start is sought for: numbers [C], ascending."""
    on_grid = (place % stride(len(place)) == 0).all(axis=1)
    present, first = np.unique(chart, return_index=True)
    alone = first[~np.isin(present, chart[on_grid])]
    return np.sort(np.concatenate([np.flatnonzero(on_grid), alone])).astype(np.int64)


def stride(texels: int) -> int:
    """Texels each way between those of the start of a light map of so many."""
    return max(STRIDE, math.ceil(math.sqrt(texels / MOST_TEXELS)))


def find_start(
    field: TexelField,
    step: int,
    lobes: int,
    options: CoherentOptions,
    seed: int,
    *,
    signal: bool = True,
    threads: int = 1,
    on_step: OnStep = silent,
) -> Start:
    """Lobes of a field of chosen texels, every `step` texels each way, from the same even cover everywhere.

    Without a `signal` anywhere in the light map nothing is sought.
    """
    coarse = _beside_each_other(field, step)
    found = constrain(shared_start(coarse, lobes), torch.from_numpy(coarse.normals))
    if signal:
        found = descend(coarse, found, options, seed, threads=threads, on_step=on_step)
    return Start(field.place, field.chart, found.numpy(), field.exposure, signal)


def coherent(
    field: TexelField,
    lobes: int,
    on_epoch: OnEpoch = nobody,
    *,
    settings: FitSettings = SETTINGS,
    seed: int = 0,
) -> Solution:
    """`settings.start_steps` of the descent on few texels, then `refine_steps` on all; epochs and seconds of both."""
    watch, threads = Stopwatch(on_epoch), torch.get_num_threads()
    normals = torch.from_numpy(field.normals)
    chosen = chosen_texels(field.place, field.chart)
    few = CoherentOptions(steps=settings.start_steps)
    found = find_start(field.take(chosen), stride(len(field)), lobes, few, seed, threads=threads)
    before = -(-few.steps * len(chosen) // len(field))
    start = torch.from_numpy(found.at(field.place, field.chart))

    def tell(step: int, raw: Tensor, loss: float) -> None:
        watch.tell(before + step, lambda: Lobes(constrain(raw, normals)))

    options = CoherentOptions(steps=settings.refine_steps)
    lobes_of_all = descend(field, start, options, seed, threads=threads, on_step=tell)
    return Solution(Lobes(lobes_of_all), before + options.steps, watch.seconds)


def _beside_each_other(field: TexelField, step: int) -> TexelField:
    """The field with small images, and texels that are `step` apart as neighbours; those off the grid have none."""
    place = field.place // step
    off_grid = np.flatnonzero((field.place % step != 0).any(axis=1))
    place[off_grid, 0] = place[:, 0].max(initial=0) + 2 * (1 + np.arange(len(off_grid)))
    images = pooled(field.images, pooled_size(field.image_size))
    return TexelField(images, field.normals, place, field.chart, field.exposure)


def _apart(place: Index, chart: Index) -> npt.NDArray[np.float64]:
    """Points [T, 3] that are nearest to each other within a chart."""
    return np.column_stack([place, chart * _APART]).astype(np.float64)
