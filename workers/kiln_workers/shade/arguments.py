"""The arguments of `shade` and `reference`; the commands, and what they import, are loaded when one is run."""

import argparse
import math
from pathlib import Path
from typing import Any

from kiln_workers.shade.term import WHOLE, Term


def add_commands(commands: Any) -> None:
    """Add both commands to the subparsers of `python -m kiln_workers`."""
    shading = commands.add_parser("shade", help="shade a package as a game would, from its own files")
    shading.add_argument("package", type=Path, help="folder with a manifest.json")
    _common(shading)
    shading.add_argument("--grid", type=_positive, default=2, help="N x N samples a pixel")
    shading.add_argument("--terms", default=",".join(WHOLE), help=f"some of {','.join(Term)}")
    shading.add_argument("--stored", help="light-field store to take the light from instead of the lobes")
    shading.add_argument("--paper", action="store_true", help="D, F and G as the paper has them, for comparison")
    shading.add_argument(
        "--against", type=Path, help="EXR of the same camera to measure PSNR, SSIM and HDR-FLIP against"
    )
    shading.set_defaults(command=_run_shade)

    tracing = commands.add_parser("reference", help="path-trace a scene and state the picture's noise")
    tracing.add_argument("scene", type=Path, help="glTF, FBX, DAE, OBJ, PLY, STL, OFF or Mitsuba XML")
    _common(tracing)
    tracing.add_argument("--env", type=Path, help="equirectangular HDR or EXR")
    tracing.add_argument("--env-scale", type=float, default=1.0)
    tracing.add_argument("--env-rotation", type=float, default=0.0, help="degrees about +Y")
    tracing.add_argument("--samples", type=_positive, default=256, help="paths a pixel, both halves together")
    tracing.add_argument("--noise", type=_noise, help="paths where they are needed, until the noise is at most this")
    tracing.add_argument("--max-samples", type=_positive, default=16384, help="paths a pixel at most, with --noise")
    tracing.add_argument("--max-depth", type=_positive, default=12, help="scattering events of a path")
    tracing.add_argument("--denoise", action="store_true", help="for looking; such a picture is refused for measuring")
    tracing.add_argument("--seed", type=_natural, default=0)
    tracing.set_defaults(command=_run_reference)


def _run_shade(options: argparse.Namespace) -> int:
    from kiln_workers.shade.command import run_shade

    return run_shade(options)


def _run_reference(options: argparse.Namespace) -> int:
    from kiln_workers.shade.command import run_reference

    return run_reference(options)


def _common(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--camera", required=True, help="px,py,pz:tx,ty,tz:fov or a JSON file; fov is vertical, degrees"
    )
    parser.add_argument("-o", "--out", required=True, type=Path, metavar="FILE", help="picture.exr or picture.png")
    parser.add_argument("--size", default="480x270", help="WIDTHxHEIGHT")
    parser.add_argument("--white", type=_luminance, help="luminance that a PNG shows as white; from the picture")
    parser.add_argument("--device", default="auto", choices=("auto", "cpu", "cuda"))
    parser.add_argument("--json", action="store_true", help="a JSON object on standard output")


def _positive(text: str) -> int:
    value = int(text)
    if value < 1:
        raise argparse.ArgumentTypeError("must be 1 or more")
    return value


def _natural(text: str) -> int:
    value = int(text)
    if value < 0:
        raise argparse.ArgumentTypeError("must be 0 or more")
    return value


def _noise(text: str) -> float:
    value = float(text)
    if not 1e-4 <= value <= 1.0:
        raise argparse.ArgumentTypeError("must be from 0.0001 to 1")
    return value


def _luminance(text: str) -> float:
    value = float(text)
    if not 0.0 < value < math.inf:
        raise argparse.ArgumentTypeError("must be positive")
    return value
