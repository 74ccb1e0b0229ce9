"""What a package's quality gates came to, and the files that tell of it: `gates.xml` and the pictures compared."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from kiln_schemas.conventions import GATES_FOLDER, GATES_XML
from kiln_schemas.gates import REFERENCE_SUFFIX, GateResult
from kiln_schemas.junit import junit
from kiln_schemas.manifest import ReferenceView
from kiln_workers.package import png
from kiln_workers.package.files import write_bytes

UInt8 = npt.NDArray[np.uint8]


@dataclass(frozen=True)
class View:
    """What the package shows from a camera, and what it should; display colours [H, W, 3] with one white point."""

    camera: str
    seen: ReferenceView
    picture: UInt8
    reference: UInt8


@dataclass(frozen=True)
class Judgement:
    """The gates as measured, none where a job states none, and the pictures that were compared."""

    results: tuple[GateResult, ...] = ()
    views: tuple[View, ...] = ()
    not_compared: str = ""
    """Why there are no pictures."""


def write_gates(folder: Path, job_name: str, judgement: Judgement) -> list[str]:
    """Write what the gates came to, and the pictures, into a package's folder; the names of the files."""
    names = []
    if judgement.results:
        write_bytes(folder / GATES_XML, junit(job_name, judgement.results))
        names.append(GATES_XML)
    for view in judgement.views:
        for suffix, picture in (("", view.picture), (REFERENCE_SUFFIX, view.reference)):
            names.append(f"{GATES_FOLDER}/{view.camera}{suffix}.png")
            write_bytes(folder / names[-1], png.encode(picture))
    return names
