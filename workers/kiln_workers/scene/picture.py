"""One picture of a texel map for the report: validity, density and charts side by side.

Validity: green is valid, red is inside geometry, dark is gutter. Density: metres a texel on a logarithmic scale from
blue (fine) to yellow (coarse). Charts: one colour each.
"""

from dataclasses import fields
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from kiln_workers.scene.geometry import Floats
from kiln_workers.scene.texel_map import TexelMap, TexelState

BACKGROUND: Final = (24, 26, 30)
STATE_COLOURS: Final = {TexelState.VALID: (92, 174, 112), TexelState.INVALID: (222, 74, 62)}
RAMP: Final = np.array(
    [[38, 60, 160], [34, 130, 170], [70, 180, 120], [190, 205, 80], [252, 226, 70]], dtype=np.float64
)
PANEL_PIXELS: Final = 256
MOST_PIXELS: Final = 2048
GAP_PIXELS: Final = 8


def thinned(values: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Every k-th row and column of a map [H, W, ...], so that a picture of it has at most MOST_PIXELS a side."""
    step = -(-max(values.shape[:2]) // MOST_PIXELS)
    return values[::step, ::step]


def texel_map_picture(texels: TexelMap) -> npt.NDArray[np.uint8]:
    """The picture [h, w, 3]; each panel has at least 256 pixels a side, row 0 of the map on top."""
    texels = TexelMap(**{field.name: np.array(thinned(getattr(texels, field.name))) for field in fields(texels)})
    panels = [_state_panel(texels), _density_panel(texels), _chart_panel(texels)]
    factor = max(1, -(-PANEL_PIXELS // texels.state.shape[0]))
    large = [panel.repeat(factor, axis=0).repeat(factor, axis=1) for panel in panels]
    gap = np.full((large[0].shape[0], GAP_PIXELS, 3), 255, dtype=np.uint8)
    return np.concatenate([large[0], gap, large[1], gap, large[2]], axis=1)


def _blank(texels: TexelMap) -> npt.NDArray[np.uint8]:
    return np.full((*texels.state.shape, 3), BACKGROUND, dtype=np.uint8)


def _state_panel(texels: TexelMap) -> npt.NDArray[np.uint8]:
    panel = _blank(texels)
    for state, colour in STATE_COLOURS.items():
        panel[texels.state == state] = colour
    return panel


def _density_panel(texels: TexelMap) -> npt.NDArray[np.uint8]:
    panel = _blank(texels)
    covered = texels.state != TexelState.GUTTER
    if covered.any():
        size = np.log(np.maximum(texels.texel_size[covered].astype(np.float64), 1e-9))
        low, high = (float(x) for x in np.percentile(size, [2, 98]))
        panel[covered] = _ramp((size - low) / max(high - low, 1e-6))
    return panel


def _chart_panel(texels: TexelMap) -> npt.NDArray[np.uint8]:
    panel = _blank(texels)
    covered = texels.chart >= 0
    # Steps of the golden ratio around the hue circle keep neighbouring numbers apart.
    hue = np.mod(texels.chart[covered] * 0.6180339887, 1.0)[:, None]
    wave = np.abs(np.mod(hue * 6.0 + np.array([0.0, 4.0, 2.0]), 6.0) - 3.0) - 1.0
    panel[covered] = np.rint(70.0 + 175.0 * np.clip(wave, 0.0, 1.0)).astype(np.uint8)
    return panel


def _ramp(value: Floats) -> npt.NDArray[np.uint8]:
    place = np.clip(value, 0.0, 1.0) * (len(RAMP) - 1)
    low = np.minimum(place.astype(np.int64), len(RAMP) - 2)
    part = (place - low)[:, None]
    return np.asarray(np.rint(RAMP[low] * (1.0 - part) + RAMP[low + 1] * part), dtype=np.uint8)
