"""Irradiance of random scenes in the product and in plain Mitsuba, texel by texel, as a table.

    make differential
    python tests/differential/differential.py [--first SEED] [--scenes N] [--jobs N] [--json FILE] [--page FILE]

`random_scenes` says what the scenes are, `plain_mitsuba` what the right value is, `comparison` when a texel fails.
"""

import argparse
import json
import multiprocessing
import sys
import time
import traceback
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from kiln_schemas.errors import InputError

TEXELS: Final = 4
"""A scene."""
MARKS: Final = ("<!-- begin of the table that make differential writes -->", "<!-- end of the table -->")


def measured(seed: int) -> dict[str, Any]:
    """A scene's comparisons, or why there are none."""
    from kiln_workers.render.backend import select_variant

    select_variant("cpu")
    from comparison import as_json, compare
    from random_scenes import make_scene

    began = time.process_time()
    description = make_scene(seed)
    try:
        out = as_json(compare(description, TEXELS))
    except InputError as refusal:
        out = _without_values(seed, description.features, f"refused: {refusal}")
    except Exception:
        out = _without_values(seed, description.features, "crashed: " + traceback.format_exc(limit=-2))
    return out | {"cpu_s": round(time.process_time() - began, 1)}


def _without_values(seed: int, features: set[str], fault: str) -> dict[str, Any]:
    return {"seed": seed, "features": sorted(features), "faults": [fault], "texels": []}


def summary(scenes: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Counts, and how the first deviations z are distributed; texels that are 0 in both count as equal, not in z."""
    texels = [texel for scene in scenes for texel in scene["texels"]]
    first = np.array([z for texel in texels for z in texel["first_z"] if texel["sigma"] > 0.0])
    final = np.array([max(abs(z) for z in texel["z"]) for texel in texels])
    kinds = Counter(fault.split(":")[0].split(" (")[0] for scene in scenes for fault in scene["faults"])
    return {
        "scenes": len(scenes),
        "scenes_with_faults": sum(bool(scene["faults"]) for scene in scenes),
        "texels": len(texels),
        "texels_dark_in_both": sum(texel["sigma"] == 0.0 for texel in texels),
        "texels_measured_again": sum(texel["again"] for texel in texels),
        "faults": dict(Counter(kind.split()[0] for kind in kinds.elements())),
        "largest_z": round(float(final.max(initial=0.0)), 2),
        "z_mean": round(float(first.mean()), 3) if len(first) else None,
        "z_standard_deviation": round(float(first.std()), 3) if len(first) else None,
        "z_half_width_of_central_68_percent": round(float(np.subtract(*np.percentile(first, [84.13, 15.87]))) / 2.0, 3)
        if len(first)
        else None,
        "z_beyond_2": round(float((np.abs(first) > 2.0).mean()), 4) if len(first) else None,
        "z_beyond_3": round(float((np.abs(first) > 3.0).mean()), 4) if len(first) else None,
        "median_relative_sigma": round(float(np.median([t["relative_sigma"] for t in texels if t["sigma"] > 0.0])), 4)
        if len(first)
        else None,
        "cpu_s": round(sum(scene["cpu_s"] for scene in scenes)),
    }


def table(scenes: Sequence[dict[str, Any]]) -> str:
    """Markdown: the counts, features, faults."""
    counts = summary(scenes)
    lines = ["| | |", "|---|---|"]
    lines += [f"| {name.replace('_', ' ')} | {value} |" for name, value in counts.items()]
    lines += ["", "| scenes with | scenes | texels | standard deviation of z | faults |", "|---|---|---|---|---|"]
    for feature in sorted({feature for scene in scenes for feature in scene["features"]}):
        some = [scene for scene in scenes if feature in scene["features"]]
        part = summary(some)
        faults = sum(len(scene["faults"]) for scene in some)
        lines.append(f"| {feature} | {len(some)} | {part['texels']} | {part['z_standard_deviation']} | {faults} |")
    lines.append("")
    lines += [f"- seed {scene['seed']}: {fault}" for scene in scenes for fault in scene["faults"]] or ["No fault."]
    return "\n".join(lines)


def write_page(path: Path, text: str) -> None:
    """Put the table between the marks of the page."""
    page = path.read_text()
    begin, end = (page.index(mark) for mark in MARKS)
    path.write_text(page[: begin + len(MARKS[0])] + "\n" + text + "\n" + page[end:])


def main() -> int:
    """0 where no texel fails."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--scenes", type=int, default=200)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--json", type=Path)
    parser.add_argument("--page", type=Path)
    options = parser.parse_args()
    scenes = []
    seeds = range(options.first, options.first + options.scenes)
    # A process keeps compiled kernels; a new one now and then keeps memory small.
    with multiprocessing.get_context("spawn").Pool(options.jobs, maxtasksperchild=20) as pool:
        for scene in pool.imap(measured, seeds):
            scenes.append(scene)
            print(
                f"{scene['seed']:5d}  {scene['cpu_s']:5.1f} s  {'; '.join(scene['faults']) or 'as it should be'}",
                flush=True,
            )
            if options.json:
                lines = ",\n ".join(json.dumps(one) for one in scenes)
                options.json.write_text(f'{{"summary": {json.dumps(summary(scenes))},\n"scenes": [\n {lines}\n]}}\n')
    print(table(scenes))
    if options.page:
        write_page(options.page, table(scenes))
    return int(any(scene["faults"] for scene in scenes))


if __name__ == "__main__":
    sys.exit(main())
