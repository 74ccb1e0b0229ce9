"""The between points of a comparison, their freshly traced light fields, and how noisy these are.

The targets are the mean of two halves. Their own noise, in the unit of log_mse, is a quarter of the halves' mutual
error: the mean of two independent estimates has half the variance of each, their difference twice.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from kiln_schemas.errors import InputError
from kiln_workers.compare.cache import Cache
from kiln_workers.compare.noise import image_errors
from kiln_workers.compare.subject import Subject
from kiln_workers.compare.texels import ChosenTexels
from kiln_workers.fit.field import BetweenPoints
from kiln_workers.render.between import PlacedPoints, place_between, trace_halves
from kiln_workers.render.tile import TexelBatch, TileRenderer

Float16 = npt.NDArray[np.float16]
Float32 = npt.NDArray[np.float32]
Index = npt.NDArray[np.int64]

KIND: Final = "between"
RETRACED: Final = 8
"""Texels that are traced again to see whether this renderer is the one that baked."""


@dataclass(frozen=True)
class BetweenTargets:
    """B between points with light fields traced there."""

    points: BetweenPoints
    normals: Float32  # [B, 3]
    images: Float16  # [B, R, R, 3] scene units
    samples: int
    """Paths a pixel."""
    noise: float
    """log_mse of the targets against the truth."""

    def __len__(self) -> int:
        return len(self.points)


def trace_targets(
    subject: Subject,
    chosen: ChosenTexels,
    cache: Cache,
    *,
    count: int,
    factor: float,
    memory_bytes: int,
    on_progress: Callable[[float], None],
) -> BetweenTargets:
    """Up to `count` points of each kind, with `factor` times the bake's samples; from the cache where possible."""
    samples = max(2, round(factor * subject.settings.render.samples))
    key = {
        "scene": subject.manifest.scene_hash,
        "texels": chosen.digest,
        "count": count,
        "samples": samples,
        "settings": subject.settings.render.model_dump(mode="json"),
    }
    found = cache.load(KIND, key)
    if found is None:
        body, arrays = _trace(subject, chosen, count, samples, memory_bytes, on_progress)
        cache.save(KIND, key, body, arrays)
        found = body, arrays
    return _targets(found[1], chosen, samples)


def retraced_difference(subject: Subject, chosen: ChosenTexels, memory_bytes: int) -> float:
    """log_mse between a few stored light fields and the same traced again, relative to P = 0.

    Zero or rounding where the same renderer baked them. Between points traced by another one would be compared with
    light that the solvers never saw.
    """
    field = chosen.field
    at = np.unique(np.linspace(0, len(field) - 1, RETRACED).astype(np.int64))
    row, column = field.place[at].T
    stored = subject.store.read_texel_map()
    batch = TexelBatch(
        index=row * chosen.texel_map.state.shape[1] + column,
        position=stored["position"][row, column],
        normal=stored["normal"][row, column],
        shading_normal=chosen.texel_map.shading_normal[row, column],
        alpha=stored["alpha"][row, column],
        texel_size=chosen.texel_map.texel_size[row, column],
    )
    renderer = TileRenderer(subject.scene, subject.manifest.scene_hash, subject.settings.render, memory_bytes)
    again = renderer.render_light_fields(batch).light_field
    return image_errors(again, field.images[at], field.normals[at], field.exposure).log_mse_rel


def _trace(
    subject: Subject,
    chosen: ChosenTexels,
    count: int,
    samples: int,
    memory_bytes: int,
    on_progress: Callable[[float], None],
) -> tuple[dict[str, Any], dict[str, npt.NDArray[Any]]]:
    scene_hash = subject.manifest.scene_hash
    placed = place_between(subject.scene, chosen.texel_map, chosen.field, count, int(scene_hash[:8], 16))
    if not len(placed.points):
        raise InputError(
            "no two texels of one chart are neighbours: there is nothing between texels to measure",
            where=subject.store.url,
            remedy="Bake with a higher lightmap.resolution.",
        )
    settings = subject.settings.render.model_copy(update={"samples": samples})
    texels = chosen.texel_map.state.size
    traced = trace_halves(subject.scene, scene_hash, settings, placed, texels, memory_bytes, on_progress)
    keep = np.flatnonzero(~traced.enclosed)
    arrays = {"first": traced.halves[0][keep], "second": traced.halves[1][keep], **_places(placed, keep)}
    return {}, arrays


def _places(placed: PlacedPoints, keep: Index) -> dict[str, npt.NDArray[Any]]:
    points = placed.points.take(keep)
    return {"corners": points.corners, "step": points.step, "at": points.first, "normals": placed.batch.normal[keep]}


def _targets(arrays: Any, chosen: ChosenTexels, samples: int) -> BetweenTargets:
    first, second = arrays["first"], arrays["second"]
    normals = np.array(arrays["normals"])
    mean = (0.5 * (first.astype(np.float32) + second)).astype(np.float16)
    apart = image_errors(np.array(first), np.array(second), normals, chosen.field.exposure).log_mse
    points = BetweenPoints(*(np.array(arrays[name]) for name in ("corners", "step", "at")))
    return BetweenTargets(points, normals, mean, samples, 0.25 * apart)
