"""Make the package: run the networks over all texels, judge what they give, write and upload every file."""

import platform
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from typing import Final

import numpy as np
import numpy.typing as npt

from kiln_schemas import __version__
from kiln_schemas.errors import InternalError
from kiln_schemas.job import check_bundle
from kiln_schemas.settings import FitSettings, Function, PackagedScene, PackageSettings
from kiln_schemas.tasks import FitMetrics, FitResult, PackagePayload, PackageResult, RefineResult, Tile
from kiln_workers.fit.metrics import TexelErrors, metrics_of, texel_errors
from kiln_workers.fit.predict import Weights, predict
from kiln_workers.fit.source import VALID, valid_texels
from kiln_workers.fit.verdict import failure, has_failed, is_negligible
from kiln_workers.package.build import EnvironmentTextures, LobeMap, PackageInput, build_package
from kiln_workers.package.denoise import denoise
from kiln_workers.package.half import as_stored
from kiln_workers.package.original import encode_original
from kiln_workers.package.preview import FunctionPreview, PackagePreview, TexelPreview, choose_texels
from kiln_workers.render.environment import environment_u, ggx_prefilter, panorama
from kiln_workers.runner.context import Context
from kiln_workers.scene.archive import unpack_scene
from kiln_workers.scene.bands import bands, mapped, release
from kiln_workers.scene.model import Environment, Scene
from kiln_workers.scene.picture import texel_map_picture
from kiln_workers.scene.texel_map import TexelMap, TexelState, open_texel_map
from kiln_workers.sphere.gaussian import evaluate
from kiln_workers.sphere.octahedral import pixel_directions
from kiln_workers.stages.bundle import lay_out
from kiln_workers.stages.gates import GateJudge
from kiln_workers.stages.refine import read_lobes
from kiln_workers.stages.tiles import map_coordinates, tiles_of, with_render_verdict, without_texels
from kiln_workers.store.layout import TEXEL_MAP_ARRAYS
from kiln_workers.store.light_field import LightFieldStore

Float16 = npt.NDArray[np.float16]
Float32 = npt.NDArray[np.float32]

U_ROUGHNESS: Final = np.linspace(0.1, 1.0, 10)
"""Perceptual roughness of the layers of environment_u.ktx2."""

LEAST_MIP: Final = 4
"""Side of the GGX cube's smallest mip."""

TEXELS_AT_ONCE: Final = 256

LIBRARIES: Final = ("mitsuba", "drjit", "torch", "numpy", "tensorstore", "OpenEXR", "OpenImageIO", "uvunwrap")


def run(payload: PackagePayload, context: Context) -> PackageResult:
    """All artifacts of a job, uploaded as blobs."""
    began = time.perf_counter()
    scene = unpack_scene(context.blob(payload.prepare.scene))
    texel_map = with_render_verdict(open_texel_map(context.blob_path(payload.prepare.texel_map)), payload.renders)
    store = LightFieldStore.open(payload.store_url)
    store.write_texel_map({name: getattr(texel_map, name) for name in TEXEL_MAP_ARRAYS})
    tiles = tuple(tiles_of(payload.renders))

    steps = len(payload.fits) + 2
    irradiance_map, irradiance = _irradiance(payload, store, texel_map, tiles, context)
    if payload.settings.package.denoise:
        denoise(irradiance, irradiance_map)
    covered = {tile: valid_texels(texel_map.state, tile) for tile in tiles}
    lobes: dict[Function, LobeMap] = {}
    metrics: dict[Function, FitMetrics] = {}
    previews: dict[Function, FunctionPreview] = {}
    for number, fit in enumerate(payload.fits):
        context.progress(number, steps, "steps", f"evaluating the {fit.function.value}")
        texels = _Texels(store, texel_map, tiles, fit.function)
        with store.all_lost([fit.function.value], covered):
            judged = _judge(fit, payload.refines, texels, payload.settings.fit, context)
        lobes[fit.function], metrics[fit.function], previews[fit.function] = judged

    context.progress(steps - 2, steps, "steps", "convolving the environment")
    environment = _convolve(scene.environment, payload.settings.package) if scene.environment else None

    context.progress(steps - 1, steps, "steps", "writing the package")
    folder = context.scratch / "package"
    folder.mkdir()
    judge = GateJudge(
        payload,
        scene,
        metrics,
        on_progress=lambda message: context.progress(steps - 1, steps, "steps", message),
        read_blob=context.blob,
    )
    artifacts = build_package(
        folder,
        PackageInput(
            payload=payload,
            scene=scene,
            texel_map=texel_map,
            irradiance_map=irradiance_map,
            irradiance=irradiance,
            lobes=lobes,
            metrics=metrics,
            preview=PackagePreview(atlas=texel_map_picture(texel_map), functions=previews),
            environment=environment,
            stage_seconds=_stage_seconds(payload, time.perf_counter() - began),
            versions=_versions(),
            original=_original(payload, scene, context),
            supercompress=payload.settings.package.supercompress,
        ),
        judge,
    )
    for artifact in artifacts:
        context.put_blob(folder / artifact.name)
    return PackageResult(artifacts=tuple(artifacts), gates=judge.results, seconds=time.perf_counter() - began)


