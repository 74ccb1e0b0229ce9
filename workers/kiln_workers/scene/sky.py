"""A clear sky with a small bright sun as an equirectangular image, for the courtyard example.

Preetham, Shirley and Smits 1999, "A Practical Analytic Model for Daylight": the Perez distribution
F(theta, gamma) = (1 + A exp(B / cos theta)) (1 + C exp(D gamma) + E cos^2 gamma), for luminance and chromaticity
(their appendix A.2). The sun's disk is wider than the real one (so that it spans several pixels) and carries a chosen
multiple of the sky's irradiance. Below the horizon lies even ground lit by both.
"""

from typing import Final

import numpy as np

from kiln_workers.scene.environment import row_solid_angles
from kiln_workers.scene.geometry import Floats
from kiln_workers.scene.model import Float32

PEREZ: Final = {  # slope and offset over turbidity of A, B, C, D, E for luminance and both chromaticities
    "Y": ((0.1787, -1.4630), (-0.3554, 0.4275), (-0.0227, 5.3251), (0.1206, -2.5771), (-0.0670, 0.3703)),
    "x": ((-0.0193, -0.2592), (-0.0665, 0.0008), (-0.0004, 0.2125), (-0.0641, -0.8989), (-0.0033, 0.0452)),
    "y": ((-0.0167, -0.2608), (-0.0950, 0.0092), (-0.0079, 0.2102), (-0.0441, -1.6537), (-0.0109, 0.0529)),
}
ZENITH_X: Final = (
    (0.00166, -0.00375, 0.00209, 0.0),
    (-0.02903, 0.06377, -0.03202, 0.00394),
    (0.11693, -0.21196, 0.06052, 0.25886),
)
ZENITH_Y: Final = (
    (0.00275, -0.00610, 0.00317, 0.0),
    (-0.04214, 0.08970, -0.04153, 0.00516),
    (0.15346, -0.26756, 0.06670, 0.26688),
)
XYZ_TO_RGB: Final = np.array(
    [[3.2404542, -1.5371385, -0.4985314], [-0.9692660, 1.8760108, 0.0415560], [0.0556434, -0.2040259, 1.0572252]]
)


def clear_sky(
    width: int,
    sun: Floats,
    turbidity: float,
    sky_irradiance: float,
    sun_to_sky: float,
    sun_radius_deg: float = 1.0,
    ground: tuple[float, float, float] = (0.20, 0.17, 0.13),
) -> Float32:
    """Radiance [W/2, W, 3]; `sun` is the unit direction to it (above the horizon), irradiance is on level ground.

    The sky alone gives level ground the mean-channel irradiance `sky_irradiance`, the sun `sun_to_sky` times that.
    """
    directions = equirectangular_directions(width)
    weight = row_solid_angles(width // 2)[:, None] / width * np.maximum(directions[..., 1], 0.0)
    rgb = _sky_colour(directions, sun, turbidity)
    rgb *= sky_irradiance / float((rgb.mean(axis=2) * weight).sum())
    irradiance = np.einsum("hwc,hw->c", rgb, weight)

    # The disk fades out over its outer quarter; its warm light carries the chosen irradiance exactly.
    angle = np.rad2deg(np.arccos(np.clip(directions @ sun, -1.0, 1.0)))
    edge = np.clip((sun_radius_deg - angle) / (0.25 * sun_radius_deg), 0.0, 1.0)
    disk = edge * edge * (3.0 - 2.0 * edge)
    warm = np.array([1.12, 1.0, 0.80])
    sunlight = warm / warm.mean() * sun_to_sky * sky_irradiance
    rgb += (disk / (disk * weight).sum())[..., None] * sunlight
    below = np.asarray(ground) / np.pi * (irradiance + sunlight)
    mixed = np.where(directions[..., 1:2] < 0.0, below, rgb)
    return mixed.astype(np.float32)


def equirectangular_directions(width: int) -> Floats:
    """Directions [W/2, W, 3] of the pixel centres, as `model.Environment` has them."""
    height = width // 2
    theta = np.pi * (np.arange(height)[:, None] + 0.5) / height
    phi = 2.0 * np.pi * (np.arange(width)[None, :] + 0.5) / width
    x, z = -np.sin(theta) * np.cos(phi), -np.sin(theta) * np.sin(phi)
    return np.stack([x, np.broadcast_to(np.cos(theta), x.shape), z], axis=-1)


def _sky_colour(directions: Floats, sun: Floats, turbidity: float) -> Floats:
    """Linear Rec.709 of the sky without the sun, unscaled; rows below the horizon are black."""
    cosine = np.maximum(directions[..., 1], 0.01)
    gamma = np.arccos(np.clip(directions @ sun, -1.0, 1.0))
    sun_angle = float(np.arccos(sun[1]))
    powers = np.array([sun_angle**3, sun_angle**2, sun_angle, 1.0])
    grades = np.array([turbidity**2, turbidity, 1.0])
    zenith = {
        "Y": 1.0,
        "x": float(grades @ np.array(ZENITH_X) @ powers),
        "y": float(grades @ np.array(ZENITH_Y) @ powers),
    }
    value = {}
    for name, table in PEREZ.items():
        a, b, c, d, e = (slope * turbidity + offset for slope, offset in table)

        def perez(
            cos_theta: Floats, angle: Floats, a: float = a, b: float = b, c: float = c, d: float = d, e: float = e
        ) -> Floats:
            glow = 1.0 + c * np.exp(d * angle) + e * np.cos(angle) ** 2
            return np.asarray((1.0 + a * np.exp(b / cos_theta)) * glow)

        value[name] = zenith[name] * perez(cosine, gamma) / perez(np.array(1.0), np.array(sun_angle))
    luminance, x, y = value["Y"], value["x"], value["y"]
    xyz = np.stack([luminance * x / y, luminance, luminance * (1.0 - x - y) / y], axis=-1)
    rgb = np.maximum(xyz @ XYZ_TO_RGB.T, 0.0)
    return np.where(directions[..., 1:2] > 0.0, rgb, 0.0)
