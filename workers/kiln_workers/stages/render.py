"""Render one tile into the store: light field, visibility and irradiance of its texels, and light fields between."""

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from kiln_schemas.tasks import RenderPayload, RenderResult
from kiln_workers.render.backend import select_variant
from kiln_workers.render.between import trace_sparse
from kiln_workers.render.tile import TexelBatch, TileRenderer
from kiln_workers.runner.context import Context
from kiln_workers.scene.archive import unpack_scene
from kiln_workers.scene.texel_map import TexelMap, TexelState, unpack_texel_map
from kiln_workers.stages.radiance_cache import unpack_cache
from kiln_workers.stages.tiles import covered_texels, map_coordinates
from kiln_workers.store.light_field import LightFieldStore

Float16 = npt.NDArray[np.float16]
Ints = npt.NDArray[np.int64]

_WARM: Final = "render"

FINE_SEQUENCE: Final = 16
"""The finer irradiance's random numbers begin after those of the texels and of all points between."""

FINE_SHARE: Final = 0.2
"""About what the finer irradiance takes of a tile's time."""

BETWEEN_SHARE: Final = 0.3
"""About what the light fields between texels take of a tile's time: three points a texel, a quarter of the pixels."""


def run(payload: RenderPayload, context: Context) -> RenderResult:
    """Path-trace a tile and replace its shard; the same payload always gives the same bytes."""
    began = time.perf_counter()
    warm = _warm(payload, context)
    warm.store.check()
    texel_map, tile = warm.texel_map, payload.tile
    inside = covered_texels(texel_map, tile)
    place = map_coordinates(tile, inside)
    batch = TexelBatch.of(texel_map, place)
    fine_from = 1.0 - FINE_SHARE if warm.fine is not None else 1.0
    between_from = fine_from - BETWEEN_SHARE if warm.between else fine_from

    def on_progress(fraction: float) -> None:
        context.progress(fraction * len(inside), len(inside), "texels", f"tile {tile.row},{tile.column}")

    images = warm.renderer.render(batch, lambda done: on_progress(between_from * done))
    warm.store.write_tile(tile, inside, images.light_field, images.visibility, images.irradiance)
    paths = images.paths
    if warm.between:
        span = fine_from - between_from
        between, more = _trace_between(warm, payload, place, lambda done: on_progress(between_from + span * done))
        warm.store.write_between(tile, inside, between)
        paths += more
    if warm.fine is not None:
        paths += _render_fine(warm, warm.fine, payload, lambda done: on_progress(fine_from + FINE_SHARE * done))
    warm.store.check()
    invalid = inside[images.enclosed]
    return RenderResult(
        tile=tile,
        paths=paths,
        overflows=images.overflows,
        invalid=len(invalid),
        invalid_texels=tuple(invalid.tolist()),
        seconds=time.perf_counter() - began,
    )


def _render_fine(warm: "_Warm", fine: TexelMap, payload: RenderPayload, on_progress: Callable[[float], None]) -> int:
    """Write the tile's part of the finer irradiance map; how many paths it took."""
    scale = warm.store.irradiance_scale
    inside = covered_texels(fine, payload.tile, scale)
    batch = TexelBatch.of(fine, map_coordinates(payload.tile, inside, scale), FINE_SEQUENCE * warm.texel_map.state.size)
    irradiance, paths, _ = warm.renderer.render_fine_irradiance(batch, on_progress)
    warm.store.write_fine_irradiance(payload.tile, inside, irradiance)
    return paths


def _trace_between(
    warm: "_Warm", payload: RenderPayload, place: tuple[Ints, Ints], on_progress: Callable[[float], None]
) -> tuple[Float16, int]:
    """Sparse light fields [T, 3, R / 2, R / 2, 3] of the points between that belong to texels `place`, and paths."""
    settings = payload.settings.render
    half = settings.image_size // 2
    out = np.zeros((len(place[0]), len(warm.between), half, half, 3), np.float16)
    paths = 0
    for kind, moved in enumerate(warm.between):
        at = np.flatnonzero(moved.state[place] == TexelState.VALID)
        points = place[0][at], place[1][at]

        def report(done: float, kind: int = kind) -> None:
            on_progress((kind + done) / len(warm.between))

        if len(at):
            out[at, kind], more = trace_sparse(warm.renderer, moved, points, kind, settings.between_samples, report)
            paths += more
    return out, paths


@dataclass(frozen=True)
class _Warm:
    """What one process keeps between the tiles of a scene."""

    key: tuple[object, ...]
    renderer: TileRenderer
    texel_map: TexelMap
    between: tuple[TexelMap, ...]
    fine: TexelMap | None
    store: LightFieldStore


def _warm(payload: RenderPayload, context: Context) -> _Warm:
    maps = (payload.texel_map, payload.between, payload.fine, payload.cache)
    key = (payload.scene, maps, payload.store_url, payload.settings.render)
    warm = context.cache.get(_WARM)
    if not isinstance(warm, _Warm) or warm.key != key:
        context.cache.pop(_WARM, None)
        select_variant(threads=context.threads)
        store = LightFieldStore.open(payload.store_url)
        scene = unpack_scene(context.blob(payload.scene))
        renderer = TileRenderer(
            scene,
            store.attributes["scene_hash"],
            payload.settings.render,
            context.memory_bytes,
            cache=None if payload.cache is None else unpack_cache(context.blob(payload.cache)),
        )
        between = tuple(unpack_texel_map(context.blob(digest)) for digest in payload.between)
        fine = None if payload.fine is None else unpack_texel_map(context.blob(payload.fine))
        warm = _Warm(key, renderer, unpack_texel_map(context.blob(payload.texel_map)), between, fine, store)
        context.cache[_WARM] = warm
    return warm
