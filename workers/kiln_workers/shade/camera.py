"""A pinhole camera in world space (right-handed, +Y up), as a contract and as rays.

One definition serves the G-buffer, whose rays are computed here, and the path-traced reference, which takes Mitsuba's
own `perspective` sensor: two derivations that agree only if neither of them mirrors the picture.
"""

from pathlib import Path
from typing import Self

import numpy as np
import numpy.typing as npt
from pydantic import Field, ValidationError, field_validator, model_validator

from kiln_schemas.base import Contract
from kiln_schemas.errors import InputError

Floats = npt.NDArray[np.float64]
Triple = tuple[float, float, float]

REMEDY = "Write px,py,pz:tx,ty,tz:fov, or name a JSON file with position, target and fov_deg."
FORWARD_UP_LIMIT = 1e-6
"""Least sine of the angle between the viewing direction and `up`."""


class Camera(Contract):
    """Where the eye is, where it looks, and how wide."""

    position: Triple  # metres
    target: Triple  # metres
    fov_deg: float = Field(gt=0.0, lt=179.0)
    """Vertical field of view in degrees (glTF's yfov)."""
    up: Triple = (0.0, 1.0, 0.0)

    @field_validator("position", "target", "up")
    @classmethod
    def _finite(cls, value: Triple) -> Triple:
        if not np.isfinite(value).all():
            raise ValueError("coordinates must be finite")
        return value

    @model_validator(mode="after")
    def _has_a_frame(self) -> Self:
        forward, up = np.subtract(self.target, self.position), np.asarray(self.up)
        if np.linalg.norm(np.cross(forward, up)) <= FORWARD_UP_LIMIT * np.linalg.norm(forward) * np.linalg.norm(up):
            raise ValueError("target and position coincide, or the camera looks along `up`")
        return self

    def frame(self) -> tuple[Floats, Floats, Floats]:
        """Unit vectors to the right of the picture, to its top, and forward [3]."""
        forward = np.subtract(self.target, self.position).astype(np.float64)
        forward /= np.linalg.norm(forward)
        right = np.cross(forward, self.up)
        right /= np.linalg.norm(right)
        return right, np.cross(right, forward), forward

    def directions(self, width: int, height: int, grid: int) -> Floats:
        """Unit directions [H, W, grid^2, 3] through `grid` x `grid` points of each pixel; row 0 at the top."""
        inside = (np.arange(grid) + 0.5) / grid
        columns = (np.arange(width)[:, None] + inside).ravel()
        rows = (np.arange(height)[:, None] + inside).ravel()
        slope = np.tan(np.radians(self.fov_deg) / 2.0)
        x = (2.0 * columns / width - 1.0) * slope * width / height
        y = (1.0 - 2.0 * rows / height) * slope
        right, up, forward = self.frame()
        out = forward + x[None, :, None] * right + y[:, None, None] * up
        out /= np.linalg.norm(out, axis=-1, keepdims=True)
        split = out.reshape(height, grid, width, grid, 3).transpose(0, 2, 1, 3, 4)
        return np.ascontiguousarray(split.reshape(height, width, grid * grid, 3))


def read_camera(text: str) -> Camera:
    """The camera of `px,py,pz:tx,ty,tz:fov`, or of a JSON file; InputError where it is neither."""
    parts = text.split(":")
    try:
        if len(parts) == 3:
            position, target = (tuple(float(x) for x in part.split(",")) for part in parts[:2])
            return Camera.model_validate({"position": position, "target": target, "fov_deg": float(parts[2])})
        return Camera.model_validate_json(Path(text).read_text(encoding="utf-8"))
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join(str(x) for x in first["loc"])
        raise InputError(f"{place or 'camera'}: {first['msg']}", where=f"--camera {text}", remedy=REMEDY) from None
    except ValueError:
        raise InputError("is not a camera", where=f"--camera {text}", remedy=REMEDY) from None
    except OSError as error:
        raise InputError(f"cannot be read: {error.strerror}", where=f"--camera {text}", remedy=REMEDY) from None
