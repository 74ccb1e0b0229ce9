"""Charts, stretch, coverage and seconds of unwrappers on real models: prints tables and writes JSON.

    python benchmarks/atlas.py FOLDER [--preset draft] [--json FILE] [--slow]

FOLDER holds scenes (.glb, .gltf, .obj, .ply), also in folders of their own. Each is unwrapped by xatlas as it comes, by
xatlas with a higher `max_cost` (larger charts), and by what lightkiln uses; `--slow` gives xatlas scenes of more than
60,000 triangles as well, which take it minutes. Then lightkiln lays out the light map with the preset's `auto`.

- stretch: the root mean square of the singular values of the map from the chart to the surface (Sander, Snyder, Gortler
  and Hoppe 2001, L2), over the surface, with the chart's area made equal to the surface's: 1 is none.
- missing: triangles that the unwrapper gave no chart.
- covered: part of the light map that charts touch. specks: part of that in charts of four texels or fewer.
"""

import argparse
import json
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import xatlas

from kiln_schemas.settings import PRESETS, UvPolicy
from kiln_workers.scene.atlas import make_lightmap
from kiln_workers.scene.geometry import face_areas
from kiln_workers.scene.load import load_scene
from kiln_workers.scene.model import Mesh, Scene
from kiln_workers.scene.texel_map import speck_share
from kiln_workers.scene.texels import rasterise_texels
from kiln_workers.scene.unwrap import cut_into_charts

SUFFIXES = {".glb", ".gltf", ".obj", ".ply"}
LARGE = 60_000
Charts = tuple[np.ndarray, np.ndarray]  # uv [F, 3, 2] in metres, chart [F] or -1


def by_xatlas(meshes: Sequence[Mesh], **options: float) -> list[Charts]:
    """xatlas with positions scaled so that its absolute thresholds do not count."""
    atlas = xatlas.Atlas()
    scale = 1e3 / np.sqrt(sum(face_areas(mesh.positions, mesh.faces).sum() for mesh in meshes))
    for mesh in meshes:
        atlas.add_mesh((mesh.positions * scale).astype(np.float32), mesh.faces.astype(np.uint32), mesh.normals)
    charts, packs = xatlas.ChartOptions(), xatlas.PackOptions()
    for name, value in options.items():
        setattr(charts, name, value)
    packs.padding, packs.texels_per_unit = 0, 0.5
    packs.bilinear = packs.bruteForce = packs.create_image = False
    atlas.generate(charts, packs)
    out = []
    for number in range(len(meshes)):
        _, faces, uv = atlas[number]
        pages, chart = atlas.get_mesh_vertex_assignment(number)
        own = np.where(pages < 2**31, chart.astype(np.int64), -1)
        out.append((uv[faces] * np.array([atlas.width, atlas.height]) / (0.5 * scale), own[faces].min(axis=1)))
    return out


def by_lightkiln(meshes: Sequence[Mesh]) -> list[Charts]:
    parts = cut_into_charts(meshes)
    return [(part.uv[part.faces], part.chart[part.faces[:, 0]]) for part in parts]


UNWRAPPERS: dict[str, Callable[[Sequence[Mesh]], list[Charts]]] = {
    "xatlas": by_xatlas,
    "xatlas max_cost 8": lambda meshes: by_xatlas(meshes, max_cost=8.0),
    "uvunwrap": by_lightkiln,
}


def stretch(mesh: Mesh, uv: np.ndarray) -> tuple[float, float]:
    """L2 stretch squared times the mesh's area, and that area."""
    a, b, c = np.moveaxis(mesh.positions.astype(np.float64)[mesh.faces], 1, 0)
    length = np.maximum(np.linalg.norm(b - a, axis=1), 1e-30)
    along = ((c - a) * (b - a)).sum(axis=1) / length
    height = np.sqrt(np.maximum(((c - a) ** 2).sum(axis=1) - along**2, 0.0))
    flat = np.stack([uv[:, 1] - uv[:, 0], uv[:, 2] - uv[:, 0]], axis=2)
    area, flat_area = 0.5 * length * height, 0.5 * np.abs(np.linalg.det(flat))
    good = flat_area > 1e-6 * area
    surface = np.stack([np.stack([length, along], 1), np.stack([0 * length, height], 1)], axis=1)
    jacobian = surface[good] @ np.linalg.inv(flat[good])
    mean = 0.5 * (jacobian**2).sum(axis=(1, 2))
    return float((mean * area[good]).sum() * flat_area[good].sum() / area[good].sum()), float(area[good].sum())


def measure(name: str, scene: Scene, slow: bool) -> dict[str, Any]:
    out = {}
    for label, unwrap in UNWRAPPERS.items():
        if label.startswith("xatlas") and scene.triangles > LARGE and not slow:
            continue
        began = time.perf_counter()
        charts = unwrap(scene.meshes)
        seconds = time.perf_counter() - began
        rows = [stretch(mesh, uv) for mesh, (uv, _) in zip(scene.meshes, charts, strict=True)]
        total = sum(area for _, area in rows)
        out[label] = {
            "charts": int(sum(np.unique(chart[chart >= 0]).size for _, chart in charts)),
            "missing": int(sum((chart < 0).sum() for _, chart in charts)),
            "stretch": float(np.sqrt(sum(value for value, _ in rows) / total)),
            "seconds": seconds,
        }
    return {"name": name, "triangles": scene.triangles, "meshes": len(scene.meshes), "unwrappers": out}


def laid_out(scene: Scene, preset: str) -> dict[str, Any]:
    settings = PRESETS[preset].lightmap.model_copy(update={"uv": UvPolicy.UNWRAP})
    began = time.perf_counter()
    made = make_lightmap(scene, settings)
    seconds = time.perf_counter() - began
    texels = rasterise_texels(made.scene, made.resolution)
    return {
        "resolution": made.resolution,
        "charts": int(np.unique(texels.chart).size - 1),
        "covered": texels.covered / made.resolution**2,
        "specks": speck_share(texels.chart),
        "texel_m": float(np.median(texels.texel_size[texels.chart >= 0])),
        "seconds": seconds,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--preset", default="draft", choices=list(PRESETS))
    parser.add_argument("--json", type=Path)
    parser.add_argument("--slow", action="store_true")
    options = parser.parse_args()
    rows = []
    labels = list(UNWRAPPERS)
    print("| model | triangles | charts | stretch | missing | seconds | light map | covered | specks | seconds |")
    print("|---|---|---|---|---|---|---|---|---|---|")
    for path in sorted(path for path in options.folder.rglob("*") if path.suffix in SUFFIXES):
        scene = replace(load_scene(path.parent, path.name, None), notes=())
        row = measure(path.stem, scene, options.slow) | {"lightmap": laid_out(scene, options.preset)}
        rows.append(row)
        found = [row["unwrappers"].get(label, {}) for label in labels]
        cells = [
            " / ".join(f"{item[key]:{form}}" if item else "-" for item in found)
            for key, form in (("charts", ""), ("stretch", ".3f"), ("missing", ""), ("seconds", ".1f"))
        ]
        made = row["lightmap"]
        cells += [f"{made['resolution']}²", f"{made['covered']:.2f}", f"{made['specks']:.2f}", f"{made['seconds']:.1f}"]
        print(f"| {row['name']} | {row['triangles']:,} | {' | '.join(cells)} |", flush=True)
    if options.json:
        options.json.write_text(json.dumps({"preset": options.preset, "models": rows}, indent=1) + "\n")


if __name__ == "__main__":
    main()
