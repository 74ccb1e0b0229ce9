"""Pictures in and out: EXR for measuring, PNG for looking at.

A PNG is tone-mapped (`package.colour`), which takes a luminance that shows as white. Two pictures can only be compared
with the same one, so whoever makes several passes the first one's on.
"""

from pathlib import Path
from typing import Final

from kiln_schemas.errors import InputError
from kiln_workers.package import colour, exr, png
from kiln_workers.package.files import write_bytes
from kiln_workers.scene.model import Float32
from kiln_workers.shade.package import DENOISED

SUFFIXES: Final = (".exr", ".png")


def check_output(path: Path) -> Path:
    """The path unchanged if a picture can be written in the format that its suffix names; InputError otherwise."""
    if path.suffix.lower() not in SUFFIXES:
        raise InputError(
            f"'{path.suffix}' is not a format that is written"
            if path.suffix
            else "the name has no suffix to say the format",
            where=str(path),
            remedy=f"Use {' or '.join(SUFFIXES)}.",
        )
    return path


def write_picture(path: Path, radiance: Float32, white: float, denoised: bool = False) -> None:
    """Write radiance [H, W, 3]: as it is to an EXR, tone-mapped to a PNG; MachineLacks where the disk refuses.

    A denoised picture is marked as such in the file's metadata; `read_exr` refuses it.
    """
    marks = {DENOISED: "for looking, not for measuring"} if denoised else {}
    if path.suffix.lower() == ".png":
        write_bytes(path, png.encode(colour.tone_map(radiance, white), marks))
    else:
        exr.write_rgb(path, radiance, comments="radiance, linear Rec.709", marks=marks)