def _irradiance(
    payload: PackagePayload, store: LightFieldStore, texel_map: TexelMap, tiles: Sequence[Tile], context: Context
) -> tuple[TexelMap, Float32]:
    """The irradiance map's texels and values [H, W, 3]: the finer ones where the bake has rendered them."""
    if payload.prepare.fine is None:
        return texel_map, store.read_irradiance(tiles)
    finer = open_texel_map(context.blob_path(payload.prepare.fine))
    irradiance = store.read_fine_irradiance(tiles)
    return without_texels(finer, np.asarray((irradiance < 0.0).any(axis=2))), np.maximum(irradiance, 0.0)


def _original(payload: PackagePayload, scene: Scene, context: Context) -> bytes | None:
    """The user's own file with the light-map UVs, where it is asked for."""
    if payload.settings.package.scene is not PackagedScene.ORIGINAL:
        return None
    bundle = check_bundle(payload.bundle)
    return encode_original(lay_out(bundle, context), bundle.entry, scene.meshes)


@dataclass(frozen=True)
class _Texels:
    """The valid texels of one function, tile by tile."""

    store: LightFieldStore
    map: TexelMap
    tiles: tuple[Tile, ...]
    function: Function

    def batches(self) -> Iterator[tuple[tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]], Float16, Float32]]:
        """(rows, columns), images [T, R, R, 3] and normals [T, 3] of at most TEXELS_AT_ONCE texels at a time."""
        for tile in self.tiles:
            inside = valid_texels(self.map.state, tile)
            for start in range(0, len(inside), TEXELS_AT_ONCE):
                part = inside[start : start + TEXELS_AT_ONCE]
                place = map_coordinates(tile, part)
                yield place, self.store.read_tile(self.function, tile, part), self.map.normal[place]

    def image(self, row: int, column: int) -> Float16:
        """One texel's image [R, R, 3]."""
        tile = next(t for t in self.tiles if 0 <= row - t.row < t.size and 0 <= column - t.column < t.size)
        inside = np.array([(row - tile.row) * tile.size + column - tile.column])
        return np.asarray(self.store.read_tile(self.function, tile, inside)[0])


