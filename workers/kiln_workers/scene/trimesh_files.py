"""Not read yet."""

from pathlib import Path

from kiln_workers.scene.model import Scene


def read_obj(folder: Path, entry: str) -> Scene:
    raise NotImplementedError


def read_ply(folder: Path, entry: str) -> Scene:
    raise NotImplementedError
