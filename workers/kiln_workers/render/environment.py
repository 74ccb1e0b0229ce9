"""The environment without the scene: quadrature samples, U(w, alpha), the GGX-prefiltered cube, and its panorama.

Every pixel of the image contributes, weighted with its exact solid angle, so a sun of one pixel is never missed. Both
filtered products are sums over an octahedral grid of the environment's energy, finer for narrower lobes (see `lobes`).
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from kiln_workers.render import lobes
from kiln_workers.render.backend import Device, select_variant
from kiln_workers.render.jit import dr, mi
from kiln_workers.scene.model import Environment, Float32
from kiln_workers.sphere import octahedral

Floats = npt.NDArray[np.float64]

LARGEST_SAMPLES: Final = 1 << 21
"""Samples of the image, at most; a larger image is averaged over 2 x 2 pixels until it fits."""

FINEST_GRID: Final = 256
COARSEST_GRID: Final = 128


@dataclass(frozen=True)
class EnvironmentSamples:
    """A quadrature of the environment: sum radiance * solid_angle approximates any integral of it."""

    direction: Floats  # [S, 3] world
    radiance: Floats  # [S, 3] scaled
    solid_angle: Floats  # [S] they sum to 4 pi
    theta_phi: Floats  # [S, 2] from +Y and in the image, before rotation
    cell: tuple[float, float]  # extent of a sample in theta and phi
    rotation: float  # radians about +Y

    def jittered(self, index: npt.NDArray[np.int64], jitter: Floats) -> Floats:
        """Directions [K, 3] inside the cells of samples `index` [K], at `jitter` [K, 2] in [0, 1)^2."""
        angles = self.theta_phi[index] + (jitter - 0.5) * np.array(self.cell)
        return _direction(angles[:, 0], angles[:, 1], self.rotation)


def environment_samples(environment: Environment, at_least: int) -> EnvironmentSamples:
    """One sample a pixel of the image, or several (bilinear) where it has fewer pixels than `at_least`."""
    pixels = environment.pixels.astype(np.float64) * environment.scale
    while pixels.shape[0] * pixels.shape[1] > LARGEST_SAMPLES and min(pixels.shape[:2]) > 1:
        pixels = _halved(pixels)
    factor = max(1, int(np.ceil(np.sqrt(at_least / (pixels.shape[0] * pixels.shape[1])))))
    pixels = _magnified(pixels, factor)
    height, width = pixels.shape[:2]
    edges = np.cos(np.pi * np.arange(height + 1) / height)
    theta = np.repeat(np.pi * (np.arange(height) + 0.5) / height, width)
    phi = np.tile(2.0 * np.pi * (np.arange(width) + 0.5) / width, height)
    rotation = float(np.radians(environment.rotation_deg))
    return EnvironmentSamples(
        direction=_direction(theta, phi, rotation),
        radiance=pixels.reshape(-1, 3),
        solid_angle=np.repeat((edges[:-1] - edges[1:]) * 2.0 * np.pi / width, width),
        theta_phi=np.stack([theta, phi], axis=-1),
        cell=(np.pi / height, 2.0 * np.pi / width),
        rotation=rotation,
    )


def pixel_of(directions: Floats, grid: int) -> npt.NDArray[np.int64]:
    """Row-major octahedral pixel [K] of each direction [K, 3]."""
    cell = np.clip(((octahedral.encode(directions) + 1.0) * 0.5 * grid).astype(np.int64), 0, grid - 1)
    return np.asarray(cell[:, 1] * grid + cell[:, 0])


def octahedral_energy(samples: EnvironmentSamples, grid: int) -> Floats:
    """Integral of radiance over each octahedral pixel and, last, of 1: [grid^2, 4].

    Both by the same samples, so a constant environment has the same quotient in every pixel.
    """
    pixel = pixel_of(samples.direction, grid)
    energy = samples.radiance * samples.solid_angle[:, None]
    columns = [energy[:, 0], energy[:, 1], energy[:, 2], samples.solid_angle]
    return np.stack([np.bincount(pixel, weights=column, minlength=grid * grid) for column in columns], axis=-1)


def environment_u(
    environment: Environment, alphas: Floats, size: int, device: Device = "auto"
) -> tuple[Float32, Floats]:
    """U(w, alpha) of the light-field paper (eq. 6), with w.l as a further weight, and the scale that eq. 6 has.

    The mean of radiance under D(h) (w.l) for n = v = w, times the integral of D(h) over the hemisphere. Eq. 6 weights
    with D alone, which is not zero at the edge of its hemisphere: a small sun that crosses it drew a hard line.
    Constant light gives the same in both.

    Returns octahedral layers [A, size, size, 3] in world space (pixel layout of `conventions`) and the integrals of D
    alone [A], by which a layer has to be divided to become a mean of radiance.
    """
    select_variant(device)
    targets = octahedral.pixel_directions(size).reshape(-1, 3)
    integrals = lobes.ggx_integral(alphas)
    means = np.stack([_filtered(environment, targets, float(alpha)) for alpha in alphas])
    return (means * integrals[:, None, None]).reshape(-1, size, size, 3).astype(np.float32), integrals


def ggx_prefilter(environment: Environment, size: int, mips: int, device: Device = "auto") -> list[Float32]:
    """Cube mips [6, s, s, 3], s = size, size/2, ...: the mean of radiance under D(h) (n.l) for n = v = r.

    Faces +X -X +Y -Y +Z -Z, rows from the top as GL and KTX 2 have them. Mip m holds the roughness r that the look-up
    lod = maxLod r (2 - r) reads there, maxLod = mips - 1 (three.js, Filament): r = 1 - sqrt(1 - m / maxLod).
    """
    select_variant(device)
    levels = []
    for mip in range(mips):
        side = max(size >> mip, 1)
        roughness = 1.0 - np.sqrt(1.0 - mip / max(mips - 1, 1))
        if mip == 0:
            levels.append(_cube_mirror(environment, side))
            continue
        mean = _filtered(environment, cube_directions(side).reshape(-1, 3), float(roughness**2))
        levels.append(mean.reshape(6, side, side, 3).astype(np.float32))
    return levels


def cube_directions(side: int, offset: tuple[float, float] = (0.5, 0.5)) -> Floats:
    """Unit directions [6, side, side, 3] of a cube map's texels (OpenGL 4.6 specification, table 8.19)."""
    s = np.broadcast_to(2.0 * (np.arange(side) + offset[0]) / side - 1.0, (side, side))
    t = np.broadcast_to((2.0 * (np.arange(side) + offset[1]) / side - 1.0)[:, None], (side, side))
    one = np.ones((side, side))
    faces = [(one, -t, -s), (-one, -t, s), (s, one, t), (s, -one, -t), (s, -t, one), (-s, -t, -one)]
    directions = np.stack([np.stack(face, axis=-1) for face in faces])
    return np.asarray(directions / np.linalg.norm(directions, axis=-1, keepdims=True))


