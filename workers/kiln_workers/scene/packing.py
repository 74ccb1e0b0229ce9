"""Pack charts into one square light map: each as the set of texels that it touches, first fit from the top left.

Charts are taken from the largest to the smallest, tried upright and turned, and put where their lowest row is highest.
A placed chart keeps `padding` texels around it free. Charts smaller than a texel that belong to one mesh, lie within a
texel's width of each other and face the same way share a texel: what falls on them is one light at this scale. The
scale (texels a metre) is the finest for which all charts fit, found by bisection, so the atlas is as full as this order
allows. Deterministic: integers and fixed order only.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt
from scipy.ndimage import binary_dilation

from kiln_workers.scene.charts import Pieces, cut_long, gather, slimmed
from kiln_workers.scene.geometry import Floats, Ints
from kiln_workers.scene.model import Mesh
from kiln_workers.scene.raster import touching_squares
from kiln_workers.scene.unwrap import Unwrapped

Bits = npt.NDArray[np.bool_]

REFINE_STEPS: Final = 6
"""Bisections once a scale was found at which all charts fit."""
COARSER: Final = 0.75
ROUNDING: Final = 2e-3
"""Texels that a chart's box is widened by: UVs are stored as float32."""
STRIDE: Final = 16
"""A chart of so many rows is tried at every second row only, one of twice as many at every third, and so on."""


@dataclass(frozen=True)
class Layout:
    """Where all charts of a scene lie."""

    side: int
    scale: float  # texels a metre
    parts: tuple[Unwrapped, ...]
    """The parts with the charts cut that are longer than the light map."""
    uv: tuple[Floats, ...]  # of each part [V', 2] in texels
    cut: int
    """Pieces that come from cuts."""
    merged: int
    """Charts that share a texel with another."""


def lay_out(meshes: Sequence[Mesh], parts: Sequence[Unwrapped], side: int, padding: int) -> Layout | None:
    """The finest layout of straightened parts in a square of `side` texels; None if they fit at no scale."""
    area = float(gather(meshes, parts).area.sum())
    longest = max(float(part.uv.max()) for part in parts)
    scale, high, best = 0.8 * side / math.sqrt(area), side / math.sqrt(area), None
    while best is None:
        best = lay_out_at(meshes, parts, side, padding, scale)
        if best is None:
            if scale * longest < 0.5:
                return None
            high, scale = scale, COARSER * scale
    low = best.scale
    for _ in range(REFINE_STEPS):
        scale = 0.5 * (low + high)
        layout = lay_out_at(meshes, parts, side, padding, scale)
        if layout is None:
            high = scale
        else:
            low, best = scale, layout
    return best


def lay_out_at(
    meshes: Sequence[Mesh], parts: Sequence[Unwrapped], side: int, padding: int, scale: float
) -> Layout | None:
    """The layout with `scale` texels a metre; None if the charts do not fit."""
    room = side - 2.0 * ROUNDING
    cut = [cut_long(slimmed(part, scale, room, padding), room / scale * (1.0 + 1e-9)) for part in parts]
    pieces = gather(meshes, cut)
    group = _groups(pieces, scale)
    placed = _place_all(pieces, group, side, padding, scale)
    if placed is None:
        return None
    turned, origin = placed
    uv, done = [], 0
    for part in cut:
        chart = part.chart + done
        own = np.where(turned[chart][:, None], part.uv[:, ::-1], part.uv)
        uv.append(own * scale + origin[chart])
        done += part.charts
    return Layout(
        side=side,
        scale=scale,
        parts=tuple(cut),
        uv=tuple(uv),
        cut=sum(part.charts for part in cut) - sum(part.charts for part in parts),
        merged=len(group) - _different(group),
    )


def side_for(charts: int, padding: int) -> int:
    """Texels along a square's side that hold so many charts of one texel each."""
    return (1 + padding) * math.ceil(math.sqrt(charts)) - padding


def fewest_charts(meshes: Sequence[Mesh], parts: Sequence[Unwrapped]) -> int:
    """How many texels the charts need at least, however coarse the scale."""
    pieces = gather(meshes, parts)
    return _different(_groups(pieces, 0.4 / float(pieces.extent.max())))


def _different(group: Ints) -> int:
    return int(np.unique(group).size)


def _groups(pieces: Pieces, scale: float) -> Ints:
    """Number of the group [C] of each chart: of its own, or that with which it shares a texel."""
    tiny = np.asarray((pieces.extent * scale <= 1.0 - 2.0 * ROUNDING).all(axis=1))
    axis = np.abs(pieces.normal).argmax(axis=1)
    away = np.take_along_axis(pieces.normal, axis[:, None], axis=1)[:, 0] < 0.0
    cell = np.floor((pieces.centre - pieces.centre.min(axis=0)) * scale).astype(np.int64)
    own = np.where(tiny, -1, np.arange(len(tiny)))
    rows = np.column_stack([own, pieces.mesh, 2 * axis + away, cell])
    rows[~tiny, 1:] = 0
    return np.asarray(np.unique(rows, axis=0, return_inverse=True)[1].reshape(-1), dtype=np.int64)


