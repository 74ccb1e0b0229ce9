"""Points half-way between texels: where the coherent fit learns, and the targets of `log_mse_between`.

The light-map UV of every mesh is moved by half a texel and rasterised again: the texel centres of the moved map are the
between points of the first one, so their places on the surface are exact and need no interpolation of positions. A
point counts only where the moved chart contains that centre, belongs to the mesh and chart of all its corners and was
not pushed out of other geometry.

What a bake traces for the fit is sparse, one pixel of each 2 x 2 block (`sparse_offsets`). The targets that measure
the error are traced afresh and whole, in two halves. All of these, and the texels' own images, have different random
numbers.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
import numpy.typing as npt

from kiln_schemas.settings import RenderSettings
from kiln_workers.fit.field import BetweenPoints, TexelField
from kiln_workers.render.backend import Device
from kiln_workers.render.tile import Progress, TexelBatch, TileRenderer, silent
from kiln_workers.scene.bands import bands
from kiln_workers.scene.geometry import Floats
from kiln_workers.scene.model import Float32, Scene
from kiln_workers.scene.raster import touched_squares
from kiln_workers.scene.texel_map import TexelMap, TexelState, joined
from kiln_workers.scene.texels import TexelMaker
from kiln_workers.store.layout import BETWEEN_STEPS, sparse_offsets

Float16 = npt.NDArray[np.float16]
Bools = npt.NDArray[np.bool_]
Index = npt.NDArray[np.int64]

SPARSE_SEQUENCE: Final = 7
"""The sparse images' random numbers begin after those of the texels and of both halves of three kinds of targets."""


def between_maps(scene: Scene, texel_map: TexelMap, device: Device = "auto") -> tuple[TexelMap, ...]:
    """One texel map for each of BETWEEN_STEPS: a texel that is VALID there stands for the point a step from its own."""
    return tuple(joined(between_bands(scene, texel_map, step, device)) for step in BETWEEN_STEPS)


def between_bands(
    scene: Scene, texel_map: TexelMap, step: tuple[int, int], device: Device = "auto"
) -> Iterator[TexelMap]:
    """The map of one of BETWEEN_STEPS in bands of rows, top to bottom; `texel_map` may lie in a file."""
    shape = (texel_map.state.shape[0], texel_map.state.shape[1])
    moved_to = moved_scene(scene, step, shape)
    maker = TexelMaker(moved_to, shape[0], device)
    corners = np.concatenate([_uv(mesh.lightmap_uv)[mesh.faces] for mesh in moved_to.meshes])
    corners = corners * [shape[1], shape[0]]
    for rows in bands(shape):
        moved, usable = _moved_rows(maker, corners, texel_map, rows)
        usable &= _between_one_chart(texel_map.rows(slice(rows.start, rows.stop + 1)), step, len(usable))
        yield replace(moved, state=np.where(usable, TexelState.VALID, TexelState.GUTTER).astype(np.uint8))
        texel_map.release()


def _between_one_chart(texel_map: TexelMap, step: tuple[int, int], rows: int) -> Bools:
    """Texels [rows, W] from which a step leads to a point whose corners are all valid and of one chart.

    The map has these rows and the next one, if there is one.
    """
    chart = np.where(texel_map.state == TexelState.VALID, texel_map.chart, -1)
    height, width = chart.shape
    padded = np.full((rows + 1, width + 1), -1, chart.dtype)
    padded[:height, :width] = chart
    out = chart[:rows] >= 0
    for down, right in ((step[0], 0), (0, step[1]), step):
        out &= padded[down : down + rows, right : right + width] == chart[:rows]
    return out


def trace_sparse(
    renderer: TileRenderer,
    moved: TexelMap,
    place: tuple[Index, Index],
    kind: int,
    samples: int,
    on_progress: Progress = silent,
) -> tuple[Float16, int]:
    """Sparse light fields [B, R / 2, R / 2, 3] of the points `place` of one of `between_maps`, and the paths traced."""
    offsets = sparse_offsets(*place, kind)
    batch = TexelBatch.of(moved, place, (SPARSE_SEQUENCE + kind) * moved.state.size)
    traced = renderer.render_light_fields(batch, on_progress, samples=samples, offsets=offsets)
    images = traced.light_field
    half = images.shape[1] // 2
    out = np.empty((len(images), half, half, 3), np.float16)
    for offset in np.unique(offsets, axis=0):
        at = (offsets == offset).all(axis=1)
        out[at] = images[at, offset[0] :: 2, offset[1] :: 2]
    return out, traced.paths


