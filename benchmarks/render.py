"""How fast the renderer traces: paths per second by scene, beside Mitsuba's own `path` integrator in the same run.

    python benchmarks/render.py [--json FILE] [--texels 256] [--image-size 32] [--samples 16]

A path counts when its first direction is above the texel's horizon. The reference traces as many paths of the same
depth from one of the texels, uniform over the hemisphere, without storing images. Times are the best of three. The last
column is the growth of the process's peak memory per lane when a wavefront is made larger.
"""

import argparse
import json
import resource
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from kiln_schemas.settings import RenderSettings
from kiln_workers.render.backend import device_summary, select_variant
from kiln_workers.render.jit import dr, mi
from kiln_workers.render.mitsuba_scene import to_mitsuba
from kiln_workers.render.tile import TexelBatch, TileRenderer, lanes_above_horizon
from kiln_workers.scene.model import Environment, Material, Mesh, Scene

DEPTH, REPEATS = 6, 3


def quad(origin: Any, a: Any, b: Any, material: int) -> Mesh:
    o, a, b = (np.asarray(v, np.float32) for v in (origin, a, b))
    normal = np.cross(a, b) / np.linalg.norm(np.cross(a, b))
    corners = np.stack([o, o + a, o + a + b, o + b])
    faces = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
    return Mesh("quad", corners, np.repeat(normal[None], 4, axis=0).astype(np.float32), faces, material)


def sphere(centre: Any, radius: float, rings: int, material: int) -> Mesh:
    """A sphere of 4 * rings^2 triangles with smooth normals."""
    theta, phi = np.meshgrid(np.linspace(0, np.pi, rings + 1), np.linspace(0, 2 * np.pi, 2 * rings + 1), indexing="ij")
    normals = np.stack([np.sin(theta) * np.sin(phi), np.cos(theta), np.sin(theta) * np.cos(phi)], -1).reshape(-1, 3)
    corner = (np.arange(rings)[:, None] * (2 * rings + 1) + np.arange(2 * rings)).ravel()
    below = corner + 2 * rings + 1
    faces = np.concatenate([np.stack([corner, below, below + 1], -1), np.stack([corner, below + 1, corner + 1], -1)])
    positions = (np.asarray(centre) + radius * normals).astype(np.float32)
    return Mesh("sphere", positions, normals.astype(np.float32), faces.astype(np.int32), material)


def cornell(spheres: int = 0, rings: int = 0, sky: bool = False) -> Scene:
    materials = (
        Material("white", (0.7, 0.7, 0.7, 1.0)),
        Material("red", (0.6, 0.1, 0.1, 1.0)),
        Material("green", (0.1, 0.5, 0.1, 1.0)),
        Material("lamp", (0.0, 0.0, 0.0, 1.0), emission=(8.0, 7.0, 6.0)),
        Material("metal", (0.9, 0.8, 0.6, 1.0), metallic=1.0, roughness=0.4),
    )
    meshes = [
        quad((0, 0, 0), (0, 0, 1), (1, 0, 0), 0),
        quad((0, 0, 0), (1, 0, 0), (0, 1, 0), 4),
        quad((0, 0, 0), (0, 1, 0), (0, 0, 1), 1),
        quad((1, 0, 0), (0, 0, 1), (0, 1, 0), 2),
        quad((0.35, 0.99, 0.35), (0.3, 0, 0), (0, 0, 0.3), 3),
    ]
    random = np.random.default_rng(1)
    for _ in range(spheres):
        centre = random.uniform((0.1, 0.15, 0.1), (0.9, 0.8, 0.9))
        meshes.append(sphere(centre, 0.06, rings, int(random.choice([0, 1, 2, 4]))))
    if not sky:
        return Scene((*meshes, quad((0, 1, 0), (1, 0, 0), (0, 0, 1), 0)), materials)
    pixels = np.full((64, 128, 3), 0.5, np.float32)
    pixels[10, 40] = 500.0
    return Scene(tuple(meshes), materials, environment=Environment(pixels))


def floor_texels(count: int) -> TexelBatch:
    points = np.random.default_rng(2).uniform((0.05, 0.0, 0.05), (0.95, 0.0, 0.95), (count, 3)).astype(np.float32)
    up = np.tile(np.array([[0, 1, 0]], np.float32), (count, 1))
    alpha = np.full(count, 0.3, np.float32)
    return TexelBatch(np.arange(count, dtype=np.int64), points, up, up, alpha, np.full(count, 0.05, np.float32))


