"""Bakes inputs that other bakers or older versions of this one baked wrongly, and compares with the truth.

    make faults
    python benchmarks/faults.py [--only KIND] [--json FILE] [--page FILE]

Inputs: tests/faults/data, each after a report that users of other programs filed in public. Right values are analytic,
by quadrature, or from plain Mitsuba, as the table says. `before` is what version 0.1.0 of November 2026 baked.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
import trimesh

from kiln_workers.shade import textures
from kiln_workers.shade.package import ShadePackage

DATA: Final = Path(__file__).parent.parent / "tests" / "faults" / "data"
TINY: Final = (
    "lightmap.tile=16",
    "render.image_size=16",
    "render.samples=4",
    "render.irradiance_samples=512",
    "render.between_samples=0",
    "fit.solver=cnn",
    "fit.lobes=6",
    "fit.steps=300",
    "package.environment_size=16",
)
RELATIVE: Final = 0.06
"""Of the right value: paths are few, a texel is a mean over its square, and right values have three digits."""
ABSOLUTE: Final = 0.03
"""In units of irradiance: what paths and the bilinear look-up leave in a dark place."""
MARKS: Final = ("<!-- begin of the table that make faults writes -->", "<!-- end of the table -->")
UP: Final = (0.0, 1.0, 0.0)
DOWN: Final = (0.0, -1.0, 0.0)


@dataclass(frozen=True)
class Probe:
    """A point on a surface that faces `normal`; irradiance there, one number for all channels or one a channel."""

    point: tuple[float, float, float]
    right: float | tuple[float, float, float]
    before: float | tuple[float, float, float] | None = None
    normal: tuple[float, float, float] = UP


@dataclass(frozen=True)
class Case:
    """A file of one kind of fault."""

    kind: str
    file: str
    source: str
    """Where the right values are from."""
    probes: Sequence[Probe] = ()
    resolution: int = 32
    environment: str | None = None
    dark: bool = False
    """Whether all of it is right to be 0."""
    words: str = ""
    """What standard output or standard error has to say."""


QUADRATURE, MITSUBA, TWIN, GEOMETRY = "quadrature", "plain Mitsuba", "the file without the fault", "form factors"
CASES: Final = (
    Case(
        "01 a closed room of single sheets leaks the sky",
        "01-closed-room-leaks-at-edges/corner.glb",
        "the same room without a sky",
        (
            Probe((2.05, 0, 0), 0.112, 1.024),
            Probe((2, 0, 0), 0.124, 0.685),
            Probe((0, 0, 1.68), 0.136, 1.223),
            Probe((0, 0, 0), 0.265, 0.260),
        ),
        64,
        "white.exr",
    ),
    Case(
        "02 alpha darkens an emissive texture",
        "02-png-alpha-darkens-colour/emissive0.glb",
        QUADRATURE,
        (Probe((0, 0, 0), 1.161, 0.0),),
    ),
    Case(
        "02 alpha darkens an emissive texture",
        "02-png-alpha-darkens-colour/emissive128.glb",
        QUADRATURE,
        (Probe((0, 0, 0), 1.161, 0.257),),
    ),
    Case(
        "02 alpha darkens a base colour",
        "02-png-alpha-darkens-colour/base0.glb",
        MITSUBA,
        (Probe((1.2, 2.2, 0), 0.262, 0.006, DOWN),),
    ),
    Case(
        "03 the floor under a one-sided canopy is lit",
        "03-one-sided-canopy/roofFalse.glb",
        GEOMETRY,
        (
            Probe((0, 0, 0), 0.040, 1.654),
            Probe((1, 0, 0), 0.066, 1.649),
            Probe((1.5, 0, 1.5), 0.302, 1.704),
            Probe((3, 0, 0), 3.103, 3.100),
        ),
        48,
        "white.exr",
    ),
    Case(
        "04 far from the origin",
        "04-far-from-origin/far100000.glb",
        MITSUBA + " at the origin",
        (
            Probe((1e5, 0, -1e5), 0.052, 0.2425),
            Probe((1e5 + 0.5, 0, -1e5), 0.050, 0.2425),
            Probe((1e5 + 0.9, 0, -1e5), 1.687, 0.2425),
            Probe((1e5 + 1.5, 0, 1 - 1e5), 0.768, 0.2425),
        ),
        64,
    ),
    Case(
        "05 a ground plane of 20 km in the file",
        "05-large-ground-plane/ground20000.glb",
        TWIN,
        (
            Probe((0, 0, 0), 0.0008, 1.251),
            Probe((0.4, 0, 0), 0.0062, 1.235),
            Probe((0.7, 0, 0), 1.177, 1.733),
            Probe((1.5, 0, 0), 1.029, 1.061),
        ),
        64,
    ),
    Case(
        "06 back-to-back sheets, the outer ones first",
        "06-back-to-back-faces/outer_first.glb",
        TWIN,
        (Probe((0, 0, 0), 2.163),),
        64,
    ),
    Case(
        "07 a small thing of many triangles",
        "marble.obj",
        "the same 100 times larger",
        (Probe((0.07, 0, 0), 0.704),),
        96,
    ),
    Case(
        "08 a strip of 400 m x 0.1 m",
        "08-long-thin-strip/strip400.glb",
        MITSUBA,
        (Probe((0, 0, 0), 2.308), Probe((1, 0, 0), 1.556), Probe((1.5, 0, 1.5), 0.566)),
        256,
    ),
    Case(
        "09 a concave polygon of an OBJ file",
        "09-obj-concave-polygon/poly.obj",
        "the same as three quads",
        (Probe((0, 0, -1), 3.898, 0.0), Probe((0, 0, 0), 4.113, 0.0), Probe((1.5, 0, -1), 1.521, 0.0)),
    ),
    Case("10 MTL `d 0.0`", "10-mtl-transparency-and-tiling-ignored/d.obj", TWIN, (Probe((0, 0, 0), 2.308, 0.0),)),
    Case("10 MTL `map_d`", "10-mtl-transparency-and-tiling-ignored/map_d.obj", TWIN, (Probe((0, 0, 0), 2.308, 0.0),)),
    Case(
        "10 MTL `map_Ke -s 8 8 1`",
        "10-mtl-transparency-and-tiling-ignored/tiled.obj",
        QUADRATURE,
        (Probe((-0.5, 0, 0.5), 3.720, 6.988), Probe((0.5, 0, -0.5), 3.319, 1.390)),
    ),
    Case("11 a hidden node", "11-hidden-nodes-are-baked/s.glb", TWIN, (Probe((0, 0, 0), 2.308, 0.0),)),
    Case(
        "12 vertex colours",
        "12-vertex-colours/vertex.glb",
        "the colour as a factor",
        (Probe((-1.6, 0, 0), (0.523, 0.368, 0.368), (0.534, 0.534, 0.534)),),
    ),
    Case(
        "13 a texture with a UV set of its own",
        "13-two-uv-sets/s.glb",
        QUADRATURE,
        (Probe((-0.5, 0, 0), 4.309, 11.261), Probe((0.5, 0, 0), 11.333, 4.317)),
    ),
    Case(
        "16 a room whose faces point outward",
        "16-inside-out-room/s.glb",
        "glTF: backs reflect nothing",
        dark=True,
        words="back",
    ),
    Case("20 a quad of 0.4 mm", "20-materials-and-reference/screw.gltf", "it bakes"),
    Case(
        "20 a pane of glass",
        "20-materials-and-reference/glass.gltf",
        "quadrature, less Fresnel's share",
        (Probe((0, 0, 0), 0.222, 0.0),),
    ),
)


@dataclass
class Outcome:
    """What a case's bake gave."""

    case: Case
    code: int
    seconds: float
    values: list[list[float]] = field(default_factory=list)
    faults: list[str] = field(default_factory=list)


