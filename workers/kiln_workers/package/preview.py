"""What the packager is handed to show to people: pictures of the atlas, chosen light fields, errors per texel."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from kiln_schemas.errors import InternalError
from kiln_schemas.settings import Function

Float32 = npt.NDArray[np.float32]


@dataclass(frozen=True)
class TexelPreview:
    """One texel's image and what its lobes make of it."""

    row: int
    column: int
    log_mse: float
    normal: tuple[float, float, float]  # geometric; directions below its horizon are not shown
    original: Float32  # [R, R, 3] octahedral, scene units
    predicted: Float32  # [R, R, 3], from the lobes as stored


@dataclass(frozen=True)
class FunctionPreview:
    """Best, median and worst texel of a function, and the error of all texels."""

    best: TexelPreview
    median: TexelPreview
    worst: TexelPreview
    errors: Float32  # [H, W] log_mse; NaN where a texel has no lobes

    def texels(self) -> tuple[tuple[str, TexelPreview], ...]:
        return ("best", self.best), ("median", self.median), ("worst", self.worst)


@dataclass(frozen=True)
class PackagePreview:
    atlas: npt.NDArray[np.uint8]  # [h, w, 3] validity, density and charts side by side (`scene.picture`)
    functions: Mapping[Function, FunctionPreview]


def choose_texels(errors: Float32) -> tuple[tuple[int, int], tuple[int, int], tuple[int, int]]:
    """Row and column of the best, median and worst texel of per-texel errors [H, W] (NaN: no lobes)."""
    flat = errors.reshape(-1)
    finite = np.flatnonzero(np.isfinite(flat))
    if finite.size == 0:
        raise InternalError("no texel has an error to show", where="package")
    order = finite[np.argsort(flat[finite], kind="stable")]
    width = errors.shape[1]
    best, median, worst = (divmod(int(order[i]), width) for i in (0, len(order) // 2, -1))
    return best, median, worst
