"""The commands `shade` and `reference`: one picture each, and what is to be said about it as text or JSON."""

import argparse
import json
import math
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from kiln_schemas.camera import read_camera
from kiln_schemas.errors import InputError
from kiln_schemas.files import open_regular
from kiln_workers.package import colour
from kiln_workers.render.backend import select_variant
from kiln_workers.scene.environment import place_environment, read_environment
from kiln_workers.scene.load import check_light, load_scene
from kiln_workers.scene.model import Scene
from kiln_workers.scene.sheets import part_sheets
from kiln_workers.shade.adaptive import AdaptiveSampler, measured_noise
from kiln_workers.shade.denoise import check_denoiser, denoised
from kiln_workers.shade.gbuffer import render_gbuffer
from kiln_workers.shade.image_files import check_output, write_picture
from kiln_workers.shade.image_metrics import compare_pictures, flip_noise_floor, psnr
from kiln_workers.shade.package import ShadePackage, read_exr
from kiln_workers.shade.picture import shade
from kiln_workers.shade.reference import ReferenceTracer
from kiln_workers.shade.sampling_line import SamplingLine
from kiln_workers.shade.stored import StoredImages
from kiln_workers.shade.term import Term

LARGEST_SIDE = 16384


def run_shade(options: argparse.Namespace) -> int:
    """Shade a package as a game would, from its own files."""
    camera, (width, height), out = read_camera(options.camera), parse_size(options.size), check_output(options.out)
    terms = parse_terms(options.terms)
    against = None if options.against is None else read_exr(options.against)
    if against is not None and against.shape[:2] != (height, width):
        raise InputError(
            f"is {against.shape[1]} x {against.shape[0]}, the picture {width} x {height}",
            where=str(options.against),
            remedy="Pass the same --size to both.",
        )
    began = time.perf_counter()
    cuda = select_variant(options.device).startswith("cuda")
    package = ShadePackage.read(options.package, torch.device("cuda" if cuda else "cpu"))
    shape = (package.lobes.light_field.shape[0], package.lobes.light_field.shape[1])
    stored = None if options.stored is None else StoredImages.open(store_url(options.stored), shape)
    buffer = render_gbuffer(package.scene, camera, width, height, options.grid, options.device)
    picture = shade(package, buffer, terms, stored, options.paper)
    white = options.white or colour.white_point(picture if against is None else against)
    write_picture(out, picture, white)
    told: dict[str, Any] = {
        "out": str(out),
        "width": width,
        "height": height,
        "terms": [str(term) for term in terms],
        "paper": options.paper,
        "source": "textures" if stored is None else "store",
        "white": white,
        "seconds": round(time.perf_counter() - began, 3),
    }
    if against is not None:
        told |= compare_pictures(against, picture, white).rounded()
    _tell(told, options.json)
    return 0


def run_reference(options: argparse.Namespace) -> int:
    """Path-trace a scene, and say how noisy the picture is."""
    camera, (width, height), out = read_camera(options.camera), parse_size(options.size), check_output(options.out)
    if options.denoise:
        check_denoiser()
    scene = check_light(read_scene(options.scene, options.env, options.env_scale, options.env_rotation))
    began = time.perf_counter()
    tracer = ReferenceTracer(scene, camera, width, height, options.max_depth, options.device)
    sampled: dict[str, Any] = {}
    if options.noise is None:
        reference = tracer.render(options.samples, options.seed)
    else:
        with SamplingLine(options.noise) as line:
            found = AdaptiveSampler(tracer, options.noise, options.max_samples, options.seed, line.show).run()
        reference = found.reference
        sampled = {
            "noise_asked": options.noise,
            "noise_reached": found.reached,
            "noise_of_worst_tile": float(found.tile_noise.max()),
            "tiles_over_noise": float((found.tile_noise > options.noise).mean()),
            "most_samples": int(found.paths.max()),
            "max_samples": options.max_samples,
            "scout_samples": round(float(found.scouts.mean())),
        }
    white = options.white or colour.white_point(reference.picture)
    picture = reference.picture
    if options.denoise:
        picture = denoised(picture, *tracer.guides(options.seed))
    write_picture(out, picture, white, options.denoise)
    result = {
        "out": str(out),
        "width": width,
        "height": height,
        "samples": reference.samples,
        **sampled,
        "max_depth": options.max_depth,
        "psnr_of_halves": _finite(psnr(*reference.halves, white)),
        "denoised": options.denoise,
        "noise": measured_noise(reference, white),
        "rms_noise": reference.rms_noise,
        "flip_noise_floor": round(float(flip_noise_floor(reference.halves).mean()), 5),
        "white": white,
        "seconds": round(time.perf_counter() - began, 3),
    }
    _tell(result, options.json)
    return 0


