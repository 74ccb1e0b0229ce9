"""The product's irradiance at random texels of a random scene beside plain Mitsuba's at the same points.

Both are means of independent blocks, whose scatter gives their standard errors: z is their difference over the root of
the sum of both squares. A texel whose z exceeds 4 in a channel is measured again by both, with eight times the paths
and other random numbers, and fails if z exceeds 4 again. With 32 blocks a side a sound texel fails by chance once in
three million, one of 800 texels with a probability of 2e-4; a fault of a few standard errors is found.
"""

import tempfile
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from plain_mitsuba import RADIUS, PlainMitsuba
from random_scenes import RandomScene, write_scene

from kiln_schemas.settings import LightmapSettings, RenderSettings
from kiln_schemas.tasks import EnvironmentRef
from kiln_workers.package import exr
from kiln_workers.render.tile import TexelBatch, TileRenderer
from kiln_workers.scene.archive import scene_hash
from kiln_workers.scene.atlas import make_lightmap
from kiln_workers.scene.load import check_light, load_scene
from kiln_workers.scene.model import Scene
from kiln_workers.scene.sheets import part_sheets
from kiln_workers.scene.texel_map import TexelMap, TexelState
from kiln_workers.scene.texels import build_texel_map

Floats = npt.NDArray[np.float64]

DEPTH: Final = 5
BLOCKS: Final = 32
BLOCK_PATHS: Final = (512, 1024)
"""Of the product and of Mitsuba, a block."""
AGAIN: Final = 8
SIGMAS: Final = 4.0
ROUNDING: Final = 1e-4
"""Relative error of a value without noise: float32 coordinates of a lamp and a texel."""
MEMORY: Final = 1 << 27
SKY_WIDTH: Final = 512


@dataclass(frozen=True)
class Texel:
    """One comparison."""

    place: tuple[int, int]
    found: Floats  # [3] the product's irradiance
    right: Floats  # [3] Mitsuba's
    sigma: Floats  # [3] of their difference
    again: bool = False
    """Whether it was measured a second time; the values are the second ones."""
    first_z: Floats = field(default_factory=lambda: np.zeros(3))

    @property
    def z(self) -> Floats:
        return z_score(self.found, self.right, self.sigma)

    @property
    def doubtful(self) -> bool:
        """Whether it deviates by more than SIGMAS, or is no number."""
        return not bool(np.abs(self.z).max() <= SIGMAS)

    @property
    def fails(self) -> bool:
        return self.again and self.doubtful


@dataclass(frozen=True)
class Outcome:
    """What became of a scene."""

    seed: int
    features: frozenset[str]
    texels: tuple[Texel, ...]
    misplaced: tuple[str, ...]
    """What is wrong with the points themselves."""

    @property
    def faults(self) -> list[str]:
        out = list(self.misplaced)
        for texel in self.texels:
            if texel.fails:
                out.append(
                    f"texel {texel.place}: {numbers(texel.found)} instead of {numbers(texel.right)}, "
                    f"{np.abs(texel.z).max():.1f} sigma"
                )
        return out


def numbers(values: Floats) -> str:
    return "(" + ", ".join(f"{value:.4g}" for value in values) + ")"


def z_score(found: Floats, right: Floats, sigma: Floats) -> Floats:
    """Deviations in standard errors of at least ROUNDING; 0 where both are the same number."""
    difference = found - right
    return np.where(difference == 0.0, 0.0, difference / np.maximum(sigma, ROUNDING * np.abs(right) + 1e-30))


def prepared(scene: RandomScene, folder: Path) -> tuple[Scene, TexelMap]:
    """What the prepare stage makes of the scene's file."""
    entry, environment = write_scene(scene, folder), None
    if scene.sky is not None:
        exr.write_rgb(folder / "sky.exr", sky_pixels(scene))
        environment = EnvironmentRef(file="sky.exr", scale=scene.sky.scale, rotation_deg=scene.sky.rotation_deg)
    settings = LightmapSettings(density=5.0 / scene.unit, least=32, most=128)
    loaded = part_sheets(check_light(load_scene(folder, entry, environment)))
    lightmap = make_lightmap(loaded, settings)
    return lightmap.scene, build_texel_map(lightmap.scene, lightmap.resolution)


