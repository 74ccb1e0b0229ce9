"""Pictures of a comparison: each solver's lobes in the package's place, shaded, against the path-traced reference.

The lobes become textures as the packager makes them (scene units, fp16, dilated over the gutters); all else is the
package's: irradiance, visibility, environment, materials. What the reference's own noise gives is stated beside it.
"""

import hashlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import torch

from kiln_schemas.camera import Camera
from kiln_workers.compare.cache import Cache
from kiln_workers.compare.result import Camera as CameraView
from kiln_workers.compare.result import ImageScore
from kiln_workers.compare.subject import Subject
from kiln_workers.compare.texels import ChosenTexels
from kiln_workers.fit.lobes import amplitude_scale
from kiln_workers.package import colour
from kiln_workers.package.dilate import plan_fill
from kiln_workers.package.half import as_stored
from kiln_workers.shade import image_metrics
from kiln_workers.shade.gbuffer import GBuffer, render_gbuffer
from kiln_workers.shade.package import Incident, LobeTextures, ShadePackage
from kiln_workers.shade.picture import shade
from kiln_workers.shade.reference import Reference, path_trace
from kiln_workers.shade.stored import StoredImages

Float32 = npt.NDArray[np.float32]
Bools = npt.NDArray[np.bool_]

MAX_DEPTH: Final = 12
"""Scattering events of the reference's paths."""
GRID: Final = 2
LEAST_SHARE: Final = 0.003
"""Share of the picture below which a material's alpha is not reported."""
MOST_ALPHAS: Final = 8


@dataclass(frozen=True)
class PictureSettings:
    width: int
    height: int
    samples: int
    """Paths a pixel of the reference, both halves together."""


@dataclass(frozen=True)
class Shot:
    """A shaded picture and how far it is from the reference."""

    picture: Float32  # [H, W, 3]
    error: Float32  # [H, W] FLIP
    scores: tuple[ImageScore, ...]
    """Whole and per alpha."""


@dataclass(frozen=True)
class View:
    """One camera: what it sees and what it should look like."""

    name: str
    camera: Camera
    buffer: GBuffer
    reference: Reference

    @cached_property
    def white(self) -> float:
        """Luminance that shows as white, in every picture of this camera."""
        return colour.white_point(self.reference.picture)

    @cached_property
    def masks(self) -> dict[float | None, Bools]:
        """Pixels [H, W] that count: all under None, then those of one material alpha each."""
        alpha = np.round(self.buffer.pixel_alpha().astype(np.float64), 2)
        values, counts = np.unique(alpha[np.isfinite(alpha)], return_counts=True)
        usual = values[np.argsort(-counts, kind="stable")][:MOST_ALPHAS]
        out: dict[float | None, Bools] = {None: np.ones(alpha.shape, bool)}
        for value in sorted(usual.tolist()):
            mask = alpha == value
            if mask.mean() >= LEAST_SHARE:
                out[value] = mask
        return out

    @cached_property
    def noise(self) -> Float32:
        """FLIP [H, W] that the reference's own noise gives."""
        return image_metrics.flip_noise_floor(self.reference.halves)

    def judge(self, picture: Float32) -> Shot:
        """The picture [H, W, 3] against the reference."""
        error = image_metrics.flip_map(self.reference.picture, picture)
        scores = tuple(self._score(alpha, mask, picture, error) for alpha, mask in self.masks.items())
        return Shot(picture, error, scores)

    def _score(self, alpha: float | None, mask: Bools, picture: Float32, error: Float32) -> ImageScore:
        whole = alpha is None
        psnr = masked_psnr(self.reference.picture, picture, self.white, mask)
        return ImageScore(
            camera=self.name,
            alpha=alpha,
            pixels=int(mask.sum()),
            psnr=psnr,
            ssim=float(image_metrics.ssim(self.reference.picture, picture, self.white)) if whole else None,
            flip=float(error[mask].mean()),
            flip_noise=float(self.noise[mask].mean()),
        )