def read_scene(path: Path, env: Path | None, scale: float, rotation_deg: float) -> Scene:
    """A scene file with what it references beside it, under the environment `env` from anywhere, if one is named."""
    if not path.is_file():
        raise InputError("there is no such file", where=str(path))
    if not (math.isfinite(scale) and scale >= 0.0 and math.isfinite(rotation_deg)):
        raise InputError("must be finite, the scale not negative", where="--env-scale, --env-rotation")
    scene = part_sheets(load_scene(path.parent, path.name))
    if env is None:
        return scene
    try:
        with open_regular(env) as file:
            data = file.read()
    except OSError as error:
        raise InputError(f"cannot be read: {error.strerror}", where=str(env)) from None
    pixels, _ = read_environment(data, str(env))
    return replace(scene, environment=place_environment(pixels, scale, rotation_deg, path.name))


def parse_size(text: str) -> tuple[int, int]:
    """Width and height of `480x270`."""
    try:
        width, height = (int(part) for part in text.lower().split("x"))
    except ValueError:
        width = height = 0
    if not (0 < width <= LARGEST_SIDE and 0 < height <= LARGEST_SIDE):
        raise InputError(f"'{text}' is not a size", where="--size", remedy="Write WIDTHxHEIGHT, e.g. 480x270.")
    return width, height


def parse_terms(text: str) -> tuple[Term, ...]:
    """Terms separated by commas."""
    try:
        return tuple(dict.fromkeys(Term(part.strip()) for part in text.split(",")))
    except ValueError:
        raise InputError(f"'{text}' is refused", where="--terms", remedy=f"Choose some of {','.join(Term)}.") from None


def store_url(text: str) -> str:
    """A store's URL; a folder becomes a file URL."""
    return text if "://" in text else Path(text).absolute().as_uri()


def _finite(value: float) -> float | None:
    """JSON has no infinity: equal pictures have no PSNR."""
    return round(value, 3) if math.isfinite(value) else None


def _tell(told: dict[str, Any], as_json: bool) -> None:
    if as_json:
        print(json.dumps(told))
        return
    print(told["out"])
    words = {
        "psnr": "PSNR against the given picture: {} dB",
        "ssim": "SSIM: {}",
        "flip": "HDR-FLIP: {}",
        "psnr_of_halves": "PSNR between two halves: {} dB",
        "samples": "paths a pixel, on average: {}",
        "noise": "noise, as a share of the display's range: {:.4f}",
        "noise_of_worst_tile": "of the worst 8 x 8 pixels: {:.4f}",
        "rms_noise": "RMS of the noise over the mean radiance: {:.4f}",
        "flip_noise_floor": "HDR-FLIP that this noise alone makes: {}",
        "seconds": "seconds: {}",
    }
    for key, sentence in words.items():
        if key in told:
            print(sentence.format(told[key]))
    if told.get("denoised"):
        print("The picture is denoised, for looking; all figures are of the picture before that.")
    if not told.get("noise_reached", True):
        print(
            f"Noise {told['noise_asked']:g} is not reached: {told['tiles_over_noise']:.1%} of the picture has more "
            f"with {told['most_samples']} paths a pixel at most. Raise --max-samples or --noise."
        )
