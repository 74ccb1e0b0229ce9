"""Lights of a Collada file: their colours are taken one to one as W/sr and W/m^2, as those of glTF.

A light whose attenuation is 1 / (q d^2) alone, d in the file's unit, has the intensity colour / q; any other
attenuation has no counterpart in light, and the colour is taken as the intensity, with a note. A spot's edge is sharp
where its fall-off has no exponent; with one it fades from the axis on.
"""

import numpy as np

from kiln_workers.scene.collada_document import Collada, name_of
from kiln_workers.scene.collada_nodes import metres
from kiln_workers.scene.geometry import Floats, unit
from kiln_workers.scene.model import LightKind, PunctualLight
from kiln_workers.scene.xml_nodes import Node

KINDS = {kind.value: kind for kind in LightKind}


def read_light(document: Collada, light: Node, matrix: Floats) -> PunctualLight | None:
    """The light under a transform to the world; None for one without a counterpart, which is counted as ignored."""
    common = light.child("technique_common")
    shape = next((node for node in common.children if node.tag in KINDS), None) if common is not None else None
    if shape is None:
        document.ignored["ambient or other lights without a place"] += 1
        return None
    name = name_of(light) or shape.tag
    colour = shape.child("color")
    values = document.floats(colour)[:3] if colour is not None else np.ones(3)
    if len(values) != 3 or not np.isfinite(values).all() or values.min() < 0.0:
        raise document.fail(shape, "has a colour that is not three numbers of 0 or more")
    factor = _exporter_intensity(document, light)
    if shape.tag != "directional":
        factor *= _attenuation(document, shape, name)
    red, green, blue = (float(value) for value in values * factor)
    inner, outer = _cones(document, shape, name)
    x, y, z = (float(value) for value in matrix[:3, 3])
    ahead = unit(-matrix[:3, 2])
    dx, dy, dz = (float(value) for value in ahead) if ahead.any() else (0.0, -1.0, 0.0)
    return PunctualLight(name, KINDS[shape.tag], (red, green, blue), (x, y, z), (dx, dy, dz), inner, outer)


def _exporter_intensity(document: Collada, light: Node) -> float:
    """The factor that FCollada's exporters (3ds Max, Maya) write beside the colour."""
    for technique in light.below():
        if technique.tag == "technique" and technique.attributes.get("profile") == "FCOLLADA":
            value = document.float_of(technique.child("intensity"), 1.0)
            return value if np.isfinite(value) and value >= 0.0 else 1.0
    return 1.0


def _attenuation(document: Collada, shape: Node, name: str) -> float:
    """The intensity in W/sr of a light of colour 1."""
    constant, linear, quadratic = (
        document.float_of(shape.child(f"{kind}_attenuation"), default)
        for kind, default in (("constant", 1.0), ("linear", 0.0), ("quadratic", 0.0))
    )
    if constant == linear == 0.0 and 0.0 < quadratic < np.inf:
        return metres(document) ** 2 / quadratic
    document.notes.append(
        f"Light '{name}': its attenuation has no counterpart; its colour is taken as its intensity in W/sr."
    )
    return 1.0


def _cones(document: Collada, shape: Node, name: str) -> tuple[float, float]:
    """Half angles of a spot's inner and outer cone in radians."""
    if shape.tag != "spot":
        return 0.0, np.pi / 4
    outer = np.deg2rad(document.float_of(shape.child("falloff_angle"), 180.0)) / 2.0
    if not 0.0 < outer <= np.pi / 2:
        if not outer > 0.0:
            raise document.fail(shape, "has a falloff_angle that is not above 0")
        outer = np.pi / 2
    if document.float_of(shape.child("falloff_exponent"), 0.0) > 0.0:
        document.notes.append(f"Light '{name}': its fall-off is approximated; it fades as a spot of glTF does.")
        return 0.0, float(outer)
    return float(outer), float(outer)
