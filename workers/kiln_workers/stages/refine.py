"""Refine one block: the coherent descent of both functions on its texels (`fit.solvers.joint`).

A block is solved with `conventions.REFINE_HALO` texels of its neighbours around it, which are then dropped: the lobes
of a texel near the edge are moved by what lies around it, as its neighbours' are in the block next to it. Memory is
that of one block's images; a lost task is simply done again, and gives the same bytes.
"""

import time
from collections.abc import Iterator, Sequence
from typing import Final

import numpy as np
import numpy.typing as npt
import torch

from kiln_schemas.conventions import ARRAY_BETWEEN, REFINE_HALO
from kiln_schemas.settings import Function
from kiln_schemas.tasks import Block, RefinePayload, RefineResult, Tile
from kiln_workers.fit.between import read_field, read_texels
from kiln_workers.fit.field import TexelField
from kiln_workers.fit.pooling import pooled_size
from kiln_workers.fit.solvers.coherent import Start
from kiln_workers.fit.solvers.joint import CoherentOptions, descend
from kiln_workers.fit.source import Index, valid_texels
from kiln_workers.runner.context import Context
from kiln_workers.scene.container import pack, unpack
from kiln_workers.scene.texel_map import TexelMap, unpack_texel_map
from kiln_workers.stages.tiles import map_coordinates, tiles_of, with_render_verdict
from kiln_workers.store.light_field import LightFieldStore

Float32 = npt.NDArray[np.float32]

_KIND: Final = "lobes"
_PLACE: Final = "place"


def run(payload: RefinePayload, context: Context) -> RefineResult:
    """The lobes of a block's valid texels; the same payload always gives the same bytes."""
    began = time.perf_counter()
    settings = payload.settings.fit
    texel_map = with_render_verdict(unpack_texel_map(context.blob(payload.texel_map)), payload.renders)
    store = LightFieldStore.open(payload.store_url)
    tiles = list(_with_halo(texel_map, tiles_of(payload.renders), payload.block))
    steps = [getattr(settings, settings.refine_steps_key(fit.function)) for fit in payload.fits]
    arrays: dict[str, npt.NDArray[np.generic]] = {}
    for number, fit in enumerate(payload.fits):
        start = Start.from_bytes(context.blob(fit.weights))
        field = _read(fit.function, store, texel_map, tiles, start.exposure, payload, context)
        options = CoherentOptions(steps=steps[number])
        before = sum(steps[:number])

        def on_step(step: int, _: torch.Tensor, loss: float, before: int = before) -> None:
            where = f"block {payload.block.row},{payload.block.column}"
            context.progress(before + step, sum(steps), "steps", where, loss)

        lobes = torch.from_numpy(start.at(field.place, field.chart))
        if start.signal:
            lobes = descend(field, lobes, options, payload.settings.seed, threads=context.threads, on_step=on_step)
        inside = _inside(field.place, payload.block)
        arrays |= {fit.function.value: start.in_scene_units(lobes.numpy())[inside], _PLACE: field.place[inside]}
    return RefineResult(
        block=payload.block,
        lobes=context.put_blob(pack(_KIND, {}, arrays)),
        texels=len(arrays[_PLACE]),
        steps=sum(steps),
        seconds=time.perf_counter() - began,
    )


def read_lobes(data: bytes, function: Function) -> tuple[tuple[Index, Index], Float32]:
    """(rows, columns) in the light map and a function's lobes [T, N, 7] in scene units of a refined block."""
    _, arrays = unpack(_KIND, data)
    place = arrays[_PLACE].astype(np.int64)
    return (place[:, 0], place[:, 1]), np.asarray(arrays[function.value], np.float32)


def _read(
    function: Function,
    store: LightFieldStore,
    texel_map: TexelMap,
    tiles: Sequence[tuple[Tile, Index]],
    exposure: float,
    payload: RefinePayload,
    context: Context,
) -> TexelField:
    """A function's images at the tiles' texels; of the light field also those between, of the visibility small ones."""
    if function is Function.VISIBILITY:
        with store.all_lost([function.value], dict(tiles)):
            return read_texels(store, function, texel_map, tiles, exposure, pooled_size(store.image_size))
    between = [ARRAY_BETWEEN] if store.has_between else []
    with store.all_lost([function.value, *between], dict(tiles)):
        return read_field(store, texel_map, tiles, exposure, lambda: _moved(payload, context))


def _moved(payload: RefinePayload, context: Context) -> tuple[TexelMap, ...]:
    return tuple(unpack_texel_map(context.blob(digest)) for digest in payload.between)


def _end(block: Block) -> tuple[int, int]:
    return block.row + block.size, block.column + block.size


def _inside(place: Index, block: Block) -> npt.NDArray[np.bool_]:
    """Which of the texels at `place` [T, 2] are the block's own."""
    return np.asarray(((place >= (block.row, block.column)) & (place < _end(block))).all(axis=1))


def _with_halo(texel_map: TexelMap, tiles: list[Tile], block: Block) -> Iterator[tuple[Tile, Index]]:
    """Each tile with those of its valid texels that lie in the block or its halo, where there are any."""
    low = np.array([block.row, block.column]) - REFINE_HALO
    high = np.array(_end(block)) + REFINE_HALO
    for tile in tiles:
        inside = valid_texels(texel_map.state, tile)
        place = np.stack(map_coordinates(tile, inside), axis=1)
        chosen = inside[((place >= low) & (place < high)).all(axis=1)]
        if len(chosen):
            yield tile, chosen
