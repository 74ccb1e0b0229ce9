"""Another scene's network as the start of this one (figure 8)."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from kiln_schemas.errors import InputError, NotFound
from kiln_schemas.settings import Function
from kiln_workers.compare.subject import KEPT
from kiln_workers.fit.network import Shape
from kiln_workers.fit.predict import Weights
from kiln_workers.shade.package import read_manifest


@dataclass(frozen=True)
class WarmStart:
    label: str
    options: Mapping[str, Any]
    """For the network's solver."""


def warm_start(named: str, image_size: int, lobes: int) -> WarmStart:
    """The light-field network of a weights file or of a kept bake's folder; it must have this fit's shape."""
    path = Path(named)
    if path.is_dir():
        manifest = read_manifest(path)
        label, weights = manifest.job_name, _of_bake(path, manifest.exposure.get(Function.LIGHT_FIELD.value))
    elif path.is_file():
        label, weights = path.name, Weights.from_bytes(path.read_bytes())
    else:
        raise NotFound("there is no such file or folder", where=f"--warm {named}")
    if weights.shape != Shape(image_size, lobes):
        raise InputError(
            f"the network is for {weights.shape.image_size}² pixels and {weights.shape.lobes} lobes, "
            f"this fit has {image_size}² and {lobes}",
            where=f"--warm {named}",
            remedy="Name a network of the same preset, or pass its number first in --lobes.",
        )
    return WarmStart(label, {"start": weights})


def _of_bake(folder: Path, exposure: float | None) -> Weights:
    """The weights among a kept bake's blobs: those with the light field's exposure."""
    for path in sorted((folder / KEPT / "blobs").glob("*/*")):
        try:
            weights = Weights.from_bytes(path.read_bytes())
        except InputError:
            continue
        if weights.exposure == exposure:
            return weights
    raise NotFound(
        "no network of the light field was kept",
        where=str(folder),
        remedy="Bake it with `lightkiln bake --keep --set fit.solver=cnn`.",
    )
