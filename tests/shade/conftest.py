"""A small package in memory and on disk: a glossy floor, a dull wall, a lamp, and lobes of known shape."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from kiln_schemas import conventions
from kiln_schemas.manifest import Manifest, ManifestMetrics
from kiln_schemas.settings import make_settings
from kiln_schemas.tasks import FitMetrics
from kiln_workers.package import exr, ktx2
from kiln_workers.package.glb import encode_glb
from kiln_workers.package.half import lobes_to_layers, to_half
from kiln_workers.scene.model import Environment, Material, Mesh, Scene
from kiln_workers.shade.package import EnvironmentLookup, LobeTextures, ShadePackage

SIZE = 16
U_ALPHAS = (0.01, 0.2, 0.5, 1.0)


def quad(name: str, material: int, corner, u, v, cell) -> Mesh:
    """A quad corner, corner + u, corner + u + v, corner + v, seen from the side of u x v; `cell` is (u, v, side)."""
    corner, u, v = (np.asarray(x, np.float64) for x in (corner, u, v))
    positions = np.stack([corner, corner + u, corner + u + v, corner + v]).astype(np.float32)
    normal = np.cross(u, v) / np.linalg.norm(np.cross(u, v))
    square = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.float32)
    faces = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
    lightmap_uv = (np.array(cell[:2]) + cell[2] * square).astype(np.float32)
    return Mesh(name, positions, np.tile(normal, (4, 1)).astype(np.float32), faces, material, square, lightmap_uv)


def room() -> Scene:
    """Nothing in it is symmetrical, so a flipped or mirrored picture differs."""
    materials = (
        Material("brass", base_color=(0.9, 0.7, 0.3, 1.0), metallic=1.0, roughness=0.55),
        Material("plaster", base_color=(0.4, 0.6, 0.5, 1.0), roughness=0.9),
        Material("red lamp", base_color=(0.0, 0.0, 0.0, 1.0), emission=(4.0, 0.5, 0.25)),
        Material("blue lamp", base_color=(0.0, 0.0, 0.0, 1.0), emission=(0.25, 0.5, 3.0)),
    )
    meshes = (
        quad("floor", 0, (-1.5, 0, 1), (3, 0, 0), (0, 0, -2), (0.05, 0.05, 0.4)),
        quad("wall", 1, (-1.5, 0, -1), (2, 0, 0), (0, 1, 0), (0.55, 0.05, 0.4)),
        quad("red", 2, (-1.0, 0.5, -0.8), (0.6, 0, 0), (0, 0.3, 0), (0.05, 0.55, 0.1)),
        quad("blue", 3, (0.9, 0.1, -0.5), (0.3, 0, 0), (0, 0.9, 0), (0.3, 0.55, 0.1)),
    )
    return Scene(meshes, materials)


def lobe_map(constant: bool) -> np.ndarray:
    """Lobes [H, W, 3, 7]: the sum is 1 everywhere in all directions, or something that varies over the map."""
    lobes = np.zeros((SIZE, SIZE, 3, 7), np.float32)
    lobes[..., :3] = (0.0, 1.0, 0.0)
    if constant:
        lobes[..., 0, 4:] = 1.0
        return lobes
    rows, columns = np.indices((SIZE, SIZE))[..., None] / SIZE
    angle = 2.0 * np.pi * (np.arange(3) / 3 + 0.1 * rows + 0.07 * columns)
    lobes[..., :3] = np.stack([np.cos(angle), np.full_like(angle, 0.8), np.sin(angle)], axis=-1) / np.sqrt(1.64)
    lobes[..., 3] = 3.0 + 9.0 * np.arange(3) + 4.0 * rows
    lobes[..., 4:] = np.array([[1.0, 0.4, 0.2], [0.2, 0.9, 0.3], [0.3, 0.2, 1.1]]) * (0.6 + columns[..., None])
    return lobes


def manifest(environment: bool) -> Manifest:
    fitted = FitMetrics(log_mse=0.1, log_mse_zero=1.0, log_mse_rel=0.1, texels=SIZE * SIZE, signal=True)
    integrals = [4.0 / (1.0 + alpha**2) for alpha in U_ALPHAS]
    u = {"alphas": list(U_ALPHAS), "lobe_integrals": integrals, "normalised": False}
    lobes = {name: {"lobes": 3} for name in (conventions.LIGHT_FIELD_KTX2, conventions.VISIBILITY_KTX2)}
    maps = (
        {**lobes, conventions.ENVIRONMENT_U_KTX2: u, conventions.ENVIRONMENT_EXR: {}}
        if environment
        else {conventions.LIGHT_FIELD_KTX2: {}}
    )
    return Manifest(
        format_version=conventions.FORMAT_VERSION,
        generator="test",
        job_id="1",
        job_name="room",
        settings=make_settings("draft", ()),
        scene_hash="a" * 64,
        inputs={},
        environment=None,
        seeds={},
        exposure={},
        metrics=ManifestMetrics(light_field=fitted, visibility=fitted if environment else None),
        textures=maps,
        lightmap={"width": SIZE, "height": SIZE},
        stage_seconds={},
        overflows=0,
        versions={},
        notes=(),
        files=(),
    )


def package(*, constant: bool = False, environment: bool = False) -> ShadePackage:
    """A package in memory; `constant`: light field, visibility, irradiance / pi and environment are all 1."""
    lobes = torch.from_numpy(lobe_map(constant))
    integrals = torch.tensor([4.0 / (1.0 + alpha**2) for alpha in U_ALPHAS])
    u = integrals[:, None, None, None].expand(len(U_ALPHAS), 8, 8, 3).clone()
    itself = torch.arange(4 * 8 * 3, dtype=torch.float32).reshape(4, 8, 3)
    return ShadePackage(
        manifest=manifest(environment),
        scene=room(),
        irradiance=torch.full((SIZE, SIZE, 3), torch.pi),
        lobes=LobeTextures(lobes, lobes if environment else None),
        environment=EnvironmentLookup(u, torch.tensor(U_ALPHAS), itself) if environment else None,
    )


@pytest.fixture
def make_package() -> Callable[..., ShadePackage]:
    return package


@pytest.fixture
def room_scene() -> Scene:
    return room()


@pytest.fixture
def lit_room() -> Scene:
    """The room under an uneven environment."""
    pixels = np.linspace(0.1, 2.0, 8 * 16 * 3, dtype=np.float32).reshape(8, 16, 3)
    return replace(room(), environment=Environment(pixels))


@pytest.fixture
def package_folder(tmp_path: Path) -> Path:
    """The package with an environment as files, as the packager's own writers write them."""
    folder = tmp_path / "package"
    folder.mkdir()
    made = package(environment=True)
    assert made.environment is not None
    layers, _ = lobes_to_layers(made.lobes.light_field.numpy())
    for name in (conventions.LIGHT_FIELD_KTX2, conventions.VISIBILITY_KTX2):
        ktx2.write(folder / name, ktx2.texture_array(layers, {}))
    u, _ = to_half(np.concatenate([made.environment.u.numpy(), np.ones((4, 8, 8, 1))], axis=-1))
    ktx2.write(folder / conventions.ENVIRONMENT_U_KTX2, ktx2.texture_array(u, {}))
    exr.write_rgb(folder / conventions.ENVIRONMENT_EXR, made.environment.itself.numpy())
    exr.write_rgb(folder / conventions.IRRADIANCE_EXR, made.irradiance.numpy())
    (folder / conventions.SCENE_GLB).write_bytes(encode_glb(made.scene))
    (folder / conventions.MANIFEST_JSON).write_text(made.manifest.model_dump_json())
    return folder
