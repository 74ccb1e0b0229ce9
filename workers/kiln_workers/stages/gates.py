"""Measure the quality gates that a job states, and how the package looks, on its files as they will be downloaded.

The errors of the lobes are known when the files are written. For a picture the package is shaded (`shade.picture`) and
held against a path-traced reference of the scene. The reference has noise, and noise looks like an error. For a FLIP
gate, rounds of paths are added until the reference's two halves differ, in FLIP, by no more than a part of the
threshold, or a bound is reached; what they still differ by is stated with the result. The package has no part in that
choice, so the same scene, camera and threshold have the same reference, whatever was baked.

Where no gate compares pictures, one small picture is compared all the same (`package.pictures`), so that the report
can say how the bake looks: from the first camera that the job names, else the scene file's, else from where the viewer
looks first. Its number of paths is four times that of a light-field pixel, since who bakes better looks closer.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Final

import numpy as np
import torch

from kiln_schemas.camera import Camera
from kiln_schemas.errors import InputError, KilnError
from kiln_schemas.gates import FLIP, LOG_MSE_REL, VISIBILITY_LOG_MSE_REL, GateResult
from kiln_schemas.manifest import Manifest, ReferenceView
from kiln_schemas.settings import Function
from kiln_schemas.tasks import FitMetrics, PackagePayload
from kiln_workers.package import colour
from kiln_workers.package.gates import Judgement, View
from kiln_workers.render.backend import select_variant
from kiln_workers.scene.file_camera import file_camera
from kiln_workers.scene.model import Float32, Scene
from kiln_workers.shade.first_camera import first_camera
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

PICTURE: Final = (192, 108)
"""Width and height of the picture that is compared without a gate."""

PATHS_A_SAMPLE: Final = 4
LEAST_PATHS: Final = 64
MOST_PATHS: Final = 1024
"""Paths a pixel of that picture's reference: so many times `render.samples`, within these bounds."""

FIRST_CAMERA: Final = "first"
"""The name of the camera that nobody named."""

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
    read_blob: Callable[[str], bytes]
    results: tuple[GateResult, ...] = ()

    def __call__(self, folder: Path, manifest: Manifest) -> Judgement:
        """The gates, and the pictures that were compared."""
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
        if views:
            return Judgement(self.results, tuple(views))
        if not self.payload.settings.package.pictures:
            return Judgement(self.results, not_compared="package.pictures is off")
        try:
            return Judgement(self.results, (self._first_look(folder, manifest),))
        except KilnError as error:
            # The package is whole without: no bake fails for a picture that nobody asked for.
            return Judgement(
                self.results, not_compared=f"{error.where}: {error.detail}" if error.where else error.detail
            )

    def _first_look(self, folder: Path, manifest: Manifest) -> View:
        """The picture that is compared without a gate."""
        name, camera = self._first_camera()
        paths = min(max(PATHS_A_SAMPLE * self.payload.settings.render.samples, LEAST_PATHS), MOST_PATHS)
        self.on_progress(f"shading from camera {name}")
        picture = shaded(folder, manifest, camera, PICTURE)
        self.on_progress(f"path-tracing from camera {name}")
        reference = path_trace(self.scene, camera, *PICTURE, paths, self._depth())
        value, noise = flip(reference.picture, picture), float(flip_noise_floor(reference.halves).mean())
        return _view(name, camera, picture, reference, value, noise)

    def _first_camera(self) -> tuple[str, Camera]:
        """The first camera that the job names, else the scene file's own, else the viewer's first look."""
        if self.payload.cameras:
            return next(iter(self.payload.cameras.items()))
        bundle = self.payload.bundle
        stated = file_camera(self.read_blob(bundle.files[bundle.entry]), bundle.entry)
        return FIRST_CAMERA, first_camera(self.scene, PICTURE[0] / PICTURE[1], stated)

    def _depth(self) -> int:
        return max(LEAST_DEPTH, self.payload.settings.render.max_depth + 1)

    def _log_mse_rel(self, name: str) -> float:
        function = _FUNCTIONS[name]
        if function not in self.metrics:
            raise InputError(f"no {function.value} was baked", where=f"gates.{name}", remedy="Leave the gate out.")
        return self.metrics[function].log_mse_rel

    def _flip(self, name: str, threshold: float, folder: Path, manifest: Manifest) -> tuple[GateResult, View]:
        """The FLIP gate of a camera."""
        camera = self.payload.cameras[name]
        self.on_progress(f"shading from camera {name}")
        picture = shaded(folder, manifest, camera, (WIDTH, HEIGHT))
        tell = partial(self.on_progress, f"path-tracing from camera {name}")
        reference, flip_of_halves = traced(self.scene, camera, self._depth(), NOISE_SHARE * threshold, tell)
        value, noise = flip(reference.picture, picture), float(flip_noise_floor(reference.halves).mean())
        result = GateResult.of(FLIP + name, value, threshold, flip_of_halves=flip_of_halves, noise_floor=noise)
        view = _view(name, camera, picture, reference, value, noise)
        return result, view


def _view(name: str, camera: Camera, picture: Float32, reference: Reference, value: float, noise: float) -> View:
    """The package's picture beside the reference, its FLIP and the reference's noise floor."""
    white = colour.white_point(reference.picture)
    height, width, _ = picture.shape
    seen = ReferenceView(
        camera=camera,
        white=white,
        flip=value,
        noise_floor=noise,
        samples=reference.samples,
        width=width,
        height=height,
    )
    return View(name, seen, colour.tone_map(picture, white), colour.tone_map(reference.picture, white))


def shaded(folder: Path, manifest: Manifest, camera: Camera, size: tuple[int, int]) -> Float32:
    """What the package in `folder` looks like, [H, W, 3]; `size` is width and height."""
    cuda = select_variant().startswith("cuda")
    device = torch.device("cuda" if cuda else "cpu")
    package = ShadePackage.of(folder, manifest, device, lobes_in_files=True)
    return shade(package, render_gbuffer(package.scene, camera, *size))


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
