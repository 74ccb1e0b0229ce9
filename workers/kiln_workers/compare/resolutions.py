"""How the network converges on light maps of other sizes (figure 6).

Taking every k-th texel of a large light map would not be a smaller one: its texels stand for larger pieces of surface.
So the scene is rendered again with the same light-map UV at each size. All sizes share one image size, by default
smaller than the bake's, because the largest of them costs as much as a bake otherwise; it is stated with the curves.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from kiln_schemas.errors import InputError, TooLarge
from kiln_schemas.settings import Function, RenderSettings
from kiln_workers.compare.cache import Cache, source_digest
from kiln_workers.compare.convergence import Recorder, epochs_to_tolerance
from kiln_workers.compare.result import Convergence
from kiln_workers.compare.subject import Subject
from kiln_workers.fit.field import TexelField
from kiln_workers.fit.metrics import exposure_of
from kiln_workers.fit.solution import Solver
from kiln_workers.fit.solvers.evaluate import errors_at_texels
from kiln_workers.fit.source import ArraySource
from kiln_workers.render.tile import TexelBatch, TileRenderer
from kiln_workers.scene.texel_map import TexelState
from kiln_workers.scene.texels import build_texel_map

LEAST: Final = 8
MOST: Final = 1024


@dataclass(frozen=True)
class Rendered:
    """A light map of some size."""

    resolution: int
    field: TexelField
    samples: int


def render_resolution(
    subject: Subject,
    resolution: int,
    image_size: int,
    memory_bytes: int,
    cache: Cache,
    on_progress: Callable[[float], None],
) -> Rendered:
    """All valid texels of the scene at `resolution` squared; from the cache where possible."""
    tree = subject.settings.render.model_dump(mode="json") | {"image_size": image_size}
    settings = RenderSettings.model_validate(tree)
    key = {"scene": subject.manifest.scene_hash, "resolution": resolution, "settings": tree}
    found = cache.load("light-map", key)
    if found is None:
        arrays = _render(subject, resolution, settings, memory_bytes, on_progress)
        cache.save("light-map", key, {}, arrays)
        found = {}, arrays
    images, normals, place, chart = (np.array(found[1][name]) for name in ("images", "normals", "place", "chart"))
    exposure = exposure_of(ArraySource(images, normals), Function.LIGHT_FIELD)
    return Rendered(resolution, TexelField(images, normals, place, chart, exposure), settings.samples)


def converge(
    label: str, rendered: Rendered, function: Solver, lobes: int, cache: Cache, options: Mapping[str, Any]
) -> Convergence:
    """Run a solver and record its curve over epochs; from the cache where possible."""
    field = rendered.field
    key = {
        "label": label,
        "resolution": rendered.resolution,
        "texels": len(field),
        "signal": float(field.images.astype(np.float64).sum()),
        "lobes": lobes,
        "sources": source_digest(function),
    }
    found = cache.load("convergence", key)
    if found is not None:
        return Convergence.model_validate(found[0])
    recorder = Recorder(field, None)
    solution = function(field, lobes, on_epoch=recorder, **options)
    curve = recorder.finish(solution.epochs, solution.representation)
    errors = errors_at_texels(solution.representation, field)
    made = Convergence(
        label=label,
        resolution=rendered.resolution,
        texels=len(field),
        image_size=field.image_size,
        samples=rendered.samples,
        lobes=lobes,
        epochs=solution.epochs,
        epochs_to_5_percent=epochs_to_tolerance(curve),
        seconds_per_epoch=solution.seconds / max(1, solution.epochs),
        log_mse=errors.log_mse,
        log_mse_rel=errors.log_mse_rel,
        curve=curve,
    )
    cache.save("convergence", key, made.model_dump(mode="json"), {})
    return made


def _render(
    subject: Subject,
    resolution: int,
    settings: RenderSettings,
    memory_bytes: int,
    on_progress: Callable[[float], None],
) -> dict[str, Any]:
    texel_map = build_texel_map(subject.scene, resolution)
    row, column = np.nonzero(texel_map.state == TexelState.VALID)
    needed = len(row) * settings.image_size**2 * 3 * 2
    if not len(row):
        raise InputError(f"no texel is covered at {resolution} x {resolution}", where="--resolutions")
    if needed > memory_bytes:
        raise TooLarge(
            f"{len(row):,} light fields of {settings.image_size} x {settings.image_size} take {needed / 2**30:.1f} GiB",
            where=f"--resolutions {resolution}",
            remedy="Leave it out, lower --resolution-image-size or raise --memory.",
        )
    batch = TexelBatch.of(texel_map, (row, column))
    renderer = TileRenderer(subject.scene, subject.manifest.scene_hash, settings, memory_bytes)
    made = renderer.render_light_fields(batch, on_progress)
    keep = ~made.enclosed
    return {
        "images": made.light_field[keep],
        "normals": batch.normal[keep],
        "place": np.stack([row, column], axis=1).astype(np.int64)[keep],
        "chart": texel_map.chart[row, column].astype(np.int64)[keep],
    }
