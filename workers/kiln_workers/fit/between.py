"""What a bake traced half-way between texels, read from its store for a field of texels."""

from collections.abc import Iterable

import numpy as np

from kiln_schemas.tasks import Tile
from kiln_workers.fit.field import TexelField, TracedBetween
from kiln_workers.fit.source import Index
from kiln_workers.scene.texel_map import TexelMap, TexelState
from kiln_workers.store.layout import BETWEEN_STEPS, sparse_offsets
from kiln_workers.store.light_field import LightFieldStore


def read_between(
    store: LightFieldStore, field: TexelField, moved: tuple[TexelMap, ...], tiles: Iterable[tuple[Tile, Index]]
) -> TracedBetween:
    """Of the field's between points those that count: whose texel is VALID in `moved`, one map a kind.

    `tiles` are the field's texels: a tile and row-major indices inside of it.
    """
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
