"""Takes the path tracer's noise out of the irradiance map without blurring the shadows that stand out from it.

Non-local means with the noise known (Rousselle, Knaus and Zwicker 2012, "Adaptive Rendering with Non-Local Means
Filtering", ACM TOG 31(6), eq. 5 and 6): a neighbour counts as much as the patch of texels around it looks like the
patch around the texel, in units of their noise. Three things differ from the paper:

- The noise is estimated from the map itself (`_noise`), so that nothing but the map need be kept of a bake. The
  paper's two half buffers were no better (docs/results/seams.md).
- The weights fit a plane to the neighbours' values instead of a constant, so that an even gradient stays as it is.
- Nothing of another chart is ever looked at, and a neighbour whose shading normal differs counts less: beyond a chart's
  border and beyond a crease lies another light.

Open Image Denoise, which knows pictures and not light maps, takes contact shadows for noise; the same page has figures.
"""

from typing import Any, Final

import numba
import numpy as np
import numpy.typing as npt

from kiln_workers.fit.machine_code import BOXES, compiled
from kiln_workers.scene.bands import bands
from kiln_workers.scene.texel_map import TexelMap, TexelState

Float32 = npt.NDArray[np.float32]

RADIUS: Final = 3
"""Of the window of neighbours, in texels."""
PATCH: Final = 2
"""Radius of the patches that are compared."""
NOISE_RADIUS: Final = 3
"""Radius of the window in which the noise is taken to be the same."""
STRICTNESS: Final = 0.7
"""The paper's k: the smaller, the fewer neighbours count, and the more noise and shadows are left."""
CREASE: Final = 0.1
"""1 - cosine of the angle between shading normals at which a neighbour counts 1/e."""
FAINT: Final = 1e-4
"""Noise relative to the value that is none."""
RIDGE: Final = 1e-3
"""Weight that keeps a plane level which too few neighbours hold."""
HALO: Final = RADIUS + PATCH + NOISE_RADIUS + 1
"""Rows above and below that a texel's value depends on."""

LOG_BIAS: Final = 1.2703628454614782
"""Minus the mean of the logarithm of a squared standard normal variable: Euler's constant + log 2."""
TINY: Final = 1e-30
NOTHING: Final = -1

_CHARTS: Final = numba.int32[:, ::1]


def denoise(irradiance: Float32, texels: TexelMap) -> None:
    """Take the noise out of the irradiance map [H, W, 3], in place; what is no valid texel keeps its value.

    The same bytes however the rows are cut into bands.
    """
    above = irradiance[:0].copy()  # rows that have been overwritten, as they were
    for rows in bands(irradiance.shape):
        wide = slice(rows.start - len(above), rows.stop + HALO)
        values = np.concatenate([above, irradiance[rows.start : wide.stop]])
        chart = np.where(texels.state[wide] == TexelState.VALID, texels.chart[wide], np.int32(NOTHING))
        normals = np.array(texels.shading_normal[wide])
        texels.release()
        noise, filtered = np.empty_like(values), values.copy()
        _noise(values, chart, noise, np.empty((*chart.shape, 4), np.float32))
        _filter(values, chart, normals, noise, filtered)
        done = rows.stop - wide.start
        irradiance[rows] = filtered[len(above) : done]
        above = values[max(done - HALO, 0) : done].copy()


