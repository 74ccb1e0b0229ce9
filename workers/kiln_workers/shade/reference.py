"""A path-traced picture of a scene, by Mitsuba's own `path` integrator, and how noisy it is.

Independent of the tracer that bakes: only the scene's translation is shared. Two halves with different seeds are
rendered; the picture is their mean, and half their difference estimates its noise.
"""

from dataclasses import dataclass

import numpy as np

from kiln_schemas.camera import Camera
from kiln_workers.render.backend import Device, select_variant
from kiln_workers.render.jit import mi
from kiln_workers.render.mitsuba_scene import to_mitsuba
from kiln_workers.scene.model import Float32, Scene
from kiln_workers.scene.origin import local_camera

SAMPLES_A_PASS = 1 << 24
"""Paths of one wavefront: bounds the memory."""


@dataclass(frozen=True)
class Reference:
    """Two independent pictures of the same camera."""

    halves: tuple[Float32, Float32]  # each [H, W, 3]
    samples: int  # paths a pixel, of both halves together

    @property
    def picture(self) -> Float32:
        """The mean of the halves [H, W, 3]."""
        return 0.5 * (self.halves[0] + self.halves[1])

    @property
    def rms_noise(self) -> float:
        """Root mean square noise of the picture over its mean: half the difference of the halves estimates it."""
        noise = 0.5 * (self.halves[0].astype(np.float64) - self.halves[1])
        return float(np.sqrt(np.mean(np.square(noise))) / max(float(self.picture.mean()), 1e-30))


def path_trace(
    scene: Scene,
    camera: Camera,
    width: int,
    height: int,
    samples: int,
    max_depth: int,
    seed: int = 0,
    device: Device = "auto",
) -> Reference:
    """Render with `samples` paths a pixel, half of them in each half; `max_depth` scattering events at most."""
    select_variant(device)
    camera = local_camera(camera, scene.origin)
    translated = to_mitsuba(scene)
    sensor = mi.load_dict(
        {
            "type": "perspective",
            "fov": camera.fov_deg,
            "fov_axis": "y",
            "near_clip": 1e-3,
            "far_clip": 1e6,
            "to_world": mi.ScalarTransform4f().look_at(
                origin=list(camera.position), target=list(camera.target), up=list(camera.up)
            ),
            "film": {
                "type": "hdrfilm",
                "width": width,
                "height": height,
                "pixel_format": "rgb",
                "component_format": "float32",
                "rfilter": {"type": "box"},
            },
            "sampler": {"type": "independent"},
        }
    )
    integrator = mi.load_dict({"type": "path", "max_depth": max_depth + 1})
    each = max(1, samples // 2)
    passes = max(1, -(-each * width * height // SAMPLES_A_PASS))
    halves = []
    for half in range(2):
        total = np.zeros((height, width, 3), np.float64)
        counts = [each // passes + (number < each % passes) for number in range(passes)]
        for number, count in enumerate(counts):
            if count:
                key = (seed * 2 + half) * passes + number
                picture = mi.render(translated, sensor=sensor, integrator=integrator, spp=count, seed=key)
                total += count * np.asarray(picture, np.float64)
        halves.append((total / each).astype(np.float32))
    return Reference((halves[0], halves[1]), 2 * each)