def best(task: Callable[[int], Any]) -> float:
    times = []
    for attempt in range(REPEATS + 1):
        start = time.perf_counter()
        task(attempt)
        times.append(time.perf_counter() - start)
    return min(times[1:])


def reference_rate(scene: Scene, paths: int) -> float:
    """Paths per second of Mitsuba's integrator from a point on the floor."""
    world = to_mitsuba(scene)
    integrator = mi.load_dict({"type": "path", "max_depth": DEPTH + 1, "rr_depth": 4})

    def task(seed: int) -> None:
        sampler = mi.load_dict({"type": "independent"})
        sampler.seed(seed, paths)
        local = mi.warp.square_to_uniform_hemisphere(sampler.next_2d())
        ray = mi.RayDifferential3f(mi.Point3f(0.37, 1e-4, 0.58), mi.Vector3f(local.x, local.z, local.y))
        dr.eval(integrator.sample(world, sampler, ray)[0])
        dr.sync_thread()

    return paths / best(task)


def peak_bytes() -> int:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


def measure(name: str, scene: Scene, settings: RenderSettings, count: int) -> dict[str, Any]:
    texels = floor_texels(count)
    tile = TileRenderer(scene, "5" * 64, settings, 1 << 30)
    paths = len(lanes_above_horizon(texels.normal, settings.image_size)) * settings.samples

    seconds = best(lambda _: tile.render_light_fields(texels))
    whole = best(lambda _: tile.render(texels))
    reference = reference_rate(scene, min(paths, 2_000_000))
    return {
        "scene": name,
        "triangles": scene.triangles,
        "paths": paths,
        "light_field_paths_per_s": paths / seconds,
        "mitsuba_path_paths_per_s": reference,
        "ratio": paths / seconds / reference,
        "ms_per_texel_all_images": 1e3 * whole / count,
    }


def bytes_per_lane(scene: Scene) -> float:
    """Growth of peak memory from wavefronts of 2^14 lanes to one of all lanes, per lane."""
    settings = RenderSettings(image_size=128, samples=8, irradiance_samples=1)
    texels = floor_texels(256)
    lanes = len(lanes_above_horizon(texels.normal, settings.image_size))
    tile = TileRenderer(scene, "5" * 64, settings, 1 << 30)
    tile.wavefront = 1 << 14
    tile.render(texels)
    before = peak_bytes()
    tile.wavefront = lanes
    tile.render(texels)
    return (peak_bytes() - before) / lanes


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path)
    parser.add_argument("--texels", type=int, default=256)
    parser.add_argument("--image-size", type=int, default=32)
    parser.add_argument("--samples", type=int, default=16)
    options = parser.parse_args()
    select_variant()
    settings = RenderSettings(
        image_size=options.image_size, samples=options.samples, irradiance_samples=256, max_depth=DEPTH
    )
    memory = bytes_per_lane(cornell(sky=True))
    scenes = {
        "cornell, lamp": cornell(),
        "cornell, sky": cornell(sky=True),
        "40 spheres, lamp": cornell(40, 25),
        "40 spheres, sky": cornell(40, 25, sky=True),
    }
    print(f"{'scene':<18}{'triangles':>10}{'M paths/s':>11}{'mi path':>9}{'ratio':>7}{'ms/texel, all':>15}")
    rows = []
    for name, scene in scenes.items():
        row = measure(name, scene, settings, options.texels)
        rows.append(row)
        print(
            f"{name:<18}{row['triangles']:>10}{row['light_field_paths_per_s'] / 1e6:>11.2f}"
            f"{row['mitsuba_path_paths_per_s'] / 1e6:>9.2f}{row['ratio']:>7.2f}{row['ms_per_texel_all_images']:>15.2f}",
            flush=True,
        )
    print(f"memory: {memory:.0f} bytes per lane of a wavefront")
    if options.json:
        report = {"device": device_summary(), "bytes_per_lane": memory, "rows": rows}
        options.json.write_text(json.dumps(report, indent=2) + "\n")


if __name__ == "__main__":
    main()
