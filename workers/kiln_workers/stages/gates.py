"""Measure the quality gates that a job states (`kiln_schemas.gates`), on a package's files as they will be downloaded.

The errors of the lobes are known when the files are written. For a FLIP gate the package is shaded from the gate's
camera (`shade.picture`) and held against a path-traced reference of the scene. The reference has noise, and noise looks
like an error: rounds of paths are added until its two halves differ, in FLIP, by no more than a part of the threshold,
or a bound is reached; what they still differ by is stated with the result. The package has no part in that choice, so
the same scene, camera and threshold have the same reference, whatever was baked.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Final

import numpy as np
import torch

from kiln_schemas.camera import Camera
from kiln_schemas.errors import InputError
from kiln_schemas.gates import FLIP, LOG_MSE_REL, VISIBILITY_LOG_MSE_REL, GateResult
from kiln_schemas.manifest import Manifest, ReferenceView
from kiln_schemas.settings import Function
from kiln_schemas.tasks import FitMetrics, PackagePayload
from kiln_workers.package import colour
from kiln_workers.package.gates import Judgement, View
from kiln_workers.render.backend import select_variant
from kiln_workers.scene.model import Float32, Scene
from kiln_workers.shade.gbuffer import render_gbuffer
from kiln_workers.shade.image_metrics import flip, flip_noise_floor
from kiln_workers.shade.package import ShadePackage
from kiln_workers.shade.picture import shade
from kiln_workers.shade.reference import Reference, path_trace

WIDTH: Final = 480
HEIGHT: Final = 270
"""Pixels of the pictures that are compared."""

SAMPLES_A_ROUND: Final = 64
MOST_ROUNDS: Final = 16
"""Paths a pixel: 64 at least, 1024 at most."""

NOISE_SHARE: Final = 0.5
"""How much of the threshold the FLIP of the reference's halves may be."""

LEAST_DEPTH: Final = 12
"""Scattering events of a reference's paths, at least: a bake whose own paths are too short is to be noticed."""

_FUNCTIONS: Final = {LOG_MSE_REL: Function.LIGHT_FIELD, VISIBILITY_LOG_MSE_REL: Function.VISIBILITY}


@dataclass
class GateJudge:
    """Measures every gate of the payload on the package in a folder; `results` holds them afterwards."""

    payload: PackagePayload
    scene: Scene
    metrics: Mapping[Function, FitMetrics]
    on_progress: Callable[[str], None]
    results: tuple[GateResult, ...] = ()

    def __call__(self, folder: Path, manifest: Manifest) -> Judgement:
        """The gates, and the pictures that FLIP compared."""
        results: list[GateResult] = []
        views: list[View] = []
        for name, threshold in self.payload.gates.thresholds().items():
            if name in _FUNCTIONS:
                results.append(GateResult.of(name, self._log_mse_rel(name), threshold))
            else:
                result, view = self._flip(name.removeprefix(FLIP), threshold, folder, manifest)
                results.append(result)
                views.append(view)
        self.results = tuple(results)
        return Judgement(self.results, tuple(views))

    def _log_mse_rel(self, name: str) -> float:
        function = _FUNCTIONS[name]
        if function not in self.metrics:
            raise InputError(f"no {function.value} was baked", where=f"gates.{name}", remedy="Leave the gate out.")
        return self.metrics[function].log_mse_rel

    def _flip(self, name: str, threshold: float, folder: Path, manifest: Manifest) -> tuple[GateResult, View]:
        """The FLIP gate of a camera."""
        camera = self.payload.cameras[name]
        self.on_progress(f"shading from camera {name}")
        picture = shaded(folder, manifest, camera)
        depth = max(LEAST_DEPTH, self.payload.settings.render.max_depth + 1)
        tell = partial(self.on_progress, f"path-tracing from camera {name}")
        made, flip_of_halves = traced(self.scene, camera, depth, NOISE_SHARE * threshold, tell)
        reference, noise = made.picture, float(flip_noise_floor(made.halves).mean())
        value = flip(reference, picture)
        result = GateResult.of(FLIP + name, value, threshold, flip_of_halves=flip_of_halves, noise_floor=noise)
        white = colour.white_point(reference)
        seen = ReferenceView(camera=camera, white=white)
        view = View(name, seen, colour.tone_map(picture, white), colour.tone_map(reference, white))
        return result, view


def shaded(folder: Path, manifest: Manifest, camera: Camera) -> Float32:
    """What the package in `folder` looks like, [HEIGHT, WIDTH, 3]."""
    cuda = select_variant().startswith("cuda")
    package = ShadePackage.of(folder, manifest, torch.device("cuda" if cuda else "cpu"))
    return shade(package, render_gbuffer(package.scene, camera, WIDTH, HEIGHT))


def traced(
    scene: Scene, camera: Camera, max_depth: int, most_noise: float, on_round: Callable[[], None]
) -> tuple[Reference, float]:
    """The reference [HEIGHT, WIDTH, 3], and the FLIP of its halves, which is at most `most_noise` within the bound."""
    totals = np.zeros((2, HEIGHT, WIDTH, 3))
    for done in range(1, MOST_ROUNDS + 1):
        on_round()
        made = path_trace(scene, camera, WIDTH, HEIGHT, SAMPLES_A_ROUND, max_depth, seed=done)
        totals += np.stack(made.halves)
        # The noise falls slowly with the rounds: looking after each power of two is often enough.
        if done & (done - 1) == 0 or done == MOST_ROUNDS:
            one, other = (totals / done).astype(np.float32)
            noise = flip(one, other)
            if noise <= most_noise:
                break
    return Reference((one, other), done * SAMPLES_A_ROUND), noise
