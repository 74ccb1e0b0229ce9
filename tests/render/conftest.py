"""Small scenes, built directly from the scene model."""

from collections.abc import Callable, Sequence

import numpy as np
import pytest

from kiln_schemas.settings import RenderSettings
from kiln_workers.render.backend import select_variant
from kiln_workers.render.tile import TexelBatch, TileRenderer
from kiln_workers.scene.model import Environment, Material, Mesh, Scene

MEMORY = 1 << 27

select_variant("cpu")


def make_quad(origin: Sequence[float], a: Sequence[float], b: Sequence[float], material: int = 0) -> Mesh:
    """A parallelogram that faces a x b; TEXCOORD_0 has u along a, and v = 0 at the far end of b."""
    o, a_, b_ = (np.asarray(v, np.float32) for v in (origin, a, b))
    normal = np.cross(a_, b_) / np.linalg.norm(np.cross(a_, b_))
    return Mesh(
        name="quad",
        positions=np.stack([o, o + a_, o + a_ + b_, o + b_]).astype(np.float32),
        normals=np.repeat(normal[None], 4, axis=0).astype(np.float32),
        faces=np.array([[0, 1, 2], [0, 2, 3]], np.int32),
        material=material,
        uv=np.array([[0, 1], [1, 1], [1, 0], [0, 0]], np.float32),
    )


def make_texels(
    points: Sequence[Sequence[float]], normal: Sequence[float] = (0.0, 1.0, 0.0), alpha: float = 0.3
) -> TexelBatch:
    count = len(points)
    normals = np.repeat(np.asarray(normal, np.float32)[None], count, axis=0)
    return TexelBatch(
        index=np.arange(count, dtype=np.int64) * 7 + 3,
        position=np.asarray(points, np.float32),
        normal=normals,
        shading_normal=normals,
        alpha=np.full(count, alpha, np.float32),
        texel_size=np.full(count, 0.05, np.float32),
    )


def make_cornell(environment: Environment | None = None) -> Scene:
    """A unit box with a lamp, coloured walls and a glossy metal back; open at the top under an environment."""
    materials = (
        Material("white", (0.7, 0.7, 0.7, 1.0)),
        Material("red", (0.6, 0.1, 0.1, 1.0), roughness=0.6),
        Material("green", (0.1, 0.5, 0.1, 1.0)),
        Material("lamp", (0.0, 0.0, 0.0, 1.0), emission=(8.0, 7.0, 6.0)),
        Material("metal", (0.9, 0.8, 0.6, 1.0), metallic=1.0, roughness=0.5),
    )
    meshes = [
        make_quad((0, 0, 0), (0, 0, 1), (1, 0, 0), 0),
        make_quad((0, 0, 0), (1, 0, 0), (0, 1, 0), 4),
        make_quad((0, 0, 0), (0, 1, 0), (0, 0, 1), 1),
        make_quad((1, 0, 0), (0, 0, 1), (0, 1, 0), 2),
        make_quad((0.35, 0.99, 0.35), (0.3, 0, 0), (0, 0, 0.3), 3),
    ]
    if environment is None:
        meshes.append(make_quad((0, 1, 0), (1, 0, 0), (0, 0, 1), 0))
    return Scene(tuple(meshes), materials, environment=environment)


def make_renderer(scene: Scene, key: int = 1, memory: int = MEMORY, **settings: int) -> TileRenderer:
    values = {"image_size": 16, "samples": 16, "irradiance_samples": 256, "max_depth": 6} | settings
    return TileRenderer(scene, f"{key:016x}" + "0" * 48, RenderSettings(**values), memory, device="cpu")


@pytest.fixture
def quad() -> Callable[..., Mesh]:
    return make_quad


@pytest.fixture
def texels() -> Callable[..., TexelBatch]:
    return make_texels


@pytest.fixture
def cornell() -> Callable[..., Scene]:
    return make_cornell


@pytest.fixture
def renderer() -> Callable[..., TileRenderer]:
    return make_renderer


@pytest.fixture
def sky() -> Environment:
    """A gradient with a warm horizon and a small sun, so that no two directions are alike."""
    rows, columns = np.mgrid[0:24, 0:48]
    pixels = np.stack([0.2 + 0.02 * rows, 0.3 + 0.01 * columns, 0.9 - 0.02 * rows], axis=-1).astype(np.float32)
    pixels[5, 9] = (120.0, 110.0, 90.0)
    return Environment(pixels, scale=1.5, rotation_deg=-55.0)
