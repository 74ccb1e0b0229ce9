"""Filling what no surface covers: gutters between charts and texels whose point lies inside geometry.

A bilinear lookup near a chart's border reads texels outside it. They must therefore continue the chart: a texel
without data takes the value of the nearest texel with data (exact Euclidean distance, as in Rong and Tan 2006's jump
flooding, here by SciPy's distance transform). Lobes are copied whole, because the k-th lobe of two texels correspond
only as far as the network made them: an average over several charts would put lobes where neither had any.
Irradiance, a plain colour, is smoothed inside the filled region (a few Jacobi steps of Laplace's equation from the
nearest values) so that mip maps and compressors see no cell borders. Valid texels are never changed.
"""

import numpy as np
import numpy.typing as npt
from scipy.ndimage import distance_transform_edt

from kiln_schemas.errors import InternalError

Float32 = npt.NDArray[np.float32]
Bools = npt.NDArray[np.bool_]
Int64 = npt.NDArray[np.int64]

SMOOTHING_STEPS = 16


def nearest_filled(filled: Bools) -> tuple[Int64, Int64]:
    """Row and column [H, W] of the nearest texel with data, for each texel; a texel with data is its own nearest."""
    if not filled.any():
        raise InternalError("no texel of the light map has data", where="package")
    indices = distance_transform_edt(~filled, return_distances=False, return_indices=True)
    return indices[0].astype(np.int64), indices[1].astype(np.int64)


def fill_nearest(values: npt.NDArray[np.generic], filled: Bools) -> npt.NDArray[np.generic]:
    """`values` [H, W, ...] with each texel outside `filled` [H, W] replaced by its nearest filled one's."""
    rows, columns = nearest_filled(filled)
    return values[rows, columns]


def fill_smooth(values: Float32, filled: Bools, steps: int = SMOOTHING_STEPS) -> Float32:
    """`fill_nearest`, then `steps` averages of each filled-in texel [H, W, C] with its four neighbours."""
    out = np.asarray(fill_nearest(values, filled), dtype=np.float32)
    keep = filled[..., None]
    for _ in range(steps):
        padded = np.pad(out, ((1, 1), (1, 1), (0, 0)), mode="edge")
        mean = 0.25 * (padded[:-2, 1:-1] + padded[2:, 1:-1] + padded[1:-1, :-2] + padded[1:-1, 2:])
        out = np.where(keep, out, mean)
    return out
