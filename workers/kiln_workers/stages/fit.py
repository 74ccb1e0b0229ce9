"""Fit one function: the network, trained on the rendered tiles, or what the coherent descent starts from."""

import time
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch

from kiln_schemas.conventions import ARRAY_IRRADIANCE
from kiln_schemas.settings import Function, Solver
from kiln_schemas.tasks import FitPayload, FitResult, Progress, Tile
from kiln_workers.fit.between import read_texels
from kiln_workers.fit.curve import Curve
from kiln_workers.fit.metrics import TexelErrors, exposure_of, has_signal, metrics_of, texel_errors
from kiln_workers.fit.pooling import PooledSource, pooled_size
from kiln_workers.fit.solvers.coherent import chosen_texels, find_start, stride
from kiln_workers.fit.solvers.joint import CoherentOptions
from kiln_workers.fit.source import Index, StoreSource, TexelSource, require_texels, valid_texels
from kiln_workers.fit.train import train
from kiln_workers.fit.verdict import is_negligible
from kiln_workers.runner.context import Context
from kiln_workers.scene.texel_map import TexelMap, TexelState, unpack_texel_map
from kiln_workers.stages.tiles import map_coordinates, tiles_of, with_render_verdict
from kiln_workers.store.light_field import LightFieldStore


@dataclass(frozen=True)
class _LightMap:
    """What was rendered: where it is stored, the texels, and by tile those that count."""

    store: LightFieldStore
    texels: TexelMap
    covered: Mapping[Tile, Index]

    def source(self, function: Function) -> StoreSource:
        """The images of a function, tile by tile."""
        return StoreSource(self.store, function, self.texels.state, self.texels.normal, list(self.covered))


def run(payload: FitPayload, context: Context) -> FitResult:
    """The function's lobes as far as a fit of the whole light map at once makes them."""
    texel_map = with_render_verdict(unpack_texel_map(context.blob(payload.texel_map)), payload.renders)
    store = LightFieldStore.open(payload.store_url)
    covered = {tile: valid_texels(texel_map.state, tile) for tile in tiles_of(payload.renders)}
    light_map = _LightMap(store, texel_map, covered)
    with store.all_lost([payload.function.value, ARRAY_IRRADIANCE], covered):
        if payload.settings.fit.solver is Solver.COHERENT:
            result = _start(payload, context, light_map)
        else:
            result = _train(payload, context, light_map)
    context.log(f"{payload.function.value}: log_mse_rel {result.metrics.log_mse_rel:.4f}")
    return result


def _train(payload: FitPayload, context: Context, light_map: "_LightMap") -> FitResult:
    """Train the network from the store, going on from the last published checkpoint where there is one."""
    function, asked = payload.function, payload.settings.fit
    source: TexelSource = light_map.source(function)
    if function is Function.VISIBILITY:
        source = PooledSource(source)
    checkpoint = context.last_checkpoint()
    context.log(f"{function.value}: {'going on from a checkpoint' if checkpoint else 'starting'}")

    def on_progress(at: Progress) -> None:
        context.progress(at.done, at.total, at.unit, at.message, at.loss)

    def negligible(exposure: float) -> bool:
        valid = light_map.texels.state == TexelState.VALID
        light = function is Function.LIGHT_FIELD
        return light and is_negligible(exposure, light_map.store.read_irradiance(list(light_map.covered))[valid])

    outcome = train(
        source,
        asked.model_copy(update={"steps": getattr(asked, asked.steps_key(function))}),
        function,
        payload.settings.seed,
        threads=context.threads,
        checkpoint=checkpoint,
        on_checkpoint=context.checkpoint,
        on_progress=on_progress,
        checkpoint_every_s=asked.checkpoint_s,
        is_negligible=negligible,
    )
    return FitResult(
        function=function,
        weights=context.put_blob(outcome.weights),
        exposure=outcome.exposure,
        metrics=outcome.metrics,
        curve=outcome.curve,
        steps=outcome.steps,
        seconds=outcome.seconds,
    )


def _start(payload: FitPayload, context: Context, light_map: "_LightMap") -> FitResult:
    """Find what the coherent descent of all blocks starts from; its metrics are of the texels chosen for that."""
    began = time.perf_counter()
    settings = payload.settings.fit
    store, texel_map = light_map.store, light_map.texels
    source = light_map.source(payload.function)
    require_texels(source, payload.function)
    exposure = exposure_of(source, payload.function)
    chosen, step = _chosen(texel_map, light_map.covered)
    field = read_texels(store, payload.function, texel_map, chosen, exposure, pooled_size(store.image_size))
    options, curve = CoherentOptions(steps=settings.start_steps), Curve()

    def on_step(done: int, _: torch.Tensor, loss: float) -> None:
        curve.add(done, loss, options.steps)
        context.progress(done, options.steps, "steps", loss=curve.last)

    start = find_start(
        field,
        step,
        settings.lobes,
        options,
        payload.settings.seed,
        signal=has_signal(source, exposure),
        threads=context.threads,
        on_step=on_step,
    )
    lobes, parts, done = start.in_scene_units(start.lobes), [], 0
    for tile, inside in chosen:  # against whole images, which are not held
        part = slice(done, done + len(inside))
        images = store.read_tile(payload.function, tile, inside)
        parts.append(texel_errors(lobes[part], images, field.normals[part], exposure))
        done = part.stop
    return FitResult(
        function=payload.function,
        weights=context.put_blob(start.to_bytes()),
        exposure=exposure,
        metrics=metrics_of(TexelErrors.join(parts), signal=start.signal),
        curve=tuple(curve.points),
        steps=options.steps,
        seconds=time.perf_counter() - began,
    )


def _chosen(texel_map: TexelMap, covered: Mapping[Tile, Index]) -> tuple[list[tuple[Tile, Index]], int]:
    """The texels that the start is sought for, tile by tile as `covered`, and how far they lie apart."""
    place = np.concatenate([np.stack(map_coordinates(tile, inside), axis=1) for tile, inside in covered.items()])
    chart = texel_map.chart[place[:, 0], place[:, 1]].astype(np.int64)
    keep = np.zeros(len(place), bool)
    keep[chosen_texels(place, chart)] = True
    ends = np.cumsum([len(inside) for inside in covered.values()])
    parts = np.split(keep, ends[:-1])
    tiles = [(tile, inside[part]) for (tile, inside), part in zip(covered.items(), parts, strict=True)]
    return [(tile, inside) for tile, inside in tiles if len(inside)], stride(len(place))
