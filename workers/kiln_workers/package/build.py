"""Builds a package from arrays: the files of DESIGN's "What comes out", and last of all the manifest that names them.

A pure library: it knows no queue, no store and no network. Every file is written atomically; `manifest.json` comes last
(and an old one goes first), so a folder with a manifest is a whole package.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, Protocol

import numpy as np
import numpy.typing as npt

from kiln_schemas import __version__
from kiln_schemas.conventions import (
    ENVIRONMENT_EXR,
    ENVIRONMENT_GGX_KTX2,
    ENVIRONMENT_U_KTX2,
    ERRORS_KTX2,
    FORMAT_VERSION,
    IRRADIANCE_EXR,
    IRRADIANCE_KTX2,
    LAYERS_PER_LOBE,
    LIGHT_FIELD_KTX2,
    MANIFEST_JSON,
    ORIGINAL_GLB,
    REPORT_HTML,
    SCENE_GLB,
    VISIBILITY_KTX2,
)
from kiln_schemas.errors import InternalError
from kiln_schemas.manifest import Manifest, ManifestMetrics
from kiln_schemas.settings import Function
from kiln_schemas.tasks import Artifact, FitMetrics, PackagePayload
from kiln_workers.package import exr, ktx2, report, shaders
from kiln_workers.package.dilate import Fill, plan_fill
from kiln_workers.package.files import artifact, write_bytes
from kiln_workers.package.gates import Judgement, write_gates
from kiln_workers.package.glb import encode_glb
from kiln_workers.package.half import lobes_to_layers, to_half
from kiln_workers.package.preview import PackagePreview
from kiln_workers.package.seams import LOBES, Stitcher
from kiln_workers.scene.bands import bands, release
from kiln_workers.scene.model import Scene
from kiln_workers.scene.texel_map import speck_share

Float32 = npt.NDArray[np.float32]
Bools = npt.NDArray[np.bool_]

LOBE_FILES: Final = {Function.LIGHT_FIELD: LIGHT_FIELD_KTX2, Function.VISIBILITY: VISIBILITY_KTX2}
TEXEL_VALID: Final = 1
LOBE_SHARE: Final = 8
"""Of a band's texels, so that their lobes take no more memory than other maps' bands do."""
GGX_LOD: Final = "(mips - 1) * r * (2 - r)"


class TexelMapLike(Protocol):
    """What the packager reads of a texel map (`kiln_workers.scene.texels.TexelMap`); arrays [H, W]."""

    @property
    def state(self) -> npt.NDArray[np.uint8]: ...
    @property
    def texel_size(self) -> Float32: ...
    @property
    def chart(self) -> npt.NDArray[np.int32]: ...


@dataclass(frozen=True)
class LobeMap:
    """The lobes of one function over the light map."""

    lobes: Float32 | npt.NDArray[np.float16]
    """[H, W, N, 7]; anything outside `mask`. May lie in a file (`scene.bands`), and is read some rows at a time."""
    mask: Bools  # [H, W] texels that have lobes


@dataclass(frozen=True)
class EnvironmentTextures:
    """The environment, preconvolved and as it is (`kiln_workers.render.environment`)."""

    panorama: Float32
    """[H, W, 3] equirectangular, W = 2 H: row 0 is +Y, the centre is +X, to the right of it lies +Z."""
    ggx_mips: Sequence[Float32]
    """Per mip [6, S, S, 3], largest first, faces +X -X +Y -Y +Z -Z with OpenGL's face orientations."""
    u_layers: Float32
    """[A, R, R, 3] octahedral maps of U(direction, alpha)."""
    u_alphas: Sequence[float]
    """Ascending alpha of each layer."""
    u_integrals: Sequence[float]
    """Integral of D(h) alone for each layer: U / integral is a mean of radiance."""
    u_normalised: bool
    """Whether U was divided by the integral of D(h); the paper's is not."""


@dataclass(frozen=True)
class PackageInput:
    """Everything that a package is made of, as arrays."""

    payload: PackagePayload
    scene: Scene
    texel_map: TexelMapLike
    irradiance_map: TexelMapLike
    """The texels of the irradiance map: the light map's own, or finer ones."""
    irradiance: Float32  # [H, W, 3] radiance times sr; anything outside valid texels
    lobes: Mapping[Function, LobeMap]
    metrics: Mapping[Function, FitMetrics]
    """Errors of the lobes as stored (`half.as_stored`), for each function of `lobes`."""
    preview: PackagePreview
    environment: EnvironmentTextures | None
    stage_seconds: Mapping[str, float]
    versions: Mapping[str, str]
    left_out: Mapping[str, str] = field(default_factory=dict)
    original: bytes | None = None
    """`original.glb`, where it is asked for."""
    supercompress: bool = False
    """Zstandard inside the lobe textures; engines that cannot inflate need plain files."""