def bake(case: Case, folder: Path) -> Outcome:
    """Bake a case as a user does, and compare."""
    path = DATA / case.file
    if case.file == "marble.obj":
        path = folder / case.file
        _write_marble(path)
    began = time.monotonic()
    sky = ["--env", str(path.with_name(case.environment))] if case.environment else []
    overrides = [word for setting in (f"lightmap.resolution={case.resolution}", *TINY) for word in ("--set", setting)]
    command = [str(Path(sys.executable).with_name("lightkiln")), "bake", str(path), *sky, "--preset", "draft"]
    done = subprocess.run(
        [*command, *overrides, "--out", str(folder / "out"), "--force"],
        capture_output=True,
        text=True,
        stdin=subprocess.DEVNULL,
    )
    outcome = Outcome(case, done.returncode, time.monotonic() - began)
    if done.returncode:
        outcome.faults.append((done.stderr.strip().splitlines() or ["no word"])[-1])
        return outcome
    if case.words not in done.stdout + done.stderr:
        outcome.faults.append(f"nothing was said of '{case.words}'")
    package = ShadePackage.read(folder / "out", torch.device("cpu"))
    if case.dark and package.irradiance.abs().max() > 0.0:
        outcome.faults.append(f"irradiance is up to {float(package.irradiance.max()):.3f}")
    for probe in case.probes:
        seen = irradiance_at(package, probe)
        right = np.broadcast_to(np.asarray(probe.right, np.float64), 3)
        outcome.values.append(seen.tolist())
        if (np.abs(seen - right) > np.maximum(RELATIVE * right, ABSOLUTE)).any():
            outcome.faults.append(f"{probe.point}: {_shown(seen.tolist())} instead of {_shown(probe.right)}")
    return outcome


