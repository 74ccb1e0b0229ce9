"""Bakes scenes as they come and compares a picture of each package with a path-traced one.

    python benchmarks/public_scenes.py FOLDER --env HDR --out FOLDER [--json FILE]

FOLDER holds scenes (.glb, .gltf, .obj, .ply ...), also in folders of their own. Each is baked by
`lightkiln bake SCENE --env HDR --preset draft` and nothing more. The camera is that of the report's picture. In
OUT/NAME.png the shaded package is on the left, the path-traced scene on the right. What is in OUT already is not baked
again.

- covered: part of the light map that charts touch. specks: part of that in charts of four texels or fewer.
- FLIP: mean HDR-FLIP of the shaded package against the path-traced picture; noise: what FLIP the noise of the latter
  would show by itself.
"""

import argparse
import json
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from kiln_schemas.errors import InputError
from kiln_workers.package.colour import white_point
from kiln_workers.scene.load import load_scene
from kiln_workers.shade.image_files import write_picture
from kiln_workers.shade.image_metrics import flip
from kiln_workers.shade.package import read_exr

SUFFIXES: Final = {".glb", ".gltf", ".obj", ".ply", ".stl", ".off", ".dae", ".fbx", ".xml"}
SIZE: Final = "480x360"


def lightkiln(*words: str) -> subprocess.CompletedProcess[str]:
    """A command of lightkiln, as a user calls it."""
    program = str(Path(sys.executable).with_name("lightkiln"))
    return subprocess.run([program, *words], capture_output=True, text=True, stdin=subprocess.DEVNULL)


def bake(scene: Path, environment: Path, out: Path, samples: int) -> dict[str, Any]:
    """Bake, shade and path-trace one scene; what came of it, for the table."""
    name = scene.stem
    package = out / name
    row: dict[str, Any] = {"scene": name}
    kept = out / f"{name}.json"
    if kept.exists():
        return dict(json.loads(kept.read_text()))
    try:
        row["triangles"] = load_scene(scene.parent, scene.name).triangles
    except InputError as error:
        return row | {"fault": str(error)}
    sky = ["--env", str(environment)]
    began = time.monotonic()
    done = lightkiln("bake", str(scene), *sky, "--preset", "draft", "--out", str(package), "--force")
    row["seconds"] = round(time.monotonic() - began, 1)
    if done.returncode:
        return row | {"fault": (done.stderr.strip().splitlines() or [f"exit code {done.returncode}"])[-1]}
    manifest = json.loads((package / "manifest.json").read_text())
    lightmap = manifest["lightmap"]
    row |= {
        "charts": lightmap["charts"],
        "specks": lightmap["speck_share"],
        "log_mse_rel": manifest["metrics"]["light_field"]["log_mse_rel"],
    }
    row["size"] = lightmap["width"]
    row["covered"] = lightmap["covered"] / (lightmap["width"] * lightmap["height"])
    if not manifest["views"]:
        return row | {"fault": "the report has no picture of it"}
    camera = out / f"{name}-camera.json"
    camera.write_text(json.dumps(next(iter(manifest["views"].values()))["camera"]))
    shaded, traced = out / f"{name}-shaded.exr", out / f"{name}-traced.exr"
    view = ["--camera", str(camera), "--size", SIZE, "--json"]
    for command in (
        ["shade", str(package), *view, "--out", str(shaded)],
        ["reference", str(scene), *sky, *view, "--samples", str(samples), "--out", str(traced)],
    ):
        done = lightkiln(*command)
        if done.returncode:
            return row | {"fault": f"{command[0]}: {(done.stderr.strip().splitlines() or ['no word'])[-1]}"}
    row["noise"] = json.loads(done.stdout)["flip_noise_floor"]
    left, right = read_exr(shaded), read_exr(traced)
    row["flip"] = flip(right, left)
    write_picture(out / f"{name}.png", np.concatenate([left, right], axis=1), white_point(right))
    kept.write_text(json.dumps(row, indent=1) + "\n")
    return row


def table(rows: Sequence[dict[str, Any]]) -> Iterator[str]:
    """Lines of Markdown."""
    yield "| scene | triangles | charts | light map | covered | specks | seconds | log_mse_rel | FLIP | of it noise |"
    yield "|---|---|---|---|---|---|---|---|---|---|"
    for row in rows:
        if "fault" in row:
            yield f"| {row['scene']} | {row.get('triangles', '')} | **{row['fault']}** | | | | | | | |"
            continue
        numbers = f"{row['covered']:.2f} | {row['specks']:.2f} | {row['seconds']:.0f} | {row['log_mse_rel']:.3f}"
        yield (
            f"| {row['scene']} | {row['triangles']:,} | {row['charts']} | {row['size']}² | {numbers} "
            f"| {row['flip']:.3f} | {row['noise']:.3f} |"
        )


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--env", type=Path, required=True)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--samples", type=int, default=128, help="paths a pixel of the path-traced pictures")
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    rows = []
    for scene in sorted(path for path in options.folder.rglob("*") if path.suffix.lower() in SUFFIXES):
        rows.append(bake(scene, options.env, options.out, options.samples))
        print(rows[-1], flush=True)
    print("\n".join(table(rows)))
    if options.json:
        options.json.write_text(json.dumps(rows, indent=1) + "\n")
    return 1 if any("fault" in row for row in rows) else 0


if __name__ == "__main__":
    sys.exit(main())