Judge = Callable[[Path, Manifest], Judgement]
"""Measures the quality gates on the files that are there, under the manifest as it stands."""


@dataclass
class _Package:
    """The folder being filled."""

    folder: Path
    given: PackageInput
    files: list[Artifact] = field(default_factory=list)
    textures: dict[str, dict[str, Any]] = field(default_factory=dict)
    clamped: int = 0
    judgement: Judgement = field(default_factory=Judgement)

    def add(self, name: str) -> None:
        self.files.append(artifact(self.folder, name))

    def add_texture(self, name: str, texture: ktx2.Texture, description: Mapping[str, Any]) -> None:
        """Write a KTX2 file and describe it."""
        ktx2.write(self.folder / name, texture)
        self._describe(name, texture.shape, len(texture.levels), False, description)

    def add_bands(self, name: str, shape: ktx2.Shape, bands: ktx2.Bands, description: Mapping[str, Any]) -> None:
        """The same of a texture that is made some rows at a time."""
        compress = self.given.supercompress and name in LOBE_FILES.values()
        ktx2.write_bands(self.folder / name, shape, bands, supercompress=compress)
        self._describe(name, shape, 1, compress, description)

    def _describe(
        self, name: str, shape: ktx2.Shape, mips: int, compress: bool, description: Mapping[str, Any]
    ) -> None:
        self.textures[name] = {
            "width": shape.width,
            "height": shape.height,
            "layers": shape.layers,
            "faces": shape.faces,
            "mips": mips,
            "format": "R16G16B16A16_SFLOAT",
            "supercompression": "zstd" if compress else "none",
            **description,
        }
        self.add(name)

    def half(self, values: Float32) -> npt.NDArray[np.float16]:
        """RGB values [..., 3] as RGBA halves with alpha 1, clamped values counted."""
        rgb, clamped = to_half(values)
        self.clamped += clamped
        return np.concatenate([rgb, np.ones((*rgb.shape[:-1], 1), np.float16)], axis=-1)


def build_package(folder: Path, given: PackageInput, judge: Judge | None = None) -> list[Artifact]:
    """Write the whole package into `folder`; every file of it, the manifest last, which holds what `judge` found.

    Raises MachineLacks where the disk refuses, InternalError where the arrays contradict each other.
    """
    _check(given)
    package = _Package(folder, given)
    (folder / MANIFEST_JSON).unlink(missing_ok=True)
    valid = given.irradiance_map.state == TEXEL_VALID
    for function, lobe_map in given.lobes.items():
        fill = plan_fill(lobe_map.mask, given.texel_map.chart)
        _write_lobes(package, function, lobe_map, fill, Stitcher(given.scene, fill, LOBES))
    fill = plan_fill(valid, given.irradiance_map.chart)
    irradiance = _filled_irradiance(given.irradiance, fill, Stitcher(given.scene, fill))
    _write_irradiance(package, irradiance)
    _write_errors(package)
    if given.environment is not None:
        _write_environment(package, given.environment)
    write_bytes(folder / SCENE_GLB, encode_glb(given.scene))
    package.add(SCENE_GLB)
    if given.original is not None:
        write_bytes(folder / ORIGINAL_GLB, given.original)
        package.add(ORIGINAL_GLB)
    for name, text in shaders.sources().items():
        write_bytes(folder / "shaders" / name, text.encode("utf-8"))
        package.add(f"shaders/{name}")

    if judge is not None:
        package.judgement = judge(folder, _manifest(package))
    for name in write_gates(folder, given.payload.job_name, package.judgement):
        package.add(name)

    # The report shows the manifest as it stands without the report; the final manifest then names the report as well.
    shown = report.ReportInput(
        _manifest(package), given.payload.fits, given.preview, irradiance, valid, package.judgement
    )
    write_bytes(folder / REPORT_HTML, report.render(shown))
    package.add(REPORT_HTML)
    manifest = _manifest(package).model_dump_json(indent=2) + "\n"
    write_bytes(folder / MANIFEST_JSON, manifest.encode("utf-8"))
    return [*package.files, artifact(folder, MANIFEST_JSON)]


def _check(given: PackageInput) -> None:
    """Arrays that contradict each other are a defect of the caller; say which before anything is written."""
    shape = given.texel_map.state.shape
    if given.irradiance.shape != (*given.irradiance_map.state.shape, 3):
        expected = given.irradiance_map.state.shape
        raise InternalError(f"irradiance is {given.irradiance.shape}, its map {expected}", where="package")
    fitted = {fit.function for fit in given.payload.fits}
    for function, lobe_map in given.lobes.items():
        if lobe_map.lobes.shape[:2] != shape or lobe_map.mask.shape != shape:
            raise InternalError(f"lobes are {lobe_map.lobes.shape}, the light map {shape}", where=str(function))
        if function not in given.metrics or function not in fitted:
            raise InternalError("lobes without metrics or without a fit", where=str(function))
        for rows in bands(shape, LOBE_SHARE):
            if not np.isfinite(lobe_map.lobes[rows][lobe_map.mask[rows]]).all():
                raise InternalError("lobes that are not finite", where=str(function))
            release(lobe_map.lobes)
    if not np.isfinite(given.irradiance[given.irradiance_map.state == TEXEL_VALID]).all():
        raise InternalError("irradiance that is not finite", where="package")


