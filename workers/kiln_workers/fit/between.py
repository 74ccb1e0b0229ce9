"""A part of the light map read from a bake's store: its light fields, and what was traced half-way between texels."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from kiln_schemas.settings import Function
from kiln_schemas.tasks import Tile
from kiln_workers.fit.field import TexelField, TracedBetween
from kiln_workers.fit.pooling import pooled
from kiln_workers.fit.source import Index
from kiln_workers.scene.texel_map import TexelMap, TexelState
from kiln_workers.store.layout import BETWEEN_STEPS, sparse_offsets
from kiln_workers.store.light_field import LightFieldStore

Moved = Callable[[], tuple[TexelMap, ...]]
"""Makes the texel maps of the points between (`render.between.between_maps`), where they are wanted."""


def read_field(
    store: LightFieldStore, texel_map: TexelMap, tiles: Sequence[tuple[Tile, Index]], exposure: float, moved: Moved
) -> TexelField:
    """The light fields of texels and between them, tile by tile: a tile and row-major indices of valid texels in it."""
    field = read_texels(store, Function.LIGHT_FIELD, texel_map, tiles, exposure)
    if not store.has_between or not len(field):
        return field
    return replace(field, traced=_read_between(store, field, moved(), tiles))


def read_texels(
    store: LightFieldStore,
    function: Function,
    texel_map: TexelMap,
    tiles: Sequence[tuple[Tile, Index]],
    exposure: float,
    size: int | None = None,
) -> TexelField:
    """The images of a function at the texels alone, pooled to `size` as they are read."""
    size = size or store.image_size
    images, places = [np.empty((0, size, size, 3), np.float16)], [np.empty((0, 2), np.int64)]
    for tile, inside in tiles:
        rows, columns = np.divmod(inside, tile.size)
        places.append(np.stack([rows + tile.row, columns + tile.column], axis=1))
        images.append(pooled(store.read_tile(function, tile, inside), size))
    place = np.concatenate(places)
    at = place[:, 0], place[:, 1]
    chart = texel_map.chart[at].astype(np.int64)
    return TexelField(np.concatenate(images), texel_map.normal[at], place, chart, exposure)


def _read_between(
    store: LightFieldStore, field: TexelField, moved: tuple[TexelMap, ...], tiles: Sequence[tuple[Tile, Index]]
) -> TracedBetween:
    """Of the field's between points those that count: whose texel is VALID in `moved`, one map a kind."""
    between, half = field.between, store.image_size // 2
    number = np.full(store.shape, -1, np.int64)
    row, column = field.place.T
    number[row, column] = np.arange(len(field))
    stored = np.empty((len(field), len(BETWEEN_STEPS), half, half, 3), np.float16)
    for tile, inside in tiles:
        rows, columns = np.divmod(inside, tile.size)
        stored[number[rows + tile.row, columns + tile.column]] = store.read_between(tile, inside)
    points, normals, offsets, images = [], [], [], []
    for kind, step in enumerate(BETWEEN_STEPS):
        mine = np.flatnonzero((between.step == step).all(axis=1))
        first = between.first[mine]
        counts = moved[kind].state[row[first], column[first]] == TexelState.VALID
        mine, first = mine[counts], first[counts]
        at = row[first], column[first]
        points.append(mine)
        normals.append(moved[kind].normal[at])
        offsets.append(sparse_offsets(*at, kind))
        images.append(stored[first, kind])
    return TracedBetween(*(np.concatenate(parts) for parts in (points, normals, offsets, images)))
