"""Render one tile: the light field, the visibility and the irradiance of each of its texels, into the store."""

import time
from dataclasses import dataclass
from typing import Final

from kiln_schemas.tasks import RenderPayload, RenderResult
from kiln_workers.render.backend import select_variant
from kiln_workers.render.tile import TexelBatch, TileRenderer
from kiln_workers.runner.context import Context
from kiln_workers.scene.archive import unpack_scene
from kiln_workers.scene.texel_map import TexelMap, unpack_texel_map
from kiln_workers.stages.tiles import BACK_FACE_LIMIT, covered_texels, map_coordinates
from kiln_workers.store.light_field import LightFieldStore

_WARM: Final = "render"


def run(payload: RenderPayload, context: Context) -> RenderResult:
    """Path-trace a tile and replace its shard; the same payload always gives the same bytes."""
    began = time.perf_counter()
    warm = _warm(payload, context)
    texel_map, tile = warm.texel_map, payload.tile
    inside = covered_texels(texel_map, tile)
    place = map_coordinates(tile, inside)
    batch = TexelBatch(
        index=place[0] * texel_map.state.shape[1] + place[1],
        position=texel_map.position[place],
        normal=texel_map.normal[place],
        shading_normal=texel_map.shading_normal[place],
        alpha=texel_map.alpha[place],
        texel_size=texel_map.texel_size[place],
    )

    def on_progress(fraction: float) -> None:
        context.progress(fraction * len(inside), len(inside), "texels", f"tile {tile.row},{tile.column}")

    images = warm.renderer.render(batch, on_progress)
    warm.store.write_tile(tile, inside, images.light_field, images.visibility, images.irradiance)
    invalid = inside[images.back_faces > BACK_FACE_LIMIT]
    return RenderResult(
        tile=tile,
        paths=images.paths,
        overflows=images.overflows,
        invalid=len(invalid),
        invalid_texels=tuple(invalid.tolist()),
        seconds=time.perf_counter() - began,
    )


@dataclass(frozen=True)
class _Warm:
    """What one process keeps between the tiles of a scene."""

    key: tuple[object, ...]
    renderer: TileRenderer
    texel_map: TexelMap
    store: LightFieldStore


def _warm(payload: RenderPayload, context: Context) -> _Warm:
    key = (payload.scene, payload.texel_map, payload.store_url, payload.settings.render)
    warm = context.cache.get(_WARM)
    if not isinstance(warm, _Warm) or warm.key != key:
        context.cache.pop(_WARM, None)
        select_variant(threads=context.threads)
        store = LightFieldStore.open(payload.store_url)
        scene = unpack_scene(context.blob(payload.scene))
        renderer = TileRenderer(scene, store.attributes["scene_hash"], payload.settings.render, context.memory_bytes)
        warm = _Warm(key, renderer, unpack_texel_map(context.blob(payload.texel_map)), store)
        context.cache[_WARM] = warm
    return warm
