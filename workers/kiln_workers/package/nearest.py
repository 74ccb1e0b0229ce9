"""The nearest known texel of every texel of a map, exactly, some rows at a time.

Euclidean distance transform of Maurer, Qi and Raghavan 2003 ("A Linear Time Algorithm for Computing Exact Euclidean
Distance Transforms of Binary Images in Arbitrary Dimensions", IEEE PAMI 25): first the nearest known texel within each
column, then along each row the lower envelope of the parabolas that stand on these. A row needs of the rest of the map
the last known row above it and the first one below it in every column, and nothing else. Of several at one distance the
one in the leftmost column is taken, and in that column the upper one, as SciPy's `distance_transform_edt` does, which
holds the whole map; a test compares them.
"""

from typing import Any, Final

import numba
import numpy as np
import numpy.typing as npt

from kiln_workers.fit.machine_code import INDEX, INDEX_ROWS, compiled

Bools = npt.NDArray[np.bool_]
Int64 = npt.NDArray[np.int64]

EVERY: Final = 64
"""Rows between those for which is kept what lies above and below."""

NONE: Final = -1


class Nearest:
    """The known texels of a map [H, W]."""

    def __init__(self, known: Bools) -> None:
        self._known = np.ascontiguousarray(known)
        height, width = known.shape
        blocks = -(-height // EVERY)
        self._above = np.full((blocks + 1, width), NONE, np.int32)  # last known row before row EVERY * b
        self._below = np.full((blocks + 1, width), NONE, np.int32)  # first known row from there on
        for block in range(blocks):
            part = self._known[block * EVERY : (block + 1) * EVERY]
            rows = np.arange(block * EVERY, block * EVERY + len(part), dtype=np.int32)[:, None]
            last = np.where(part, rows, NONE).max(axis=0)
            self._above[block + 1] = np.where(last == NONE, self._above[block], last)
        for block in reversed(range(blocks)):
            part = self._known[block * EVERY : (block + 1) * EVERY]
            first = part.argmax(axis=0) + block * EVERY
            self._below[block] = np.where(part.any(axis=0), first, self._below[block + 1])

    def sources(self, rows: slice) -> tuple[Int64, Int64]:
        """Row and column [B, W] of the known texel that is nearest to each texel of some rows; -1 if none is known."""
        first, last = rows.start // EVERY, -(-rows.stop // EVERY)
        begin, end = first * EVERY, min(last * EVERY, len(self._known))
        row = np.full((end - begin, self._known.shape[1]), NONE, np.int64)
        column = np.full_like(row, NONE)
        _fill_columns(
            self._known[begin:end], begin, self._above[first].astype(np.int64), self._below[last].astype(np.int64), row
        )
        row, column = row[rows.start - begin : rows.stop - begin], column[: rows.stop - rows.start]
        _fill_rows(rows.start, row, column)
        return row, column


@compiled(numba.types.Array(numba.boolean, 2, "C", readonly=False), numba.int64, INDEX, INDEX, INDEX_ROWS)
def _fill_columns(known: Any, begin: Any, above: Any, below: Any, row: Any) -> None:
    """Fill `row` [B, W] with the nearest known row in each texel's own column, the upper one of two.

    The rows are `begin` and the B - 1 after it; `above` and `below` [W] are the nearest known rows beyond them.
    """
    height, width = known.shape
    for i in range(height):
        for j in range(width):
            if known[i, j]:
                above[j] = begin + i
            row[i, j] = above[j]
    for back in range(height):
        i = height - 1 - back
        for j in range(width):
            if known[i, j]:
                below[j] = begin + i
            up, down = row[i, j], below[j]
            if up == NONE or (down != NONE and down - (begin + i) < (begin + i) - up):
                row[i, j] = down


@compiled(numba.int64, INDEX_ROWS, INDEX_ROWS)
def _fill_rows(begin: Any, row: Any, column: Any) -> None:
    """Replace the nearest row in each texel's column (`row` [B, W]) by row and column of the nearest known texel."""
    height, width = row.shape
    site = np.empty(width, np.int64)  # columns whose parabolas make the envelope, left to right
    lift = np.empty(width, np.int64)  # their squared distances within the column
    near = np.empty(width, np.int64)
    for i in range(height):
        count = 0
        for j in range(width):
            near[j] = row[i, j]
            if near[j] == NONE:
                continue
            up = (near[j] - begin - i) ** 2
            # Drop what lies above the parabolas of its two neighbours everywhere.
            while count >= 2:
                a = site[count - 1] - site[count - 2]
                b = j - site[count - 1]
                if (a + b) * lift[count - 1] - b * lift[count - 2] - a * up - a * b * (a + b) <= 0:
                    break
                count -= 1
            site[count], lift[count] = j, up
            count += 1
        k = 0
        for j in range(width if count else 0):
            while k + 1 < count and lift[k + 1] + (site[k + 1] - j) ** 2 < lift[k] + (site[k] - j) ** 2:
                k += 1
            row[i, j], column[i, j] = near[site[k]], site[k]
