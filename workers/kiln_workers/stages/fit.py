"""Fit one function: stream the rendered tiles through the network until it is trained."""

from kiln_schemas.conventions import ARRAY_IRRADIANCE
from kiln_schemas.settings import Function, Solver
from kiln_schemas.tasks import FitPayload, FitResult, Progress
from kiln_workers.fit.source import StoreSource, valid_texels
from kiln_workers.fit.train import train
from kiln_workers.fit.verdict import is_negligible
from kiln_workers.runner.context import Context
from kiln_workers.scene.texel_map import TexelState, unpack_texel_map
from kiln_workers.stages.tiles import with_render_verdict
from kiln_workers.store.light_field import LightFieldStore


def run(payload: FitPayload, context: Context) -> FitResult:
    """Train from the store, going on from the last published checkpoint where there is one."""
    texel_map = with_render_verdict(unpack_texel_map(context.blob(payload.texel_map)), payload.renders)
    tiles = sorted((render.tile for render in payload.renders), key=lambda tile: (tile.row, tile.column))
    store = LightFieldStore.open(payload.store_url)
    source = StoreSource(store, payload.function, texel_map.state, texel_map.normal, tiles)

    checkpoint = context.last_checkpoint()
    context.log(f"{payload.function.value}: {'going on from a checkpoint' if checkpoint else 'starting'}")

    def on_progress(at: Progress) -> None:
        context.progress(at.done, at.total, at.unit, at.message, at.loss)

    asked = payload.settings.fit
    settings = asked.model_copy(update={"steps": getattr(asked, asked.steps_key(payload.function))})
    covered = {tile: valid_texels(texel_map.state, tile) for tile in tiles}

    is_light_field = payload.function is Function.LIGHT_FIELD

    def negligible(exposure: float) -> bool:
        valid = texel_map.state == TexelState.VALID
        return is_light_field and is_negligible(exposure, store.read_irradiance(tiles)[valid])

    with store.all_lost([payload.function.value, ARRAY_IRRADIANCE], covered):
        outcome = train(
            source,
            settings,
            payload.function,
            payload.settings.seed,
            threads=context.threads,
            checkpoint=checkpoint,
            on_checkpoint=context.checkpoint,
            on_progress=on_progress,
            checkpoint_every_s=settings.checkpoint_s,
            is_negligible=negligible,
            is_start=is_light_field and settings.solver is Solver.COHERENT,
        )
    context.log(f"{payload.function.value}: log_mse_rel {outcome.metrics.log_mse_rel:.4f}")
    return FitResult(
        function=payload.function,
        weights=context.put_blob(outcome.weights),
        exposure=outcome.exposure,
        metrics=outcome.metrics,
        curve=outcome.curve,
        steps=outcome.steps,
        seconds=outcome.seconds,
    )
