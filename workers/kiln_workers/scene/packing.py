"""Pack charts into one square light map: each as the set of texels that it touches, first fit from the top left.

Charts are taken from the largest to the smallest, tried upright and turned, and put where their lowest row is highest.
A placed chart keeps `padding` texels around it free. The scale (texels a metre) is the finest for which all charts
fit, found by bisection, so the atlas is as full as this order allows. Deterministic: integers and fixed order only.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt
from scipy.ndimage import binary_dilation
from scipy.signal import fftconvolve

from kiln_workers.scene.geometry import Floats
from kiln_workers.scene.raster import touched_squares

Bits = npt.NDArray[np.bool_]

FIT_STEPS: Final = 8
ROUNDING: Final = 2e-3
"""Texels that a chart's box is widened by: UVs are stored as float32."""
DIRECT_TEXELS: Final = 48
"""Up to this many texels a chart is tested texel by texel, above by convolution."""


@dataclass(frozen=True)
class Chart:
    """A flat piece of surface."""

    corners: Floats  # [F, 3, 2] metres, lower bounds at 0


@dataclass(frozen=True)
class Place:
    """Where a chart lies: uv in texels = (turned ? swap(xy) : xy) * scale + origin."""

    turned: bool
    origin: tuple[float, float]


def pack_charts(charts: list[Chart], side: int, padding: int) -> tuple[float, list[Place]] | None:
    """Texels a metre and the place of each chart in a square of `side` texels; None if they fit at no scale."""
    area = sum(_area(chart) for chart in charts)
    low, high, best = 0.0, side / float(np.sqrt(area)), None
    scale = 0.8 * high
    for _ in range(FIT_STEPS):
        places = _place_all(charts, side, padding, scale)
        if places is None:
            high = scale
        else:
            low, best = scale, (scale, places)
        scale = 0.5 * (low + high) if low > 0.0 else 0.7 * high
    if best is None:
        # The smallest sensible scale: every chart about one texel.
        scale = 1.0 / max(float(chart.corners.max()) for chart in charts)
        places = _place_all(charts, side, padding, scale)
        best = None if places is None else (scale, places)
    return best


def _place_all(charts: list[Chart], side: int, padding: int, scale: float) -> list[Place] | None:
    masks, margins = _footprints(charts, scale)
    if sum(int(mask.sum()) for mask in masks) > side * side:
        return None
    order = sorted(range(len(charts)), key=lambda i: (-max(masks[i].shape), -int(masks[i].sum()), i))
    taken = np.zeros((side, side), dtype=bool)
    grown = np.ones((2 * padding + 1, 2 * padding + 1), dtype=bool)
    places: list[Place | None] = [None] * len(charts)
    for i in order:
        options = []
        for turned in (False, True):
            mask = masks[i].T if turned else masks[i]
            spot = _first_free(taken, mask)
            if spot is not None:
                options.append((spot[0] + mask.shape[0], spot[1], turned, spot))
        if not options:
            return None
        _, _, turned, (row, column) = min(options)
        mask = masks[i].T if turned else masks[i]
        _mark(taken, binary_dilation(np.pad(mask, padding), grown), row - padding, column - padding)
        margin = margins[i][::-1] if turned else margins[i]
        places[i] = Place(turned, (column + float(margin[0]), row + float(margin[1])))
    return [place for place in places if place is not None]


def _footprints(charts: list[Chart], scale: float) -> tuple[list[Bits], Floats]:
    """The texels that each chart touches, [rows, columns], and the margins [C, 2] that centre it in them.

    All charts are rasterised at once, side by side on one wide canvas.
    """
    extent = np.array([chart.corners.max(axis=(0, 1)) for chart in charts]) * scale
    size = np.maximum(np.ceil(extent + ROUNDING).astype(np.int64), 1)
    margins = 0.5 * (size - extent)
    left = np.cumsum(size[:, 0]) - size[:, 0]
    shift = margins + np.stack([left, np.zeros_like(left)], axis=1)
    corners = np.concatenate([chart.corners * scale + offset for chart, offset in zip(charts, shift, strict=True)])
    width, height = int(size[:, 0].sum()), int(size[:, 1].max())
    canvas = np.zeros((height, width), dtype=bool)
    canvas.ravel()[touched_squares(corners, width, height).square] = True
    return [canvas[:rows, x : x + columns] for x, (columns, rows) in zip(left, size, strict=True)], margins


def _first_free(taken: Bits, mask: Bits) -> tuple[int, int] | None:
    """The first row and column, in reading order, where the mask meets nothing taken."""
    rows, columns = (taken.shape[0] - mask.shape[0] + 1, taken.shape[1] - mask.shape[1] + 1)
    if rows < 1 or columns < 1:
        return None
    if mask.sum() <= DIRECT_TEXELS:
        blocked = np.zeros((rows, columns), dtype=bool)
        for y, x in np.argwhere(mask):
            blocked |= taken[y : y + rows, x : x + columns]
    else:
        meets = fftconvolve(taken.astype(np.float32), mask[::-1, ::-1].astype(np.float32), mode="valid")
        blocked = meets > 0.5
    index = int(np.argmin(blocked))
    row, column = divmod(index, columns)
    return None if blocked[row, column] else (row, column)


def _mark(taken: Bits, mask: Bits, row: int, column: int) -> None:
    """Set the mask's texels, as far as they lie in the square."""
    top, left = max(-row, 0), max(-column, 0)
    part = mask[top : top + taken.shape[0] - max(row, 0), left : left + taken.shape[1] - max(column, 0)]
    taken[max(row, 0) : max(row, 0) + part.shape[0], max(column, 0) : max(column, 0) + part.shape[1]] |= part


def _area(chart: Chart) -> float:
    a, b, c = np.moveaxis(chart.corners, 1, 0)
    return float(0.5 * np.abs((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]).sum())


def bounding_turn(points: Floats) -> Floats:
    """The rotation [2, 2] (rows are axes) that makes the bounding box of points [V, 2] smallest, over 64 angles."""
    best, turn = np.inf, np.eye(2)
    for angle in np.linspace(0.0, 0.5 * np.pi, 64, endpoint=False):
        axes = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
        width, height = np.ptp(points @ axes.T, axis=0)
        if width * height < best * (1.0 - 1e-6):
            best, turn = width * height, axes
    return turn
