"""Recomputes a package's errors from its KTX2 file and the light-field store, sharing no code with lightkiln.

Only numpy, zarr-python and its numcodecs: an own KTX2 parser, an own octahedral map, solid angles by summing the area
element over sub-pixels. Run it as a program (`python recompute.py PACKAGE STORE light_field`) or call `recompute`.
"""

import json
import struct
import sys
from pathlib import Path

import numpy as np
import zarr
from numcodecs.zstd import Zstd

SUB_PIXELS = 32
FILES = {"light_field": "lightfield.ktx2", "visibility": "visibility.ktx2"}


def recompute(package_dir: Path, store_path: Path, function: str) -> tuple[float, float, float]:
    """(log_mse, log_mse of P = 0, their ratio) of `light_field` or `visibility`, over all valid texels."""
    manifest = json.loads((package_dir / "manifest.json").read_text())
    exposure = manifest["exposure"][function]
    layers = read_half_layers((package_dir / FILES[function]).read_bytes())
    store = zarr.open_group(store_path, mode="r")
    images, normals = store[function], np.asarray(store["normal"][:], np.float64)
    valid = np.asarray(store["state"][:]) == 1
    valid.reshape(-1)[manifest["lightmap"]["invalid_texels"]] = False

    directions, solid_angles = octahedral_pixels(images.shape[2])
    error = zero = weight = 0.0
    for row, column in np.argwhere(valid):
        target = np.log1p(exposure * np.asarray(images[row, column], np.float64))
        shape, amplitude = layers[0::2, row, column], layers[1::2, row, column, :3]
        lobes = np.exp(shape[:, 3] * (directions @ shape[:, :3].T - 1.0))
        predicted = np.log1p(exposure * (lobes @ amplitude))
        above = np.where(directions @ normals[row, column] > 0.0, solid_angles, 0.0)
        error += float(np.einsum("ji,jic->", above, (target - predicted) ** 2))
        zero += float(np.einsum("ji,jic->", above, target**2))
        weight += 3.0 * float(above.sum())
    return error / weight, zero / weight, error / zero


def read_half_layers(data: bytes) -> np.ndarray:
    """Layers [L, H, W, 4] of an RGBA16F KTX2 array texture without mips, plain or with Zstandard, as float64."""
    assert data[:12] == b"\xabKTX 20\xbb\r\n\x1a\n", "not a KTX2 file"
    vk_format, _, width, height, depth, layers, faces, levels, scheme = struct.unpack_from("<9I", data, 12)
    assert (vk_format, depth, faces, levels) == (97, 0, 1, 1) and scheme in (0, 2), "not an RGBA16F array"
    offset, length, _ = struct.unpack_from("<3Q", data, 80)
    level = data[offset : offset + length]
    halves = np.frombuffer(Zstd().decode(level) if scheme == 2 else level, "<f2").reshape(layers, height, width, 4)
    return halves.astype(np.float64)


def octahedral_pixels(size: int) -> tuple[np.ndarray, np.ndarray]:
    """Directions [R, R, 3] of the pixel centres (row, column) and solid angles [R, R]; the latter sum to 4 pi."""
    fine = (np.arange(size * SUB_PIXELS) + 0.5) / (size * SUB_PIXELS) * 2.0 - 1.0
    points = np.linalg.norm(unfold(*np.meshgrid(fine, fine)), axis=-1)
    element = (2.0 / (size * SUB_PIXELS)) ** 2 / points**3
    solid_angles = element.reshape(size, SUB_PIXELS, size, SUB_PIXELS).sum(axis=(1, 3))
    centres = (np.arange(size) + 0.5) / size * 2.0 - 1.0
    p = unfold(*np.meshgrid(centres, centres))
    return p / np.linalg.norm(p, axis=-1, keepdims=True), solid_angles


def unfold(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Points on the octahedron |x| + |y| + |z| = 1 for square coordinates in [-1, 1]."""
    z = 1.0 - np.abs(x) - np.abs(y)
    lower = z < 0.0
    folded_x = np.where(lower, np.sign(x) * (1.0 - np.abs(y)), x)
    folded_y = np.where(lower, np.sign(y) * (1.0 - np.abs(x)), y)
    return np.stack([folded_x, folded_y, z], axis=-1)


if __name__ == "__main__":
    print(
        "log_mse {:.6g}  log_mse_zero {:.6g}  log_mse_rel {:.6g}".format(
            *recompute(*map(Path, sys.argv[1:3]), sys.argv[3])
        )
    )
