"""Illumination-weighted environment visibility W_E (light-field paper, eq. 7) from one traced visibility image a texel.

    W_E(w) = sum_p D(h) (w.p) Lbar_p V_p / sum_p D(h) (w.p) Lbar_p     over the texel's upper hemisphere, three channels

Both sums are one quadrature over octahedral pixels p, so W_E is exactly 1 where nothing occludes. Lbar_p is the
environment's energy in the pixel, every image pixel counted. V_p is traced with shadow rays that are distributed inside
the pixel as the environment's luminance is, in strata of equal energy: the sun's pixel sends its rays at the sun.
Pixels that hold much of the energy get more rays. The paper traces a lobe of rays for each pixel of W_E instead; this
takes one set of rays a texel for all of them. Where a channel is black all over the hemisphere, a white environment
is assumed.
"""

from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from kiln_workers.render import counters, lobes
from kiln_workers.render.environment import environment_samples, octahedral_energy, pixel_of
from kiln_workers.render.jit import column, columns, dr, mi, to_numpy
from kiln_workers.render.paths import PathTracer
from kiln_workers.scene.model import Environment, Float32
from kiln_workers.sphere import octahedral

Int64 = npt.NDArray[np.int64]

RAYS: Final = 4
"""Shadow rays a pixel, at least."""

MOST_RAYS: Final = 64
"""Shadow rays for a pixel with very much of the energy."""

VARIANTS: Final = 8
"""Sets of ray directions; a texel takes one of them by its hash, so that neighbours do not share all errors."""

COARSEST_GRID: Final = 32
"""Sources are merged down to this grid, at most."""

WIDE_LOBE: Final = 2.0
"""Sources are merged 2 x 2 while alpha is at least this many of the merged pixels."""

LUMINANCE: Final = np.array([0.2126, 0.7152, 0.0722])


@dataclass(frozen=True)
class RayTable:
    """Where the shadow rays of each octahedral pixel go; the same for all texels of a scene."""

    energy: Float32  # [R * R, 4] integral of radiance over the pixel, and its solid angle
    first: Any  # UInt32 [R * R] the pixel's first ray
    rays: Any  # UInt32 [R * R] how many it has
    directions: Any  # Float [VARIANTS * K * 3]
    count: int  # K

    @staticmethod
    def make(environment: Environment, size: int) -> "RayTable":
        samples = environment_samples(environment, 32 * size * size)
        energy = octahedral_energy(samples, size)
        luminance = energy[:, :3] @ LUMINANCE
        share = luminance / max(luminance.sum(), 1e-30)
        rays = np.minimum(RAYS + np.round(0.25 * RAYS * size * size * share), MOST_RAYS).astype(np.int64)
        first = np.concatenate([[0], np.cumsum(rays)[:-1]])
        # Sort the samples by pixel; a ray then picks one by inverting the cumulative weight of its pixel.
        pixel = pixel_of(samples.direction, size)
        order = np.argsort(pixel, kind="stable")
        floor = 1e-6 * luminance.sum() / (4.0 * np.pi) + 1e-30
        weight = ((samples.radiance @ LUMINANCE + floor) * samples.solid_angle)[order]
        cumulative = np.concatenate([[0.0], np.cumsum(weight)])
        bounds = np.searchsorted(pixel[order], np.arange(size * size + 1))
        random = np.random.default_rng(0)
        owner = np.repeat(np.arange(size * size), rays)
        low, high = cumulative[bounds[owner]], cumulative[bounds[owner + 1]]
        sets = []
        for _ in range(VARIANTS):
            stratum = (np.arange(len(owner)) - first[owner] + random.random(len(owner))) / rays[owner]
            picked = np.searchsorted(cumulative, low + stratum * (high - low), side="right") - 1
            picked = np.clip(picked, bounds[owner], np.maximum(bounds[owner + 1] - 1, bounds[owner]))
            jittered = samples.jittered(order[np.minimum(picked, len(order) - 1)], random.random((len(owner), 2)))
            # A pixel that no sample fell into (only at the poles of coarse images) shoots at its centre.
            empty = (bounds[owner] == bounds[owner + 1])[:, None]
            sets.append(np.where(empty, octahedral.pixel_directions(size).reshape(-1, 3)[owner], jittered))
        return RayTable(
            energy=energy.astype(np.float32),
            first=mi.UInt32(first.astype(np.uint32)),
            rays=mi.UInt32(rays.astype(np.uint32)),
            directions=mi.Float(np.stack(sets).astype(np.float32).ravel()),
            count=len(owner),
        )


@dr.syntax  # type: ignore[untyped-decorator, unused-ignore]
def trace_visibility(
    tracer: PathTracer, table: RayTable, texel_hash: Any, pixels: Any, origin: Any, normal: Any
) -> tuple[Any, Any]:
    """Of each lane's rays the mean that is above the horizon and not occluded (Color3f where surfaces may let a part of
    the light pass, else Float), and the fraction above the horizon."""
    ray = dr.gather(mi.UInt32, table.first, pixels)
    rays = dr.gather(mi.UInt32, table.rays, pixels)
    last = ray + rays
    directions = table.directions
    shift = mi.UInt32(texel_hash % VARIANTS) * table.count
    above = dr.zeros(mi.UInt32, dr.width(pixels))
    seen = dr.zeros(mi.Color3f if tracer.has_veils else mi.Float, dr.width(pixels))
    while ray < last:
        direction = dr.gather(mi.Vector3f, directions, shift + ray)
        up = dr.dot(direction, normal) > 0.0
        above += dr.select(up, 1, 0)
        if dr.hint(tracer.has_veils, mode="scalar"):
            seen += dr.select(up, tracer.passing(mi.Ray3f(origin, direction), up), 0.0)
        else:
            seen += dr.select(up & ~tracer.blocked(mi.Ray3f(origin, direction), up), 1.0, 0.0)
        ray += 1
    return seen / mi.Float(rays), mi.Float(above) / mi.Float(rays)


