"""Dr.Jit and Mitsuba without their type stubs.

The stubs describe no variant that is ever selected (array types change with `select_variant`), so to the type checker
both are Any. Import `dr` and `mi` from here; importing loads no backend.
"""

from typing import Any, Final

import drjit
import mitsuba
import numpy as np
import numpy.typing as npt

dr: Any = drjit
mi: Any = mitsuba

ALIGNMENT: Final = 64
"""Bytes at a multiple of which Dr.Jit's own arrays begin, at least."""


def column(kind: Any, values: npt.NDArray[Any]) -> Any:
    """NumPy values [N] as a Dr.Jit array of `kind`, a dtype of the same size.

    Dr.Jit compiles a kernel anew for each set of arrays that happen to be aligned, and takes NumPy's memory as it is:
    without the copy here, which kernel runs would be up to the allocator, and seconds would go into compiling them.
    """
    room = np.empty(values.nbytes + ALIGNMENT, np.uint8)
    first = -room.ctypes.data % ALIGNMENT
    out = room[first : first + values.nbytes].view(values.dtype)
    out[:] = values
    return kind(out)


def columns(kind: Any, values: npt.NDArray[Any]) -> Any:
    """NumPy values [N, 3] as a Dr.Jit array of vectors, the same way."""
    return kind(*(column(mi.Float, values[:, axis].astype(np.float32)) for axis in range(3)))


def to_numpy(vectors: Any) -> npt.NDArray[Any]:
    """A Dr.Jit array of vectors as NumPy values [N, C]; `np.array` would compile a kernel for each N."""
    return np.stack([np.array(part) for part in vectors], axis=1)


def mean(colour: Any) -> Any:
    """Mean over the channels; `dr.mean` holds the number of lanes, so that every wavefront would be compiled anew."""
    return (colour[0] + colour[1] + colour[2]) * (1.0 / 3.0)
