"""The light-field store: per-texel images in a sharded Zarr v3 group, shard = tile, chunk = texel.

Written by render workers tile by tile, streamed by the fit, and readable with stock zarr-python. tensorstore does the
work because its writers replace a shard atomically (lock file, fsync, rename; one PUT on S3): a killed writer leaves
the old shard or none, never a torn one. Every chunk and every shard's index has a CRC-32C, so damaged bytes are an
error when they are read. What is absent reads as zeros in silence, so every reader asks of zeros if they are stored.
Which tiles a bake must have is the database's business, not the store's.
"""

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from typing import Any, Final, Self

import numpy as np
import numpy.typing as npt
import tensorstore as ts

from kiln_schemas import conventions
from kiln_schemas.errors import Conflict, InputError, InternalError, NotFound, StoreLost, TilesLost
from kiln_schemas.settings import Function
from kiln_schemas.tasks import Tile
from kiln_workers.scene.bands import release
from kiln_workers.store import layout
from kiln_workers.store.location import (
    first_words,
    is_damage,
    is_difference,
    kvstore_spec,
    translated,
    translated_errors,
    write_patiently,
)

Float16 = npt.NDArray[np.float16]
Float32 = npt.NDArray[np.float32]
Index = npt.NDArray[np.integer[Any]]

_GROUP_KEY: Final = "zarr.json"


