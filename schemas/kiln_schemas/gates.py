"""Quality gates: the thresholds that a job states, and what became of them.

    log_mse_rel              error of the light field's lobes (docs/mathematics.md)
    visibility_log_mse_rel   error of the visibility's lobes
    flip.CAMERA              mean HDR-FLIP of the package, shaded from that camera, against the path-traced reference

A gate is met where the measured value is at most the threshold. A job that misses one has its artifacts all the same.
"""

from collections.abc import Mapping, Sequence
from typing import Annotated, Final, Self

from pydantic import Field, TypeAdapter, ValidationError, model_validator

from kiln_schemas.base import FLOAT32_MAX, Contract, Name
from kiln_schemas.camera import Camera, CameraName, read_camera
from kiln_schemas.errors import GateFailed, InputError, Problem

MOST_CAMERAS: Final = 32
FLIP: Final = "flip."
"""Before a camera's name, the name of its gate."""
LOG_MSE_REL: Final = "log_mse_rel"
VISIBILITY_LOG_MSE_REL: Final = "visibility_log_mse_rel"
REFERENCE_SUFFIX: Final = "_reference"
"""After a camera's name, the name of its reference picture; so no camera's name ends with it."""

Threshold = Annotated[float, Field(gt=0.0, le=1.0)]
Cameras = Annotated[dict[CameraName, Camera], Field(max_length=MOST_CAMERAS)]

REMEDY: Final = "Write log_mse_rel=X, visibility_log_mse_rel=X or flip.CAMERA=X with X over 0 and at most 1."
NAMES: Final = f"A name has letters, digits, '_', '.' and '-'; there may be {MOST_CAMERAS} cameras."


class Gates(Contract):
    """Largest values that a job's package may have; what is not stated is not measured."""

    log_mse_rel: Threshold | None = None
    visibility_log_mse_rel: Threshold | None = None
    flip: dict[CameraName, Threshold] = Field(default_factory=dict, max_length=MOST_CAMERAS)
    """By the camera's name."""

    def thresholds(self) -> dict[str, float]:
        """Each gate's name and threshold, in the order in which they are told."""
        errors = {LOG_MSE_REL: self.log_mse_rel, VISIBILITY_LOG_MSE_REL: self.visibility_log_mse_rel}
        stated = {name: threshold for name, threshold in errors.items() if threshold is not None}
        return stated | {FLIP + camera: threshold for camera, threshold in self.flip.items()}


class GateResult(Contract):
    """One gate, measured."""

    name: Name
    value: float = Field(ge=0.0, le=FLOAT32_MAX)
    threshold: Threshold
    passed: bool
    flip_of_halves: float | None = Field(default=None, ge=0.0, le=FLOAT32_MAX)
    """Of a FLIP gate: FLIP of the reference's two halves."""
    noise_floor: float | None = Field(default=None, ge=0.0, le=FLOAT32_MAX)
    """Of a FLIP gate: what a package without any error would measure, for the noise of the reference."""

    @model_validator(mode="after")
    def _is_consistent(self) -> Self:
        if self.passed != (self.value <= self.threshold):
            raise ValueError(f"passed is {self.passed}, but {self.value} is held against {self.threshold}")
        return self

    @classmethod
    def of(cls, name: str, value: float, threshold: float, **noise: float) -> Self:
        """The verdict on a measured value; `noise` are the two figures of a FLIP gate's reference."""
        return cls(name=name, value=value, threshold=threshold, passed=value <= threshold, **noise)

    def sentence(self) -> str:
        """What was measured and what was allowed."""
        relation = "within" if self.passed else "more than"
        noise = "" if self.noise_floor is None else f" (noise of the reference: {self.noise_floor:.4g})"
        return f"{self.name} is {self.value:.6g}, {relation} the threshold {self.threshold:.6g}{noise}"


def gate_problem(results: Sequence[GateResult]) -> Problem | None:
    """What a job ends with that misses gates; None where all are met."""
    missed = [result.sentence() for result in results if not result.passed]
    if not missed:
        return None
    return GateFailed(
        "; ".join(missed),
        where="gates",
        remedy="The package is there: look at report.html. Then raise fit.lobes, fit.steps, render.samples or "
        "lightmap.resolution, or the threshold.",
    ).problem()


def check_gates(gates: Gates, cameras: Mapping[str, Camera]) -> Gates:
    """The gates unchanged, if every camera is there and none has a reference picture's name; InputError otherwise."""
    for name in cameras:
        if name.endswith(REFERENCE_SUFFIX):
            raise InputError(
                f"'{name}' ends with '{REFERENCE_SUFFIX}', as the names of reference pictures do",
                where="cameras",
                remedy="Choose another name.",
            )
    for name in gates.flip:
        if name not in cameras:
            given = f"The cameras are: {', '.join(cameras)}." if cameras else "No camera is given."
            raise InputError(
                f"there is no camera '{name}'",
                where=f"gates.{FLIP}{name}",
                remedy=f"{given} Add it to `cameras`, or with --camera {name}=px,py,pz:tx,ty,tz:fov.",
            )
    return gates


def read_gates(texts: Sequence[str]) -> Gates:
    """The gates of `NAME=VALUE` words, the last of a name holding; InputError names the word at fault."""
    errors: dict[str, float] = {}
    flip: dict[str, float] = {}
    gates = Gates()
    for text in texts:
        name, _, value = text.partition("=")
        where = f"--gate {text}"
        try:
            if name in (LOG_MSE_REL, VISIBILITY_LOG_MSE_REL):
                errors[name] = float(value)
            elif name.startswith(FLIP):
                flip[name.removeprefix(FLIP)] = float(value)
            else:
                raise InputError(f"'{name}' is not a gate", where=where, remedy=REMEDY)
            gates = Gates.model_validate({**errors, "flip": flip})
        except ValidationError as error:
            raise InputError(f"is refused: {error.errors()[0]['msg']}", where=where, remedy=REMEDY) from None
        except ValueError:
            raise InputError(f"'{value}' is not a number", where=where, remedy=REMEDY) from None
    return gates


def read_cameras(texts: Sequence[str]) -> dict[str, Camera]:
    """Cameras by name of `NAME=px,py,pz:tx,ty,tz:fov` or `NAME=FILE` lines; InputError names the line at fault."""
    cameras: dict[str, Camera] = {}
    for text in texts:
        name, equals, camera = text.partition("=")
        where = f"--camera {text}"
        if not (name and equals):
            raise InputError("has no name", where=where, remedy="Write it as NAME=px,py,pz:tx,ty,tz:fov or NAME=FILE.")
        cameras[name] = read_camera(camera, where)
    try:
        return TypeAdapter(Cameras).validate_python(cameras)
    except ValidationError as error:
        raise InputError(f"is refused: {error.errors()[0]['msg']}", where="--camera", remedy=NAMES) from None
