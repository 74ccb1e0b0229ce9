"""Render the texels of a tile: light-field images, environment visibility, irradiance, within a memory bound.

The unit of work is a lane (see `paths`): pixels whose square lies wholly or partly above a texel's geometric horizon.
A pixel holds the mean radiance, by solid angle, over the part of it that is above the horizon; a pixel with no such
part is zero. Lanes are listed texel by texel and cut into wavefronts of as many as the memory bound holds, which
changes no byte of the result.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any, Final, Self

import numpy as np
import numpy.typing as npt

from kiln_schemas.conventions import FP16_MAX
from kiln_schemas.errors import MachineLacks
from kiln_schemas.settings import RenderSettings
from kiln_workers.render import adaptive, counters, enclosure
from kiln_workers.render.backend import Device, select_variant
from kiln_workers.render.jit import column, columns, dr, mi, to_numpy
from kiln_workers.render.paths import TEXEL_OFFSET, LaneSums, PathTracer, Start
from kiln_workers.render.visibility import RayTable, texel_hash, trace_visibility, weighted_visibility
from kiln_workers.scene.model import Float32, Scene
from kiln_workers.scene.texel_map import TexelMap
from kiln_workers.sphere import octahedral

Float16 = npt.NDArray[np.float16]
Int64 = npt.NDArray[np.int64]

BYTES_PER_LANE: Final = 384
"""Inputs, outputs, copies in NumPy and shares of the paths, per lane of a wavefront (benchmarks/render.py)."""

LARGEST_WAVEFRONT: Final = 1 << 22
SMALLEST_WAVEFRONT: Final = 1 << 12

RADIANCE, WEIGHT, SQUARE, PATHS, DROPPED = slice(0, 3), 3, 4, 5, 6
"""Columns of a lane's sums (`paths.LaneSums`)."""

IRRADIANCE_BLOCK: Final = 16
"""Irradiance samples per lane: few, so that the few texels of a tile fill many lanes."""


INSIDE_GEOMETRY: Final = -1.0
"""What a finer irradiance map holds where a point lies inside something."""


@dataclass(frozen=True)
class TexelBatch:
    """T surface points to be baked."""

    index: Int64  # [T] row * W + column in the light map: with the scene's hash it seeds the texel's random numbers
    position: Float32  # [T, 3] metres
    normal: Float32  # [T, 3] unit, geometric, on the side that light reaches
    shading_normal: Float32  # [T, 3] unit
    alpha: Float32  # [T] GGX alpha
    texel_size: Float32  # [T] metres

    def __len__(self) -> int:
        return len(self.index)

    @classmethod
    def of(cls, texel_map: TexelMap, place: tuple[Int64, Int64], first: int = 0) -> Self:
        """The points of a map at (rows, columns); `first` is the index of its texel (0, 0)."""
        return cls(
            index=first + place[0] * texel_map.state.shape[1] + place[1],
            position=texel_map.position[place],
            normal=texel_map.normal[place],
            shading_normal=texel_map.shading_normal[place],
            alpha=texel_map.alpha[place],
            texel_size=texel_map.texel_size[place],
        )


@dataclass(frozen=True)
class TileImages:
    """What was rendered for the T texels of a batch, R = image_size."""

    light_field: Float16  # [T, R, R, 3] radiance without the directly seen environment
    visibility: Float16 | None  # [T, R, R, 3] W_E; None without an environment
    irradiance: Float32  # [T, 3] W/m^2, over the shading normal's hemisphere above the surface
    enclosed: npt.NDArray[np.bool_]  # [T] no light reaches the texel, and it lies inside something (`enclosure`)
    paths: int
    overflows: int  # values clamped to the fp16 range, and paths dropped because they were not finite


Progress = Callable[[float], None]
"""Told the fraction that is done; may raise to stop."""


def silent(fraction: float) -> None:
    """Nobody listens."""