class LightFieldStore:
    """An open store; make one with `create` or `open`. Safe to use from several processes at once."""

    def __init__(self, url: str, attributes: Mapping[str, Any]) -> None:
        self.url: Final = url
        self.attributes: Final = dict(attributes)
        self.shape: Final[tuple[int, int]] = (attributes["resolution"][0], attributes["resolution"][1])
        self.image_size: Final = int(attributes["image_size"])
        self.tile_size: Final = int(attributes["tile"])
        self.has_between: Final = bool(attributes.get("between", False))
        self.irradiance_scale: Final = int(attributes.get("irradiance_scale", 1))
        self.functions: Final = tuple(Function(name) for name in attributes["functions"])
        self._context = ts.Context({"data_copy_concurrency": {"limit": 2}, "file_io_concurrency": {"limit": 8}})
        self._arrays: dict[str, Any] = {}

    @classmethod
    def create(
        cls,
        url: str,
        *,
        shape: tuple[int, int],
        image_size: int,
        tile: int,
        functions: Sequence[Function],
        attributes: Mapping[str, Any],
        between: bool = False,
        irradiance_scale: int = 1,
    ) -> Self:
        """Make the store, or open it where an identical one lies there; Conflict where a different one does.

        What is damaged of an identical one is made anew.

        `attributes` (settings, scene hash, ...) must be JSON. The group document is written last, so a
        store that opens is whole.
        """
        described = layout.group_attributes(shape, image_size, tile, functions, between, irradiance_scale, attributes)
        mine = json.loads(json.dumps(described))
        try:
            found = _read_group(url)
        except StoreLost:
            found = None
        if found is not None:
            _refuse_difference(url, found, mine)
        store = cls(url, mine)
        for name in store._metadata():
            try:
                store._arrays[name] = store._open_array(name, create=True)
            except StoreLost:
                store._arrays[name] = store._open_array(name, create=True, delete_existing=True)
        if found is None:
            with translated_errors(url):
                document = json.dumps(layout.group_document(mine), indent=1, sort_keys=True)
                _kvstore(url).write(_GROUP_KEY, document.encode()).result()
        return store

    @classmethod
    def open(cls, url: str) -> Self:
        """Open an existing store; StoreLost where there is none, InputError where a later version wrote it."""
        attributes = _read_group(url)
        if attributes is None:
            raise _store_lost(url, "it is not there")
        if attributes.get("format") != "lightkiln.light-field":
            raise InputError("the Zarr group is not a light-field store", where=url)
        if attributes["format_version"] > conventions.FORMAT_VERSION:
            raise InputError(
                f"the store has format version {attributes['format_version']}, this program reads up to "
                f"{conventions.FORMAT_VERSION}",
                where=url,
                remedy="Update lightkiln.",
            )
        return cls(url, attributes)

    def check(self) -> None:
        """Raise StoreLost where the store is no longer there: what is written now would be found by nobody."""
        if _read_group(self.url) is None:
            raise _store_lost(self.url, "it is not there any more")

    @contextmanager
    def all_lost(self, names: Sequence[str], tiles: Mapping[Tile, Index]) -> Iterator[None]:
        """Where a tile is lost in the block, raise TilesLost of all that are, each with its covered texels [T]."""
        try:
            yield
        except TilesLost as error:
            lost = self.lost_tiles(names, tiles)
            if not lost:
                raise
            raise self._lost(" or ".join(names), lost, f"cannot be read; the first: {error.detail}") from error

    def write_texel_map(self, arrays: Mapping[str, npt.NDArray[Any]]) -> None:
        """Keep `position`, `normal` [H, W, 3], `alpha` and `state` [H, W] with the light fields."""
        if set(arrays) != set(layout.TEXEL_MAP_ARRAYS):
            raise InternalError(f"texel map arrays are {sorted(layout.TEXEL_MAP_ARRAYS)}, not {sorted(arrays)}")
        for name, values in arrays.items():
            array, dtype = self._array(name), layout.TEXEL_MAP_ARRAYS[name][0]
            for first in range(0, len(values), layout.TEXEL_MAP_ROWS):
                rows = slice(first, min(first + layout.TEXEL_MAP_ROWS, len(values)))
                part = values[rows].astype(dtype)
                self._refuse_not_finite(part, name)
                write_patiently(self.url, partial(_write, array[rows], part))
                release(values)

    def read_texel_map(self) -> dict[str, npt.NDArray[Any]]:
        """The arrays of `write_texel_map`; StoreLost where a part of them is not there, or its bytes are damaged."""
        out = {}
        for name in layout.TEXEL_MAP_ARRAYS:
            array = self._array(name)
            try:
                out[name] = np.asarray(array.read().result())
                stored = array.storage_statistics(query_fully_stored=True).result().fully_stored
            except ValueError as error:
                if not is_damage(error):
                    raise translated(self.url, error) from error
                raise _store_lost(self.url, f"its texel map is damaged ({first_words(error)})") from error
            if not stored:
                raise _store_lost(self.url, f"parts of '{name}' of its texel map are gone")
        return out

    def write_tile(
        self, tile: Tile, covered: Index, light_field: Float16, visibility: Float16 | None, irradiance: Float32
    ) -> None:
        """Replace a tile: `covered` [T] row-major indices inside it, images [T, R, R, 3], irradiance [T, 3].

        Each array's part is one transaction, that is one atomic replacement of one object.
        """
        images = {Function.LIGHT_FIELD: light_field}
        if visibility is not None:
            images[Function.VISIBILITY] = visibility
        if set(images) != set(self.functions):
            raise InternalError(f"the store holds {self.functions}, the tile has {tuple(images)}")
        expected = (len(covered), self.image_size, self.image_size, 3)
        for function, values in images.items():
            if values.shape != expected or values.dtype != np.float16:
                raise InternalError(f"{function.value} is {values.dtype}{values.shape}, not float16{expected}")
            self._refuse_not_finite(values, function.value)
        self._refuse_not_finite(irradiance, conventions.ARRAY_IRRADIANCE)
        for function, values in images.items():
            self._write_texels(function.value, tile, covered, values)
        self._write_texels(conventions.ARRAY_IRRADIANCE, tile, covered, irradiance.astype(np.float32, copy=False))

    def write_fine_irradiance(self, tile: Tile, covered: Index, irradiance: Float32) -> None:
        """Replace a tile's finer irradiance [T, 3], -1 inside geometry; `covered` [T] row-major in the finer tile."""
        self._refuse_not_finite(irradiance, conventions.ARRAY_FINE_IRRADIANCE)
        self._write_texels(conventions.ARRAY_FINE_IRRADIANCE, tile, covered, irradiance.astype(np.float32, copy=False))

    def write_between(self, tile: Tile, texels: Index, images: Float16) -> None:
        """Replace a tile's sparse light fields between texels: row-major `texels` [B], images [B, 3, R/2, R/2, 3]."""
        self._refuse_not_finite(images, conventions.ARRAY_BETWEEN)
        self._write_texels(conventions.ARRAY_BETWEEN, tile, texels, images)

    def read_between(self, tile: Tile, texels: Index) -> Float16:
        """Sparse light fields [B, 3, R/2, R/2, 3] of the texels [B] (row-major inside the tile).

        NotFound where the store keeps none; TilesLost where one of them is not there, or its bytes are damaged.
        """
        if not self.has_between:
            raise NotFound("the store holds no light fields between texels", where=self.url)
        return self._read_texels(conventions.ARRAY_BETWEEN, tile, texels)

    def read_tile(self, function: Function, tile: Tile, covered: Index) -> Float16:
        """Images [T, R, R, 3] of the texels `covered` [T] (row-major inside the tile).

        TilesLost where one of them is not there, or its bytes are damaged.
        """
        if function not in self.functions:
            raise NotFound(f"the store has no {function.value}", where=self.url)
        return self._read_texels(function.value, tile, covered)

    def read_irradiance(self, tiles: Iterable[Tile]) -> Float32:
        """Irradiance [H, W, 3] of tiles, zero elsewhere; TilesLost where one of them is not there."""
        return self._read_map(conventions.ARRAY_IRRADIANCE, tiles)

    def read_fine_irradiance(self, tiles: Iterable[Tile]) -> Float32:
        """The same of the finer map [S H, S W, 3], S = `irradiance_scale`; -1 where a point lies inside geometry."""
        return self._read_map(conventions.ARRAY_FINE_IRRADIANCE, tiles)

    def _read_map(self, name: str, tiles: Iterable[Tile]) -> Float32:
        array, scale = self._array(name), self._scale(name)
        height, width = (scale * side for side in self.shape)
        out, lost = np.zeros((height, width, 3), np.float32), []
        for tile in tiles:
            row, column, size = (scale * number for number in (tile.row, tile.column, tile.size))
            rows, columns = slice(row, min(row + size, height)), slice(column, min(column + size, width))
            try:
                out[rows, columns] = self._stored(name, tile, array[rows, columns])
            except TilesLost:
                lost.append(tile)
        if lost:
            raise self._lost(name, lost, "are gone or damaged")
        return out

    def _scale(self, name: str) -> int:
        """Texels of an array along each side of a texel."""
        return self.irradiance_scale if name == conventions.ARRAY_FINE_IRRADIANCE else 1

    def lost_tiles(self, names: Iterable[str], tiles: Mapping[Tile, Index]) -> list[Tile]:
        """Those of the tiles, each with its covered texels [T], that cannot be read from all of these arrays."""
        lost = []
        for tile, covered in tiles.items():
            try:
                for name in names:
                    self._read_texels(name, tile, covered)
            except TilesLost:
                lost.append(tile)
        return lost

    def _read_texels(self, name: str, tile: Tile, covered: Index) -> Float16:
        rows, columns = self._positions(tile, covered, self._scale(name))
        values: Float16 = self._stored(name, tile, self._array(name)[rows, columns])
        # A texel that was never written is zero in all its bits, as is a black one: only of those the store is asked.
        zero = ~values.reshape(len(values), -1).view(np.uint8).any(axis=1)
        if zero.any() and not zero.all():
            self._stored(name, tile, self._array(name)[rows[zero], columns[zero]])
        return values

    def _stored(self, name: str, tile: Tile, part: Any) -> Any:
        """The values of a part of a tile; TilesLost where they are damaged, or zeros that nobody has stored."""
        try:
            values = np.asarray(part.read().result())
            if values.any() or not values.size:
                return values
            stored = part.storage_statistics(query_fully_stored=True).result().fully_stored
        except ValueError as error:
            if not is_damage(error):
                raise translated(self.url, error) from error
            raise self._lost(name, [tile], f"are damaged ({first_words(error)})") from error
        if not stored:
            raise self._lost(name, [tile], "are gone")
        return values

    def _lost(self, name: str, tiles: Sequence[Tile], what: str) -> TilesLost:
        labels = tuple(tile.label for tile in tiles)
        named = ", ".join(labels[:8]) + (f" and {len(labels) - 8} more" if len(labels) > 8 else "")
        return TilesLost(
            f"chunks of {name} of {named} {what}", where=self.url, remedy="Render them again.", labels=labels
        )

    def _write_texels(self, name: str, tile: Tile, covered: Index, values: npt.NDArray[Any]) -> None:
        rows, columns = self._positions(tile, covered, self._scale(name))
        array = self._array(name)

        def write() -> None:
            with ts.Transaction() as transaction:
                array.with_transaction(transaction)[rows, columns].write(values).result()

        def write_anew() -> None:
            try:
                write()
            except ValueError as error:
                if not is_damage(error):
                    raise
                # A shard is read before some of its texels are replaced: a damaged one has to go first.
                tail = "/0" * (array.rank - 2)
                at = f"c/{tile.row // self.tile_size}/{tile.column // self.tile_size}{tail}"
                array.kvstore.write(at, None).result()
                write()

        write_patiently(self.url, write_anew)

    def _positions(self, tile: Tile, covered: Index, scale: int) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
        aligned = tile.row % self.tile_size == 0 and tile.column % self.tile_size == 0 and tile.size == self.tile_size
        if not aligned:
            raise InternalError(f"tile {tile} does not lie on the store's grid of {self.tile_size}")
        rows, columns = np.divmod(np.asarray(covered, dtype=np.int64), scale * tile.size)
        rows, columns = rows + scale * tile.row, columns + scale * tile.column
        if len(rows) and (rows.max() >= scale * self.shape[0] or columns.max() >= scale * self.shape[1]):
            raise InternalError(f"tile {tile} has texels outside of the light map {self.shape}")
        return rows, columns

    def _metadata(self) -> dict[str, dict[str, Any]]:
        out = {f.value: layout.image_metadata(f, self.shape, self.image_size, self.tile_size) for f in self.functions}
        if self.has_between:
            out[conventions.ARRAY_BETWEEN] = layout.between_metadata(self.shape, self.image_size, self.tile_size)
        out[conventions.ARRAY_IRRADIANCE] = layout.irradiance_metadata(self.shape, self.tile_size)
        if (scale := self.irradiance_scale) > 1:
            finer = (scale * self.shape[0], scale * self.shape[1])
            out[conventions.ARRAY_FINE_IRRADIANCE] = layout.irradiance_metadata(finer, scale * self.tile_size)
        return out | {name: layout.texel_map_metadata(name, self.shape) for name in layout.TEXEL_MAP_ARRAYS}

    def _array(self, name: str) -> Any:
        if name not in self._arrays:
            self._arrays[name] = self._open_array(name, create=False)
        return self._arrays[name]

    def _open_array(self, name: str, *, create: bool, delete_existing: bool = False) -> Any:
        base = kvstore_spec(self.url)
        spec = {
            "driver": "zarr3",
            "kvstore": {**base, "path": f"{base['path']}{name}/"},
            "metadata": self._metadata()[name],
            # A covered texel may be black: store its zeros, so that absent means no surface.
            "store_data_equal_to_fill_value": True,
        }
        mode = {"open": not delete_existing, "create": create, "delete_existing": delete_existing}
        try:
            return ts.open(spec | mode, context=self._context).result()
        except ValueError as error:
            if is_damage(error) and not is_difference(error):
                raise _store_lost(self.url, f"its array '{name}' is gone or damaged ({first_words(error)})") from error
            raise translated(self.url, error) from error

    def _refuse_not_finite(self, values: npt.NDArray[Any], name: str) -> None:
        if not np.isfinite(values).all():
            bad = int(np.count_nonzero(~np.isfinite(values)))
            raise InternalError(f"{bad} values of {name} are not finite", where=self.url)


