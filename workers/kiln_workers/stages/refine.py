"""Refine one block of the light field's lobes: from the network's to coherent ones (`fit.solvers.joint`).

A block is solved with `conventions.REFINE_HALO` texels of its neighbours around it, which are then dropped: the lobes
of a texel near the edge are moved by what lies around it, as its neighbours' are in the block next to it. Memory is
that of one block's images; a lost task is simply done again, and gives the same bytes.
"""

import time
from collections.abc import Iterator
from typing import Final

import numpy as np
import numpy.typing as npt
import torch

from kiln_schemas.conventions import ARRAY_BETWEEN, ARRAY_LIGHT_FIELD, FP16_MAX, REFINE_HALO
from kiln_schemas.tasks import Block, RefinePayload, RefineResult, Tile
from kiln_workers.fit.between import read_field
from kiln_workers.fit.field import TexelField
from kiln_workers.fit.lobes import amplitude_scale
from kiln_workers.fit.predict import Weights, predict
from kiln_workers.fit.solvers.joint import CoherentOptions, descend
from kiln_workers.fit.source import valid_texels
from kiln_workers.runner.context import Context
from kiln_workers.scene.container import pack, unpack
from kiln_workers.scene.texel_map import TexelMap, unpack_texel_map
from kiln_workers.stages.tiles import map_coordinates, with_render_verdict
from kiln_workers.store.light_field import LightFieldStore

Float32 = npt.NDArray[np.float32]

_KIND: Final = "lobes"


def run(payload: RefinePayload, context: Context) -> RefineResult:
    """The lobes of a block's valid texels; the same payload always gives the same bytes."""
    began = time.perf_counter()
    block, steps = payload.block, payload.settings.fit.refine_steps
    texel_map = with_render_verdict(unpack_texel_map(context.blob(payload.texel_map)), payload.renders)
    weights = Weights.from_bytes(context.blob(payload.fit.weights))
    store = LightFieldStore.open(payload.store_url)
    tiles = list(_wanted(texel_map, sorted((r.tile for r in payload.renders), key=lambda t: (t.row, t.column)), block))
    arrays = [ARRAY_LIGHT_FIELD, ARRAY_BETWEEN] if store.has_between else [ARRAY_LIGHT_FIELD]
    with store.all_lost(arrays, dict(tiles)):
        field = read_field(store, texel_map, tiles, weights.exposure, lambda: _moved(payload, context))
    start = predict(weights, field.images, field.normals, threads=context.threads)
    found = start
    if weights.signal and len(field):
        found = _descended(field, start, CoherentOptions(steps=steps), payload, context)
    inside = ((field.place >= (block.row, block.column)) & (field.place < _end(block))).all(axis=1)
    return RefineResult(
        block=block,
        lobes=context.put_blob(pack(_KIND, {}, {"lobes": found[inside], "place": field.place[inside]})),
        texels=int(inside.sum()),
        steps=steps,
        seconds=time.perf_counter() - began,
    )


def read_lobes(data: bytes) -> tuple[tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]], Float32]:
    """(rows, columns) in the light map and lobes [T, N, 7] in scene units of a refined block."""
    _, arrays = unpack(_KIND, data)
    place = arrays["place"].astype(np.int64)
    return (place[:, 0], place[:, 1]), np.asarray(arrays["lobes"], np.float32)


def _descended(
    field: TexelField, start: Float32, options: CoherentOptions, payload: RefinePayload, context: Context
) -> Float32:
    scale = amplitude_scale(field.exposure)
    where = f"block {payload.block.row},{payload.block.column}"

    def on_step(step: int, _: torch.Tensor) -> None:
        context.progress(step, options.steps, "steps", where)

    seed = payload.settings.seed
    found = descend(field, torch.from_numpy(start) * scale, options, seed, threads=context.threads, on_step=on_step)
    lobes = (found / scale).numpy()
    lobes[..., 4:] = np.minimum(lobes[..., 4:], FP16_MAX)
    return lobes


def _moved(payload: RefinePayload, context: Context) -> tuple[TexelMap, ...]:
    return tuple(unpack_texel_map(context.blob(digest)) for digest in payload.between)


def _end(block: Block) -> tuple[int, int]:
    return block.row + block.size, block.column + block.size


def _wanted(texel_map: TexelMap, tiles: list[Tile], block: Block) -> Iterator[tuple[Tile, npt.NDArray[np.int64]]]:
    """Each tile with those of its valid texels that lie in the block or its halo, where there are any."""
    low = np.array([block.row, block.column]) - REFINE_HALO
    high = np.array(_end(block)) + REFINE_HALO
    for tile in tiles:
        inside = valid_texels(texel_map.state, tile)
        place = np.stack(map_coordinates(tile, inside), axis=1)
        chosen = inside[((place >= low) & (place < high)).all(axis=1)]
        if len(chosen):
            yield tile, chosen