@dataclass(frozen=True)
class PlacedPoints:
    """B between points and where they lie on the surface."""

    points: BetweenPoints
    batch: TexelBatch
    """Its `index` lies beyond that of every texel."""


@dataclass(frozen=True)
class TracedHalves:
    """Two independent light fields of each of B points."""

    halves: tuple[Float16, Float16]  # each [B, R, R, 3]
    enclosed: Bools  # [B] whether the point is dark and lies inside something
    samples: int  # paths a pixel, both halves together


def place_between(
    scene: Scene, texel_map: TexelMap, field: TexelField, count: int, seed: int, device: Device = "auto"
) -> PlacedPoints:
    """Up to `count` points of each kind between the field's texels, drawn evenly at random from `seed`.

    `texel_map` is the scene's at the field's resolution.
    """
    chosen, batches = [], []
    for kind, (step, moved) in enumerate(zip(BETWEEN_STEPS, between_maps(scene, texel_map, device), strict=True)):
        mine = np.flatnonzero((field.between.step == step).all(axis=1))
        row, column = field.place[field.between.first[mine]].T
        counts = moved.state[row, column] == TexelState.VALID
        mine, row, column = (values[counts] for values in (mine, row, column))
        drawn = np.random.default_rng([seed, kind]).permutation(len(mine))[:count]
        drawn.sort()
        place = row[drawn], column[drawn]
        chosen.append(mine[drawn])
        texels = texel_map.state.size
        batches.append(TexelBatch.of(moved, place, (1 + kind) * texels))
    joined = {name: np.concatenate([getattr(b, name) for b in batches]) for name in TexelBatch.__dataclass_fields__}
    return PlacedPoints(field.between.take(np.concatenate(chosen)), TexelBatch(**joined))


def trace_halves(
    scene: Scene,
    scene_hash: str,
    settings: RenderSettings,
    placed: PlacedPoints,
    texels: int,
    memory_bytes: int,
    on_progress: Callable[[float], None] = silent,
    device: Device = "auto",
) -> TracedHalves:
    """Trace both halves, each with half of `settings.samples` (at least 1), of a light map of `texels` = H W."""
    each = max(1, settings.samples // 2)
    renderer = TileRenderer(scene, scene_hash, settings.model_copy(update={"samples": each}), memory_bytes, device)
    made = []
    for half in range(2):
        index = placed.batch.index + half * len(BETWEEN_STEPS) * texels
        batch = replace(placed.batch, index=index)

        def report(done: float, half: int = half) -> None:
            on_progress(0.5 * (half + done))

        made.append(renderer.render_light_fields(batch, report))
    enclosed = made[0].enclosed & made[1].enclosed
    return TracedHalves((made[0].light_field, made[1].light_field), enclosed, 2 * each)


def moved_scene(scene: Scene, step: tuple[int, int], shape: tuple[int, int]) -> Scene:
    """The scene with light-map UVs moved so that the centre of texel (r, c) lies where (r, c) + step / 2 lay."""
    offset = np.array([0.5 * step[1] / shape[1], 0.5 * step[0] / shape[0]])
    meshes = []
    for mesh in scene.meshes:
        assert mesh.lightmap_uv is not None
        meshes.append(replace(mesh, lightmap_uv=(mesh.lightmap_uv - offset).astype(np.float32)))
    return replace(scene, meshes=tuple(meshes))


def _moved_rows(maker: TexelMaker, corners: Floats, texel_map: TexelMap, rows: slice) -> tuple[TexelMap, Bools]:
    """Rows of the texel map of the moved scene, and which of its texels are points that count."""
    rasterised = maker.rasterised(rows)
    pushed = maker.push_out(rasterised)
    here = texel_map.rows(rows)
    touched = touched_squares(corners, maker.shape[1], maker.shape[0], rows=rows)
    inside = np.zeros(here.state.size, bool)
    inside[touched.square[touched.distance == 0.0] - rows.start * maker.shape[1]] = True
    usable = (
        inside.reshape(here.state.shape)
        & (rasterised.state == TexelState.VALID)
        & (rasterised.mesh == here.mesh)
        & (rasterised.chart == here.chart)
        & (pushed.position == rasterised.position).all(axis=-1)
    )
    return pushed, usable


def _uv(values: Float32 | None) -> npt.NDArray[np.float64]:
    assert values is not None
    return values.astype(np.float64)