def weighted_visibility(
    table: RayTable, size: int, alpha: Float32, lanes: Int64, seen: Float32, above: Float32
) -> Float32:
    """W_E [L, 3] of the lanes (texel, pixel) [L, 2]; texels count from 0, alpha [T]; seen [L] or [3, L], above [L]."""
    out = np.empty((len(lanes), 3), np.float32)
    grids = np.array([source_grid(float(value), size) for value in alpha])
    for grid in np.unique(grids):
        mask = grids[lanes[:, 0]] == grid
        out[mask] = _convolved(table, size, int(grid), alpha, lanes[mask], seen[..., mask], above[mask])
    return out


def source_grid(alpha: float, size: int) -> int:
    """Side of the grid of sources for a lobe in an image of `size` pixels a side."""
    grid = size
    while grid > COARSEST_GRID and grid % 2 == 0 and alpha >= WIDE_LOBE * lobes.pixel_angle(grid // 2):
        grid //= 2
    return grid


def _convolved(
    table: RayTable, size: int, grid: int, alpha: Float32, lanes: Int64, seen: Float32, above: Float32
) -> Float32:
    """The two sums of W_E with sources on a `grid`, which divides `size`, and their ratio [L, 3]."""
    source, numerator, denominator, first, last = _sources(table, size, grid, len(alpha), lanes, seen, above)
    # Two neighbouring pixels of one texel share a lane.
    texel, start = np.unique(lanes[:, 0], return_index=True)
    stop = np.append(start[1:], len(lanes))
    pairs = np.concatenate([np.arange(a, b, lobes.TARGETS) for a, b in zip(start, stop, strict=True)])
    owner = lanes[pairs, 0]
    ends = stop[np.searchsorted(texel, owner)]
    rows = np.minimum(pairs[:, None] + np.arange(lobes.TARGETS), ends[:, None] - 1)
    directions = octahedral.pixel_directions(size).reshape(-1, 3).astype(np.float32)[lanes[rows, 1]]
    sums = lobes.lobe_sums(
        [columns(mi.Vector3f, directions[:, k]) for k in range(lobes.TARGETS)],
        column(mi.Float, lobes.resolved_alpha(alpha[owner], grid).astype(np.float32)),
        column(mi.UInt32, first[owner].astype(np.uint32)),
        column(mi.UInt32, last[owner].astype(np.uint32)),
        lobes.packed(octahedral.pixel_directions(grid).reshape(-1, 3)[source]),
        [lobes.packed(numerator), lobes.packed(denominator)],
    )
    dr.eval(sums)
    out = np.empty((len(lanes), 3), np.float32)
    for k, (top, bottom) in enumerate(sums):
        out[rows[:, k]] = _ratio(to_numpy(top), to_numpy(bottom))
    return out


def _ratio(numerator: Float32, denominator: Float32) -> Float32:
    """Channels 0-2; where the environment is black over the hemisphere, the ratio under a white one (channel 3)."""
    lit_at_all = denominator[:, 3:] > 0.0
    white = np.where(lit_at_all, numerator[:, 3:] / np.where(lit_at_all, denominator[:, 3:], 1.0), 0.0)
    lit = denominator[:, :3] > 0.0
    return np.where(lit, numerator[:, :3] / np.where(lit, denominator[:, :3], 1.0), white).astype(np.float32)


def _sources(
    table: RayTable, size: int, grid: int, texels: int, lanes: Int64, seen: Float32, above: Float32
) -> tuple[Int64, Float32, Float32, Int64, Int64]:
    """Pixels [S] of the grid above the horizon, by texel; their energy seen and unoccluded [S, 4]; texels' ranges."""
    energy = table.energy[lanes[:, 1]]
    if seen.ndim == 2:  # [3, L]
        seen = np.concatenate([seen, seen.mean(axis=0, keepdims=True)]).T
    numerator, denominator = energy * seen.reshape(len(energy), -1), energy * above[:, None]
    texel, pixel = lanes[:, 0], lanes[:, 1]
    if grid < size:
        step = size // grid
        key = texel * grid * grid + (pixel // size // step) * grid + pixel % size // step
        keys, place = np.unique(key, return_inverse=True)
        sums = [np.zeros((len(keys), 4), np.float32) for _ in range(2)]
        for total, part in zip(sums, (numerator, denominator), strict=True):
            np.add.at(total, place, part)
        numerator, denominator = sums
        texel, pixel = keys // (grid * grid), keys % (grid * grid)
    first = np.searchsorted(texel, np.arange(texels), side="left")
    last = np.searchsorted(texel, np.arange(texels), side="right")
    return pixel, numerator, denominator, first, last


def texel_hash(scene_key: int, index: Any) -> Any:
    """UInt64 by which a texel takes one of the table's variants."""
    return counters.lane_state(scene_key, counters.STREAM_VISIBILITY, index, mi.UInt32(0))
