"""Reading of the distant illumination: an equirectangular Radiance HDR or OpenEXR image of a bundle.

A low-dynamic-range picture is refused, by its decoded format: its sun is clipped, and a bake made from it looks wrong
everywhere without a word. Images wider than 4096 pixels are averaged down by box filters weighted with the rows'
solid angles, so the light that arrives stays the same.
"""

from pathlib import Path

import numpy as np
import numpy.typing as npt
from scipy.sparse import csr_array

from kiln_schemas.errors import InputError
from kiln_schemas.tasks import EnvironmentRef
from kiln_workers.scene.bundle import BundleFolder
from kiln_workers.scene.images import HDR_FORMATS, decode_image, image_format
from kiln_workers.scene.model import Environment, Float32

MAX_WIDTH = 4096


def load_environment(folder: Path, reference: EnvironmentRef) -> tuple[Environment, list[str]]:
    """The environment that `reference` names inside `folder`, and notes."""
    data = BundleFolder(folder, "environment").read(reference.file, "environment")
    pixels, notes = read_environment(data, reference.file)
    return Environment(pixels, reference.scale, reference.rotation_deg), notes


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
    return _box_down(pixels, MAX_WIDTH), [note]


def row_solid_angles(height: int) -> npt.NDArray[np.float64]:
    """Solid angles [H] of a whole row of an equirectangular image, in steradians; they sum to 4 pi."""
    return np.asarray(2.0 * np.pi * -np.diff(np.cos(np.linspace(0.0, np.pi, height + 1))))


def _box_down(pixels: Float32, width: int) -> Float32:
    # Rows near the poles cover less of the sphere: weight them, so that the sum over solid angle is kept.
    angles = row_solid_angles(pixels.shape[0])
    rows, columns = _box_matrix(pixels.shape[0], width // 2), _box_matrix(pixels.shape[1], width)
    total = rows @ angles
    channels = []
    for channel in range(3):
        weighted = rows @ (pixels[..., channel] * angles[:, None]) / total[:, None]
        channels.append((columns @ weighted.T).T)
    return np.stack(channels, axis=-1).astype(np.float32)


def _box_matrix(source: int, target: int) -> csr_array:
    """[target, source]: the part of each source pixel in each target pixel; rows sum to 1."""
    pixel = np.arange(source)
    ratio = target / source
    first = np.minimum((pixel * ratio).astype(np.int64), target - 1)
    border = np.clip((first + 1) / ratio - pixel, 0.0, 1.0)  # the part of the pixel before the next target's border
    second = np.minimum(first + 1, target - 1)
    values = np.concatenate([border, 1.0 - border]) * ratio
    places = (np.concatenate([first, second]), np.concatenate([pixel, pixel]))
    return csr_array((values, places), shape=(target, source))
