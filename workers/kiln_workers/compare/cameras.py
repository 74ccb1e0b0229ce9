"""Cameras of a comparison, from JSON files: one camera, named after the file, or an object of cameras by name."""

import json
from pathlib import Path

from kiln_schemas.camera import REMEDY, Camera, read_camera
from kiln_schemas.errors import InputError
from kiln_schemas.files import read_small


def read_cameras(names: list[str]) -> dict[str, Camera]:
    """Cameras by name, in order; InputError where a file is none or two have one name."""
    out: dict[str, Camera] = {}
    for text in names:
        for name, camera in _of(text).items():
            if name in out:
                raise InputError(f"there are two cameras named '{name}'", where="--cameras", remedy="Rename one.")
            out[name] = camera
    return out


def _of(text: str) -> dict[str, Camera]:
    path = Path(text)
    if not path.is_file():
        return {f"camera-{text.replace(':', '_')}" if text.count(":") == 2 else path.stem: read_camera(text)}
    try:
        document = json.loads(read_small(path))
    except (ValueError, RecursionError, OSError):
        raise InputError("is not JSON", where=text, remedy=REMEDY) from None
    if isinstance(document, dict) and document and all(isinstance(value, dict) for value in document.values()):
        return {name: _parse(value, f"{text}: {name}") for name, value in document.items()}
    return {path.stem: read_camera(text)}


def _parse(value: object, where: str) -> Camera:
    try:
        return Camera.model_validate_json(json.dumps(value))
    except ValueError:
        raise InputError("is not a camera", where=where, remedy=REMEDY) from None
