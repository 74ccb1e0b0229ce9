"""Reading of the distant illumination: an equirectangular Radiance HDR or OpenEXR image of a bundle.

A low-dynamic-range picture is refused, by its decoded format: its sun is clipped, and a bake made from it looks wrong
everywhere without a word. Images wider than 4096 pixels are averaged down by box filters weighted with the rows'
solid angles, so the light that arrives stays the same.
"""

from pathlib import Path, PurePosixPath
from typing import Final

import numpy as np
from scipy.sparse import csr_array

from kiln_schemas.errors import InputError
from kiln_schemas.tasks import EnvironmentRef
from kiln_workers.scene.bundle import BundleFolder
from kiln_workers.scene.geometry import Floats
from kiln_workers.scene.images import HDR_FORMATS, decode_image, image_format
from kiln_workers.scene.model import Environment, Float32

MAX_WIDTH = 4096
MITSUBA_TURN: Final = -90.0
"""Degrees that turn an image from where `model.Environment` has it to where Mitsuba's `envmap` has it."""


def load_environment(folder: Path, reference: EnvironmentRef, entry: str = "") -> tuple[Environment, list[str]]:
    """The environment that `reference` names inside `folder` around the scene `entry`, and notes."""
    data = BundleFolder(folder, "environment").read(reference.file, "environment")
    pixels, notes = read_environment(data, reference.file)
    return place_environment(pixels, reference.scale, reference.rotation_deg, entry), notes


def place_environment(pixels: Float32, scale: float, rotation_deg: float, entry: str) -> Environment:
    """An image around the scene `entry`, as programs of its format place one: Mitsuba for XML, else three.js."""
    turn = MITSUBA_TURN if PurePosixPath(entry).suffix.lower() == ".xml" else 0.0
    return Environment(pixels, scale, rotation_deg + turn)


def read_environment(data: bytes, name: str) -> tuple[Float32, list[str]]:
    """Linear radiance [H, W, 3] of an encoded image, W = 2 H <= 4096, and notes; InputError names `name`."""
    kind = image_format(data)
    if kind not in HDR_FORMATS:
        raise InputError(
            f"is {kind.upper() + ', not' if kind else 'neither'} Radiance HDR {'or' if kind else 'nor'} OpenEXR",
            where=name,
            remedy="An environment must hold linear radiance beyond 1; use a .hdr or .exr file.",
        )
    pixels = decode_image(data, name).pixels
    rgb = np.repeat(pixels, 3, axis=2) if pixels.shape[2] == 1 else pixels[..., :3]
    if rgb.shape[2] != 3:
        raise InputError(f"has {rgb.shape[2]} channels", where=name, remedy="Save it with one or three channels.")
    return checked_environment(np.asarray(rgb, dtype=np.float32), name)


def checked_environment(pixels: Float32, name: str) -> tuple[Float32, list[str]]:
    """`pixels` [H, W, 3] if finite, not negative and 2 : 1, averaged down to 4096 wide, and notes."""
    height, width = pixels.shape[:2]
    if width != 2 * height:
        raise InputError(
            f"has {width} x {height} pixels",
            where=name,
            remedy="An equirectangular image is twice as wide as high.",
        )
    for test, what in ((np.isfinite(pixels), "not finite"), (pixels >= 0.0, "negative")):
        if not test.all():
            row, column, channel = (int(x) for x in np.argwhere(~test)[0])
            raise InputError(
                f"channel {channel} at row {row}, column {column} is {what} ({pixels[row, column, channel]})",
                where=name,
                remedy="Radiance is finite and at least 0; mend the image.",
            )
    if width <= MAX_WIDTH:
        return np.ascontiguousarray(pixels), []
    note = f"Environment '{name}': averaged down from {width} to {MAX_WIDTH} pixels wide."
    return averaged_down(pixels, MAX_WIDTH), [note]


def row_solid_angles(height: int) -> Floats:
    """Solid angles [H] of a whole row of an equirectangular image, in steradians; they sum to 4 pi."""
    return np.asarray(2.0 * np.pi * -np.diff(np.cos(np.linspace(0.0, np.pi, height + 1))))


def averaged_down(pixels: Float32, width: int) -> Float32:
    """The image [H, W, 3] as [width / 2, width, 3] by box filters; the light from every part of the sphere is kept."""
    # Rows are weighted by the solid angle that they share, so the parts near the poles count less.
    height = pixels.shape[0]
    rows = _overlaps(-np.cos(np.linspace(0.0, np.pi, height + 1)), -np.cos(np.linspace(0.0, np.pi, width // 2 + 1)))
    columns = _overlaps(np.linspace(0.0, 1.0, pixels.shape[1] + 1), np.linspace(0.0, 1.0, width + 1))
    channels = [columns @ (rows @ pixels[..., channel]).T for channel in range(3)]
    return np.stack([channel.T for channel in channels], axis=-1).astype(np.float32)


def _overlaps(source: Floats, target: Floats) -> csr_array:
    """[T, S]: the part of each of T intervals that each of S >= T finer ones covers; rows sum to 1, edges rise."""
    low, high = source[:-1], source[1:]
    first = np.clip(np.searchsorted(target, low, side="right") - 1, 0, len(target) - 2)
    inside = np.minimum(high, target[first + 1]) - low
    second = np.minimum(first + 1, len(target) - 2)
    values = np.concatenate([inside, high - low - inside])
    rows, places = np.concatenate([first, second]), np.tile(np.arange(len(low)), 2)
    return csr_array((values / np.diff(target)[rows], (rows, places)), shape=(len(target) - 1, len(low)))
