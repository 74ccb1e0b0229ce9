"""Where the fit's texels come from: the light-field store tile by tile, or arrays in memory."""

from collections.abc import Sequence
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from kiln_schemas.errors import InputError
from kiln_schemas.settings import Function
from kiln_schemas.tasks import Tile
from kiln_workers.store.light_field import LightFieldStore

Float16 = npt.NDArray[np.float16]
Float32 = npt.NDArray[np.float32]
Index = npt.NDArray[np.int64]

VALID = 1
"""`TexelMap.state` of texels that train and count."""


class TexelSource(Protocol):
    """Valid texels in tiles; the same source gives the same texels in the same order each time."""

    @property
    def image_size(self) -> int: ...

    @property
    def counts(self) -> Sequence[int]:
        """Valid texels of each tile."""

    def normals(self, tile: int) -> Float32:
        """Unit geometric normals [n, 3] of a tile's texels."""

    def images(self, tile: int, texels: Index) -> Float16:
        """Images [T, R, R, 3] of some of a tile's texels, by their place among its valid ones."""


class ArraySource:
    """Images [T, R, R, 3] and normals [T, 3] in memory, cut into tiles of `tile` texels."""

    def __init__(self, images: Float16, normals: Float32, tile: int = 256) -> None:
        self._images, self._normals, self._tile = images, normals, tile
        self.image_size = images.shape[1]
        self.counts = tuple(min(tile, len(images) - start) for start in range(0, len(images), tile))

    def normals(self, tile: int) -> Float32:
        return self._normals[tile * self._tile : (tile + 1) * self._tile]

    def images(self, tile: int, texels: Index) -> Float16:
        return self._images[tile * self._tile + texels]


class StoreSource:
    """The valid texels of a store's tiles.

    `state` [H, W] is the texel map's with the renderer's invalid texels marked (1 is valid), `normals` [H, W, 3] are
    the geometric ones.
    """

    def __init__(
        self,
        store: LightFieldStore,
        function: Function,
        state: npt.NDArray[Any],
        normals: Float32,
        tiles: Sequence[Tile],
    ) -> None:
        self._store, self._function = store, function
        self._map_normals = normals
        inside = [(tile, valid_texels(state, tile)) for tile in tiles]
        self._tiles = [(tile, texels) for tile, texels in inside if len(texels)]
        self.image_size = store.image_size
        self.counts = tuple(len(texels) for _, texels in self._tiles)

    def normals(self, tile: int) -> Float32:
        place, inside = self._tiles[tile]
        rows, columns = np.divmod(inside, place.size)
        return np.asarray(self._map_normals[rows + place.row, columns + place.column], dtype=np.float32)

    def images(self, tile: int, texels: Index) -> Float16:
        place, inside = self._tiles[tile]
        return self._store.read_tile(self._function, place, inside[texels])


def require_texels(source: TexelSource, function: Function) -> None:
    """InputError where a source has no texel at all."""
    if not sum(source.counts):
        raise InputError(
            f"no texel of the light map is valid, so there is nothing to fit the {function.value} to",
            where="texel map",
            remedy="Check the scene: every texel lies inside other geometry.",
        )


def valid_texels(state: npt.NDArray[Any], tile: Tile) -> Index:
    """Row-major indices inside the tile of its valid texels, ascending."""
    rows, columns = np.nonzero(state[tile.row : tile.row + tile.size, tile.column : tile.column + tile.size] == VALID)
    return np.asarray(rows * tile.size + columns, dtype=np.int64)