def _write_lobes(package: _Package, function: Function, lobe_map: LobeMap, fill: Fill, stitcher: Stitcher) -> None:
    height, width, count, parameters = lobe_map.lobes.shape
    near_seams = np.empty((len(stitcher.texels), count, parameters), np.float32)
    for rows in bands(lobe_map.mask.shape, LOBE_SHARE):
        part, place = stitcher.within(rows, width)
        if len(place):
            source = tuple(grid.ravel()[place] for grid in fill.sources(rows))
            near_seams[part] = lobe_map.lobes[source]
            release(lobe_map.lobes)
    closed = stitcher.solved_lobes(near_seams)

    def layers() -> Iterator[tuple[int, npt.NDArray[np.float16]]]:
        for rows in bands(lobe_map.mask.shape, LOBE_SHARE):
            lobes = fill.nearest(lobe_map.lobes, rows).astype(np.float32)
            part, place = stitcher.within(rows, width)
            lobes.reshape(-1, count, parameters)[place] = closed[part]
            texels, clamped = lobes_to_layers(lobes)
            package.clamped += clamped
            yield rows.start, texels
            release(lobe_map.lobes)

    metadata = {
        "lightkiln.function": str(function),
        "lightkiln.lobes": str(count),
        "lightkiln.layout": "layer 2k: axis.xyz, sharpness; layer 2k+1: amplitude.rgb, 0",
    }
    description = {
        "function": str(function),
        "lobes": count,
        "channels": {"even_layers": ["axis.x", "axis.y", "axis.z", "sharpness"], "odd_layers": ["r", "g", "b", "0"]},
    }
    shape = ktx2.Shape(width, height, LAYERS_PER_LOBE * count, 1, True, metadata)
    package.add_bands(LOBE_FILES[function], shape, layers(), description)


def _filled_irradiance(values: Float32, fill: Fill, stitcher: Stitcher) -> Float32:
    """The irradiance map [H, W, 3] without holes and with its seams closed."""
    out = np.empty(values.shape, np.float32)
    for rows in bands(out.shape):
        out[rows] = fill.smooth(values, rows)
    flat = out.reshape(-1, 3)
    flat[stitcher.texels] = stitcher.solved(flat[stitcher.texels])
    return np.maximum(out, 0.0, out=out)


def _write_irradiance(package: _Package, irradiance: Float32) -> None:
    unit = "radiance times sr (W/m^2), linear Rec.709"
    exr.write_rgb(package.folder / IRRADIANCE_EXR, irradiance, comments=f"irradiance, {unit}")
    package.add(IRRADIANCE_EXR)
    height, width, _ = irradiance.shape
    shape = ktx2.Shape(width, height, 1, 1, False, {"lightkiln.unit": unit})
    texels = ((rows.start, package.half(irradiance[rows])[None]) for rows in bands(irradiance.shape))
    package.add_bands(IRRADIANCE_KTX2, shape, texels, {"channels": ["r", "g", "b", "1"], "unit": unit})


def _write_errors(package: _Package) -> None:
    """How well each texel's lobes represent what was rendered: where to look when a bake is poor."""
    height, width = package.given.texel_map.state.shape
    errors = {function: shown.errors for function, shown in package.given.preview.functions.items()}

    def texels() -> Iterator[tuple[int, npt.NDArray[np.float16]]]:
        for rows in bands((height, width)):
            values = np.zeros((rows.stop - rows.start, width, 4), np.float32)
            for channel, function in enumerate(LOBE_FILES):
                if function in errors:
                    part = errors[function][rows]
                    values[..., channel] = np.nan_to_num(part)
                    values[..., 3] = np.maximum(values[..., 3], np.isfinite(part))
            yield rows.start, to_half(values)[0][None]

    channels = ["log_mse of the light field", "log_mse of the visibility", "0", "1 where the texel has lobes"]
    shape = ktx2.Shape(width, height, 1, 1, False, {"lightkiln.errors": "log_mse"})
    package.add_bands(ERRORS_KTX2, shape, texels(), {"channels": channels})