def look_up(environment: Environment, directions: Floats) -> Floats:
    """Scaled radiance [..., 3] in unit directions [..., 3], bilinear in the image."""
    pixels = environment.pixels
    height, width = pixels.shape[:2]
    turn = np.radians(environment.rotation_deg)
    x = np.cos(turn) * directions[..., 0] - np.sin(turn) * directions[..., 2]
    z = np.sin(turn) * directions[..., 0] + np.cos(turn) * directions[..., 2]
    theta, phi = np.arccos(np.clip(directions[..., 1], -1.0, 1.0)), np.arctan2(-z, -x)
    row, column = theta / np.pi * height - 0.5, phi / (2.0 * np.pi) * width - 0.5
    top, left = np.floor(row).astype(np.int64), np.floor(column).astype(np.int64)
    down, right = (row - top)[..., None], (column - left)[..., None]
    above, below = np.clip(top, 0, height - 1), np.clip(top + 1, 0, height - 1)
    upper = pixels[above, left % width] * (1.0 - right) + pixels[above, (left + 1) % width] * right
    lower = pixels[below, left % width] * (1.0 - right) + pixels[below, (left + 1) % width] * right
    return np.asarray((upper * (1.0 - down) + lower * down) * environment.scale, dtype=np.float64)


def panorama(environment: Environment) -> Float32:
    """The scaled environment [H, W, 3] with its rotation applied to the pixels."""
    pixels = environment.pixels
    shift = pixels.shape[1] * environment.rotation_deg / 360.0
    whole = int(np.floor(shift))
    near = np.roll(pixels.astype(np.float64), -whole, axis=1)
    turned = near + (shift - whole) * (np.roll(near, -1, axis=1) - near)
    return np.asarray(turned * environment.scale, dtype=np.float32)