def _judge(
    fit: FitResult, refines: Sequence[RefineResult], texels: _Texels, settings: FitSettings, context: Context
) -> tuple[LobeMap, FitMetrics, FunctionPreview]:
    """Lobes of every valid texel as the texture will hold them, their errors, and the texels to show.

    The lobes are those of the refined blocks, or the network's output, which the fit has judged, where there are none.
    Refined lobes that have failed are left out where the light field is too weak to be seen, else FitFailed. The lobes
    lie in a file.
    """
    network = None if refines else Weights.from_bytes(context.blob(fit.weights))
    shape = texels.map.state.shape
    lobes = mapped(context.scratch / f"lobes-{fit.function}", (*shape, settings.lobes, 7), np.float16)
    mask = np.zeros(shape, bool)
    per_texel = np.full(shape, np.nan, np.float32)
    _take_refined(refines, fit.function, lobes, context)
    valid = int(np.count_nonzero(texels.map.state == VALID))
    sums = mapped(context.scratch / f"sums-{fit.function}", (3, valid or 1), np.float64)

    def measured() -> TexelErrors:
        done = 0
        for place, images, normals in texels.batches():
            if network is not None:
                lobes[place] = as_stored(predict(network, images, normals, threads=context.threads))
            errors = texel_errors(lobes[place].astype(np.float32), images, normals, fit.exposure)
            mask[place] = True
            per_texel[place] = errors.error / errors.weight
            sums[:, done : done + len(images)] = errors.error, errors.zero, errors.weight
            done += len(images)
            release(lobes, sums)
            texels.map.release()
        return TexelErrors(*sums[:, :done])

    total, signal = measured(), fit.metrics.signal
    if refines and signal and has_failed(total):
        irradiance = texels.store.read_irradiance(texels.tiles)[texels.map.state == TexelState.VALID]
        if fit.function is Function.VISIBILITY or not is_negligible(fit.exposure, irradiance):
            setting = settings.refine_steps_key(fit.function)
            raise failure(total, fit.function, setting, getattr(settings, setting), settings.lobes)
        for rows in bands(shape):
            lobes[rows][mask[rows], :, 4:] = 0.0
            release(lobes)
        total, signal = measured(), False
    best, median, worst = (_preview(texels, lobes, per_texel, at) for at in choose_texels(per_texel))
    return LobeMap(lobes, mask), metrics_of(total, signal=signal), FunctionPreview(best, median, worst, per_texel)


def _take_refined(
    refines: Sequence[RefineResult], function: Function, lobes: npt.NDArray[np.float16], context: Context
) -> None:
    """Write a function's refined lobes into the map, as stored; InternalError where a block is not whole."""
    for refine in refines:
        place, found = read_lobes(context.blob(refine.lobes), function)
        if len(found) != refine.texels:
            raise InternalError(f"block {refine.block.row},{refine.block.column} has {len(found)} texels")
        lobes[place] = as_stored(found)
        release(lobes)


def _preview(texels: _Texels, lobes: Float16, errors: Float32, at: tuple[int, int]) -> TexelPreview:
    original = texels.image(*at).astype(np.float32)
    size = original.shape[0]
    predicted = evaluate(pixel_directions(size).reshape(-1, 3), lobes[at].astype(np.float64))
    x, y, z = (float(value) for value in texels.map.normal[at])
    return TexelPreview(
        row=at[0],
        column=at[1],
        log_mse=float(errors[at]),
        normal=(x, y, z),
        original=original,
        predicted=predicted.reshape(size, size, 3).astype(np.float32),
    )


def _convolve(environment: Environment, settings: PackageSettings) -> EnvironmentTextures:
    """The environment's two preconvolved textures (light-field paper, eq. 6, and the split sum), and itself."""
    size = settings.environment_size
    mips = int(np.log2(size / LEAST_MIP)) + 1
    alphas = U_ROUGHNESS**2
    layers, integrals = environment_u(environment, alphas, size)
    return EnvironmentTextures(
        panorama=panorama(environment),
        ggx_mips=ggx_prefilter(environment, size, mips),
        u_layers=layers,
        u_alphas=alphas.tolist(),
        u_integrals=integrals.tolist(),
        u_normalised=False,
    )


def _stage_seconds(payload: PackagePayload, package: float) -> Mapping[str, float]:
    """Busy seconds of each stage, added up over its tasks; `package` up to the writing of the manifest."""
    fits = {f"fit {fit.function.value}": fit.seconds for fit in payload.fits}
    render = sum(result.seconds for result in payload.renders)
    refine = {"refine": sum(result.seconds for result in payload.refines)} if payload.refines else {}
    return {"prepare": payload.prepare.seconds, "render": render, **fits, **refine, "package": package}


def _versions() -> Mapping[str, str]:
    return {"lightkiln": __version__, "python": platform.python_version()} | {name: version(name) for name in LIBRARIES}
