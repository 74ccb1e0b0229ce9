"""The texel map: which point of the scene each light-map texel stands for, and its bytes.

It is made once by the prepare task and read by every later one. Arrays are [H, W, ...] with row 0 at v = 0.
"""

import math
import mmap
from collections.abc import Iterable
from dataclasses import dataclass, fields
from enum import IntEnum
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from kiln_schemas.errors import InputError
from kiln_workers.scene.bands import bands, release
from kiln_workers.scene.container import Array, pack, unpack, write_frame

KIND: Final = "texel map"


class TexelState(IntEnum):
    """What a texel is."""

    GUTTER = 0
    """No chart touches it."""
    VALID = 1
    """It has a point to which light can come."""
    INVALID = 2
    """Its point lies inside other geometry; filled from its neighbours when packaging."""


@dataclass(frozen=True)
class TexelMap:
    """Points of a scene's surface, one a light-map texel; zero (and -1 in `mesh`, `chart`) in the gutter."""

    state: npt.NDArray[np.uint8]  # [H, W] TexelState
    position: npt.NDArray[np.float32]  # [H, W, 3] metres, world; where paths start
    normal: npt.NDArray[np.float32]  # [H, W, 3] unit, geometric (the side that light reaches)
    shading_normal: npt.NDArray[np.float32]  # [H, W, 3] unit, interpolated
    alpha: npt.NDArray[np.float32]  # [H, W] GGX alpha = roughness^2
    texel_size: npt.NDArray[np.float32]  # [H, W] metres along a texel's side
    mesh: npt.NDArray[np.int32]  # [H, W]
    chart: npt.NDArray[np.int32]  # [H, W]

    @property
    def covered(self) -> int:
        """Texels that a chart touches."""
        return int(np.count_nonzero(self.state))

    def rows(self, rows: slice) -> "TexelMap":
        """Some rows of the map; no array is copied."""
        return TexelMap(**{field.name: getattr(self, field.name)[rows] for field in fields(self)})

    def release(self) -> None:
        """Give back the memory of a map that lies in a file (`scene.bands`)."""
        release(*(getattr(self, field.name) for field in fields(self)))


def joined(parts: Iterable[TexelMap]) -> TexelMap:
    """Bands of rows as one map."""
    listed = list(parts)
    return TexelMap(
        **{field.name: np.concatenate([getattr(part, field.name) for part in listed]) for field in fields(TexelMap)}
    )


SPECK: Final = 4
"""A chart of so many texels or fewer shows one light, not how light changes over it."""
COARSE: Final = 0.5
"""A light map is too coarse where more than this part of its texels lies in specks."""


def speck_share(chart: npt.NDArray[np.int32]) -> float:
    """The part of the covered texels of `chart` [H, W] (-1: gutter) that lies in charts of at most SPECK texels."""
    counts = chart_sizes(chart)
    return float(counts[counts <= SPECK].sum() / max(counts.sum(), 1))


def chart_sizes(chart: npt.NDArray[np.int32]) -> npt.NDArray[np.int64]:
    """Texels of each chart of `chart` [H, W] (-1: gutter) by the chart's number."""
    counts = np.zeros(0, np.int64)
    for rows in bands(chart.shape):
        part = chart[rows]
        more = np.bincount(part[part >= 0], minlength=len(counts))
        more[: len(counts)] += counts
        counts = more
        release(chart)
    return counts


_LAYOUT: Final[dict[str, tuple[str, tuple[int, ...]]]] = {
    "state": ("|u1", ()),
    "position": ("<f4", (3,)),
    "normal": ("<f4", (3,)),
    "shading_normal": ("<f4", (3,)),
    "alpha": ("<f4", ()),
    "texel_size": ("<f4", ()),
    "mesh": ("<i4", ()),
    "chart": ("<i4", ()),
}


def write_texel_map(path: Path, shape: tuple[int, int], parts: Iterable[TexelMap]) -> None:
    """Write the bytes of `pack_texel_map` to a file, from bands of the map's rows, top to bottom."""
    arrays = {name: (dtype, (*shape, *tail)) for name, (dtype, tail) in _LAYOUT.items()}
    with path.open("wb") as file:
        places = write_frame(file, KIND, {}, arrays)
        done = 0
        for part in parts:
            for name, (dtype, tail) in _LAYOUT.items():
                values = np.ascontiguousarray(getattr(part, name), dtype)
                file.seek(places[name] + done * shape[1] * math.prod(tail) * values.itemsize)
                file.write(values.data)
            done += len(part.state)
    if done != shape[0]:
        raise ValueError(f"the bands have {done} rows, the map {shape[0]}")


def open_texel_map(path: Path) -> TexelMap:
    """The map of a file, mapped into memory; InputError if its bytes are anything else."""
    with path.open("rb") as file:
        return unpack_texel_map(mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ))


def pack_texel_map(texels: TexelMap) -> bytes:
    """The map as bytes; the same map gives the same bytes."""
    return pack(KIND, {}, {field.name: getattr(texels, field.name) for field in fields(texels)})


def unpack_texel_map(data: bytes | mmap.mmap) -> TexelMap:
    """The map of `pack_texel_map`'s bytes, arrays read-only; InputError if they are anything else."""
    _, arrays = unpack(KIND, data)
    grid = arrays["state"].shape if "state" in arrays else ()
    parts: dict[str, Any] = {}
    for name, (dtype, tail) in _LAYOUT.items():
        array = arrays.get(name)
        if array is None or len(grid) != 2 or array.shape != grid + tail or array.dtype.str != dtype:
            raise InputError(f"the array '{name}' is missing or misshapen", where=KIND, remedy="Run prepare again.")
        if array.dtype.kind == "f" and not _finite(array):
            raise InputError(f"the array '{name}' holds values that are not finite", where=KIND)
        parts[name] = array
    if parts["state"].size and parts["state"].max() > TexelState.INVALID:
        raise InputError("a texel has a state that does not exist", where=KIND, remedy="Run prepare again.")
    return TexelMap(**parts)


def _finite(values: Array) -> bool:
    for rows in bands(values.shape) if values.size else ():
        if not np.isfinite(values[rows]).all():
            return False
        release(values)
    return True
