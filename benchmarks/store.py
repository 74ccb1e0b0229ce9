"""How fast the light-field store writes and reads tiles: prints a table and writes JSON.

    python benchmarks/store.py [--image-size 64] [--tiles 8] [--url file:///DIR] [--json FILE]

Whole tiles of random radiance are written, read back in full and read texel by texel. Reads come from the page cache.
"""

import argparse
import json
import tempfile
import time
from pathlib import Path

import numpy as np

from kiln_schemas.settings import Function
from kiln_schemas.tasks import Tile
from kiln_workers.store.light_field import LightFieldStore

TILE = 16


def measure(url: str, size: int, tiles: int) -> dict[str, float]:
    """Megabytes a second of each way of access."""
    functions = tuple(Function)
    store = LightFieldStore.create(
        url, shape=(TILE, TILE * tiles), image_size=size, tile=TILE, functions=functions, attributes={}
    )
    covered = np.arange(TILE * TILE)
    images = np.random.default_rng(0).random((len(covered), size, size, 3)).astype(np.float16)
    irradiance = np.ones((len(covered), 3), np.float32)
    places = [Tile(row=0, column=TILE * k, size=TILE, texels=len(covered)) for k in range(tiles)]
    megabytes = tiles * images.nbytes / 1e6

    def timed(work: "list[Tile]", action: object) -> float:
        began = time.perf_counter()
        for place in work:
            action(place)  # type: ignore[operator]
        return time.perf_counter() - began

    seconds = timed(places, lambda place: store.write_tile(place, covered, images, images, irradiance))
    out = {"write_both_mb_s": 2 * megabytes / seconds}
    for function in functions:
        seconds = timed(places, lambda place, f=function: store.read_tile(f, place, covered))
        out[f"read_{function.value}_mb_s"] = megabytes / seconds
    every_eighth = covered[::8]
    seconds = timed(places, lambda place: store.read_tile(Function.LIGHT_FIELD, place, every_eighth))
    out["read_every_8th_texel_mb_s"] = megabytes / 8 / seconds
    return out


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--image-size", type=int, default=64)
    parser.add_argument("--tiles", type=int, default=8)
    parser.add_argument("--url")
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        url = arguments.url or f"file://{folder}/store"
        results = measure(url, arguments.image_size, arguments.tiles)
    for name, value in results.items():
        print(f"{name:28} {value:8.0f}")
    if arguments.json:
        arguments.json.write_text(json.dumps(results, indent=1))


if __name__ == "__main__":
    main()
