"""OpenEXR output of linear Rec.709 pictures (irradiance, environment), written through OpenEXR's own library.

The file carries the chromaticities of Rec.709 (ITU-R BT.709: its primaries and D65) because EXR leaves colour spaces to
this attribute; channels are floats or halves as given, zip compressed. The library writes only to paths, so the
picture goes to a temporary file whose bytes then take the atomic way of every other file of a package.
"""

import tempfile
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Final

import numpy as np
import numpy.typing as npt
import OpenEXR

from kiln_schemas import __version__
from kiln_schemas.errors import InternalError
from kiln_workers.package.files import write_bytes

Float32 = npt.NDArray[np.float32]
Half = npt.NDArray[np.float16]

REC709_CHROMATICITIES: Final = (0.64, 0.33, 0.30, 0.60, 0.15, 0.06, 0.3127, 0.3290)


def write_rgb(
    path: Path, pixels: Float32 | Half, *, comments: str = "", marks: Mapping[str, str] = MappingProxyType({})
) -> None:
    """Write linear Rec.709 pixels [H, W, 3] as an EXR, row 0 at the top; InternalError unless all are finite.

    `marks` are further attributes of the header.
    """
    if not np.isfinite(pixels).all():
        raise InternalError("the picture holds values that are not finite", where=path.name)
    header = {
        "compression": OpenEXR.ZIP_COMPRESSION,
        "type": OpenEXR.scanlineimage,
        "chromaticities": REC709_CHROMATICITIES,
        "software": f"lightkiln {__version__}",
        "comments": comments,
        **marks,
    }
    channels = {"RGB": np.ascontiguousarray(pixels)}
    with tempfile.TemporaryDirectory(prefix="lightkiln-exr-") as folder:
        temporary = Path(folder) / "picture.exr"
        with OpenEXR.File(header, channels) as file:
            file.write(str(temporary))
        write_bytes(path, temporary.read_bytes())
