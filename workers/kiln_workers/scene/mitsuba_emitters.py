"""Mitsuba's distant and punctual emitters as environments and lamps of the scene model."""

from pathlib import Path
from typing import Final

import numpy as np

from kiln_workers.scene.bundle import BundleFolder
from kiln_workers.scene.environment import MITSUBA_TURN, read_environment
from kiln_workers.scene.geometry import Floats
from kiln_workers.scene.lookup import look_up
from kiln_workers.scene.mitsuba_tree import Plugin
from kiln_workers.scene.model import Environment, Float32, LightKind, PunctualLight, TextureRef

ENVIRONMENTS: Final = ("envmap", "constant")
LAMPS: Final = ("point", "spot", "directional")
SUBPIXELS: Final = 2
"""Along each side of a pixel of an environment that is turned about another axis than +Y."""
ROWS: Final = 64
"""Of an environment that are turned at a time."""
WRAPPED: Final = TextureRef(0, ("repeat", "clamp"))
"""The last column is followed by the first; the poles are edges."""


def environment(plugin: Plugin, folder: Path, notes: list[str]) -> Environment:
    """The environment of `envmap` or `constant`."""
    if plugin.kind == "constant":
        radiance = np.array(plugin.radiance("radiance"), dtype=np.float32)
        return Environment(np.broadcast_to(radiance, (16, 32, 3)).copy())
    name = plugin.text("filename")
    if not name:
        raise plugin.fail("it has no filename")
    pixels, remarks = read_environment(BundleFolder(folder, "").read(name, "environment"), name)
    notes += remarks
    scale = plugin.number("scale", 1.0)
    if scale < 0.0:
        raise plugin.fail(f"its scale is {scale}")
    linear = plugin.transform()[:3, :3]
    if not np.isfinite(linear).all() or abs(np.linalg.det(linear)) < 1e-12:
        raise plugin.fail("its to_world is no rotation")
    turn = linear / np.cbrt(abs(np.linalg.det(linear)))
    if not np.allclose(turn.T @ turn, np.eye(3), atol=1e-4):
        notes.append(f"{plugin.label}: its to_world is no rotation; its scale and shear bend the image.")
    elif np.allclose(turn[1], [0.0, 1.0, 0.0], atol=1e-5) and np.linalg.det(turn) > 0.0:
        return Environment(pixels, scale, float(np.rad2deg(np.arctan2(turn[0, 2], turn[0, 0]))) + MITSUBA_TURN)
    notes.append(f"{plugin.label}: resampled, because it is turned about another axis than +Y.")
    return Environment(turned(pixels, turn), scale, MITSUBA_TURN)


def turned(pixels: Float32, turn: Floats) -> Float32:
    """The image [H, W, 3] of Mitsuba's `envmap` whose `to_world` is the identity, for one whose is `turn` [3, 3]."""
    height, width = pixels.shape[:2]
    out = np.empty_like(pixels)
    for first in range(0, height, ROWS):
        rows = np.arange(first * SUBPIXELS, min(first + ROWS, height) * SUBPIXELS)
        theta = np.pi * (rows + 0.5) / (SUBPIXELS * height)
        phi = 2.0 * np.pi * (np.arange(SUBPIXELS * width) + 0.5) / (SUBPIXELS * width)
        sine = np.sin(theta)[:, None]
        level = np.broadcast_to(np.cos(theta)[:, None], (len(theta), len(phi)))
        world = np.stack([sine * np.sin(phi), level, -sine * np.cos(phi)], axis=-1)
        local = world @ np.linalg.inv(turn).T
        x, y, z = np.moveaxis(local / np.linalg.norm(local, axis=-1, keepdims=True), -1, 0)
        u = np.arctan2(x, -z) / (2.0 * np.pi)
        v = np.arccos(np.clip(y, -1.0, 1.0)) / np.pi
        v = (v * (height - 1) + 0.5) / height  # its first row lies at the pole
        found = look_up(pixels, WRAPPED, np.stack([u, v], axis=-1).reshape(-1, 2))
        out[first : first + ROWS] = found.reshape(-1, SUBPIXELS, width, SUBPIXELS, 3).mean(axis=(1, 3))
    return out


def lamp(plugin: Plugin, notes: list[str]) -> PunctualLight:
    """The lamp of `point`, `spot` or `directional`."""
    matrix = plugin.transform()
    forward = matrix[:3, :3] @ np.array([0.0, 0.0, 1.0])
    position = matrix[:3, 3]
    if plugin.kind == "point" and plugin.has("position"):
        position = plugin.vector("position", (0.0, 0.0, 0.0))
    if plugin.kind == "directional" and plugin.has("direction"):
        forward = plugin.vector("direction", (0.0, 0.0, 1.0))
    length = float(np.linalg.norm(forward))
    if not (np.isfinite(matrix).all() and length > 0.0):
        raise plugin.fail("it has no direction")
    if plugin.kind == "spot":
        notes.append(f"{plugin.label}: fades from beam_width to cutoff_angle as glTF's spot does.")
        if plugin.child("texture") is not None:
            notes.append(f"{plugin.label}: its texture is ignored.")
    x, y, z = (float(value) for value in forward / length)
    px, py, pz = (float(value) for value in position)
    cutoff = plugin.number("cutoff_angle", 20.0)
    beam = plugin.number("beam_width", 0.75 * cutoff)
    if not 0.0 <= beam <= cutoff < 180.0 or cutoff == 0.0:
        raise plugin.fail(f"its beam_width is {beam} and its cutoff_angle {cutoff}", "Give 0 <= beam <= cutoff < 180.")
    return PunctualLight(
        name=plugin.kind,
        kind=LightKind(plugin.kind),
        intensity=plugin.radiance("irradiance" if plugin.kind == "directional" else "intensity"),
        position=(px, py, pz),
        direction=(x, y, z),
        inner_cone=float(np.deg2rad(beam)),
        outer_cone=float(np.deg2rad(cutoff)),
    )
