"""The coherent descent and its loss: microseconds a texel and step, lobe-pixels a second; prints a table, writes JSON.

    python benchmarks/descent.py [--lobes 16] [--size 64] [--side 24] [--steps 40] [--json FILE]

Everything on one thread, processor time, best of three runs in turn. The loss as products of matrices (what was used
until November 2026, `reference_texel_losses`) is the yardstick of the compiled one.
"""

import argparse
import json
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch

from kiln_workers.fit.field import TexelField
from kiln_workers.fit.solvers.joint import CoherentOptions, descend
from kiln_workers.fit.solvers.losses import reference_texel_losses, texel_losses
from kiln_workers.fit.solvers.starts import shared_start
from kiln_workers.sphere import gaussian, octahedral

TEXELS, PIXELS = 64, 512
"""Of one call of the loss, as a step of the descent makes it."""


def floor(side: int, size: int) -> TexelField:
    """side x side texels of a floor under twenty lobes that turn from texel to texel."""
    rng = np.random.default_rng(0)
    place = np.argwhere(np.ones((side, side), bool))
    row, column = place.T.astype(np.float64)
    normals = np.tile(np.float32([0.0, 1.0, 0.0]), (len(place), 1))
    lobes = []
    for _ in range(20):
        towards = np.abs(rng.normal(size=3)) * (rng.choice([-1, 1]), 1, rng.choice([-1, 1]))
        axes = towards + 0.1 * rng.normal() * np.stack([column, 0.0 * row, row], axis=1)
        axes /= np.linalg.norm(axes, axis=1, keepdims=True)
        shape = [np.exp(rng.uniform(1.0, 5.0)), *np.exp(rng.normal(size=3))]
        lobes.append(np.concatenate([axes, np.tile(shape, (len(place), 1))], axis=1))
    directions = octahedral.pixel_directions(size).reshape(-1, 3)
    images = gaussian.evaluate(directions, np.stack(lobes, axis=1)) * (normals @ directions.T > 0.0)[..., None]
    chart = np.zeros(len(place), np.int64)
    return TexelField(images.reshape(-1, size, size, 3).astype(np.float16), normals, place, chart, 0.7)


def of_loss(lobes: int) -> dict[str, float]:
    """Thousands of millions of lobe-pixels a second of both losses."""
    rng = np.random.default_rng(0)

    def unit(*shape: int) -> np.ndarray:
        vectors = rng.normal(size=(*shape, 3))
        return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)

    sharpness, amplitudes = np.exp(rng.uniform(0, 5, (TEXELS, lobes, 1))), np.exp(rng.normal(size=(TEXELS, lobes, 3)))
    arrays = (
        np.concatenate([unit(TEXELS, lobes), sharpness, amplitudes], axis=-1),
        *(np.log1p(np.exp(rng.normal(size=(TEXELS, PIXELS, 3)))), unit(TEXELS, PIXELS)),
        rng.uniform(0.0, 1e-2, (TEXELS, PIXELS)),
    )
    arguments = [torch.from_numpy(array.astype(np.float32)) for array in arrays]
    work = TEXELS * PIXELS * lobes / 1e9
    return {
        "products of matrices": work / best(lambda: reference_texel_losses(*arguments)),
        "compiled": work / best(lambda: texel_losses(*arguments)),
    }


def of_descent(side: int, size: int, lobes: int, steps: int) -> float:
    """Microseconds of a processor a texel and step, without what is done once."""
    field = floor(side, size)
    start = shared_start(field, lobes)

    def run(count: int) -> None:
        descend(field, start, CoherentOptions(steps=count), 0)

    once = best(lambda: run(1), 3)
    return 1e6 * (best(lambda: run(steps + 1), 3) - once) / steps / len(field)


def best(work: Callable[[], object], runs: int = 20) -> float:
    """The least processor seconds of some runs, after one that compiles and warms caches."""
    work()
    seconds = []
    for _ in range(runs):
        began = time.process_time()
        work()
        seconds.append(time.process_time() - began)
    return min(seconds)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--lobes", type=int, default=16)
    parser.add_argument("--size", type=int, default=64, help="pixels along a side of a light field")
    parser.add_argument("--side", type=int, default=24, help="texels along a side of the floor")
    parser.add_argument("--steps", type=int, default=40)
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    torch.set_num_threads(1)
    rates = of_loss(options.lobes)
    step = of_descent(options.side, options.size, options.lobes, options.steps)
    print("| loss | lobe-pixels a second | |\n|---|---|---|")
    for name, rate in rates.items():
        print(f"| {name} | {rate:.3f} G | {rate / rates['products of matrices']:.1f} x |")
    print(f"\nA step of the descent: {step:.1f} us a texel ({options.lobes} lobes, images of {options.size}²)")
    if options.json:
        found = {
            "lobe_pixels_per_second": {name: 1e9 * rate for name, rate in rates.items()},
            "step_us_per_texel": step,
        }
        options.json.write_text(json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    main()
