"""Filling what no surface covers: gutters between charts and texels whose point lies inside geometry.

A bilinear lookup near a chart's border reads texels outside it, so these must continue the chart. Each texel without
data takes its values from one source texel: a covered one from the nearest valid texel of its own chart, any other
from the nearest covered one (exact Euclidean distance transform, Maurer et al. 2003, by SciPy). Lobes are copied whole,
because the k-th lobes of two texels correspond only as far as the network made them: an average over several charts
would put lobes where neither had any. Irradiance is a plain colour: beyond the rings that a filter can reach it is
smoothed by Jacobi steps of Laplace's equation, so that mip maps and compressors see no cell borders. Valid texels are
never changed.
"""

from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from scipy.ndimage import distance_transform_edt, find_objects

from kiln_schemas.errors import InternalError

Float32 = npt.NDArray[np.float32]
Bools = npt.NDArray[np.bool_]
Int32 = npt.NDArray[np.int32]
Int64 = npt.NDArray[np.int64]

SHARP_RINGS: Final = 4
"""Texels this near to a chart keep their source's value exactly: filters that read them must see that chart alone."""

SMOOTHING_STEPS: Final = 16


@dataclass(frozen=True)
class Fill:
    """Where each texel [H, W] takes its values from; a valid texel is its own source."""

    rows: Int64
    columns: Int64
    distance: npt.NDArray[np.float64]
    """Texels to the source."""

    def nearest(self, values: npt.NDArray[Any]) -> npt.NDArray[Any]:
        """`values` [H, W, ...] with every texel replaced by its source's."""
        return values[self.rows, self.columns]

    def smooth(self, values: Float32, steps: int = SMOOTHING_STEPS) -> Float32:
        """`nearest`, then `steps` averages with the four neighbours [H, W, C] beyond SHARP_RINGS of any source."""
        out: Float32 = self.nearest(values).astype(np.float32)
        keep = (self.distance <= SHARP_RINGS)[..., None]
        for _ in range(steps):
            padded = np.pad(out, ((1, 1), (1, 1), (0, 0)), mode="edge")
            mean = 0.25 * (padded[:-2, 1:-1] + padded[2:, 1:-1] + padded[1:-1, :-2] + padded[1:-1, 2:])
            out = np.where(keep, out, mean).astype(np.float32)
        return out


def plan_fill(valid: Bools, chart: Int32) -> Fill:
    """Sources for every texel of a light map, from its valid texels [H, W] and chart numbers [H, W] (-1: gutter)."""
    if not valid.any():
        raise InternalError("no texel of the light map has data", where="package")
    rows, columns = (np.ascontiguousarray(grid) for grid in np.indices(valid.shape))
    known = valid.copy()

    # Fill covered texels without data from their own chart, where that chart has any.
    boxes = find_objects(chart + 1)
    for number in np.unique(chart[~valid & (chart >= 0)]):
        box = boxes[number]
        inside = chart[box] == number
        own = inside & valid[box]
        if not own.any():
            continue
        nearest = distance_transform_edt(~own, return_distances=False, return_indices=True)
        filled = inside & ~own
        rows[box][filled] = nearest[0][filled] + box[0].start
        columns[box][filled] = nearest[1][filled] + box[1].start
        known[box] |= inside

    # Fill the rest from the nearest texel that has a source by now.
    nearest = distance_transform_edt(~known, return_distances=False, return_indices=True)
    rows, columns = rows[nearest[0], nearest[1]], columns[nearest[0], nearest[1]]
    here = np.indices(valid.shape)
    return Fill(rows, columns, np.hypot(rows - here[0], columns - here[1]))
