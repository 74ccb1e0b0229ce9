"""The texels that solvers are fitted to: a store's light fields, all of them or evenly chosen tiles, as a `TexelField`.

The store keeps no charts; they are those of the scene's rasterised light-map UV, which is checked against the store.
"""

from dataclasses import dataclass, replace
from functools import cached_property
from hashlib import sha256
from typing import Final

import numpy as np

from kiln_schemas.errors import InputError, TooLarge
from kiln_schemas.tasks import Tile
from kiln_workers.compare.subject import Subject
from kiln_workers.fit.between import read_field
from kiln_workers.fit.field import TexelField
from kiln_workers.fit.source import valid_texels
from kiln_workers.render.between import between_maps
from kiln_workers.scene.texel_map import TexelMap, TexelState
from kiln_workers.scene.texels import build_texel_map, rasterise_texels
from kiln_workers.stages.tiles import plan_tiles

DEFAULT_BYTES: Final = 2 << 30
"""Bytes that the light fields may take in memory."""


@dataclass(frozen=True)
class ChosenTexels:
    """Texels of a light map in memory."""

    field: TexelField
    texel_map: TexelMap
    """`state` is the store's: texels that rendering found inside other geometry are invalid."""
    tiles: int
    of_tiles: int

    @property
    def whole(self) -> bool:
        """Whether these are all valid texels of the light map."""
        return self.tiles == self.of_tiles

    @cached_property
    def digest(self) -> str:
        """sha256 over all that a solver sees."""
        out = sha256(repr(self.field.exposure).encode())
        for values in (self.field.images, self.field.normals, self.field.place, self.field.chart):
            out.update(np.ascontiguousarray(values).data)
        if self.field.traced is not None:
            out.update(np.ascontiguousarray(self.field.traced.images).data)
        return out.hexdigest()


def choose_texels(subject: Subject, tiles: int | None, memory_bytes: int = DEFAULT_BYTES) -> ChosenTexels:
    """All texels where they fit into `memory_bytes`, else those of `tiles` evenly chosen tiles."""
    store = subject.store
    texel_map = _texel_map(subject)
    planned = [tile for tile in plan_tiles(texel_map, store.tile_size) if len(valid_texels(texel_map.state, tile))]
    if not planned:
        raise InputError(
            "no texel of the light map is valid: there is nothing to fit", where=store.url, remedy="Bake the scene."
        )
    chosen = planned if tiles is None or tiles >= len(planned) else _evenly(planned, tiles)
    texels = sum(len(valid_texels(texel_map.state, tile)) for tile in chosen)
    needed = texels * store.image_size**2 * 3 * 2
    if needed > memory_bytes:
        fits = max(1, int(len(chosen) * memory_bytes / needed))
        raise TooLarge(
            f"{texels:,} light fields of {store.image_size} x {store.image_size} take {needed / 2**30:.1f} GiB, "
            f"{memory_bytes / 2**30:.1f} GiB are allowed",
            where=store.url,
            remedy=f"Take some of its tiles (--tiles {fits} would fit), or raise --memory.",
        )

    def moved() -> tuple[TexelMap, ...]:
        # The points that counted when the bake was prepared, before rendering found invalid texels.
        return between_maps(subject.scene, build_texel_map(subject.scene, store.shape[0]))

    wanted = [(tile, valid_texels(texel_map.state, tile)) for tile in chosen]
    field = read_field(store, texel_map, wanted, subject.exposure, moved)
    return ChosenTexels(field, texel_map, len(chosen), len(planned))


def _texel_map(subject: Subject) -> TexelMap:
    """The scene's texel map with the store's verdicts; InputError where the two do not cover the same texels."""
    state = subject.store.read_texel_map()["state"]
    made = rasterise_texels(subject.scene, state.shape[0])
    if not np.array_equal(made.state != TexelState.GUTTER, state != TexelState.GUTTER):
        raise InputError(
            "its texel map is not that of the package's scene",
            where=subject.store.url,
            remedy="The bake did not end, or another version of lightkiln made it: bake it again.",
        )
    return replace(made, state=state)


def _evenly(planned: list[Tile], count: int) -> list[Tile]:
    """`count` of the tiles, evenly spread over their list (row by row)."""
    at = np.unique(np.floor((np.arange(count) + 0.5) * len(planned) / count).astype(np.int64))
    return [planned[number] for number in at]
