"""Pictures in and out: EXR for measuring, PNG for looking at, and the PSNR between two of them.

A PNG is tone-mapped (`package.colour`), which takes a luminance that shows as white. Two pictures can only be compared
with the same one, so whoever makes several passes the first one's on.
"""

from pathlib import Path
from typing import Final

import numpy as np

from kiln_schemas.errors import InputError
from kiln_workers.package import colour, exr, png
from kiln_workers.package.files import write_bytes
from kiln_workers.scene.model import Float32

SUFFIXES: Final = (".exr", ".png")


def check_output(path: Path) -> Path:
    """The path unchanged if a picture can be written in the format that its suffix names; InputError otherwise."""
    if path.suffix.lower() not in SUFFIXES:
        raise InputError(
            f"'{path.suffix}' is not a format that is written", where=str(path), remedy=f"Use {' or '.join(SUFFIXES)}."
        )
    return path


def write_picture(path: Path, radiance: Float32, white: float) -> None:
    """Write radiance [H, W, 3]: as it is to an EXR, tone-mapped to a PNG; MachineLacks where the disk refuses."""
    if path.suffix.lower() == ".png":
        write_bytes(path, png.encode(colour.tone_map(radiance, white)))
    else:
        exr.write_rgb(path, radiance, comments="radiance, linear Rec.709")


def psnr(one: Float32, other: Float32, white: float) -> float:
    """Peak signal-to-noise ratio in dB of the display-mapped pictures [H, W, 3]; infinite where they are equal."""
    difference = colour.tone_map(one, white).astype(np.float64) - colour.tone_map(other, white)
    error = float(np.mean(np.square(difference / 255.0)))
    return float("inf") if error == 0.0 else -10.0 * float(np.log10(error))
