"""A path-traced picture of a scene, by Mitsuba's own `volpath` integrator, and how noisy it is.

Independent of the tracer that bakes: only the scene's translation is shared. Two halves with different seeds are
rendered; the picture is their mean, and half their difference estimates its noise. `volpath` and not `path`, because
its shadow rays pass through what is cut out of a surface. Mitsuba's rays start a distance off a surface that suits a
scene of metres, so a small scene is enlarged first: radiance does not change with the unit of length.
"""

from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from kiln_schemas.camera import Camera
from kiln_schemas.errors import InternalError
from kiln_workers.render.backend import Device, select_variant
from kiln_workers.render.jit import dr, mi
from kiln_workers.render.mitsuba_scene import scene_diagonal, to_mitsuba
from kiln_workers.scene.model import Float32, LightKind, PunctualLight, Scene
from kiln_workers.scene.origin import Point, local_camera

SAMPLES_A_PASS: Final = 1 << 24
"""Paths of one wavefront: bounds the memory."""

GUIDE_RAYS: Final = 16
"""Rays a pixel of what a denoiser is guided by."""

LEAST_DIAGONAL: Final = 64.0
"""Metres; Mitsuba keeps 1e-4 (1 + the coordinate) off surfaces, which is little from here on."""


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
    return ReferenceTracer(scene, camera, width, height, max_depth, device).render(samples, seed)


class ReferenceTracer:
    """A scene and a camera, translated once for any number of renders."""

    def __init__(
        self, scene: Scene, camera: Camera, width: int, height: int, max_depth: int, device: Device = "auto"
    ) -> None:
        select_variant(device)
        scene, camera = enlarged(scene, local_camera(camera, scene.origin))
        self._scene = to_mitsuba(scene)
        self._sensor = _sensor(camera, width, height)
        self._integrator = mi.load_dict({"type": "volpath", "max_depth": max_depth + 1})
        self._shape = (height, width, 3)

    def render(self, samples: int, seed: int = 0) -> Reference:
        """`samples` paths a pixel, half of them in each half; another seed has other paths."""
        height, width, _ = self._shape
        each = max(1, samples // 2)
        passes = max(1, -(-each * width * height // SAMPLES_A_PASS))
        halves = []
        for half in range(2):
            total = np.zeros(self._shape, np.float64)
            counts = [each // passes + (number < each % passes) for number in range(passes)]
            for number, count in enumerate(counts):
                if count:
                    key = (seed * 2 + half) * passes + number
                    picture = mi.render(
                        self._scene, sensor=self._sensor, integrator=self._integrator, spp=count, seed=key
                    )
                    total += count * np.asarray(picture, np.float64)
            halves.append((total / each).astype(np.float32))
        return Reference((halves[0], halves[1]), 2 * each)

    @property
    def size(self) -> tuple[int, int]:
        """Height and width of the picture in pixels."""
        return self._shape[0], self._shape[1]

    def sample(self, pixels: npt.NDArray[np.int64], seed: int) -> Float32:
        """Radiance [N, 3] of one path through each of `pixels` [N] (row * width + column), anywhere in the pixel."""
        sampler = mi.load_dict({"type": "independent"})
        sampler.seed(dr.opaque(mi.UInt32, seed), len(pixels))  # a literal would be compiled into the kernel
        ray, weight = self._ray(pixels, sampler)
        radiance, _, _ = self._integrator.sample(self._scene, sampler, ray, None, True)
        carried = weight * radiance
        dr.eval(carried)  # now: the kernel would else hold the number of paths, and be compiled for each anew
        out = np.asarray(carried, np.float32).T
        if not np.isfinite(out).all():
            raise InternalError("a path carries radiance that is not finite", where="reference")
        return out

    def guides(self, seed: int = 0) -> tuple[Float32, Float32]:
        """Base colour and normal [H, W, 3] of what each pixel sees first, means of `GUIDE_RAYS` rays; 0 beside it."""
        height, width = self.size
        pixels = np.repeat(np.arange(height * width), GUIDE_RAYS)
        sampler = mi.load_dict({"type": "independent"})
        sampler.seed(seed, len(pixels))
        ray, _ = self._ray(pixels, sampler)
        si = self._scene.ray_intersect(ray)
        albedo = dr.select(si.is_valid(), si.bsdf().eval_diffuse_reflectance(si, si.is_valid()), 0.0)
        normal = dr.select(si.is_valid(), mi.Vector3f(si.sh_frame.n), 0.0)
        dr.eval(albedo, normal)
        shape = (height, width, GUIDE_RAYS, 3)
        base, normals = (np.asarray(values, np.float32).T.reshape(shape).mean(axis=2) for values in (albedo, normal))
        return base, normals

    def _ray(self, pixels: npt.NDArray[np.int64], sampler: Any) -> tuple[Any, Any]:
        """Rays through random places of pixels [N], and their weights."""
        height, width = self.size
        number = mi.UInt32(pixels.astype(np.uint32))
        corner = mi.Point2f(mi.Float(number % width), mi.Float(number // width))
        position = (corner + sampler.next_2d()) / mi.Point2f(width, height)
        ray, weight = self._sensor.sample_ray_differential(0.0, 0.0, position, mi.Point2f(0.5))
        return ray, weight


def enlarged(scene: Scene, camera: Camera) -> tuple[Scene, Camera]:
    """Both at a scale (a power of two) at which the scene's diagonal is at least `LEAST_DIAGONAL`."""
    factor = 2.0 ** max(0.0, np.ceil(np.log2(LEAST_DIAGONAL / scene_diagonal(scene))))
    if factor == 1.0:
        return scene, camera
    meshes = tuple(replace(mesh, positions=mesh.positions * np.float32(factor)) for mesh in scene.meshes)
    lights = tuple(_enlarged_light(light, factor) for light in scene.lights)
    moved = {"position": _times(camera.position, factor), "target": _times(camera.target, factor)}
    return replace(scene, meshes=meshes, lights=lights), camera.model_copy(update=moved)


def _enlarged_light(light: PunctualLight, factor: float) -> PunctualLight:
    """The light farther away; its intensity keeps what arrives, unless it comes from infinity."""
    if light.kind is LightKind.DIRECTIONAL:
        return light
    intensity = _times(light.intensity, factor * factor)
    return replace(light, position=_times(light.position, factor), intensity=intensity)


def _times(point: tuple[float, float, float], factor: float) -> Point:
    x, y, z = (factor * value for value in point)
    return x, y, z


def _sensor(camera: Camera, width: int, height: int) -> Any:
    return mi.load_dict(
        {
            "type": "perspective",
            "fov": camera.fov_deg,
            "fov_axis": "y",
            "near_clip": 1e-3,
            "far_clip": 1e7,
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
