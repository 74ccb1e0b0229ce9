"""Filling what no surface covers: gutters between charts and texels whose point lies inside geometry.

A bilinear lookup near a chart's border reads texels outside it, so these must continue the chart. Each texel without
data takes its values from one source texel: a covered one from the nearest valid texel of its own chart, any other
from the nearest covered one (`nearest`). Lobes are copied whole, because the k-th lobes of two texels correspond only
as far as the fit made them: an average over several charts would put lobes where neither had any. Irradiance is a
plain colour: beyond the rings that a filter can reach it is smoothed by Jacobi steps of Laplace's equation, so that mip
maps and compressors see no cell borders. Valid texels are never changed.
"""

from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from kiln_schemas.errors import InternalError
from kiln_workers.package.nearest import Nearest
from kiln_workers.scene.bands import bands, release

Float32 = npt.NDArray[np.float32]
Bools = npt.NDArray[np.bool_]
Int32 = npt.NDArray[np.int32]
Int64 = npt.NDArray[np.int64]

SHARP_RINGS: Final = 4
"""Texels this near to a chart keep their source's value exactly: filters that read them must see that chart alone."""

SMOOTHING_STEPS: Final = 16

ALL: Final = slice(None)


@dataclass(frozen=True)
class Fill:
    """Where each texel of a light map [H, W] takes its values from; a valid texel is its own source.

    What is asked of some rows is computed for these rows: the sources of a whole map are never held.
    """

    valid: Bools  # [H, W]
    known: Nearest
    """The valid texels, and those that take their values from `own`."""
    filled: Int64
    """Texels (row * W + column, ascending) without data whose own chart has some,"""
    own: Int64
    """and the nearest valid texel of that chart."""

    def sources(self, rows: slice = ALL) -> tuple[Int64, Int64]:
        """Row and column [B, W] of the source of each texel in some rows."""
        row, column = self.known.sources(self._within(rows))
        if len(self.filled):
            texel = row * self.valid.shape[1] + column
            place = np.minimum(np.searchsorted(self.filled, texel), len(self.filled) - 1)
            moved = self.filled[place] == texel
            row[moved], column[moved] = np.divmod(self.own[place[moved]], self.valid.shape[1])
        return row, column

    def distance(self, rows: slice = ALL) -> npt.NDArray[np.float64]:
        """Texels [B, W] to the source of each texel in some rows."""
        row, column = self.sources(rows)
        here = np.arange(self.valid.shape[0])[rows, None]
        return np.asarray(np.hypot(row - here, column - np.arange(self.valid.shape[1])))

    def nearest(self, values: npt.NDArray[Any], rows: slice = ALL) -> npt.NDArray[Any]:
        """Some rows of `values` [H, W, ...], every texel replaced by its source's."""
        return values[self.sources(rows)]

    def smooth(self, values: Float32, rows: slice = ALL, steps: int = SMOOTHING_STEPS) -> Float32:
        """`nearest`, then `steps` averages with the four neighbours [B, W, C] beyond SHARP_RINGS of any source."""
        within = self._within(rows)
        # What lies outside of the rows changes one more row of them at each step.
        wide = slice(max(within.start - steps, 0), min(within.stop + steps, len(self.valid)))
        out: Float32 = self.nearest(values, wide).astype(np.float32)
        keep = (self.distance(wide) <= SHARP_RINGS)[..., None]
        for _ in range(steps):
            padded = np.pad(out, ((1, 1), (1, 1), (0, 0)), mode="edge")
            mean = 0.25 * (padded[:-2, 1:-1] + padded[2:, 1:-1] + padded[1:-1, :-2] + padded[1:-1, 2:])
            out = np.where(keep, out, mean).astype(np.float32)
        return out[within.start - wide.start : within.stop - wide.start]

    def _within(self, rows: slice) -> slice:
        first, last, _ = rows.indices(len(self.valid))
        return slice(first, last)


def plan_fill(valid: Bools, chart: Int32) -> Fill:
    """Sources for every texel of a light map, from its valid texels [H, W] and chart numbers [H, W] (-1: gutter)."""
    if not valid.any():
        raise InternalError("no texel of the light map has data", where="package")
    known, pairs = valid.copy(), [np.zeros((2, 0), np.int64)]
    # Fill covered texels without data from their own chart, where that chart has any.
    for number, box in _holed(valid, chart).items():
        inside = chart[box] == number
        own = inside & valid[box]
        if own.any():
            pairs.append(_from_own(inside & ~own, own, box, valid.shape[1]))
            known[box] |= inside
        release(chart)
    filled, source = np.concatenate(pairs, axis=1)
    order = np.argsort(filled)
    return Fill(valid, Nearest(known), filled[order], source[order])


def _from_own(holes: Bools, own: Bools, box: tuple[slice, slice], width: int) -> Int64:
    """(texels, sources) [2, T], row * width + column, of the holes in a box of the map, each from the nearest `own`."""
    nearest, pairs = Nearest(own), [np.zeros((2, 0), np.int64)]
    for rows in bands(holes.shape):
        row, column = np.nonzero(holes[rows])
        if len(row):
            source = [place[row, column] for place in nearest.sources(rows)]
            at = ((row + rows.start, column), source)
            pairs.append(np.stack([(r + box[0].start) * width + c + box[1].start for r, c in at]))
    return np.concatenate(pairs, axis=1)


def _holed(valid: Bools, chart: Int32) -> dict[int, tuple[slice, slice]]:
    """The bounding boxes of the charts that have a texel without data, by their numbers, ascending."""
    holed = np.zeros(0, np.int64)
    for rows in bands(chart.shape):
        part = chart[rows]
        holed = np.union1d(holed, part[~valid[rows] & (part >= 0)])
        release(chart)
    if not len(holed):
        return {}
    low = np.full((len(holed), 2), np.iinfo(np.int64).max)
    high = np.full((len(holed), 2), -1)
    for rows in bands(chart.shape):
        row, column = np.nonzero(np.isin(chart[rows], holed))
        at = np.searchsorted(holed, chart[rows][row, column])
        place = np.stack([row + rows.start, column], axis=1)
        np.minimum.at(low, at, place)
        np.maximum.at(high, at, place)
        release(chart)
    return {
        int(number): (slice(int(a[0]), int(b[0]) + 1), slice(int(a[1]), int(b[1]) + 1))
        for number, a, b in zip(holed, low, high, strict=True)
    }
