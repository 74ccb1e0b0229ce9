"""A synthetic bake as arrays (two charts, lobes of known shape, noisy images), and the independent readers from npm."""

import json
import multiprocessing
import shutil
import subprocess
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio
import pytest

from kiln_schemas.settings import Function, make_settings
from kiln_schemas.tasks import (
    Bundle,
    CurvePoint,
    EnvironmentRef,
    FitMetrics,
    FitResult,
    PackagePayload,
    Placement,
    PrepareResult,
    RenderResult,
    Tile,
)
from kiln_workers.package.build import EnvironmentTextures, LobeMap, PackageInput
from kiln_workers.package.half import as_stored
from kiln_workers.package.preview import FunctionPreview, PackagePreview, TexelPreview, choose_texels
from kiln_workers.scene.model import Image, LightKind, Material, Mesh, PunctualLight, Scene, TextureRef
from kiln_workers.sphere import gaussian, octahedral

NODE = Path(__file__).parent / "node"


class NodeTools:
    """ktx-parse, gltf-validator and glslang at the versions that package.json pins, in a folder of their own."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def script(self, name: str, *arguments: Path) -> Any:
        """Run one of the .mjs programs; its JSON output."""
        done = subprocess.run(
            ["node", str(self.folder / name), *map(str, arguments)], capture_output=True, text=True, timeout=60
        )
        assert done.returncode == 0, done.stderr
        return json.loads(done.stdout)

    def glslang(self, *arguments: Path | str) -> subprocess.CompletedProcess[str]:
        """Run the Khronos reference compiler (the package carries a Linux x86-64 binary)."""
        binary = self.folder / "node_modules/glslang-validator-prebuilt-predownloaded/bin/glslangValidator.linux"
        binary.chmod(0o755)
        return subprocess.run([str(binary), *map(str, arguments)], capture_output=True, text=True, timeout=600)


@pytest.fixture(scope="session")
def node_tools(tmp_path_factory: pytest.TempPathFactory) -> NodeTools:
    folder = tmp_path_factory.mktemp("node")
    for file in NODE.iterdir():
        if file.is_file():
            shutil.copy(file, folder)
    command = ["npm", "install", "--no-audit", "--no-fund", "--no-package-lock", "--ignore-scripts"]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=900)
    assert done.returncode == 0, f"npm could not install the readers that package.json pins:\n{done.stderr}"
    return NodeTools(folder)


@pytest.fixture(scope="session")
def native() -> Iterator[Callable[..., Any]]:
    """Call a function in a process of its own, where compilers and drivers can do no harm; what it returns."""
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as process:
        yield lambda function, *arguments: process.submit(function, *arguments).result(timeout=600)


@pytest.fixture
def read_png(tmp_path: Path) -> Callable[[bytes], np.ndarray]:
    """Decode PNG bytes with OpenImageIO, colours not multiplied by alpha: uint8 [H, W, channels]."""

    def read(data: bytes) -> np.ndarray:
        path = tmp_path / f"{len(list(tmp_path.iterdir()))}.png"
        path.write_bytes(data)
        config = oiio.ImageSpec()
        config.attribute("oiio:UnassociatedAlpha", 1)
        source = oiio.ImageInput.open(str(path), config)
        assert source is not None, oiio.geterror()
        try:
            spec = source.spec()
            return source.read_image(oiio.UINT8).reshape(spec.height, spec.width, spec.nchannels)
        finally:
            source.close()

    return read


@dataclass(frozen=True)
class FakeTexelMap:
    state: np.ndarray
    texel_size: np.ndarray
    chart: np.ndarray
    normal: np.ndarray


@dataclass(frozen=True)
class Sample:
    """A bake to package, and the light-field images that it pretends to have been fitted to."""

    given: PackageInput
    images: dict[Function, np.ndarray]  # [H, W, R, R, 3]
    texel_map: FakeTexelMap


@pytest.fixture
def make_scene() -> Callable[[], Scene]:
    return sample_scene


@pytest.fixture
def make_sample() -> Callable[..., Sample]:
    return sample


def sample_scene() -> Scene:
    """Textures of every kind, wrap modes, a transform, emission above 1, a cutout, all lights, a mesh without UV."""
    random = np.random.default_rng(1)
    images = (
        Image("colour", random.integers(0, 256, (4, 8, 4), dtype=np.uint8), True),
        Image("hdr", random.uniform(0.0, 7.0, (4, 4, 3)).astype(np.float32), False),
        Image("rough", random.integers(0, 256, (8, 8, 3), dtype=np.uint8), False),
        Image("gray", random.integers(0, 256, (2, 2, 1), dtype=np.uint8), True),
    )
    transformed = TextureRef(0, ("clamp", "mirror"), (0.1, 0.2), (2.0, 3.0), 0.5)
    materials = (
        Material(
            "cutout",
            base_color_texture=transformed,
            metallic_roughness_texture=TextureRef(2),
            alpha_cutoff=0.4,
            double_sided=True,
        ),
        Material("<lamp>", emission=(5.0, 2.0, 1.0), emission_texture=TextureRef(1)),
        Material("plain", base_color_texture=TextureRef(3), metallic=1.0, roughness=0.3),
    )
    lights = (
        PunctualLight("bulb", LightKind.POINT, (1.0, 2.0, 3.0), position=(1.0, 2.0, 3.0)),
        PunctualLight("spot", LightKind.SPOT, (4.0, 4.0, 3.0), direction=(0.0, -1.0, 0.0), outer_cone=0.5),
        PunctualLight("sun", LightKind.DIRECTIONAL, (9.0, 8.0, 7.0), direction=(0.0, 0.0, 1.0)),
    )
    meshes = (_quad("floor", 0, 0.0), _quad("lamp & shade", 1, 1.0), _quad("bare", 2, 2.0, uv=False))
    return Scene(meshes, materials, images, lights)


def _quad(name: str, material: int, height: float, uv: bool = True) -> Mesh:
    corners = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.float32)
    positions = np.column_stack([corners, np.full(4, height, np.float32)]).astype(np.float32)
    normals = np.tile(np.array([0, 0, 1], np.float32), (4, 1))
    faces = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
    return Mesh(name, positions, normals, faces, material, corners if uv else None, 0.3 * corners + 0.3 * height)


def sample(
    *, size: int = 24, image_size: int = 16, lobes: int = 4, environment: bool = True, name: str = "gallery"
) -> Sample:
    """A bake over two charts facing +Z and +Y, with some texels inside geometry and a gutter."""
    random = np.random.default_rng(7)
    texel_map = _texel_map(size)
    functions = [Function.LIGHT_FIELD, Function.VISIBILITY] if environment else [Function.LIGHT_FIELD]
    mask = texel_map.state == 1
    lobe_maps, images, metrics, fits, previews = {}, {}, {}, [], {}
    for function in functions:
        exposure = 0.7 if function is Function.LIGHT_FIELD else 1.0
        lobe_maps[function] = LobeMap(_smooth_lobes(random, mask, lobes, function), mask)
        images[function] = _noisy_images(random, lobe_maps[function], texel_map.normal, image_size)
        metrics[function], errors = _metrics(lobe_maps[function], images[function], texel_map.normal, exposure)
        previews[function] = _preview(lobe_maps[function], images[function], errors, texel_map.normal)
        fits.append(_fit(function, metrics[function], exposure))
    rows, columns = np.indices((size, size)) / size
    irradiance = np.stack([3.0 * columns + 0.1, 2.0 * rows + 0.1, 1.5 - columns], axis=-1).astype(np.float32)
    irradiance[~mask] = np.nan
    given = PackageInput(
        payload=_payload(name, fits, environment, size, image_size, lobes),
        scene=sample_scene(),
        texel_map=texel_map,
        irradiance_map=texel_map,
        irradiance=irradiance,
        lobes=lobe_maps,
        metrics=metrics,
        preview=PackagePreview(_atlas(texel_map), previews),
        environment=_environment(random) if environment else None,
        stage_seconds={"prepare": 1.25, "render": 41.5, "fit": 96.0, "package": 3.1},
        versions={"lightkiln": "0.1.0", "numpy": np.__version__},
    )
    return Sample(given, images, texel_map)


def _texel_map(size: int) -> FakeTexelMap:
    state, chart = np.zeros((size, size), np.uint8), np.full((size, size), -1, np.int32)
    half = size // 2
    state[2 : size - 2, 2 : half - 1], chart[2 : size - 2, 2 : half - 1] = 1, 0
    state[3 : size - 3, half + 1 : size - 2], chart[3 : size - 3, half + 1 : size - 2] = 1, 1
    state[5:7, half - 3 : half - 1] = 2
    normal = np.zeros((size, size, 3), np.float32)
    normal[chart == 0] = (0.0, 0.0, 1.0)
    normal[chart == 1] = (0.0, 1.0, 0.0)
    texel_size = np.where(chart >= 0, 0.05, 0.0).astype(np.float32)
    return FakeTexelMap(state, texel_size, chart, normal)


def _smooth_lobes(random: np.random.Generator, mask: np.ndarray, count: int, function: Function) -> np.ndarray:
    """Lobes whose parameters drift over the map; NaN outside the mask."""
    rows, columns = np.indices(mask.shape)[:, :, :, None] / mask.shape[0]
    angle = 2.0 * np.pi * (np.arange(count) / count + 0.15 * rows) + 0.5 * columns
    axes = np.stack([np.cos(angle), 0.7 + 0.3 * np.sin(2.0 * angle), np.sin(angle) + 0.6], axis=-1)
    lobes = np.concatenate([axes, np.zeros((*mask.shape, count, 4))], axis=-1)
    lobes[..., 3] = 4.0 + 12.0 * random.random(count) + 4.0 * columns
    scale = 2.0 if function is Function.LIGHT_FIELD else 0.4
    lobes[..., 4:] = scale * random.random((count, 3)) * (0.5 + rows[..., None])
    lobes[~mask] = np.nan
    return lobes.astype(np.float32)


def _noisy_images(random: np.random.Generator, lobe_map: LobeMap, normal: np.ndarray, size: int) -> np.ndarray:
    """What the stored lobes give, times noise, nothing below the horizon; zero outside the mask."""
    directions = octahedral.pixel_directions(size)
    images = np.zeros((*lobe_map.mask.shape, size, size, 3), np.float16)
    for row, column in np.argwhere(lobe_map.mask):
        stored = as_stored(lobe_map.lobes[row, column]).astype(np.float64)
        values = gaussian.evaluate(directions.reshape(-1, 3), stored).reshape(size, size, 3)
        values *= random.lognormal(sigma=0.15, size=values.shape)
        values[directions @ normal[row, column] <= 0.0] = 0.0
        images[row, column] = values
    return images


def _metrics(
    lobe_map: LobeMap, images: np.ndarray, normal: np.ndarray, exposure: float
) -> tuple[FitMetrics, np.ndarray]:
    size = images.shape[2]
    directions, weights = octahedral.pixel_directions(size), octahedral.pixel_solid_angles(size)
    errors = np.full(lobe_map.mask.shape, np.nan, np.float32)
    total, zero, weight = 0.0, 0.0, 0.0
    for row, column in np.argwhere(lobe_map.mask):
        stored = as_stored(lobe_map.lobes[row, column]).astype(np.float64)
        predicted = gaussian.evaluate(directions.reshape(-1, 3), stored).reshape(size, size, 3)
        above = weights * (directions @ normal[row, column] > 0.0)
        target = np.log1p(exposure * images[row, column].astype(np.float64))
        squares = (above[..., None] * (target - np.log1p(exposure * predicted)) ** 2).sum()
        errors[row, column] = squares / (3.0 * above.sum())
        total, weight = total + squares, weight + 3.0 * above.sum()
        zero += (above[..., None] * target**2).sum()
    metrics = FitMetrics(
        log_mse=total / weight,
        log_mse_zero=zero / weight,
        log_mse_rel=total / zero,
        texels=int(lobe_map.mask.sum()),
        signal=True,
    )
    return metrics, errors


def _preview(lobe_map: LobeMap, images: np.ndarray, errors: np.ndarray, normal: np.ndarray) -> FunctionPreview:
    size = images.shape[2]
    directions = octahedral.pixel_directions(size).reshape(-1, 3)
    texels = []
    for row, column in choose_texels(errors):
        stored = as_stored(lobe_map.lobes[row, column]).astype(np.float64)
        predicted = gaussian.evaluate(directions, stored).reshape(size, size, 3).astype(np.float32)
        original = images[row, column].astype(np.float32)
        x, y, z = (float(c) for c in normal[row, column])
        texels.append(TexelPreview(row, column, float(errors[row, column]), (x, y, z), original, predicted))
    return FunctionPreview(*texels, errors)


def _fit(function: Function, metrics: FitMetrics, exposure: float) -> FitResult:
    random = np.random.default_rng(3)
    steps = range(10, 2501, 10)
    curve = tuple(
        CurvePoint(step=s, loss=0.04 * np.exp(-s / 400) * random.lognormal(sigma=0.1) + 0.0021) for s in steps
    )
    return FitResult(
        function=function,
        weights="a" * 64,
        exposure=exposure,
        metrics=metrics,
        curve=curve,
        steps=2500,
        seconds=48.2,
    )


def _payload(
    name: str, fits: list[FitResult], environment: bool, size: int, image_size: int, lobes: int
) -> PackagePayload:
    overrides = [f"lightmap.resolution={size}", f"render.image_size={image_size}", f"fit.lobes={lobes}"]
    tile = Tile(row=0, column=0, size=size, texels=size * size)
    files = {"gallery.glb": "b" * 64, "sky.exr": "c" * 64}
    return PackagePayload(
        job_id="0b8e6f0a",
        job_name=name,
        bundle=Bundle(
            entry="gallery.glb", files=files, environment=EnvironmentRef(file="sky.exr") if environment else None
        ),
        prepare=PrepareResult(
            scene="d" * 64,
            texel_map="e" * 64,
            scene_hash="f" * 64,
            tiles=(tile,),
            has_environment=environment,
            has_light=True,
            triangles=6,
            placements=(Placement(mesh="room", scale=0.5, offset=(0.25, 0.0)),),
            notes=("floor: TEXCOORD_1 kept", "lamp & shade: unwrapped because its UVs overlap"),
            seconds=1.25,
        ),
        renders=(RenderResult(tile=tile, paths=1000, overflows=2, invalid=4, seconds=41.5),),
        fits=tuple(fits),
        settings=make_settings("preview", overrides),
        store_url="file:///store",
    )


def _atlas(texel_map: FakeTexelMap) -> np.ndarray:
    tones = np.array([[40, 40, 44], [120, 180, 140], [200, 90, 60]], np.uint8)
    hues = np.array([[40, 40, 44], [90, 140, 200], [230, 170, 80]], np.uint8)
    return np.concatenate([tones[texel_map.state], hues[texel_map.chart + 1]], axis=1)


def _environment(random: np.random.Generator) -> EnvironmentTextures:
    mips = [random.random((6, side, side, 3)).astype(np.float32) for side in (8, 4, 2, 1)]
    layers = random.random((3, 8, 8, 3)).astype(np.float32)
    panorama = random.random((8, 16, 3)).astype(np.float32)
    return EnvironmentTextures(
        panorama, mips, layers, (0.04, 0.25, 1.0), u_integrals=(3.9, 3.1, 1.5), u_normalised=False
    )
