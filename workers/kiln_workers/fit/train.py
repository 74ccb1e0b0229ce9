"""Train one network on a source of texels: Adam, one cycle, log loss, checkpoints, the error at the end.

A step's batch is cut into MICRO_BATCHES equal parts whatever the number of threads; each part's gradient is
computed by one thread with single-threaded kernels, and the parts are added in order. So weights do not depend on the
number of threads, and a fit resumed from a checkpoint ends in the bytes of an undisturbed one: random numbers
come from (seed, step), the order of texels from `stream`, and a checkpoint holds the whole optimiser's state.
"""

import time
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from itertools import islice
from typing import Any, Final, TypeVar

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from kiln_schemas.errors import InputError
from kiln_schemas.settings import FitSettings, Function
from kiln_schemas.tasks import CurvePoint, FitMetrics, Progress
from kiln_workers.fit.curve import Curve
from kiln_workers.fit.lobes import constrain
from kiln_workers.fit.loss import jittered_directions, log_loss, step_weights
from kiln_workers.fit.metrics import TexelErrors, exposure_of, has_signal, metrics_of, texel_errors
from kiln_workers.fit.network import INPUT_GAIN, Shape, encode, initial_parameters, network_input, split
from kiln_workers.fit.optimizer import Adam, one_cycle
from kiln_workers.fit.predict import Weights, predict
from kiln_workers.fit.source import Float16, Float32, TexelSource, require_texels
from kiln_workers.fit.stream import Batch, TexelStream
from kiln_workers.fit.threads import single_threaded_pool
from kiln_workers.fit.verdict import failure, has_failed
from kiln_workers.scene.container import pack, unpack

MICRO_BATCHES: Final = 4

_CHECKPOINT: Final = "fit-checkpoint"
_PIXEL_STREAM: Final = 0x706978
"""Tells the random numbers of the pixels from the others of the same seed."""

_In = TypeVar("_In")
_Out = TypeVar("_Out")


@dataclass(frozen=True)
class FitOutcome:
    weights: bytes
    """For `predict`."""
    exposure: float
    metrics: FitMetrics
    curve: tuple[CurvePoint, ...]
    steps: int
    seconds: float
    """Of all attempts together, as far as their checkpoints tell."""


@dataclass
class _State:
    """All that changes from step to step."""

    step: int
    adam: Adam
    exposure: float
    seconds: float = 0.0
    curve: Curve = field(default_factory=Curve)


def train(
    source: TexelSource,
    settings: FitSettings,
    function: Function,
    seed: int,
    *,
    threads: int = 1,
    device: str = "cpu",
    checkpoint: bytes | None = None,
    on_checkpoint: Callable[[bytes], None] = lambda _: None,
    on_progress: Callable[[Progress], None] = lambda _: None,
    checkpoint_every_s: float = 60.0,
    exposure: float | None = None,
    on_epoch: Callable[[int, Weights], None] | None = None,
    start: Weights | None = None,
    is_negligible: Callable[[float], bool] = lambda exposure: False,
) -> FitOutcome:
    """Fit one function; FitFailed where it does not clearly beat P = 0, InputError where there are no texels.

    A function that `is_negligible` at its exposure (asked where the fit has failed) is left out instead: it is too weak
    to be seen, and the network finds nothing in it.

    `exposure` is that of the source unless given; `on_epoch` is shown the weights after each pass over the texels;
    `start` is a network of the same shape to go on from, instead of random weights.
    """
    began = time.monotonic()
    require_texels(source, function)
    shape = Shape(source.image_size, settings.lobes)
    identity = {
        "function": function.value,
        "seed": seed,
        "settings": settings.model_dump(mode="json"),
        "image_size": shape.image_size,
        "counts": list(source.counts),
    }
    if checkpoint is not None:
        state = _restore(checkpoint, identity)
    else:
        if exposure is None:
            exposure = exposure_of(source, function)
        state = _State(0, Adam.start(_first(shape, seed, start)), exposure)
    began -= state.seconds
    with single_threaded_pool(threads) as pool:
        if checkpoint is None and not has_signal(source, state.exposure):
            return _without_signal(source, shape, state, time.monotonic() - began)
        trainer = _Trainer(shape, settings, seed, device, pool, state)
        last_saved = time.monotonic()
        stream = TexelStream(source, seed, settings.batch, settings.window)
        for batch in islice(stream.batches(state.step), settings.steps - state.step):
            trainer.step(batch)
            on_progress(_progress(state, settings))
            epoch, inside = divmod(state.step * settings.batch, sum(source.counts))
            if on_epoch is not None and inside < settings.batch:
                on_epoch(epoch, _weights(shape, state))
            if time.monotonic() - last_saved >= checkpoint_every_s and state.step < settings.steps:
                on_checkpoint(_save(state, identity, time.monotonic() - began))
                last_saved = time.monotonic()
        weights = _weights(shape, state)
        errors = _errors(source, weights, state.exposure, pool)
    metrics = metrics_of(errors, signal=True)
    if has_failed(errors):
        if not is_negligible(state.exposure):
            raise failure(errors, function, settings.steps_key(function), settings.steps, settings.lobes)
        weights = replace(weights, signal=False)
        metrics = metrics.model_copy(update={"signal": False, "log_mse": errors.log_mse_zero, "log_mse_rel": 1.0})
    return FitOutcome(
        weights=weights.to_bytes(),
        exposure=state.exposure,
        metrics=metrics,
        curve=tuple(state.curve.points),
        steps=state.step,
        seconds=time.monotonic() - began,
    )