@compiled(BOXES, _CHARTS, BOXES, BOXES)
def _noise(values: Any, chart: Any, noise: Any, logs: Any) -> None:
    """Fill `noise` [H, W, 3] with the variance of each value; `logs` [H, W, 4] is room to work in.

    Three texels in a row show x - (x- + x+) / 2, of which an even gradient leaves 0 and noise 3/2 of its variance.
    The mean of the logarithms of the squares over a window heeds few large ones, such as those on a shadow's edge.
    """
    height, width = chart.shape
    for i in range(height):
        for j in range(width):
            logs[i, j, 0] = logs[i, j, 1] = logs[i, j, 2] = logs[i, j, 3] = 0.0
            here = chart[i, j]
            if here == NOTHING:
                continue
            for dy, dx in ((0, 1), (1, 0), (1, 1), (1, -1)):
                if not (dy <= i < height - dy and abs(dx) <= j < width - abs(dx)):
                    continue
                if chart[i + dy, j + dx] != here or chart[i - dy, j - dx] != here:
                    continue
                logs[i, j, 3] += 1.0
                for c in range(3):
                    x = values[i, j, c]
                    bend = x - 0.5 * (values[i + dy, j + dx, c] + values[i - dy, j - dx, c])
                    logs[i, j, c] += np.log(bend * bend / 1.5 + (FAINT * x) ** 2 + TINY)
    for i in range(height):
        for j in range(width):
            count = red = green = blue = 0.0
            for y in range(max(i - NOISE_RADIUS, 0), min(i + NOISE_RADIUS + 1, height)):
                for x in range(max(j - NOISE_RADIUS, 0), min(j + NOISE_RADIUS + 1, width)):
                    if chart[y, x] == chart[i, j]:
                        red += logs[y, x, 0]
                        green += logs[y, x, 1]
                        blue += logs[y, x, 2]
                        count += logs[y, x, 3]
            for c, total in enumerate((red, green, blue)):
                noise[i, j, c] = np.exp(total / count + LOG_BIAS) if count > 0.0 else 0.0


@compiled(BOXES, _CHARTS, BOXES, BOXES, BOXES)
def _filter(values: Any, chart: Any, normals: Any, noise: Any, out: Any) -> None:
    """Fill the valid texels of `out` [H, W, 3]."""
    height, width = chart.shape
    moments, sums = np.empty((3, 3)), np.empty((3, 3))
    for i in range(height):
        for j in range(width):
            here = chart[i, j]
            if here == NOTHING:
                continue
            moments[:], sums[:] = 0.0, 0.0
            for dy in range(max(-RADIUS, -i), min(RADIUS, height - 1 - i) + 1):
                for dx in range(max(-RADIUS, -j), min(RADIUS, width - 1 - j) + 1):
                    y, x = i + dy, j + dx
                    if chart[y, x] != here:
                        continue
                    apart, count = 0.0, 0
                    for v in range(-PATCH, PATCH + 1):
                        if min(i, y) + v < 0 or max(i, y) + v >= height:
                            continue
                        for u in range(-PATCH, PATCH + 1):
                            if min(j, x) + u < 0 or max(j, x) + u >= width:
                                continue
                            if chart[i + v, j + u] != here or chart[y + v, x + u] != here:
                                continue
                            count += 1
                            for c in range(3):
                                one, other = noise[i + v, j + u, c], noise[y + v, x + u, c]
                                step = values[i + v, j + u, c] - values[y + v, x + u, c]
                                square = step * step - one - min(one, other)
                                apart += square / (STRICTNESS * STRICTNESS * (one + other) + TINY)
                    turn = 1.0
                    for k in range(3):
                        turn -= normals[i, j, k] * normals[y, x, k]
                    weight = 1.0
                    if dy != 0 or dx != 0:
                        weight = np.exp(-max(apart / (3 * count), 0.0) - max(turn, 0.0) / CREASE)
                    plane = (1.0, dx / RADIUS, dy / RADIUS)
                    for a in range(3):
                        for b in range(3):
                            moments[a, b] += weight * plane[a] * plane[b]
                            sums[a, b] += weight * plane[a] * values[y, x, b]
            moments[1, 1] += RIDGE * moments[0, 0]
            moments[2, 2] += RIDGE * moments[0, 0]
            # The plane's height at the texel, by Cramer's rule.
            first = moments[1, 1] * moments[2, 2] - moments[1, 2] * moments[1, 2]
            second = moments[0, 2] * moments[1, 2] - moments[0, 1] * moments[2, 2]
            third = moments[0, 1] * moments[1, 2] - moments[0, 2] * moments[1, 1]
            whole = moments[0, 0] * first + moments[0, 1] * second + moments[0, 2] * third
            for c in range(3):
                height_here = (first * sums[0, c] + second * sums[1, c] + third * sums[2, c]) / whole
                out[i, j, c] = max(height_here, 0.0)
