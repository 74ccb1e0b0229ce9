"""Which texels a tile holds, and which of them count: the one place where tiles meet the texel map."""

from collections.abc import Iterable
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from kiln_schemas.tasks import RenderResult, Tile
from kiln_workers.scene.bands import bands
from kiln_workers.scene.texel_map import TexelMap, TexelState

Ints = npt.NDArray[np.int64]


def plan_tiles(texel_map: TexelMap, size: int) -> tuple[Tile, ...]:
    """Tiles of `size` x `size` texels, row by row, that hold at least one surface point."""
    height, width = texel_map.state.shape
    tiles = []
    for row in range(0, height, size):
        for column in range(0, width, size):
            texels = int(np.count_nonzero(texel_map.state[row : row + size, column : column + size]))
            if texels:
                tiles.append(Tile(row=row, column=column, size=size, texels=texels))
    return tuple(tiles)


def tiles_of(renders: Iterable[RenderResult]) -> list[Tile]:
    """The rendered tiles, row by row."""
    return sorted((render.tile for render in renders), key=lambda tile: (tile.row, tile.column))


def covered_texels(texel_map: TexelMap, tile: Tile, scale: int = 1) -> Ints:
    """Row-major indices inside the tile [T] of its texels with a surface point, ascending.

    Tiles are squares of the light map; a finer map has `scale` texels along each side of one of its texels.
    """
    row, column, size = scale * tile.row, scale * tile.column, scale * tile.size
    rows, columns = np.nonzero(texel_map.state[row : row + size, column : column + size] != TexelState.GUTTER)
    return np.asarray(rows * size + columns, dtype=np.int64)


def map_coordinates(tile: Tile, inside: Ints, scale: int = 1) -> tuple[Ints, Ints]:
    """Rows and columns in the light map, or in a finer one, of row-major indices inside a tile."""
    rows, columns = np.divmod(inside, scale * tile.size)
    return rows + scale * tile.row, columns + scale * tile.column


def with_render_verdict(texel_map: TexelMap, renders: Iterable[RenderResult]) -> TexelMap:
    """The texel map with the texels that rendering found inside other geometry marked invalid.

    A chart that lies inside as a whole has nothing to be filled from: it stays as it is.
    """
    inside = np.zeros(texel_map.state.shape, bool)
    for render in renders:
        inside[map_coordinates(render.tile, np.asarray(render.invalid_texels, dtype=np.int64))] = True
    return without_texels(texel_map, inside)


def without_texels(texel_map: TexelMap, inside: npt.NDArray[np.bool_]) -> TexelMap:
    """The texel map with the texels `inside` [H, W] geometry marked invalid, except for charts that wholly are."""
    state = np.array(texel_map.state)
    state[inside] = TexelState.INVALID
    somewhere = np.zeros(0, bool)  # by the chart's number
    for rows in bands(state.shape):
        charts = texel_map.chart[rows][state[rows] == TexelState.VALID]
        found = np.zeros(max(len(somewhere), int(charts.max(initial=-1)) + 1), bool)
        found[: len(somewhere)] = somewhere
        found[charts] = True
        somewhere = found
    for rows in bands(state.shape):
        row, column = np.nonzero(state[rows] == TexelState.INVALID)
        charts = texel_map.chart[rows][row, column]
        filled = (charts < len(somewhere)) & somewhere[np.minimum(charts, len(somewhere) - 1)] if len(somewhere) else 0
        state[rows][row, column] = np.where(filled, TexelState.INVALID, TexelState.VALID)
    texel_map.release()
    return replace(texel_map, state=state)
