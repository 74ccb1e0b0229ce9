"""The store's layout: Zarr v3 metadata of its arrays and the attributes that make it understandable alone.

One shard is one tile, so a tile is replaced by one atomic object write; one chunk is one texel's image, so a
single texel can be read by a byte range. Radiance is stored uncompressed: path-traced fp16 noise does not compress.
Format: Zarr v3 core, sharding_indexed (ZEP 2), crc32c on the shard's index and on every chunk.
"""

from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from kiln_schemas import conventions
from kiln_schemas.settings import Function

_BYTES: Final[dict[str, Any]] = {"name": "bytes", "configuration": {"endian": "little"}}
_CRC: Final[dict[str, Any]] = {"name": "crc32c"}
_ZSTD: Final[dict[str, Any]] = {"name": "zstd", "configuration": {"level": 3, "checksum": False}}

BETWEEN_STEPS: Final = ((0, 1), (1, 0), (1, 1))
"""From a texel to the between points that are kept with it, in half texels (rows, columns)."""

TEXEL_MAP_ARRAYS: Final[Mapping[str, tuple[str, int]]] = {
    "state": ("uint8", 1),
    "position": ("float32", 3),
    "normal": ("float32", 3),
    "alpha": ("float32", 1),
}
"""Per-texel arrays kept with the light fields: data type and channels."""

TEXEL_MAP_ROWS: Final = 512
"""Rows and columns of a chunk of these."""

CONVENTIONS: Final[Mapping[str, str]] = {
    "units": "Positions in metres; radiance in scene units (linear Rec.709 RGB); irradiance in radiance times sr.",
    "world": "Right-handed, +Y up (glTF 2.0).",
    "texels": (
        "Arrays are indexed [row, column, ...]; texel (row, column) is centred at u = (column + 1/2)/W, "
        "v = (row + 1/2)/H with v downwards, as glTF. Texels without surface are absent chunks."
    ),
    "octahedral_map": (
        "Images are indexed [row j, column i, channel] and cover the full sphere in WORLD space: pixel (i, j) covers "
        "the square [i, i+1] x [j, j+1] / R; with x = 2(i + 1/2)/R - 1, y = 2(j + 1/2)/R - 1 and "
        "p = (x, y, 1 - |x| - |y|), the direction is p/|p|, where for p.z < 0 first p.x -= sign(x) |p.z| and "
        "p.y -= sign(y) |p.z|. Solid angle element: dx dy / |p|^3."
    ),
    "horizon": (
        "Directions v with v . normal <= 0 carry nothing and count in no error; normal is the geometric normal."
    ),
    "light_field": (
        "Mean incident radiance over each pixel. The directly seen environment is left out; emissive surfaces and the "
        "environment's light reflected by the scene are in."
    ),
    "visibility": (
        "Illumination-weighted environment visibility W_E (Currius et al. 2020, eq. 7) of the GGX lobe of `alpha`, "
        "0 to 1 per colour channel."
    ),
    "between": (
        "Sparse light fields half-way between texels of a chart, indexed [row, column, kind, y, x, channel]: kind 0 "
        "half a texel to the right of texel (row, column), 1 half a texel down, 2 both. Pixel (x, y) holds pixel "
        "(2x + a, 2y + b) of a whole image, with 2b + a = (2 row + column + kind) mod 4. Points between texels of "
        "different charts are zero."
    ),
    "irradiance": "Over the hemisphere of the texel's shading normal, direct and indirect, environment included.",
    "fine_irradiance": (
        "The same over the light map with `irradiance_scale` texels along each side of a texel, -1 where the point "
        "lies inside geometry. Only in stores with an `irradiance_scale` over 1."
    ),
    "exposure": (
        "Values here are not exposure-normalised. The fit multiplies radiance by EXPOSURE_KEY / (mean luminance above "
        "the horizons, solid-angle-weighted) and undoes it in the amplitudes; the factor is in the bake's manifest."
    ),
    "alpha": "GGX alpha = (glTF roughness)^2.",
    "state": "0 gutter, 1 valid, 2 covered but inside geometry.",
    "float16": "Values above 65504 were clamped to it.",
}


