"""The rays of a pinhole camera (`kiln_schemas.camera`) in world space, right-handed, +Y up.

One definition serves the G-buffer, whose rays are computed here, and the path-traced reference, which takes Mitsuba's
own `perspective` sensor: two derivations that agree only if neither of them mirrors the picture.
"""

import numpy as np
import numpy.typing as npt

from kiln_schemas.camera import Camera

Floats = npt.NDArray[np.float64]


def camera_frame(camera: Camera) -> tuple[Floats, Floats, Floats]:
    """Unit vectors to the right of the picture, to its top, and forward [3]."""
    forward = np.subtract(camera.target, camera.position).astype(np.float64)
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, camera.up)
    right /= np.linalg.norm(right)
    return right, np.cross(right, forward), forward


def pixel_directions(camera: Camera, width: int, height: int, grid: int) -> Floats:
    """Unit directions [H, W, grid^2, 3] through `grid` x `grid` points of each pixel; row 0 at the top."""
    inside = (np.arange(grid) + 0.5) / grid
    columns = (np.arange(width)[:, None] + inside).ravel()
    rows = (np.arange(height)[:, None] + inside).ravel()
    slope = np.tan(np.radians(camera.fov_deg) / 2.0)
    x = (2.0 * columns / width - 1.0) * slope * width / height
    y = (1.0 - 2.0 * rows / height) * slope
    right, up, forward = camera_frame(camera)
    out = forward + x[None, :, None] * right + y[:, None, None] * up
    out /= np.linalg.norm(out, axis=-1, keepdims=True)
    split = out.reshape(height, grid, width, grid, 3).transpose(0, 2, 1, 3, 4)
    return np.ascontiguousarray(split.reshape(height, width, grid * grid, 3))
