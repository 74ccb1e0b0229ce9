"""Quality per second of the fit on a baked store: prints a table and writes JSON.

    python benchmarks/fit.py STORE_URL [--function light_field] [--steps 600 2500] [--lobes 16] [--json FILE]

Each row is one fit with its steps, wall and processor seconds, `log_mse_rel`, and next to it the error of fitting
a few texels each on its own by Adam: what this number of lobes can express of these light fields at all. No network
gets below that, so it tells a bad fit from a scene that is too hard.
"""

import argparse
import json
import time
from pathlib import Path

import numpy as np
import torch

from kiln_schemas.settings import FitSettings, Function
from kiln_schemas.tasks import Tile
from kiln_workers.fit import train as training
from kiln_workers.fit.lobes import constrain
from kiln_workers.fit.loss import jittered_directions, log_loss, step_weights
from kiln_workers.fit.metrics import exposure_of, texel_errors
from kiln_workers.fit.optimizer import one_cycle
from kiln_workers.fit.source import ArraySource, StoreSource
from kiln_workers.store.light_field import LightFieldStore


def load(url: str, function: Function) -> ArraySource:
    """All valid texels of a store, in memory."""
    store = LightFieldStore.open(url)
    texel_map = store.read_texel_map()
    size = store.tile_size
    height, width = store.shape
    tiles = [
        Tile(row=row, column=column, size=size, texels=0)
        for row in range(0, height, size)
        for column in range(0, width, size)
    ]
    source = StoreSource(store, function, texel_map["state"], texel_map["normal"], tiles)
    parts = range(len(source.counts))
    images = np.concatenate([source.images(k, np.arange(source.counts[k])) for k in parts])
    return ArraySource(images, np.concatenate([source.normals(k) for k in parts]))


def direct_error(source: ArraySource, function: Function, lobes: int, texels: int = 48, steps: int = 600) -> float:
    """log_mse_rel of some texels fitted one by one from the shared start, without a network."""
    rng = np.random.default_rng(0)
    count = min(texels, source.counts[0])
    chosen = [(k, rng.integers(0, source.counts[k])) for k in rng.integers(0, len(source.counts), count)]
    images = np.concatenate([source.images(tile, np.array([texel])) for tile, texel in chosen])
    normals = np.stack([source.normals(tile)[texel] for tile, texel in chosen])
    exposure = exposure_of(source, function)
    log_targets = torch.log1p(torch.from_numpy(images).float() * exposure).flatten(1, 2)
    normal = torch.from_numpy(normals)
    raw = torch.zeros(count, lobes, 7, requires_grad=True)
    optimizer = torch.optim.Adam([raw], betas=(0.9, 0.99))
    for step in range(steps):
        optimizer.param_groups[0]["lr"] = one_cycle(step, steps, 0.1)
        directions = jittered_directions(source.image_size, np.random.default_rng([1, step]))
        weights = step_weights(directions, normal, source.image_size)
        loss = log_loss(constrain(raw, normal), log_targets, directions, weights)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    result = constrain(raw, normal).detach().numpy().copy()
    result[..., 4:] /= exposure
    return texel_errors(result, images, normals, exposure).log_mse_rel


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("store_url")
    parser.add_argument("--function", type=Function, default=Function.LIGHT_FIELD)
    parser.add_argument("--steps", type=int, nargs="+", default=[600, 2500])
    parser.add_argument("--lobes", type=int, default=16)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    source = load(arguments.store_url, arguments.function)
    direct = direct_error(source, arguments.function, arguments.lobes)
    print(f"{sum(source.counts)} texels; fitted one by one: log_mse_rel {direct:.4f}")
    rows = []
    print(f"{'steps':>7} {'wall s':>8} {'cpu s':>8} {'log_mse_rel':>12}")
    for steps in arguments.steps:
        wall, processor = time.perf_counter(), time.process_time()
        settings = FitSettings(lobes=arguments.lobes, steps=steps)
        outcome = training.train(source, settings, arguments.function, 0, threads=arguments.threads)
        row = {
            "steps": steps,
            "wall_s": time.perf_counter() - wall,
            "cpu_s": time.process_time() - processor,
            "log_mse_rel": outcome.metrics.log_mse_rel,
        }
        rows.append(row)
        print(f"{steps:7d} {row['wall_s']:8.1f} {row['cpu_s']:8.1f} {row['log_mse_rel']:12.4f}")
    if arguments.json:
        arguments.json.write_text(json.dumps({"direct_log_mse_rel": direct, "fits": rows}, indent=1))


if __name__ == "__main__":
    main()