class TileRenderer:
    """Renders batches of texels of one scene; keep it while the scene stays the same.

    `memory_bytes` bounds what a wavefront takes besides the scene, the compiled kernels and the images themselves. With
    a radiance `cache` [H, W, 3 or 6] (`stages.radiance_cache`) light fields are traced with its help; irradiance never
    is, whose noise is mostly of direct light.
    """

    def __init__(
        self,
        scene: Scene,
        scene_hash: str,
        settings: RenderSettings,
        memory_bytes: int,
        device: Device = "auto",
        cache: Float16 | None = None,
    ) -> None:
        select_variant(device)
        self.settings = settings
        self.key = int(scene_hash[:16], 16)
        self.tracer = PathTracer(scene, settings.max_depth)
        self.field_tracer = self.tracer if cache is None else self.tracer.with_cache(cache)
        self.wavefront = wavefront_lanes(memory_bytes)
        self.table = None if scene.environment is None else RayTable.make(scene.environment, settings.image_size)
        self.pixel_area = 4.0 / settings.image_size**2
        self.solid_angles = mi.Float(octahedral.pixel_solid_angles(settings.image_size).astype(np.float32).ravel())

    def render(self, texels: TexelBatch, on_progress: Progress = silent) -> TileImages:
        """All images of the batch; `on_progress` is called with the fraction done and may raise to stop."""
        fields = self.render_light_fields(texels, lambda done: on_progress(0.6 * done))
        irradiance, irradiance_paths, dropped = self.render_irradiance(
            texels, lambda done: on_progress(0.6 + 0.2 * done)
        )
        visibility = self._visibility(texels, lambda done: on_progress(0.8 + 0.2 * done))
        on_progress(1.0)
        return replace(
            fields,
            visibility=visibility,
            irradiance=irradiance,
            enclosed=fields.enclosed & ~irradiance.any(axis=1),
            paths=fields.paths + irradiance_paths,
            overflows=fields.overflows + dropped,
        )

    def render_light_fields(
        self,
        texels: TexelBatch,
        on_progress: Progress = silent,
        *,
        samples: int | None = None,
        offsets: Int64 | None = None,
    ) -> TileImages:
        """The light-field images, and which dark ones are enclosed; no visibility, irradiance zero.

        `samples` paths a pixel instead of the settings'. With `offsets` [T, 2] only one pixel of each 2 x 2 block is
        traced, that row and column of the block, and no texel is judged.
        """
        size, samples = self.settings.image_size, samples or self.settings.samples
        even = adaptive.even_samples(samples)
        out = np.zeros((len(texels), size * size, 3), np.float16)
        paths = overflows = 0
        for images, lanes in self._whole_images(texels, offsets):

            def report(done: float, images: range = images) -> None:
                on_progress((images.start + done * len(images)) / len(texels))

            count = np.full(len(lanes), even)
            sums = self._trace_lanes(texels, lanes, count, 0, lambda done: report(done * even / samples))
            if even < samples and len(lanes):
                more = self._more_samples(lanes, sums, samples, size if offsets is None else size // 2)
                order = _by_count(more)
                sums[order] += self._trace_lanes(
                    texels,
                    lanes[order],
                    more[order],
                    even,
                    lambda done: report((even + done * (samples - even)) / samples),
                )
            mean = (sums[:, RADIANCE] / np.maximum(sums[:, WEIGHT], 1e-30)[:, None]).astype(np.float32)
            out[lanes[:, 0], lanes[:, 1]], clamped = to_half(mean)
            paths += int(sums[:, PATHS].sum(dtype=np.float64))
            overflows += clamped + int(sums[:, DROPPED].sum(dtype=np.float64))
        on_progress(1.0)
        enclosed = self._enclosed(texels, out) if offsets is None else np.zeros(len(texels), bool)
        return TileImages(
            light_field=out.reshape(len(texels), size, size, 3),
            visibility=None,
            irradiance=np.zeros((len(texels), 3), np.float32),
            enclosed=enclosed,
            paths=paths,
            overflows=overflows,
        )

    def _more_samples(self, lanes: Int64, sums: Float32, samples: int, side: int) -> Int64:
        """How many paths lanes [L] get after their even ones; `side`: traced pixels along an image's side."""
        step = self.settings.image_size // side
        texel = lanes[:, 0] - lanes[0, 0]
        row, column = np.divmod(lanes[:, 1], self.settings.image_size)
        place = texel, row // step, column // step
        count = np.maximum(sums[:, PATHS].astype(np.float64), 1.0)
        mean, square = sums[:, RADIANCE].mean(axis=1) / count, sums[:, SQUARE] / count
        grids = np.zeros((3, int(texel[-1]) + 1, side, side))
        for grid, values in zip(grids, (mean, np.maximum(square - mean**2, 0.0), np.ones(len(lanes))), strict=True):
            grid[place] = values
        return np.asarray(adaptive.more_samples(grids[0], grids[1], grids[2] > 0.0, samples)[place])

    def _trace_lanes(
        self, texels: TexelBatch, lanes: Int64, samples: Int64, done: int, on_progress: Progress
    ) -> Float32:
        """What lanes [L] add up over `samples` [L] paths after the first `done`: a row [L, 7] of sums each."""
        out = np.zeros((len(lanes), 7), np.float32)
        for part, fraction in self._wavefronts(np.arange(len(lanes))):
            sums = self._trace_pixels(texels, lanes[part, 0], lanes[part, 1], samples[part], done)
            out[part, RADIANCE] = to_numpy(sums.radiance)
            for number, values in enumerate((sums.weight, sums.square, sums.paths, sums.dropped), start=WEIGHT):
                out[part, number] = np.array(values)
            on_progress(fraction)
        return out

    def _trace_pixels(self, texels: TexelBatch, texel: Int64, pixel: Int64, samples: Int64, done: int) -> LaneSums:
        """One wavefront of light-field pixels."""
        size = self.settings.image_size
        points = _Points(texels, texel)
        pixels = column(mi.UInt32, pixel.astype(np.uint32))
        corner = mi.Vector2f(mi.Float(pixels % size), mi.Float(pixels // size))
        density = self.pixel_area / dr.gather(mi.Float, self.solid_angles, pixels)
        lanes = counters.lane_state(self.key, counters.STREAM_LIGHT_FIELD, points.index, pixels)
        dr.eval(lanes, corner, density, points.origin, points.normal)

        def start(lane: Any, sample: Any) -> Start:
            xy = (corner + counters.stratified_pair(lane, sample)) * (2.0 / size) - 1.0
            direction, jacobian = octahedral_direction(xy)
            return Start(points.origin, direction, jacobian * density, 0.0, dr.dot(direction, points.normal) > 0.0)

        count = column(mi.UInt32, samples.astype(np.uint32))
        # Not a literal, so that one kernel serves every value.
        before = column(mi.UInt32, np.full(len(texel), done, np.uint32))
        sums: LaneSums = self.field_tracer.trace(lanes, count, start, False, before)
        dr.eval(sums.radiance, sums.weight, sums.square, sums.paths, sums.dropped)
        return sums

    def render_irradiance(
        self, texels: TexelBatch, on_progress: Progress = silent, *, punctual: bool = True
    ) -> tuple[Float32, int, int]:
        """Irradiance [T, 3] alone, how many paths it took, and how many were dropped because they were not finite.

        Not `punctual`: without what comes straight from lights that are points or directions.
        """
        samples = self.settings.irradiance_samples
        blocks = -(-samples // IRRADIANCE_BLOCK)
        total = np.zeros((len(texels), blocks, 3), np.float64)
        dropped = 0
        grid = np.stack(np.meshgrid(np.arange(len(texels)), np.arange(blocks), indexing="ij"), axis=-1).reshape(-1, 2)
        for part, fraction in self._wavefronts(grid):
            texel, block = part[:, 0], part[:, 1]
            counts = np.minimum(samples - block * IRRADIANCE_BLOCK, IRRADIANCE_BLOCK)
            paths, direct = self._trace_irradiance(texels, texel, block, counts, punctual)
            # Sum each texel's blocks in one fixed order, whatever the wavefronts were.
            total[texel, block] = to_numpy(paths.radiance) + to_numpy(direct)
            dropped += int(np.array(paths.dropped).sum())
            on_progress(fraction)
        return (total.sum(axis=1) / samples).astype(np.float32), len(texels) * samples, dropped

    def render_fine_irradiance(
        self, texels: TexelBatch, on_progress: Progress = silent, *, punctual: bool = True
    ) -> tuple[Float32, int, int]:
        """The same of a finer map's texels: -1 where no light reaches a point and it lies inside something."""
        irradiance, paths, dropped = self.render_irradiance(texels, on_progress, punctual=punctual)
        irradiance[self._enclosed(texels, irradiance)] = INSIDE_GEOMETRY
        return irradiance, paths, dropped

    def backs(self, texels: TexelBatch) -> TexelBatch:
        """The same points on the other side of their surfaces, as seen from there."""
        behind = self.tracer.behind(
            columns(mi.Point3f, texels.position),
            columns(mi.Vector3f, texels.normal),
            column(mi.Float, texels.texel_size),
        )
        return replace(
            texels,
            position=to_numpy(behind),
            normal=-texels.normal,
            shading_normal=-texels.shading_normal,
        )

    def _enclosed(self, texels: TexelBatch, light: Float16 | Float32) -> npt.NDArray[np.bool_]:
        """Which texels [T] lie inside something, of those that have no light [T, ...]; the others are not asked."""
        out = np.zeros(len(texels), bool)
        dark = np.flatnonzero(~light.any(axis=tuple(range(1, light.ndim))))
        out[dark] = enclosure.enclosed(self.tracer, _origins(texels)[dark], texels.normal[dark])
        return out

    def _trace_irradiance(
        self, texels: TexelBatch, texel: Int64, block: Int64, counts: Int64, punctual: bool
    ) -> tuple[LaneSums, Any]:
        """One wavefront of blocks of irradiance samples: cosine-distributed paths, and next-event estimates."""
        points = _Points(texels, texel)
        blocks, count = (column(mi.UInt32, values.astype(np.uint32)) for values in (block, counts))
        # The texel's samples form one low-discrepancy set over all of its blocks.
        shared = counters.lane_state(self.key, counters.STREAM_IRRADIANCE, points.index, mi.UInt32(0))
        lanes = counters.lane_state(self.key, counters.STREAM_IRRADIANCE, points.index, blocks + 1)
        frame = mi.Frame3f(points.shading_normal)
        first = blocks * IRRADIANCE_BLOCK
        dr.eval(shared, lanes, first, frame, points.origin, points.normal)

        def start(lane: Any, sample: Any) -> Start:
            local = mi.warp.square_to_cosine_hemisphere(counters.stratified_pair(shared, first + sample))
            direction = frame.to_world(local)
            pdf = mi.warp.square_to_cosine_hemisphere_pdf(local)
            # The estimator L cos / pdf is pi L.
            return Start(points.origin, direction, dr.pi, pdf, dr.dot(direction, points.normal) > 0.0)

        paths = self.tracer.trace(lanes, count, start, True)
        direct_lanes = counters.lane_state(self.key, counters.STREAM_DIRECT, points.index, blocks)
        direct = self.tracer.direct(direct_lanes, count, points.origin, points.normal, points.shading_normal, punctual)
        dr.eval(paths.radiance, paths.dropped, direct)
        return paths, direct

    def _visibility(self, texels: TexelBatch, on_progress: Progress) -> Float16 | None:
        if self.table is None:
            return None
        size = self.settings.image_size
        out = np.zeros((len(texels), size * size, 3), np.float16)
        # The convolution needs a texel's whole hemisphere, so wavefronts are cut between texels here.
        group = max(1, self.wavefront // (size * size))
        for first in range(0, len(texels), group):
            numbers = slice(first, first + group)
            lanes = lanes_above_horizon(texels.normal[numbers], size)
            points = _Points(texels, lanes[:, 0] + first)
            pixels = column(mi.UInt32, lanes[:, 1].astype(np.uint32))
            hashes = texel_hash(self.key, points.index)
            seen, above = trace_visibility(self.tracer, self.table, hashes, pixels, points.origin, points.normal)
            dr.eval(seen, above)
            values = weighted_visibility(
                self.table,
                size,
                texels.alpha[numbers],
                lanes,
                to_numpy(seen).T if self.tracer.has_veils else np.array(seen),
                np.array(above),
            )
            out[lanes[:, 0] + first, lanes[:, 1]] = values.astype(np.float16)
            on_progress(min(first + group, len(texels)) / len(texels))
        return out.reshape(len(texels), size, size, 3)

    def _whole_images(self, texels: TexelBatch, offsets: Int64 | None) -> Iterator[tuple[range, Int64]]:
        """The texels of each group, and (texel, pixel) [L, 2] of the group's pixels above the horizon.

        A group has about as many pixels as a wavefront. With `offsets` only one pixel of each 2 x 2 block is listed.
        """
        size = self.settings.image_size
        # About half of the pixels are above.
        group = max(1, 2 * self.wavefront // (size * size))
        for first in range(0, len(texels), group):
            lanes = lanes_above_horizon(texels.normal[first : first + group], size)
            lanes[:, 0] += first
            if offsets is not None:
                inside = np.stack(np.divmod(lanes[:, 1], size), axis=1) % 2
                lanes = lanes[(inside == offsets[lanes[:, 0]]).all(axis=1)]
            yield range(first, min(first + group, len(texels))), lanes

    def _wavefronts(self, lanes: Int64) -> Iterator[tuple[Int64, float]]:
        for first in range(0, len(lanes), self.wavefront):
            part = lanes[first : first + self.wavefront]
            yield part, (first + len(part)) / len(lanes)


class _Points:
    """A wavefront's texels as Dr.Jit arrays, one entry a lane; origins already lifted off the surface."""

    def __init__(self, texels: TexelBatch, texel: Int64) -> None:
        origin = _origins(texels)
        self.index = column(mi.UInt64, texels.index[texel].astype(np.uint64))
        self.origin = columns(mi.Point3f, origin[texel])
        self.normal = columns(mi.Vector3f, texels.normal[texel])
        self.shading_normal = columns(mi.Vector3f, texels.shading_normal[texel])


def _origins(texels: TexelBatch) -> Float32:
    """Where rays start [T, 3], off the surface."""
    return (texels.position + (TEXEL_OFFSET * texels.texel_size)[:, None] * texels.normal).astype(np.float32)


def wavefront_lanes(memory_bytes: int) -> int:
    """Lanes of a wavefront that keeps within `memory_bytes`; MachineLacks where not even a small one does."""
    lanes = min(memory_bytes // BYTES_PER_LANE, LARGEST_WAVEFRONT)
    if lanes < SMALLEST_WAVEFRONT:
        raise MachineLacks(
            f"{memory_bytes} bytes hold {lanes} rays",
            where="memory",
            remedy=f"Allow at least {SMALLEST_WAVEFRONT * BYTES_PER_LANE >> 20 or 1} MiB.",
        )
    return int(lanes)


def _by_count(samples: Int64) -> Int64:
    """The lanes that have something to do, of those that take about as many paths (a factor of 1.4) side by side."""
    level = np.where(samples > 0, np.ceil(2.0 * np.log2(np.maximum(samples, 1))) + 1.0, 0.0)
    order = np.argsort(-level, kind="stable")
    return np.asarray(order[: np.count_nonzero(samples)], dtype=np.int64)


def lanes_above_horizon(normals: Float32, size: int) -> Int64:
    """(texel, pixel) [L, 2] of every pixel with a corner above the texel's horizon, by texel, then by pixel."""
    edges = np.linspace(-1.0, 1.0, size + 1)
    corners = octahedral.decode(np.stack(np.broadcast_arrays(edges[None, :], edges[:, None]), axis=-1))
    # A pixel's lowest and highest points are its corners: straight edges on a face are great circles.
    height = np.einsum("rcd,td->trc", corners, normals.astype(np.float64)) > 0.0
    above = height[:, :-1, :-1] | height[:, :-1, 1:] | height[:, 1:, :-1] | height[:, 1:, 1:]
    return np.argwhere(above.reshape(len(normals), -1))


def octahedral_direction(xy: Any) -> tuple[Any, Any]:
    """`sphere.octahedral.decode` and `jacobian` of a Point2f in [-1, 1]^2, in Dr.Jit."""
    z = 1.0 - dr.abs(xy.x) - dr.abs(xy.y)
    fold = dr.maximum(-z, 0.0)
    p = mi.Vector3f(xy.x - dr.mulsign(fold, xy.x), xy.y - dr.mulsign(fold, xy.y), z)
    inverse = dr.rsqrt(dr.squared_norm(p))
    return p * inverse, inverse * inverse * inverse


def to_half(values: Float32) -> tuple[Float16, int]:
    """Values as fp16, clamped to its range, and how many had to be."""
    clamped = int(np.count_nonzero(values > FP16_MAX))
    return np.minimum(values, FP16_MAX).astype(np.float16), clamped