def _place_all(pieces: Pieces, group: Ints, side: int, padding: int, scale: float) -> tuple[Bits, Floats] | None:
    """Of each chart whether it is turned [C] and its origin [C, 2] in texels: uv * scale (turned: v, u) + origin."""
    extent = pieces.extent * scale
    size = np.maximum(np.ceil(extent + ROUNDING).astype(np.int64), 1)
    margin = 0.5 * (size - extent)
    leaders = np.asarray(np.unique(group, return_index=True)[1], dtype=np.int64)
    if size[leaders].max() > side:
        return None
    masks = _masks(pieces, leaders, size, margin, scale)
    if sum(int(mask.sum()) for mask in masks) > side * side:
        return None
    square = _Square(side, padding)
    spots = np.zeros((len(leaders), 2))
    turned = np.zeros(len(leaders), dtype=bool)
    for i in sorted(range(len(masks)), key=lambda i: (-max(masks[i].shape), -int(masks[i].sum()), i)):
        spot = square.put(masks[i], turn=not pieces.rigid[leaders[i]])
        if spot is None:
            return None
        turned[i], spots[i] = spot[0], spot[1:]
    rank = np.unique(group, return_inverse=True)[1].reshape(-1)
    own_margin = np.where(turned[rank][:, None], margin[:, ::-1], margin)
    return turned[rank], spots[rank] + own_margin


def _masks(pieces: Pieces, which: Ints, size: Ints, margin: Floats, scale: float) -> list[Bits]:
    """The texels that each chart of `which` touches, [rows, columns], the chart in the middle of them."""
    faces = np.concatenate([np.arange(pieces.start[i], pieces.start[i + 1]) for i in which])
    item = np.repeat(np.arange(len(which)), pieces.start[which + 1] - pieces.start[which])
    corners = pieces.corners[faces] * scale + margin[which][item][:, None]
    columns, rows = size[which].T
    begin = np.cumsum(columns * rows) - columns * rows
    canvas = np.zeros(int((columns * rows).sum()), dtype=bool)
    for face, column, row in touching_squares(corners, int(columns.max()), int(rows.max())):
        mine = item[face]
        inside = (column < columns[mine]) & (row < rows[mine])
        canvas[(begin[mine] + row * columns[mine] + column)[inside]] = True
    canvas[begin[(size[which] == 1).all(axis=1)]] = True
    return [
        canvas[start : start + width * height].reshape(height, width)
        for start, width, height in zip(begin.tolist(), columns.tolist(), rows.tolist(), strict=True)
    ]


class _Square:
    """The texels that are taken, a row as the bits of one integer: a chart is tried at all columns of a row at once."""

    def __init__(self, side: int, padding: int) -> None:
        self._side, self._padding = side, padding
        self._taken = [0] * side
        self._grown = np.ones((2 * padding + 1, 2 * padding + 1), dtype=bool)
        self._tried: dict[bytes, int] = {}

    def put(self, mask: Bits, turn: bool) -> tuple[bool, int, int] | None:
        """Take room for the mask: whether it was turned, its first column and row; None where there is none."""
        options = []
        for turned in (False, True) if turn else (False,):
            shape = mask.T if turned else mask
            spot = self._first_free(shape)
            if spot is not None:
                options.append((spot[0] + shape.shape[0], spot[1], turned, spot))
        if not options:
            return None
        _, _, turned, (row, column) = min(options)
        grown = binary_dilation(np.pad(mask.T if turned else mask, self._padding), self._grown)
        for offset, bits in enumerate(_as_integers(grown)):
            at, shift = row - self._padding + offset, column - self._padding
            if 0 <= at < self._side:
                self._taken[at] |= bits << shift if shift >= 0 else bits >> -shift
        return turned, column, row

    def _first_free(self, mask: Bits) -> tuple[int, int] | None:
        """The first row and column, in reading order, where the mask meets nothing taken."""
        rows, columns = mask.shape
        if rows > self._side or columns > self._side:
            return None
        every = (1 << (self._side - columns + 1)) - 1
        runs = _runs(mask)
        # Texels are never freed, so a mask that was tried before has no room above.
        key = b"%d," % columns + np.packbits(mask).tobytes()
        for row in range(self._tried.get(key, 0), self._side - rows + 1, 1 + rows // STRIDE):
            blocked = 0
            for offset, start, length in runs:
                bits = self._taken[row + offset] >> start
                done = 1
                while 2 * done <= length:
                    bits |= bits >> done
                    done *= 2
                blocked |= bits | bits >> (length - done)
                if blocked & every == every:
                    break
            free = ~blocked & every
            if free:
                self._tried[key] = row
                return row, (free & -free).bit_length() - 1
        return None


def _runs(mask: Bits) -> list[tuple[int, int, int]]:
    """Row, first column and length of each run of texels, the longest first."""
    edges = np.diff(np.pad(mask.astype(np.int8), ((0, 0), (1, 1))), axis=1)
    row, start = np.nonzero(edges == 1)
    stop = np.nonzero(edges == -1)[1]
    runs = zip(row.tolist(), start.tolist(), (stop - start).tolist(), strict=True)
    return sorted(runs, key=lambda run: -run[2])


def _as_integers(mask: Bits) -> list[int]:
    """Each row as an integer whose bit x is column x."""
    return [int.from_bytes(row.tobytes(), "little") for row in np.packbits(mask, axis=1, bitorder="little")]