def _write_environment(package: _Package, environment: EnvironmentTextures) -> None:
    mips = [package.half(mip) for mip in environment.ggx_mips]
    cube = ktx2.texture_cube(mips, {"lightkiln.lod": GGX_LOD})
    package.add_texture(
        ENVIRONMENT_GGX_KTX2,
        cube,
        {"channels": ["r", "g", "b", "1"], "lod": GGX_LOD, "weighting": "n.l", "normalised": True},
    )
    alphas = [float(alpha) for alpha in environment.u_alphas]
    metadata = {
        "lightkiln.alphas": " ".join(f"{alpha:.6g}" for alpha in alphas),
        "lightkiln.normalised": str(environment.u_normalised).lower(),
        "lightkiln.projection": "octahedral",
    }
    description = {
        "channels": ["r", "g", "b", "1"],
        "alphas": alphas,
        "lobe_integrals": [float(integral) for integral in environment.u_integrals],
        "normalised": environment.u_normalised,
        "projection": "octahedral",
    }
    layers = package.half(environment.u_layers)
    package.add_texture(ENVIRONMENT_U_KTX2, ktx2.texture_array(layers, metadata), description)
    _write_panorama(package, environment.panorama)


def _write_panorama(package: _Package, panorama: Float32) -> None:
    """The environment for other programs, turned as three.js and Blender look up equirectangular images."""
    pixels, clamped = to_half(panorama)
    package.clamped += clamped
    about = "environment, radiance, linear Rec.709; row 0 is +Y, the centre +X, to the right of it +Z"
    exr.write_rgb(package.folder / ENVIRONMENT_EXR, pixels, comments=about)
    package.textures[ENVIRONMENT_EXR] = {
        "width": panorama.shape[1],
        "height": panorama.shape[0],
        "format": "half",
        "channels": ["r", "g", "b"],
        "projection": "equirectangular",
        "top": "+Y",
        "centre": "+X",
        "right_of_centre": "+Z",
    }
    package.add(ENVIRONMENT_EXR)


def _manifest(package: _Package) -> Manifest:
    given, payload = package.given, package.given.payload
    return Manifest(
        format_version=FORMAT_VERSION,
        generator=f"lightkiln {__version__}",
        job_id=payload.job_id,
        job_name=payload.job_name,
        settings=payload.settings,
        scene_hash=payload.prepare.scene_hash,
        inputs=dict(payload.bundle.files),
        environment=payload.bundle.environment,
        seeds={"settings": payload.settings.seed},
        exposure={str(fit.function): fit.exposure for fit in payload.fits if fit.function in given.lobes},
        metrics=ManifestMetrics(
            light_field=given.metrics.get(Function.LIGHT_FIELD), visibility=given.metrics.get(Function.VISIBILITY)
        ),
        gates=package.judgement.results,
        views={view.camera: view.seen for view in package.judgement.views},
        left_out=_left_out(given),
        textures=package.textures,
        lightmap=_lightmap(given.texel_map),
        placements=payload.prepare.placements,
        stage_seconds={name: round(seconds, 3) for name, seconds in given.stage_seconds.items()},
        overflows=sum(render.overflows for render in payload.renders) + package.clamped,
        versions=dict(given.versions),
        notes=(*payload.prepare.notes, *_weak_notes(given)),
        files=tuple(package.files),
    )


def _weak_notes(given: PackageInput) -> list[str]:
    """What is said of functions that were left out because they are too weak."""
    return [
        "Surfaces send each other so little light, under 1 % of what the light map receives, that no lobes fit it: "
        "`lightfield.ktx2` is black."
        for metrics in given.metrics.values()
        if not metrics.signal and metrics.log_mse_zero > 0.0
    ]


def _left_out(given: PackageInput) -> dict[str, str]:
    """What a package could have but this one has not, each with its reason; the caller's reasons come first."""
    out = dict(given.left_out)
    reason = "the scene has no environment" if not given.payload.prepare.has_environment else "it was not baked"
    for function in Function:
        if function not in given.lobes:
            out.setdefault(str(function), reason)
    if given.environment is None:
        for name in (ENVIRONMENT_GGX_KTX2, ENVIRONMENT_U_KTX2, ENVIRONMENT_EXR):
            out.setdefault(name, reason)
    return out


def _lightmap(texel_map: TexelMapLike) -> dict[str, Any]:
    state, chart = texel_map.state, texel_map.chart
    covered, valid = state != 0, state == TEXEL_VALID
    return {
        "width": int(state.shape[1]),
        "height": int(state.shape[0]),
        "covered": int(covered.sum()),
        "valid": int(valid.sum()),
        "invalid": int((covered & ~valid).sum()),
        "charts": int(np.unique(chart[chart >= 0]).size),
        "invalid_texels": np.flatnonzero(covered & ~valid).tolist(),  # row * width + column
        "speck_share": speck_share(chart),
        "worst_texel_size_m": float(texel_map.texel_size[covered].max()),
    }