def sparse_offsets(rows: npt.NDArray[np.int64], columns: npt.NDArray[np.int64], kind: int) -> npt.NDArray[np.int64]:
    """Row and column [B, 2] in each 2 x 2 block of the pixel that `between` holds; it changes from point to point."""
    return np.stack(np.divmod((2 * rows + columns + kind) % 4, 2), axis=1)


def group_document(attributes: Mapping[str, Any]) -> dict[str, Any]:
    """The group's zarr.json."""
    return {"zarr_format": 3, "node_type": "group", "attributes": dict(attributes)}


def group_attributes(
    shape: tuple[int, int],
    image_size: int,
    tile: int,
    functions: Sequence[Function],
    between: bool,
    irradiance_scale: int,
    extra: Mapping[str, Any],
) -> dict[str, Any]:
    """What the group says of itself: layout, conventions and what the caller adds (settings, scene hash, ...)."""
    return {
        **extra,
        "format": "lightkiln.light-field",
        "format_version": conventions.FORMAT_VERSION,
        "resolution": list(shape),
        "image_size": image_size,
        "tile": tile,
        "functions": [function.value for function in functions],
        "between": between,
        "irradiance_scale": irradiance_scale,
        "exposure_key": conventions.EXPOSURE_KEY,
        "conventions": dict(CONVENTIONS),
    }


def image_metadata(function: Function, shape: tuple[int, int], image_size: int, tile: int) -> dict[str, Any]:
    """Array metadata of a light-field or visibility array [H, W, R, R, 3] float16."""
    image = [image_size, image_size, 3]
    inner = [_BYTES, _CRC] if function is Function.LIGHT_FIELD else [_BYTES, _ZSTD, _CRC]
    return _metadata(
        "float16", [*shape, *image], [tile, tile, *image], [_sharded(image, inner)], ["row", "column", "y", "x", "rgb"]
    )


def _sharded(image: list[int], codecs: list[dict[str, Any]]) -> dict[str, Any]:
    """The codec of an array whose shard is a tile and whose chunk is one texel's `image`."""
    return {
        "name": "sharding_indexed",
        "configuration": {
            "chunk_shape": [1, 1, *image],
            "codecs": codecs,
            "index_codecs": [_BYTES, _CRC],
            "index_location": "end",
        },
    }


def between_metadata(shape: tuple[int, int], image_size: int, tile: int) -> dict[str, Any]:
    """Array metadata of the sparse light fields between texels [H, W, 3, R / 2, R / 2, 3] float16."""
    image = [len(BETWEEN_STEPS), image_size // 2, image_size // 2, 3]
    names = ["row", "column", "kind", "y", "x", "rgb"]
    return _metadata("float16", [*shape, *image], [tile, tile, *image], [_sharded(image, [_BYTES, _ZSTD, _CRC])], names)


def irradiance_metadata(shape: tuple[int, int], tile: int) -> dict[str, Any]:
    """Array metadata of the irradiance [H, W, 3] float32: one chunk a tile, which is one object."""
    return _metadata("float32", [*shape, 3], [tile, tile, 3], [_BYTES, _CRC], ["row", "column", "rgb"])


def texel_map_metadata(name: str, shape: tuple[int, int]) -> dict[str, Any]:
    """Array metadata of one of TEXEL_MAP_ARRAYS."""
    data_type, channels = TEXEL_MAP_ARRAYS[name]
    tail, names = ([channels], ["xyz"]) if channels > 1 else ([], [])
    chunk = [min(shape[0], TEXEL_MAP_ROWS), min(shape[1], TEXEL_MAP_ROWS), *tail]
    return _metadata(data_type, [*shape, *tail], chunk, [_BYTES, _ZSTD, _CRC], ["row", "column", *names])


def _metadata(
    data_type: str, shape: list[int], chunk: list[int], codecs: list[dict[str, Any]], names: list[str]
) -> dict[str, Any]:
    if data_type == "uint8":
        codecs = [{"name": "bytes"} if codec is _BYTES else codec for codec in codecs]
    return {
        "shape": shape,
        "data_type": data_type,
        "fill_value": 0,
        "dimension_names": names,
        "chunk_grid": {"name": "regular", "configuration": {"chunk_shape": chunk}},
        "codecs": codecs,
    }
