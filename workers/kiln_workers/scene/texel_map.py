"""The texel map: which point of the scene each light-map texel stands for, and its bytes.

It is made once by the prepare task and read by every later one. Arrays are [H, W, ...] with row 0 at v = 0.
"""

from dataclasses import dataclass, fields
from enum import IntEnum
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from kiln_schemas.errors import InputError
from kiln_workers.scene.container import pack, unpack

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
        return int((self.state != TexelState.GUTTER).sum())


SPECK: Final = 4
"""A chart of so many texels or fewer shows one light, not how light changes over it."""
COARSE: Final = 0.5
"""A light map is too coarse where more than this part of its texels lies in specks."""


def speck_share(chart: npt.NDArray[np.int32]) -> float:
    """The part of the covered texels of `chart` [H, W] (-1: gutter) that lies in charts of at most SPECK texels."""
    counts = np.unique(chart[chart >= 0], return_counts=True)[1]
    return float(counts[counts <= SPECK].sum() / max(counts.sum(), 1))


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


def pack_texel_map(texels: TexelMap) -> bytes:
    """The map as bytes; the same map gives the same bytes."""
    return pack(KIND, {}, {field.name: getattr(texels, field.name) for field in fields(texels)})


def unpack_texel_map(data: bytes) -> TexelMap:
    """The map of `pack_texel_map`'s bytes, arrays read-only; InputError if they are anything else."""
    _, arrays = unpack(KIND, data)
    grid = arrays["state"].shape if "state" in arrays else ()
    parts: dict[str, Any] = {}
    for name, (dtype, tail) in _LAYOUT.items():
        array = arrays.get(name)
        if array is None or len(grid) != 2 or array.shape != grid + tail or array.dtype.str != dtype:
            raise InputError(f"the array '{name}' is missing or misshapen", where=KIND, remedy="Run prepare again.")
        if array.dtype.kind == "f" and not np.isfinite(array).all():
            raise InputError(f"the array '{name}' holds values that are not finite", where=KIND)
        parts[name] = array
    if parts["state"].size and parts["state"].max() > TexelState.INVALID:
        raise InputError("a texel has a state that does not exist", where=KIND, remedy="Run prepare again.")
    return TexelMap(**parts)