def _cube_mirror(environment: Environment, side: int) -> Float32:
    """The environment itself on the cube: the mean over a grid of look-ups as dense as the image's pixels."""
    density = max(1, min(8, round(environment.pixels.shape[1] / (4.0 * side))))
    total = np.zeros((6, side, side, 3))
    for row in range(density):
        for column in range(density):
            offset = ((column + 0.5) / density, (row + 0.5) / density)
            total += look_up(environment, cube_directions(side, offset))
    return np.asarray(total / density**2, dtype=np.float32)


def _filtered(environment: Environment, targets: Floats, alpha: float) -> Floats:
    """Mean radiance [K, 3] under D(h) (w.l) of the lobes of width `alpha` about `targets` [K, 3]."""
    grid = _grid_for(alpha)
    energy = octahedral_energy(environment_samples(environment, 16 * grid * grid), grid)
    sources = octahedral.pixel_directions(grid).reshape(-1, 3)
    count = -(-len(targets) // lobes.TARGETS)
    padded = np.concatenate([targets, np.repeat(targets[-1:], count * lobes.TARGETS - len(targets), axis=0)])
    split = padded.reshape(count, lobes.TARGETS, 3).astype(np.float32)
    sums = lobes.lobe_sums(
        [mi.Vector3f(np.ascontiguousarray(split[:, k].T)) for k in range(lobes.TARGETS)],
        dr.full(mi.Float, float(lobes.resolved_alpha(alpha, grid)), count),
        dr.zeros(mi.UInt32, count),
        dr.full(mi.UInt32, grid * grid, count),
        lobes.packed(sources),
        [lobes.packed(energy)],
    )
    dr.eval(sums)
    out = np.stack([np.array(row[0]).T for row in sums], axis=1).reshape(-1, 4)
    return np.asarray(out[: len(targets), :3] / out[: len(targets), 3:], dtype=np.float64)


def _grid_for(alpha: float) -> int:
    """Side of the source grid: a pixel no wider than alpha / 4, a power of two, between the bounds.

    A small sun moves to its pixel's centre: by a quarter of alpha it brightens or darkens the lobe's flank by a tenth.
    """
    wanted = 4.0 * np.sqrt(4.0 * np.pi) / max(alpha, 1e-6)
    return int(np.clip(2 ** np.ceil(np.log2(wanted)), COARSEST_GRID, FINEST_GRID))


def _direction(theta: Floats, phi: Floats, rotation: float) -> Floats:
    """World directions [K, 3] of angles in the image (`scene.model.Environment`), turned about +Y."""
    # Turning by `rotation` about +Y, counter-clockwise from above, is a shift of phi.
    turned = phi - rotation
    return np.stack([-np.sin(theta) * np.cos(turned), np.cos(theta), -np.sin(theta) * np.sin(turned)], axis=-1)


def _halved(pixels: Floats) -> Floats:
    height, width = pixels.shape[0] // 2 * 2, pixels.shape[1] // 2 * 2
    return np.asarray(pixels[:height, :width].reshape(height // 2, 2, width // 2, 2, 3).mean(axis=(1, 3)))


def _magnified(pixels: Floats, factor: int) -> Floats:
    """Bilinear magnification by a whole factor; wraps in columns, clamps in rows."""
    if factor == 1:
        return pixels
    for axis in (0, 1):
        size = pixels.shape[axis]
        position = (np.arange(size * factor) + 0.5) / factor - 0.5
        lower = np.floor(position).astype(np.int64)
        weight = (position - lower).reshape((-1, 1, 1) if axis == 0 else (1, -1, 1))
        ends = [np.clip(lower + k, 0, size - 1) if axis == 0 else (lower + k) % size for k in (0, 1)]
        pixels = np.take(pixels, ends[0], axis=axis) * (1.0 - weight) + np.take(pixels, ends[1], axis=axis) * weight
    return pixels
