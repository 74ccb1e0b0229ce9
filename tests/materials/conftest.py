"""Irradiance at points of a scene file, as the bake measures it."""

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest

from kiln_schemas.settings import RenderSettings
from kiln_workers.package import png
from kiln_workers.render.backend import select_variant
from kiln_workers.render.tile import TexelBatch, TileRenderer
from kiln_workers.scene.load import load_scene
from kiln_workers.scene.model import Float32, Scene

DATA = Path(__file__).parent / "data"

select_variant("cpu")

Irradiance = Callable[..., Float32]


def irradiance_of(
    scene: Scene,
    points: Sequence[Sequence[float]],
    normal: Sequence[float] = (0.0, 1.0, 0.0),
    samples: int = 4096,
    depth: int = 8,
) -> Float32:
    """Irradiance [P, 3] at `points` of surfaces that face `normal`."""
    settings = RenderSettings(image_size=16, samples=1, irradiance_samples=samples, max_depth=depth)
    renderer = TileRenderer(scene, "1" * 64, settings, 1 << 28, device="cpu")
    normals = np.repeat(np.asarray(normal, np.float32)[None], len(points), axis=0)
    batch = TexelBatch(
        index=np.arange(len(points), dtype=np.int64),
        position=np.asarray(points, np.float32),
        normal=normals,
        shading_normal=normals,
        alpha=np.ones(len(points), np.float32),
        texel_size=np.full(len(points), 0.05, np.float32),
    )
    return renderer.render(batch).irradiance


@pytest.fixture
def data() -> Path:
    """Scene files of public bug reports' kinds."""
    return DATA


@pytest.fixture
def irradiance() -> Irradiance:
    return irradiance_of


@pytest.fixture
def irradiance_in() -> Irradiance:
    """The same of a file in `data`."""

    def measure(name: str, points: Sequence[Sequence[float]], **more: object) -> Float32:
        return irradiance_of(load_scene(DATA, name), points, **more)  # type: ignore[arg-type]

    return measure


@pytest.fixture
def write_png() -> Callable[[Path, np.ndarray], None]:
    """Write [H, W, C] bytes as PNG."""

    def write(path: Path, pixels: np.ndarray) -> None:
        path.write_bytes(png.encode(pixels))

    return write
