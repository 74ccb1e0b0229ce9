"""Light-map arrays some rows at a time, so that what a task holds in memory does not grow with the light map.

A whole map lies in a file of the task's scratch folder and is mapped into memory. Pages of a mapped file that were
looked at stay in memory until the system needs the room, or until `release` gives them back, so whoever goes through a
map band by band releases it after each band.
"""

import mmap
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

BAND_TEXELS: Final = 1 << 17
"""Texels of a band, about."""


def bands(shape: tuple[int, ...], share: int = 1) -> Iterator[slice]:
    """The rows of a map [H, W, ...], cut into bands of about BAND_TEXELS texels, or a part of that."""
    height, width = shape[:2]
    rows = max(BAND_TEXELS // share // width, 1)
    for first in range(0, height, rows):
        yield slice(first, min(first + rows, height))


def mapped(path: Path, shape: tuple[int, ...], dtype: npt.DTypeLike) -> npt.NDArray[Any]:
    """A new file of zeros as an array; what is never written takes no room on the disk."""
    return np.memmap(path, dtype, "w+", shape=shape)


def release(*arrays: npt.NDArray[Any]) -> None:
    """Give back the pages of mapped arrays. Their values stay as they are, in the file."""
    for array in arrays:
        base: Any = array
        while isinstance(base, np.ndarray | memoryview):
            base = base.base if isinstance(base, np.ndarray) else base.obj
        if isinstance(base, mmap.mmap):
            base.madvise(mmap.MADV_DONTNEED)
