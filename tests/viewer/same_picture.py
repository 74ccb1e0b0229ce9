"""Pictures of rasterisers held against those of `lightkiln shade`: one sample in the middle of each pixel, linear.

A rasteriser snaps vertices to a fraction of a pixel (1/16 in software GL), a ray tracer does not. So the picture is
drawn three times finer and every third pixel kept, and pixels whose ray meets another place of the light map when it is
moved by 1/64 of a pixel are left out: there the two see different surfaces, both rightly. The rule reads the ray
tracer's G-buffers alone, never the rasteriser's picture, and what it leaves out is bounded.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from kiln_schemas.camera import Camera
from kiln_workers.package import colour
from kiln_workers.shade.camera import camera_frame
from kiln_workers.shade.gbuffer import GBuffer, render_gbuffer
from kiln_workers.shade.package import ShadePackage
from kiln_workers.shade.picture import shade

WIDTH, HEIGHT, FINER = 192, 108, 3
LEAST_PSNR = 45.0
MOST_LEFT_OUT = 0.02
SHIFT = 1 / 64
TEXEL = 1 / 32


@dataclass(frozen=True)
class Reference:
    """What `lightkiln shade` computes for a scene's camera."""

    package: ShadePackage
    camera: Camera
    buffer: GBuffer
    inner: np.ndarray  # [H, W] pixels that are compared
    white: float

    @classmethod
    def of(cls, folder: Path, camera: Camera) -> "Reference":
        package = ShadePackage.read(folder, torch.device("cpu"))
        buffer = render_gbuffer(package.scene, camera, WIDTH, HEIGHT, 1, "cpu")
        inner = steady(package.scene, camera, buffer)
        assert 1.0 - inner.mean() < MOST_LEFT_OUT
        return cls(package, camera, buffer, inner, colour.white_point(shade(package, buffer)))

    def picture(self, terms) -> np.ndarray:
        return shade(self.package, self.buffer, terms)

    def psnr(self, seen: np.ndarray, terms) -> float:
        """Against the white of the whole picture: harsher than against a maximum of an HDR picture."""
        errors = (seen[..., :3].astype(np.float64) - self.picture(terms))[self.inner]
        return float(10.0 * np.log10(self.white**2 / max(np.mean(np.square(errors)), 1e-20)))


def steady(scene, camera: Camera, buffer: GBuffer) -> np.ndarray:
    """Pixels [H, W] that see the same place of the light map when the camera is turned by a fraction of a pixel."""
    right, up, forward = camera_frame(camera)
    pixel = 2.0 * np.tan(np.radians(camera.fov_deg) / 2.0) / HEIGHT
    uv, hit = places(buffer)
    same = np.ones((HEIGHT, WIDTH), bool)
    for x, y in ((1, 1), (1, -1), (-1, 1), (-1, -1)):
        target = np.asarray(camera.position) + forward + SHIFT * pixel * (x * right + y * up)
        moved = camera.model_copy(update={"target": tuple(target.tolist())})
        other_uv, other_hit = places(render_gbuffer(scene, moved, WIDTH, HEIGHT, 1, "cpu"))
        same &= (hit == other_hit) & (np.abs(uv - other_uv).max(axis=-1) < 0.5 * TEXEL)
    return same


def places(buffer: GBuffer) -> tuple[np.ndarray, np.ndarray]:
    hit = buffer.hit[..., 0]
    uv = np.zeros((*hit.shape, 2))
    uv[hit] = buffer.lightmap_uv
    return uv, hit
