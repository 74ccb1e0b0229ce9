"""A pinhole camera in world space (right-handed, +Y up): what people write of it, and nothing of its rays.

The rays are `kiln_workers.shade.camera`'s; here is only what a request, a file or a command line may say.
"""

import math
from pathlib import Path
from typing import Annotated, Final, Self

from pydantic import Field, ValidationError, model_validator

from kiln_schemas.base import Contract
from kiln_schemas.errors import InputError
from kiln_schemas.files import read_small

Coordinate = Annotated[float, Field(ge=-1e7, le=1e7)]
Triple = tuple[Coordinate, Coordinate, Coordinate]
CameraName = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]*$", max_length=64)]
"""Also part of a file's name, so of the same characters as an artifact's."""

REMEDY: Final = "Write px,py,pz:tx,ty,tz:fov, or name a JSON file with position, target and fov_deg."
FORWARD_UP_LIMIT: Final = 1e-6
"""Least sine of the angle between the viewing direction and `up`."""


class Camera(Contract):
    """Where the eye is, where it looks, and how wide."""

    position: Triple  # metres
    target: Triple  # metres
    fov_deg: float = Field(gt=0.0, lt=179.0)
    """Vertical field of view in degrees (glTF's yfov)."""
    up: Triple = (0.0, 1.0, 0.0)

    @model_validator(mode="after")
    def _has_a_frame(self) -> Self:
        x, y, z = (b - a for a, b in zip(self.position, self.target, strict=True))
        u, v, w = self.up
        across = math.hypot(y * w - z * v, z * u - x * w, x * v - y * u)
        if not across > FORWARD_UP_LIMIT * math.hypot(x, y, z) * math.hypot(u, v, w):
            raise ValueError("target and position coincide, or the camera looks along `up`")
        return self


def read_camera(text: str, where: str | None = None) -> Camera:
    """The camera of `px,py,pz:tx,ty,tz:fov`, or of a JSON file; InputError, by default at `--camera`, otherwise."""
    where = f"--camera {text}" if where is None else where
    parts = text.split(":")
    try:
        if len(parts) == 3:
            position, target = (tuple(float(x) for x in part.split(",")) for part in parts[:2])
            return Camera.model_validate({"position": position, "target": target, "fov_deg": float(parts[2])})
        return Camera.model_validate_json(read_small(Path(text)))
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join(str(x) for x in first["loc"])
        raise InputError(f"{place or 'camera'}: {first['msg']}", where=where, remedy=REMEDY) from None
    except ValueError:
        raise InputError("is not a camera", where=where, remedy=REMEDY) from None
    except OSError as error:
        raise InputError(f"cannot be read: {error.strerror}", where=where, remedy=REMEDY) from None
