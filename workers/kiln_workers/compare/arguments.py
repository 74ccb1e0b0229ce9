"""The arguments of `compare`; the command, and what it imports, is loaded when it is run."""

import argparse
from pathlib import Path
from typing import Any, Final

DEFAULT_LOBES: Final = "16"


def add_compare(commands: Any) -> None:
    """Add the command to the subparsers of `python -m kiln_workers`."""
    parser = commands.add_parser("compare", help="compare solvers on a bake's stored light fields")
    parser.add_argument("subject", help="package folder or light-field store (folder or URL)")
    parser.add_argument("--out", required=True, type=Path, metavar="DIR", help="folder for tables, pages and cache")
    parser.add_argument("--package", type=Path, help="package of the bake whose store is named")
    parser.add_argument("--store", help="store of the bake whose package is named")
    parser.add_argument("--env", type=Path, help="the scene's environment, where the bake's data was not kept")
    parser.add_argument("--solvers", help="names by commas; all by default")
    parser.add_argument("--lobes", default=DEFAULT_LOBES, help="numbers by commas, e.g. 8,16,32,64")
    parser.add_argument("--resolutions", help="light-map sizes by commas: convergence of the network (figure 6)")
    parser.add_argument("--resolution-image-size", type=int, default=32, help="light-field pixels a side of these")
    parser.add_argument("--warm", help="network to start from (figure 8): a weights file or a kept bake's folder")
    parser.add_argument("--cameras", nargs="+", action="extend", default=[], metavar="FILE", help="JSON files")
    parser.add_argument("--size", default="480x270", help="WIDTHxHEIGHT of the pictures")
    parser.add_argument("--reference-samples", type=_positive, default=512, help="paths a pixel of the references")
    parser.add_argument("--stored", action="store_true", help="shade from the stored light fields themselves too")
    parser.add_argument("--tiles", type=_positive, help="only so many tiles, evenly chosen; no pictures then")
    parser.add_argument("--between", type=_positive, default=300, help="points of each kind between texels")
    parser.add_argument("--between-samples", type=_factor, default=4.0, help="their samples over the bake's")
    parser.add_argument("--memory", help="main memory for light fields and wavefronts, e.g. 4GiB")
    parser.add_argument("--threads", type=_positive, help="cores to use; all by default")
    parser.add_argument("--json", action="store_true", help="compare.json on standard output")
    parser.set_defaults(command=_run)


def _run(options: argparse.Namespace) -> int:
    from kiln_workers.compare.command import run_compare

    return run_compare(options)


def _positive(text: str) -> int:
    value = int(text)
    if value < 1:
        raise argparse.ArgumentTypeError("must be 1 or more")
    return value


def _factor(text: str) -> float:
    value = float(text)
    if not 0.0 < value <= 1000.0:
        raise argparse.ArgumentTypeError("must be positive, 1000 at most")
    return value