class _Trainer:
    """Takes steps: forward, backward and update of the state."""

    def __init__(
        self, shape: Shape, settings: FitSettings, seed: int, device: str, pool: ThreadPoolExecutor, state: _State
    ) -> None:
        self._shape, self._settings, self._seed, self._state = shape, settings, seed, state
        self._device, self._pool = torch.device(device), pool
        state.adam = state.adam.to(self._device)

    def step(self, batch: Batch) -> None:
        """One optimiser step; the loss joins the curve."""
        state, settings = self._state, self._settings
        rng = np.random.default_rng([self._seed, _PIXEL_STREAM, state.step])
        directions = jittered_directions(self._shape.image_size, rng).to(self._device)
        parts = np.array_split(np.arange(len(batch.images)), MICRO_BATCHES)

        def gradient(part: npt.NDArray[np.int64]) -> tuple[float, Tensor]:
            return self._gradient(batch.images[part], batch.normals[part], directions, len(batch.images))

        results = list(self._run(gradient, [part for part in parts if len(part)]))
        rate = one_cycle(state.step, settings.steps, settings.learning_rate)
        state.step += 1
        state.adam.update([part for _, part in results], rate, state.step, self._run)
        state.curve.add(state.step, sum(loss for loss, _ in results), settings.steps)

    def _run(self, work: Callable[[_In], _Out], parts: Iterable[_In]) -> Iterable[_Out]:
        """Map over the pool; one after the other on a GPU, which one stream of kernels keeps busy."""
        return map(work, parts) if self._device.type == "cuda" else self._pool.map(work, parts)

    def _gradient(self, images: Float16, normals: Float32, directions: Tensor, batch: int) -> tuple[float, Tensor]:
        """Loss and flat gradient [P] of a micro-batch, as its share of a batch of `batch` texels."""
        pixels = torch.from_numpy(images).to(self._device)
        normal = torch.from_numpy(normals).to(self._device)
        layers = [layer.detach().requires_grad_() for layer in split(self._shape, self._state.adam.parameters)]
        inputs = network_input(pixels, normal, self._state.exposure)
        log_targets = inputs[:, :3].permute(0, 2, 3, 1).flatten(1, 2)
        weights = step_weights(directions, normal, self._shape.image_size) / (2.0 * np.pi * 3.0 * batch)
        lobes = constrain(encode(layers, INPUT_GAIN * inputs), normal)
        loss = log_loss(lobes, log_targets, directions, weights)
        gradients = torch.autograd.grad(loss, layers)
        return float(loss.detach()), torch.cat([gradient.reshape(-1) for gradient in gradients])


def _weights(shape: Shape, state: _State) -> Weights:
    return Weights(shape, state.exposure, True, state.adam.parameters.cpu().numpy().copy())


def _first(shape: Shape, seed: int, start: Weights | None) -> Tensor:
    """The parameters [P] before the first step."""
    if start is None:
        return initial_parameters(shape, seed)
    if start.shape != shape:
        raise InputError(f"the start's network is {start.shape}, this one {shape}", where="start")
    return torch.from_numpy(start.parameters.copy())


def _errors(source: TexelSource, weights: Weights, exposure: float, pool: ThreadPoolExecutor) -> TexelErrors:
    """Errors of all texels, tile by tile in order.

    Measured on lobes rounded to fp16, because that is what the textures hold.
    """

    def of_tile(tile: int) -> TexelErrors:
        images = source.images(tile, np.arange(source.counts[tile], dtype=np.int64))
        normals = source.normals(tile)
        lobes = predict(weights, images, normals).astype(np.float16).astype(np.float32)
        return texel_errors(lobes, images, normals, exposure)

    return TexelErrors.join(pool.map(of_tile, range(len(source.counts))))


def _without_signal(source: TexelSource, shape: Shape, state: _State, seconds: float) -> FitOutcome:
    """The outcome where the function is zero everywhere: lobes of zero amplitude, nothing trained."""
    weights = Weights(shape, state.exposure, False, state.adam.parameters.numpy())
    metrics = FitMetrics(log_mse=0.0, log_mse_zero=0.0, log_mse_rel=0.0, texels=sum(source.counts), signal=False)
    return FitOutcome(weights.to_bytes(), state.exposure, metrics, (), 0, seconds)


def _progress(state: _State, settings: FitSettings) -> Progress:
    return Progress(done=state.step, total=settings.steps, unit="steps", loss=state.curve.last)


def _save(state: _State, identity: Mapping[str, Any], seconds: float) -> bytes:
    adam = state.adam
    body = {
        "identity": identity,
        "step": state.step,
        "exposure": state.exposure,
        "seconds": seconds,
        "curve": [[point.step, point.loss] for point in state.curve.points],
        "pending": state.curve.pending,
    }
    arrays = {"parameters": adam.parameters, "mean": adam.mean, "square": adam.square}
    return pack(_CHECKPOINT, body, {name: value.cpu().numpy() for name, value in arrays.items()})


def _restore(checkpoint: bytes, identity: Mapping[str, Any]) -> _State:
    body, arrays = unpack(_CHECKPOINT, checkpoint)
    if body["identity"] != identity:
        raise InputError("the checkpoint belongs to another fit", where="checkpoint", remedy="Start without it.")
    adam = Adam(*(torch.from_numpy(arrays[name].copy()) for name in ("parameters", "mean", "square")))
    curve = Curve([CurvePoint(step=step, loss=loss) for step, loss in body["curve"]], body["pending"])
    return _State(body["step"], adam, body["exposure"], body["seconds"], curve)
