"""How long the viewer takes to its first frame, and the bytes it loads: prints a table and writes JSON.

    python benchmarks/viewer.py PACKAGE [--resolution 512] [--size 960x540] [--gpu] [--json FILE]

The package's light maps are enlarged to `resolution` squared texels (bilinear, with noise in the last bits, so that
Zstandard gains nothing from the enlargement), plain and with Zstandard inside; at 512 and 16 lobes an array is 64 MiB.
Debian's chromium opens each on software GL, or with `--gpu` on what it finds. `read` is when all is fetched and
decoded; the longest task is how long the page's thread was busy at a stretch until then, while the worker decodes.
"""

import argparse
import json
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from playwright.sync_api import sync_playwright
from scipy import ndimage

from kiln_workers.package import ktx2

LIGHTKILN = Path(sys.executable).parent / "lightkiln"
SOFTWARE_GL = ("--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")
ENLARGED = ("lightfield.ktx2", "visibility.ktx2", "irradiance.ktx2")
WATCH = """
window.tasks = [];
new PerformanceObserver((list) => window.tasks.push(...list.getEntries()))
  .observe({ type: "longtask", buffered: true });
"""
READ = """new Promise((done) => setTimeout(() => {
  const [{ startTime: read }] = performance.getEntriesByName("package read");
  const before = tasks.filter(({ startTime, duration }) => startTime + duration <= read);
  done([read, Math.max(0, ...before.map(({ duration }) => duration))]);
}, 300))"""


def enlarge(package: Path, folder: Path, resolution: int, zstd: bool) -> Path:
    """The package with larger light maps."""
    shutil.copytree(package, folder)
    manifest = json.loads((folder / "manifest.json").read_text())
    random = np.random.default_rng(0)
    for name in ENLARGED:
        if name not in manifest["textures"]:
            continue
        texture = ktx2.read(folder / name)
        layers = texture.levels[0][:, 0].astype(np.float32)
        factor = resolution / layers.shape[1]
        out = np.empty((len(layers), resolution, resolution, 4), np.float16)
        for number, layer in enumerate(layers):
            large = ndimage.zoom(layer, (factor, factor, 1), order=1, grid_mode=True, mode="nearest")
            out[number] = np.clip(large * (1.0 + random.uniform(-1e-3, 1e-3, large.shape)), -65504, 65504)
        array = ktx2.texture_array if len(out) > 1 else lambda pixels, about: ktx2.texture_2d(pixels[0], about)
        ktx2.write(folder / name, array(out, dict(texture.metadata)), supercompress=zstd)
        manifest["textures"][name] |= {"width": resolution, "height": resolution}
    (folder / "manifest.json").write_text(json.dumps(manifest))
    return folder


def measure(folder: Path, width: int, height: int, gpu: bool) -> dict[str, Any]:
    """One load in a fresh browser."""
    with (
        subprocess.Popen([LIGHTKILN, "view", str(folder)], stdout=subprocess.PIPE, text=True) as server,
        sync_playwright() as playwright,
    ):
        try:
            assert server.stdout is not None
            url = server.stdout.readline().strip()
            browser = playwright.chromium.launch(
                executable_path="/usr/bin/chromium", args=["--no-sandbox", *(() if gpu else SOFTWARE_GL)]
            )
            page = browser.new_page(viewport={"width": width, "height": height})
            page.set_default_timeout(300_000)
            page.add_init_script(WATCH)
            page.goto(url)
            first = page.evaluate("viewer.then((picture) => picture.firstFrame)")
            renderer = page.evaluate("viewer.then(({ renderer }) => renderer.getContext().getParameter(0x1f01))")
            read, longest = page.evaluate(READ)
            browser.close()
        finally:
            server.terminate()
    return {
        "mebibytes": round(first["bytes"] / 2**20, 1),
        "read_s": round(read / 1000, 2),
        "first_frame_s": round(first["milliseconds"] / 1000, 2),
        "longest_task_s": round(longest / 1000, 2),
        "renderer": renderer,
    }


def main() -> None:
    """Both kinds of file, one after the other."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("package", type=Path)
    parser.add_argument("--resolution", type=int, default=512)
    parser.add_argument("--size", default="960x540")
    parser.add_argument("--gpu", action="store_true")
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    width, height = (int(part) for part in options.size.split("x"))
    results = {}
    print(f"{'':8}{'MiB':>8}{'read s':>10}{'first frame s':>16}{'longest task s':>16}")
    with tempfile.TemporaryDirectory() as base:
        for name, zstd in (("plain", False), ("zstd", True)):
            folder = enlarge(options.package, Path(base) / name, options.resolution, zstd)
            told = results[name] = measure(folder, width, height, options.gpu)
            print(
                f"{name:8}{told['mebibytes']:8}{told['read_s']:10}{told['first_frame_s']:16}{told['longest_task_s']:16}",
                flush=True,
            )
            shutil.rmtree(folder)
    print(results["plain"]["renderer"])
    if options.json:
        options.json.write_text(json.dumps(results, indent=2) + "\n")


if __name__ == "__main__":
    main()
