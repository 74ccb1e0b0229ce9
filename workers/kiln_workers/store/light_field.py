"""The light-field store: per-texel images in a sharded Zarr v3 group, shard = tile, chunk = texel.

Written by render workers tile by tile, streamed by the fit, and readable with stock zarr-python. tensorstore does the
work because its writers replace a shard atomically (lock file, fsync, rename; one PUT on S3): a killed writer leaves
the old shard or none, never a torn one. An absent shard reads as zeros in silence, hence `read_tile` first asks
whether the shard's key exists. Completeness of a bake is the database's business, not the store's.
"""

import json
from collections.abc import Mapping, Sequence
from typing import Any, Final, Self

import numpy as np
import numpy.typing as npt
import tensorstore as ts

from kiln_schemas import conventions
from kiln_schemas.errors import Conflict, InputError, InternalError, NotFound
from kiln_schemas.settings import Function
from kiln_schemas.tasks import Tile
from kiln_workers.store import layout
from kiln_workers.store.location import kvstore_spec, translated_errors, write_patiently

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
    ) -> Self:
        """Make the store, or open it where an identical one lies there; Conflict where a different one does.

        `attributes` (settings, scene hash, ...) must be JSON. The group document is written last, so a
        store that opens is whole.
        """
        mine = json.loads(json.dumps(layout.group_attributes(shape, image_size, tile, functions, between, attributes)))
        found = _read_group(url)
        if found is not None:
            _refuse_difference(url, found, mine)
        store = cls(url, mine)
        for name in store._metadata():
            store._arrays[name] = store._open_array(name, create=True)
        if found is None:
            with translated_errors(url):
                document = json.dumps(layout.group_document(mine), indent=1, sort_keys=True)
                _kvstore(url).write(_GROUP_KEY, document.encode()).result()
        return store

    @classmethod
    def open(cls, url: str) -> Self:
        """Open an existing store; NotFound where there is none, InputError where a later version wrote it."""
        attributes = _read_group(url)
        if attributes is None:
            raise NotFound("there is no light-field store", where=url)
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

    def write_texel_map(self, arrays: Mapping[str, npt.NDArray[Any]]) -> None:
        """Keep `position`, `normal` [H, W, 3], `alpha` and `state` [H, W] with the light fields."""
        if set(arrays) != set(layout.TEXEL_MAP_ARRAYS):
            raise InternalError(f"texel map arrays are {sorted(layout.TEXEL_MAP_ARRAYS)}, not {sorted(arrays)}")
        for name, values in arrays.items():
            self._refuse_not_finite(values, name)
            self._write_array(name, values.astype(layout.TEXEL_MAP_ARRAYS[name][0]))

    def read_texel_map(self) -> dict[str, npt.NDArray[Any]]:
        """The arrays of `write_texel_map`."""
        with translated_errors(self.url):
            return {name: np.asarray(self._array(name).read().result()) for name in layout.TEXEL_MAP_ARRAYS}

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

    def write_between(self, tile: Tile, texels: Index, images: Float16) -> None:
        """Replace a tile's sparse light fields between texels: row-major `texels` [B], images [B, 3, R/2, R/2, 3]."""
        self._refuse_not_finite(images, conventions.ARRAY_BETWEEN)
        self._write_texels(conventions.ARRAY_BETWEEN, tile, texels, images)

    def read_between(self, tile: Tile, texels: Index) -> Float16:
        """Sparse light fields [B, 3, R/2, R/2, 3] of the texels [B] (row-major inside the tile); NotFound without."""
        if not self.has_between:
            raise NotFound("the store holds no light fields between texels", where=self.url)
        return self._read_texels(conventions.ARRAY_BETWEEN, tile, texels)

    def read_tile(self, function: Function, tile: Tile, covered: Index) -> Float16:
        """Images [T, R, R, 3] of the texels `covered` [T] (row-major inside the tile); NotFound without a shard."""
        if function not in self.functions:
            raise NotFound(f"the store has no {function.value}", where=self.url)
        return self._read_texels(function.value, tile, covered)

    def read_irradiance(self) -> Float32:
        """Irradiance [H, W, 3]; zero where nothing was written."""
        with translated_errors(self.url):
            return np.asarray(self._array(conventions.ARRAY_IRRADIANCE).read().result())

    def _read_texels(self, name: str, tile: Tile, covered: Index) -> Float16:
        array = self._array(name)
        dimensions = "/0" * (array.rank - 2)
        key = f"c/{tile.row // self.tile_size}/{tile.column // self.tile_size}{dimensions}"
        rows, columns = self._positions(tile, covered)
        with translated_errors(self.url):
            if not array.kvstore.list(ts.KvStore.KeyRange(key, key + "\0")).result():
                raise NotFound(
                    f"{name} has no tile at row {tile.row}, column {tile.column}",
                    where=self.url,
                    remedy="Render the tile again.",
                )
            return np.asarray(array[rows, columns].read().result())

    def _write_array(self, name: str, values: npt.NDArray[Any]) -> None:
        array = self._array(name)
        write_patiently(self.url, lambda: array[...].write(values).result())

    def _write_texels(self, name: str, tile: Tile, covered: Index, values: npt.NDArray[Any]) -> None:
        rows, columns = self._positions(tile, covered)
        array = self._array(name)

        def write() -> None:
            with ts.Transaction() as transaction:
                array.with_transaction(transaction)[rows, columns].write(values).result()

        write_patiently(self.url, write)

    def _positions(self, tile: Tile, covered: Index) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
        aligned = tile.row % self.tile_size == 0 and tile.column % self.tile_size == 0 and tile.size == self.tile_size
        if not aligned:
            raise InternalError(f"tile {tile} does not lie on the store's grid of {self.tile_size}")
        rows, columns = np.divmod(np.asarray(covered, dtype=np.int64), tile.size)
        rows, columns = rows + tile.row, columns + tile.column
        if len(rows) and (rows.max() >= self.shape[0] or columns.max() >= self.shape[1]):
            raise InternalError(f"tile {tile} has texels outside of the light map {self.shape}")
        return rows, columns

    def _metadata(self) -> dict[str, dict[str, Any]]:
        out = {f.value: layout.image_metadata(f, self.shape, self.image_size, self.tile_size) for f in self.functions}
        if self.has_between:
            out[conventions.ARRAY_BETWEEN] = layout.between_metadata(self.shape, self.image_size, self.tile_size)
        out[conventions.ARRAY_IRRADIANCE] = layout.irradiance_metadata(self.shape, self.tile_size)
        return out | {name: layout.texel_map_metadata(name, self.shape) for name in layout.TEXEL_MAP_ARRAYS}

    def _array(self, name: str) -> Any:
        if name not in self._arrays:
            self._arrays[name] = self._open_array(name, create=False)
        return self._arrays[name]

    def _open_array(self, name: str, *, create: bool) -> Any:
        base = kvstore_spec(self.url)
        spec = {
            "driver": "zarr3",
            "kvstore": {**base, "path": f"{base['path']}{name}/"},
            "metadata": self._metadata()[name],
            # A covered texel may be black: store its zeros, so that absent means no surface.
            "store_data_equal_to_fill_value": True,
        }
        with translated_errors(self.url):
            return ts.open(spec, open=True, create=create, context=self._context).result()

    def _refuse_not_finite(self, values: npt.NDArray[Any], name: str) -> None:
        if not np.isfinite(values).all():
            bad = int(np.count_nonzero(~np.isfinite(values)))
            raise InternalError(f"{bad} values of {name} are not finite", where=self.url)


def _kvstore(url: str) -> Any:
    return ts.KvStore.open(kvstore_spec(url)).result()


def _read_group(url: str) -> dict[str, Any] | None:
    """The attributes of the group at `url`, None where there is no group."""
    with translated_errors(url):
        found = _kvstore(url).read(_GROUP_KEY).result()
        if found.state != "value":
            return None
        document = json.loads(found.value)
    attributes = document.get("attributes")
    if document.get("node_type") != "group" or not isinstance(attributes, dict):
        raise InputError("zarr.json there is not a group's", where=url)
    return attributes


def _refuse_difference(url: str, found: Mapping[str, Any], mine: Mapping[str, Any]) -> None:
    differing = sorted(key for key in {*found, *mine} if found.get(key) != mine.get(key))
    if differing:
        raise Conflict(
            f"another store lies there (it differs in {', '.join(differing)})",
            where=url,
            remedy="Choose an empty folder, or remove that store.",
        )