def sky_pixels(scene: RandomScene) -> npt.NDArray[np.float32]:
    """The unscaled sky as viewers of glTF place an image (three.js, `equirectUv`): u = atan(z, x) / 2 pi + 1/2."""
    assert scene.sky is not None
    height = SKY_WIDTH // 2
    longitude = 2.0 * np.pi * ((np.arange(SKY_WIDTH)[None, :] + 0.5) / SKY_WIDTH - 0.5)
    latitude = np.pi * (0.5 - (np.arange(height)[:, None] + 0.5) / height)
    flat = np.cos(latitude)
    y = np.broadcast_to(np.sin(latitude), (height, SKY_WIDTH))
    directions = np.stack([flat * np.cos(longitude), y, flat * np.sin(longitude)], axis=-1)
    return scene.sky.radiance(directions).astype(np.float32)


def chosen(texel_map: TexelMap, count: int, random: np.random.Generator) -> list[tuple[int, int]]:
    """Random texels: of a random mesh, so that small ones have their turn, or of all alike."""
    valid = np.argwhere(texel_map.state == TexelState.VALID)
    meshes = texel_map.mesh[tuple(valid.T)]
    out: list[tuple[int, int]] = []
    for number in range(count):
        pool = valid
        if number % 2:
            pool = valid[meshes == random.choice(np.unique(meshes))]
        row, column = pool[int(random.integers(len(pool)))]
        out.append((int(row), int(column)))
    return out


class Comparison:
    """A random scene in the product and in Mitsuba."""

    def __init__(self, description: RandomScene, scene: Scene, texel_map: TexelMap) -> None:
        self.description, self.scene, self.map = description, scene, texel_map
        self.mitsuba = PlainMitsuba(description, DEPTH)

    def own_point(self, place: tuple[int, int]) -> tuple[Floats, Floats, Floats]:
        """A texel's first ray's origin, in the description's coordinates, its normal and its shading normal."""
        position = self.map.position[place].astype(np.float64)
        normal, shading = (values[place].astype(np.float64) for values in (self.map.normal, self.map.shading_normal))
        position = position + np.array(self.scene.origin) + 2e-4 * float(self.map.texel_size[place]) * normal
        return (position - self.description.offset) / self.description.unit, normal, shading

    def misplacement(self, place: tuple[int, int]) -> str:
        """Why the texel's point is on no surface of the description that faces as it does; empty if it is on one."""
        position, normal, _ = self.own_point(place)
        size = float(self.map.texel_size[place]) / self.description.unit
        corners = np.concatenate(self.mitsuba.triangles)
        distance = distances(position, corners)
        cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        facing = (cross / np.linalg.norm(cross, axis=1, keepdims=True)) @ normal
        near = distance < 0.8 * size + 1e-4 * RADIUS / self.mitsuba.magnification
        if (near & (facing > 0.999)).any():
            return ""
        best = facing[near].max(initial=-1.0)
        return f"texel {place}: its point is on no surface (nearest {distance.min():.3g}, best cosine {best:.4f})"

    def product(self, places: list[tuple[int, int]], paths: int, first: int) -> Floats:
        """Irradiance [T, BLOCKS, 3] of independent blocks: the same points under other numbers."""
        rows, columns = (np.array(values, dtype=np.int64) for values in zip(*places, strict=True))
        settings = RenderSettings(image_size=16, samples=1, irradiance_samples=paths, max_depth=DEPTH)
        renderer = TileRenderer(self.scene, scene_hash(self.scene, settings), settings, MEMORY, "cpu")
        order = np.repeat(np.arange(len(places)), BLOCKS)
        batch = TexelBatch.of(self.map, (rows[order], columns[order]))
        index = (first + np.arange(len(order))).astype(np.int64)
        moved = TexelBatch(
            index, *(getattr(batch, name) for name in TexelBatch.__dataclass_fields__ if name != "index")
        )
        return renderer.render_irradiance(moved)[0].astype(np.float64).reshape(len(places), BLOCKS, 3)

    def right(self, place: tuple[int, int], paths: int, seed: int) -> Floats:
        """Mitsuba's irradiance [BLOCKS, 3]."""
        position, normal, shading = self.own_point(place)
        return self.mitsuba.irradiance(position, normal, shading, seed, BLOCKS, paths)

    def texels(self, places: list[tuple[int, int]]) -> tuple[Texel, ...]:
        """The comparisons at some places; doubtful ones are made again."""
        own, mitsuba = BLOCK_PATHS
        found = self.product(places, own, 0)
        out = [
            compared(p, f, self.right(p, mitsuba, 1000 + k)) for k, (p, f) in enumerate(zip(places, found, strict=True))
        ]
        doubtful = [k for k, texel in enumerate(out) if texel.doubtful]
        if doubtful:
            again = self.product([places[k] for k in doubtful], AGAIN * own, 1 << 20)
            for k, values in zip(doubtful, again, strict=True):
                second = compared(places[k], values, self.right(places[k], AGAIN * mitsuba, 2000 + k))
                out[k] = Texel(second.place, second.found, second.right, second.sigma, True, out[k].z)
        return tuple(out)