class Studio:
    """Shades one subject's package with any lobes, from all cameras."""

    def __init__(
        self,
        subject: Subject,
        chosen: ChosenTexels,
        cameras: Mapping[str, Camera],
        settings: PictureSettings,
        cache: Cache,
        on_progress: Callable[[str], None],
    ) -> None:
        self._subject, self._chosen, self._settings, self._cache = subject, chosen, settings, cache
        self._package = ShadePackage.read(subject.folder, torch.device("cpu"))
        self._fill = plan_fill(_valid(chosen), chosen.texel_map.chart)
        self.views = []
        for name, camera in cameras.items():
            on_progress(f"reference of camera {name}")
            self.views.append(self._view(name, camera))

    def shaded(self, view: View, lobes: Float32) -> Float32:
        """Picture [H, W, 3] with the light field of lobes [T, N, 7] in exposure-normalised radiance."""
        texture = self.texture(lobes)
        key = self._key(view.camera) | {"lobes": hashlib.sha256(texture.tobytes()).hexdigest()}
        return self._picture(view, key, LobeTextures(torch.from_numpy(texture), self._package.lobes.visibility_lobes))

    def shaded_from_store(self, view: View) -> Float32:
        """Picture [H, W, 3] from the stored light fields themselves."""
        shape = self._subject.store.shape
        key = self._key(view.camera) | {"lobes": "stored"}
        return self._picture(view, key, lambda: StoredImages.open(self._subject.store.url, shape))

    def texture(self, lobes: Float32) -> Float32:
        """The lobe texture [H, W, N, 7] as the package would hold it."""
        field, shape = self._chosen.field, self._chosen.texel_map.state.shape
        out = np.zeros((*shape, *lobes.shape[1:]), np.float32)
        scale = amplitude_scale(1.0 / field.exposure).numpy()
        out[field.place[:, 0], field.place[:, 1]] = lobes * scale
        return as_stored(self._fill.nearest(out))

    def described(self, view: View, *, stored: bool) -> CameraView:
        """The camera's part of the result."""
        halves = view.reference.halves
        whole = np.ones(view.buffer.hit.shape[:2], bool)
        return CameraView(
            name=view.name,
            width=self._settings.width,
            height=self._settings.height,
            samples=view.reference.samples,
            psnr_of_halves=masked_psnr(*halves, view.white, whole),
            flip_of_halves=float(image_metrics.flip(*halves)),
            rms_noise=view.reference.rms_noise,
            stored=view.judge(self.shaded_from_store(view)).scores if stored else (),
        )

    def _view(self, name: str, camera: Camera) -> View:
        settings = self._settings
        buffer = render_gbuffer(self._package.scene, camera, settings.width, settings.height, GRID)
        key = self._key(camera)
        found = self._cache.load("reference", key)
        if found is None:
            made = path_trace(self._subject.scene, camera, settings.width, settings.height, settings.samples, MAX_DEPTH)
            arrays = {"first": made.halves[0], "second": made.halves[1]}
            self._cache.save("reference", key, {"samples": made.samples}, arrays)
            found = {"samples": made.samples}, arrays
        halves = np.array(found[1]["first"]), np.array(found[1]["second"])
        return View(name, camera, buffer, Reference(halves, found[0]["samples"]))

    def _picture(self, view: View, key: dict[str, Any], incident: Incident | Callable[[], Incident]) -> Float32:
        found = self._cache.load("picture", key)
        if found is not None:
            return np.array(found[1]["picture"])
        light = incident() if callable(incident) else incident
        if isinstance(light, LobeTextures):
            picture = shade(replace(self._package, lobes=light), view.buffer)
        else:
            picture = shade(self._package, view.buffer, incident=light)
        self._cache.save("picture", key, {}, {"picture": picture})
        return picture

    def _key(self, camera: Camera) -> dict[str, Any]:
        settings = self._settings
        return {
            "scene": self._subject.manifest.scene_hash,
            "package": self._subject.manifest.job_id,
            "camera": camera.model_dump(mode="json"),
            "size": [settings.width, settings.height],
            "samples": settings.samples,
            "depth": MAX_DEPTH,
            "grid": GRID,
        }


def masked_psnr(reference: Float32, picture: Float32, white: float, mask: Bools) -> float | None:
    """PSNR in dB of the display-mapped pictures over the pixels of `mask` [H, W]; None where they are equal."""
    mapped = [colour.tone_map(image[mask], white).astype(np.float64) for image in (reference, picture)]
    error = float(np.mean(np.square((mapped[0] - mapped[1]) / 255.0)))
    return None if error == 0.0 else -10.0 * float(np.log10(error))


def _valid(chosen: ChosenTexels) -> Bools:
    out = np.zeros(chosen.texel_map.state.shape, bool)
    out[chosen.field.place[:, 0], chosen.field.place[:, 1]] = True
    return out
