"""The browser's pixels are those of `lightkiln shade`: one sample in the middle of each pixel, term by term, linear.

A rasteriser snaps vertices to a fraction of a pixel (1/16 in software GL), a ray tracer does not. So the picture is
drawn three times finer and every third pixel kept, and pixels whose ray meets another place of the light map when it is
moved by 1/64 of a pixel are left out: there the two see different surfaces, both rightly. The rule reads the ray
tracer's G-buffers alone, never the browser's picture, and what it leaves out is bounded.
"""

from dataclasses import dataclass

import numpy as np
import packages
import pytest
import torch

from kiln_schemas.camera import Camera, read_camera
from kiln_workers.package import colour
from kiln_workers.shade.camera import camera_frame
from kiln_workers.shade.gbuffer import GBuffer, render_gbuffer
from kiln_workers.shade.package import ShadePackage
from kiln_workers.shade.picture import shade
from kiln_workers.shade.term import WHOLE, Term

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


@pytest.mark.parametrize("name", packages.SCENES)
def test_each_term_is_the_evaluator_s(name, made, serve, viewer, capture, record_property) -> None:
    folder = made(name)
    camera = read_camera(packages.CAMERAS[name])
    package = ShadePackage.read(folder, torch.device("cpu"))
    buffer = render_gbuffer(package.scene, camera, WIDTH, HEIGHT, 1, "cpu")
    white = colour.white_point(shade(package, buffer))
    reference = Reference(package, camera, buffer, steady(package.scene, camera, buffer), white)
    left_out = 1.0 - reference.inner.mean()
    record_property("left_out", float(left_out))
    assert left_out < MOST_LEFT_OUT
    lit = [*WHOLE, Term.UNOCCLUDED] if package.environment else [Term.EMISSION, Term.DIFFUSE, Term.INTERREFLECTION]
    told = []
    with serve(folder) as url:
        page = viewer.open(url, viewport={"width": 320, "height": 200})
        for terms in ([WHOLE] if package.environment else [lit]) + [[term] for term in lit]:
            expected = reference.picture(terms)
            if name != "courtyard" or terms != [Term.EMISSION]:  # nothing glows there
                assert expected[reference.inner].max() > 0.05 * white, terms
            psnr = reference.psnr(capture(page, camera, terms, WIDTH, HEIGHT, FINER), terms)
            record_property("+".join(terms), float(psnr))
            told.append((name, "+".join(terms), round(psnr, 1)))
            assert psnr >= LEAST_PSNR, told
        # The measure tells pictures apart that differ little: one pixel to the side, one term for another.
        diffuse = capture(page, camera, [Term.DIFFUSE], WIDTH, HEIGHT, FINER)
        assert reference.psnr(np.roll(diffuse, 1, axis=1), [Term.DIFFUSE]) < LEAST_PSNR
        assert reference.psnr(diffuse, [Term.INTERREFLECTION]) < LEAST_PSNR
    print(told, f"left out {left_out:.4f}")
