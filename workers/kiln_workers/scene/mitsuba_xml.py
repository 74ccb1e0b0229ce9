"""Not read yet."""

from pathlib import Path

from kiln_workers.scene.model import Scene


def read_mitsuba_xml(folder: Path, entry: str) -> Scene:
    raise NotImplementedError