def compared(place: tuple[int, int], found: Floats, right: Floats) -> Texel:
    """From blocks [B, 3] of both."""
    variance = sum(values.var(axis=0, ddof=1) / len(values) for values in (found, right))
    z = z_score(found.mean(axis=0), right.mean(axis=0), np.sqrt(variance))
    return Texel(place, found.mean(axis=0), right.mean(axis=0), np.sqrt(variance), first_z=z)


def distances(point: Floats, corners: Floats) -> Floats:
    """Metres [F] from a point to triangles [F, 3, 3] (to the plane inside of them, else to the nearest edge)."""
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    edges = []
    for start, end in ((a, b), (b, c), (c, a)):
        along = end - start
        share = np.clip(np.einsum("fd,fd->f", point - start, along) / np.einsum("fd,fd->f", along, along), 0.0, 1.0)
        edges.append(np.linalg.norm(point - start - share[:, None] * along, axis=1))
    normal = np.cross(b - a, c - a)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    inside = np.ones(len(corners), bool)
    for start, end in ((a, b), (b, c), (c, a)):
        inside &= np.einsum("fd,fd->f", np.cross(end - start, point - start), normal) >= 0.0
    plane = np.abs(np.einsum("fd,fd->f", point - a, normal))
    return np.where(inside, plane, np.min(edges, axis=0))


def compare(description: RandomScene, count: int) -> Outcome:
    """A scene's comparisons at `count` random texels."""
    with tempfile.TemporaryDirectory() as folder:
        scene, texel_map = prepared(description, Path(folder))
    places = chosen(texel_map, count, np.random.default_rng((description.seed, 1)))
    comparison = Comparison(description, scene, texel_map)
    misplaced = [comparison.misplacement(place) for place in places]
    return Outcome(
        description.seed,
        frozenset(description.features),
        comparison.texels(places),
        tuple(message for message in misplaced if message),
    )


def as_json(outcome: Outcome) -> dict[str, Any]:
    return {
        "seed": outcome.seed,
        "features": sorted(outcome.features),
        "faults": outcome.faults,
        "texels": [
            {
                "place": texel.place,
                "found": [float(f"{value:.5g}") for value in texel.found],
                "right": [float(f"{value:.5g}") for value in texel.right],
                "sigma": float(f"{texel.sigma.max():.3g}"),
                "relative_sigma": float(f"{texel.sigma.max() / max(np.abs(texel.right).max(), 1e-30):.3g}"),
                "first_z": texel.first_z.round(2).tolist(),
                "z": texel.z.round(2).tolist(),
                "again": texel.again,
            }
            for texel in outcome.texels
        ],
    }