def irradiance_at(package: ShadePackage, probe: Probe) -> np.ndarray[Any, Any]:
    """Irradiance [3] of the light map where a surface that faces the probe's normal is nearest to its point."""
    point = np.array(probe.point) - package.scene.origin
    best, uv = np.inf, None
    for mesh in package.scene.meshes:
        assert mesh.lightmap_uv is not None
        corners = mesh.positions[mesh.faces].astype(np.float64)
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        facing = np.flatnonzero(normals @ np.array(probe.normal) > 0.9 * np.linalg.norm(normals, axis=1))
        if not len(facing):
            continue
        nearest = trimesh.triangles.closest_point(corners[facing], np.broadcast_to(point, (len(facing), 3)))
        distances = np.linalg.norm(nearest - point, axis=1)
        at = int(distances.argmin())
        if distances[at] < best:
            best = float(distances[at])
            weights = trimesh.triangles.points_to_barycentric(corners[facing[at : at + 1]], nearest[at : at + 1])[0]
            uv = weights @ mesh.lightmap_uv[mesh.faces[facing[at]]]
    assert uv is not None, "no surface faces the probe"
    found = textures.bilinear(package.irradiance, torch.from_numpy(uv[None].astype(np.float32)))
    return found[0].numpy().astype(np.float64)


def _write_marble(path: Path) -> None:
    """A marble of 6 cm with 25,280 triangles above a floor of 20 cm, under a lamp, as OBJ and MTL."""
    marble = trimesh.creation.uv_sphere(radius=0.03, count=[80, 160])
    quad = np.array([[0, 1, 2], [0, 2, 3]])
    square = np.array([[-1.0, 0.0, 1.0], [1.0, 0.0, 1.0], [1.0, 0.0, -1.0], [-1.0, 0.0, -1.0]])
    parts = (
        ("marble", "grey", marble.vertices + np.array([0.0, 0.035, 0.0]), marble.faces),
        ("floor", "black", 0.1 * square, quad),
        ("lamp", "glow", 0.03 * square + np.array([0.0, 0.2, 0.0]), quad[:, ::-1]),
    )
    lines, first = ["mtllib marble.mtl"], 1
    for name, material, vertices, faces in parts:
        lines += [f"o {name}", f"usemtl {material}"]
        lines += [f"v {x:.9g} {y:.9g} {z:.9g}" for x, y, z in vertices]
        lines += [f"f {a} {b} {c}" for a, b, c in faces + first]
        first += len(vertices)
    path.write_text("\n".join(lines) + "\n")
    rough = "Ns 0\nillum 1\n"
    grey, black = "newmtl grey\nKd 0.5 0.5 0.5\n", "newmtl black\nKd 0 0 0\n"
    glow = "newmtl glow\nKd 0 0 0\nKe 10 10 10\n"
    path.with_name("marble.mtl").write_text(f"{grey}{rough}{black}{rough}{glow}{rough}")


def _shown(values: Any) -> str:
    """One number where all channels are about the same."""
    if values is None:
        return "no bake"
    numbers = np.atleast_1d(np.asarray(values, np.float64))
    return (
        f"{numbers.mean():.3f}"
        if np.ptp(numbers) < 0.03 * numbers.max() + 1e-3
        else " ".join(f"{x:.3f}" for x in numbers)
    )


def table(outcomes: Sequence[Outcome]) -> Iterator[str]:
    """Lines of Markdown."""
    yield "| kind and file | point | right value, from | before | now | |"
    yield "|---|---|---|---|---|---|"
    for outcome in outcomes:
        case = outcome.case
        name = f"{case.kind}: `{Path(case.file).name}`"
        verdict = "as it should be" if not outcome.faults else "**" + "; ".join(outcome.faults) + "**"
        if not case.probes:
            yield f"| {name} | | {case.source} | | exit code {outcome.code} | {verdict} |"
        for probe, seen in zip(case.probes, outcome.values or [None] * len(case.probes), strict=True):
            place = ", ".join(f"{x:g}" for x in probe.point)
            before, right = _shown(probe.before), _shown(probe.right)
            yield f"| {name} | {place} | {right}, {case.source} | {before} | {_shown(seen)} | {verdict} |"


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--only", default="", help="kinds that begin with this")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--page", type=Path, help="Markdown file whose table is replaced")
    options = parser.parse_args()
    outcomes = []
    for case in CASES:
        if not case.kind.startswith(options.only):
            continue
        with tempfile.TemporaryDirectory(prefix="lightkiln-faults-") as folder:
            outcome = bake(case, Path(folder))
        outcomes.append(outcome)
        print(f"{outcome.seconds:5.0f} s  {case.kind}: {'; '.join(outcome.faults) or 'as it should be'}", flush=True)
    lines = list(table(outcomes))
    if options.page:
        text = options.page.read_text()
        begin, end = (text.index(mark) for mark in MARKS)
        options.page.write_text(text[: begin + len(MARKS[0])] + "\n" + "\n".join(lines) + "\n" + text[end:])
    if options.json:
        kept = [
            {
                "kind": o.case.kind,
                "file": o.case.file,
                "code": o.code,
                "seconds": round(o.seconds, 1),
                "values": o.values,
                "right": [probe.right for probe in o.case.probes],
                "faults": o.faults,
            }
            for o in outcomes
        ]
        options.json.write_text(json.dumps({"cores": os.cpu_count(), "cases": kept}, indent=1) + "\n")
    print("\n".join(lines))
    return 1 if any(outcome.faults for outcome in outcomes) else 0


if __name__ == "__main__":
    sys.exit(main())
