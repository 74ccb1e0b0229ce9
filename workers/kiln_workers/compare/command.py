"""The command `compare`: options checked, everything run, and what was found written after every step.

Ctrl-C leaves a whole folder: the finished rows are in `compare.json`, `compare.csv` and `index.html`, and the same
command goes on from the cache.
"""

import argparse
import sys
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Final

import torch

from kiln_schemas.errors import InputError, MachineLacks
from kiln_workers.compare.cameras import read_cameras
from kiln_workers.compare.pictures import PictureSettings
from kiln_workers.compare.run import Plan, run
from kiln_workers.compare.subject import open_subject
from kiln_workers.fit.solution import Solver
from kiln_workers.fit.solvers import SOLVERS
from kiln_workers.render.backend import select_variant
from kiln_workers.runner.machine import cores, default_memory_bytes, parse_size
from kiln_workers.shade import command as shading

INTERRUPTED: Final = 130
OURS: Final = "coherent"
NETWORK: Final = "cnn"
"""The solver whose convergence figures 6 and 8 show."""

MOST_LOBES: Final = 64


def run_compare(options: argparse.Namespace) -> int:
    """Compare; the exit code, 130 where it was interrupted."""
    threads = options.threads or cores()
    width, height = shading.parse_size(options.size)
    subject = open_subject(options.subject, options.package, options.store, options.env)
    # Ours and the network do as the bake does; the other solvers do not depend on the job.
    known: dict[str, Solver] = dict(SOLVERS)
    for name in (OURS, NETWORK):
        known[name] = partial(SOLVERS[name], settings=subject.settings.fit)
    plan = Plan(
        out=_made(options.out),
        solvers=chosen_solvers(options.solvers, known),
        network=known[NETWORK],
        lobes=numbers(options.lobes, "--lobes", 1, MOST_LOBES),
        resolutions=numbers(options.resolutions or "", "--resolutions", 8, 1024),
        resolution_image_size=_image_size(options.resolution_image_size),
        warm=options.warm,
        cameras=read_cameras(options.cameras),
        pictures=PictureSettings(width, height, options.reference_samples),
        stored=options.stored,
        tiles=options.tiles,
        between=options.between,
        between_factor=options.between_samples,
        memory_bytes=parse_size(options.memory) if options.memory else default_memory_bytes(),
        quiet=options.json,
    )
    select_variant(threads=threads)
    torch.set_num_threads(threads)
    result = run(subject, plan)
    if options.json:
        print(result.model_dump_json(indent=2))
    else:
        print(f"{len(result.rows)} rows in {options.out}; open {options.out / 'index.html'} in a browser.")
    if not result.complete:
        print("Interrupted. The same command goes on from here.", file=sys.stderr)
        return INTERRUPTED
    return 0


def chosen_solvers(text: str | None, known: Mapping[str, Solver]) -> dict[str, Solver]:
    """The solvers named by commas, in order; all without a text."""
    names = list(known) if text is None else list(dict.fromkeys(part.strip() for part in text.split(",")))
    for name in names:
        if name not in known:
            raise InputError(
                f"'{name}' is not a solver", where="--solvers", remedy=f"Choose some of {', '.join(known)}."
            )
    return {name: known[name] for name in names}


def numbers(text: str, where: str, least: int, most: int) -> tuple[int, ...]:
    """Whole numbers by commas, each once, in order."""
    parts = [part.strip() for part in text.split(",") if part.strip()]
    try:
        values = [int(part) for part in parts]
    except ValueError:
        values = [-1]
    if any(not least <= value <= most for value in values):
        raise InputError(
            f"'{text}' is refused", where=where, remedy=f"Write numbers from {least} to {most} by commas, e.g. 16,32."
        )
    return tuple(dict.fromkeys(values))


def _image_size(value: int) -> int:
    if value not in range(16, 257, 16):
        raise InputError(
            f"{value} is refused", where="--resolution-image-size", remedy="Take a multiple of 16 from 16 to 256."
        )
    return value


def _made(out: Path) -> Path:
    """The output folder, made where it is missing."""
    try:
        out.mkdir(parents=True, exist_ok=True)
    except FileExistsError:
        raise InputError("is not a folder", where=str(out), remedy="Choose another --out.") from None
    except OSError as error:
        raise MachineLacks(f"the folder cannot be made: {error.strerror}", where=str(out)) from None
    return out