def _write(array: Any, values: npt.NDArray[Any]) -> None:
    array.write(values).result()


def _kvstore(url: str) -> Any:
    return ts.KvStore.open(kvstore_spec(url)).result()


def _read_group(url: str) -> dict[str, Any] | None:
    """The attributes of the group at `url`, None where there is no group."""
    with translated_errors(url):
        found = _kvstore(url).read(_GROUP_KEY).result()
    if found.state != "value":
        return None
    try:
        document = json.loads(found.value)
    except (ValueError, RecursionError) as error:
        raise _store_lost(url, f"its zarr.json is damaged ({type(error).__name__})") from None
    if not isinstance(document, dict) or "node_type" not in document:
        raise _store_lost(url, "its zarr.json is damaged")
    attributes = document.get("attributes")
    if document["node_type"] != "group" or not isinstance(attributes, dict):
        raise InputError("zarr.json there is not a group's", where=url)
    return attributes


def open_named(url: str) -> LightFieldStore:
    """The store that a person has named; NotFound where there is none."""
    try:
        return LightFieldStore.open(url)
    except StoreLost:
        raise NotFound(
            "there is no light-field store", where=url, remedy="Name the folder of a store, JOB.zarr."
        ) from None


def _store_lost(url: str, what: str) -> StoreLost:
    return StoreLost(
        f"the light-field store cannot be used: {what}",
        where=url,
        remedy="Check that this machine has the store's disk mounted; if it has, retry the job to render it again.",
    )


def _refuse_difference(url: str, found: Mapping[str, Any], mine: Mapping[str, Any]) -> None:
    differing = sorted(key for key in {*found, *mine} if found.get(key) != mine.get(key))
    if differing:
        raise Conflict(
            f"another store lies there (it differs in {', '.join(differing)})",
            where=url,
            remedy="Choose an empty folder, or remove that store.",
        )
