"""The radiance cache: what diffuse surfaces receive, so that paths of light fields may end where they meet one.

A path that leaves a surface by its diffuse lobe finds out, at the price of many more rays and of most of an image's
noise, what the light map's own irradiance says. So the prepare task traces that irradiance once, at the irradiance
map's resolution, and the light fields' paths look it up (Ward et al. 1988 cache it at points, light maps at texels).
Glossy lobes are followed as before. Light straight from points and directions is left out of the map and sampled at
each hit, because its shadows are sharper than a texel. Surfaces with two sides have a map of each. Where irradiance
turns fast from texel to texel, as on the ceiling around a lamp that hangs close below, paths go on as without a map: a
texel's mean would light the room from there too brightly or too darkly.

Errors: that of the map's own noise, and light moves by up to a texel of it (docs/design/render.md has both measured).
"""

from typing import Any, Final

import numpy as np
import numpy.typing as npt

from kiln_schemas.conventions import FP16_MAX
from kiln_schemas.errors import InputError
from kiln_schemas.settings import RenderSettings
from kiln_workers.package.dilate import plan_fill
from kiln_workers.render.tile import Progress, TexelBatch, TileRenderer, silent, to_half
from kiln_workers.scene.bands import bands
from kiln_workers.scene.container import pack, unpack
from kiln_workers.scene.model import Scene
from kiln_workers.scene.texel_map import TexelMap, TexelState

Float16 = npt.NDArray[np.float16]

KIND: Final = "radiance cache"
LARGEST_CACHE: Final = 1024
"""Texels along each side, at most: the prepare task makes it alone."""

SAMPLES: Final = 64
"""Paths a texel; each pixel of a light field sees several texels, and none of their noise is its own."""

FRONTS, BACKS = 96, 160
"""Their random numbers begin after so many times the map's texels, and so after those of the tiles' irradiance, which
end after 16 + 8^2 times the texels of a light map that is no larger (`stages.render.FINE_SEQUENCE`).
"""

UNKNOWN: Final = -FP16_MAX
"""What the map holds where paths go on: so low that whatever is interpolated with it is negative."""

STEEP: Final = 0.5
"""Irradiance turns fast where two neighbours differ by more than this part of the larger one,"""

NEGLIGIBLE: Final = 0.1
"""and by more than this part of the whole map's mean."""


def make_cache(
    scene: Scene,
    scene_hash: str,
    texel_map: TexelMap,
    settings: RenderSettings,
    memory_bytes: int,
    on_progress: Progress = silent,
) -> Float16:
    """Irradiance [H, W, 3], or [H, W, 6] of both sides where a material has two, without that of punctual lights.

    Texels without a surface, or inside something, have the value of the nearest with one (`package.dilate`). UNKNOWN
    is where irradiance turns fast.
    """
    shorter = settings.model_copy(update={"irradiance_samples": SAMPLES, "max_depth": settings.max_depth - 1})
    renderer = TileRenderer(scene, scene_hash, shorter, memory_bytes)
    sides = 2 if renderer.tracer.has_backs else 1
    out = np.zeros((*texel_map.state.shape, 3 * sides), np.float16)
    inside = np.zeros((*texel_map.state.shape, sides), bool)
    height = len(texel_map.state)
    for rows in bands(texel_map.state.shape):
        part = texel_map.rows(rows)
        row, column = np.nonzero(part.state == TexelState.VALID)
        place = row.astype(np.int64), column.astype(np.int64)
        for side in range(sides if len(row) else 0):

            def report(done: float, rows: slice = rows, side: int = side) -> None:
                on_progress((rows.start + (rows.stop - rows.start) * (side + done) / sides) / height)

            first = (BACKS if side else FRONTS) * texel_map.state.size + rows.start * texel_map.state.shape[1]
            batch = TexelBatch.of(part, place, first)
            values, _, _ = renderer.render_fine_irradiance(
                renderer.backs(batch) if side else batch, report, punctual=False
            )
            out[rows][..., 3 * side : 3 * side + 3][place] = to_half(values)[0]
            inside[rows][..., side][place] = values[:, 0] < 0.0
        texel_map.release()
    for side in range(sides):
        known = (texel_map.state == TexelState.VALID) & ~inside[..., side]
        channels = slice(3 * side, 3 * side + 3)
        traced = out[..., channels]
        steep = _steep(traced, texel_map.chart, known)
        filled = plan_fill(known, texel_map.chart).nearest(traced) if known.any() else np.zeros_like(traced)
        out[..., channels] = np.where(steep[..., None], np.float16(UNKNOWN), filled)
    return out


def _steep(values: Float16, chart: npt.NDArray[np.int32], known: npt.NDArray[np.bool_]) -> npt.NDArray[np.bool_]:
    """Texels [H, W] whose irradiance and a neighbour's of their own chart are too far apart, on both sides."""
    light = values.astype(np.float32).mean(axis=2)
    floor = NEGLIGIBLE * float(light[known].mean()) if known.any() else 0.0
    out = np.zeros(known.shape, bool)
    height, width = known.shape
    for down, right in ((0, 1), (1, 0), (1, 1), (1, -1)):
        here = slice(0, height - down), slice(max(-right, 0), width - max(right, 0))
        there = slice(down, height), slice(max(right, 0), width - max(-right, 0))
        apart = np.abs(light[here] - light[there]) > np.maximum(STEEP * np.maximum(light[here], light[there]), floor)
        apart &= known[here] & known[there] & (chart[here] == chart[there])
        out[here] |= apart
        out[there] |= apart
    return out


def pack_cache(cache: Float16) -> bytes:
    """The cache as bytes; the same cache gives the same bytes."""
    return pack(KIND, {}, {"irradiance": cache})


def unpack_cache(data: bytes) -> Float16:
    """The cache of `pack_cache`'s bytes; InputError if they are anything else."""
    _, arrays = unpack(KIND, data)
    cache: npt.NDArray[Any] | None = arrays.get("irradiance")
    if (
        cache is None
        or cache.dtype != np.float16
        or cache.ndim != 3
        or cache.shape[2] not in (3, 6)
        or not cache.size
        or not ((cache >= 0.0) & (cache <= FP16_MAX) | (cache == UNKNOWN)).all()
    ):
        raise InputError(
            "the array 'irradiance' is missing, misshapen or no light", where=KIND, remedy="Run prepare again."
        )
    return cache
