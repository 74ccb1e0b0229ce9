"""Values of Mitsuba 3's XML: numbers, colours, vectors, transforms, `$variables`, and references between objects.

Mitsuba documentation, "Scene XML file format". Colours are RGB or one number; measured spectra are refused.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from kiln_schemas.errors import InputError
from kiln_schemas.text import quoted
from kiln_workers.scene.geometry import Floats
from kiln_workers.scene.limits import check_count
from kiln_workers.scene.xml_nodes import Node

Colour = tuple[float, float, float]

OBJECT_TAGS: Final = frozenset({"shape", "bsdf", "emitter", "texture", "medium"})
MAX_VALUE: Final = 1 << 16
"""Characters of a value that names variables, once they are filled in: variables of variables grow without bound."""
VALUE_TAGS: Final = frozenset(
    {"float", "integer", "boolean", "string", "rgb", "spectrum", "point", "vector", "transform"}
)


@dataclass
class Plugin:
    """A plugin instance: its values by name, and the objects in it."""

    tag: str
    kind: str
    line: int
    where: str
    role: str = ""  # the `name` under which it is given to the object around it
    values: dict[str, Node] = field(default_factory=dict)
    children: list["Plugin"] = field(default_factory=list)

    def fail(self, detail: str, remedy: str = "Use one of the plugins and values that lightkiln reads.") -> InputError:
        """An InputError that names this plugin and its line."""
        return InputError(
            f"line {self.line}, {self.tag} {quoted(self.kind)}: {detail}", where=self.where, remedy=remedy
        )

    def number(self, name: str, default: float) -> float:
        """A float or integer."""
        return self._floats(name, (default,), (1,))[0]

    def flag(self, name: str, default: bool = False) -> bool:
        """A boolean."""
        text = self.text(name, "true" if default else "false").lower()
        if text not in ("true", "false"):
            raise self.fail(f"'{name}' is {quoted(text)}, not true or false")
        return text == "true"

    def text(self, name: str, default: str = "") -> str:
        """A string."""
        node = self.values.get(name)
        return default if node is None else node.attributes.get("value", "")

    def colour(self, name: str, default: Colour) -> Colour:
        """An RGB colour; one number is grey; `#rrggbb` is sRGB."""
        if any(child.tag == "texture" and child.role == name for child in self.children):
            raise self.fail(f"'{name}' is a texture", "Use an rgb colour, or bring textures by glTF.")
        text = self.text(name)
        if text.startswith("#") and len(text) == 7:
            try:
                encoded = np.array([int(text[i : i + 2], 16) / 255.0 for i in (1, 3, 5)])
            except ValueError:
                raise self.fail(f"'{name}' is {quoted(text)}") from None
            linear = np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)
            return float(linear[0]), float(linear[1]), float(linear[2])
        values = self._floats(name, default, (1, 3))
        if min(values) < 0.0:
            raise self.fail(f"'{name}' is negative")
        return (values[0],) * 3 if len(values) == 1 else (values[0], values[1], values[2])

    def vector(self, name: str, default: Colour) -> Floats:
        """A point or vector."""
        node = self.values.get(name)
        if node is not None and "value" not in node.attributes:
            return np.array([_number(node.attributes.get(axis, "0"), self) for axis in "xyz"])
        values = self._floats(name, default, (3,))
        return np.array(values)

    def transform(self, name: str = "to_world") -> Floats:
        """A 4 x 4 matrix; the element's operations apply in order, the first one first."""
        matrix = np.eye(4)
        node = self.values.get(name)
        for step in [] if node is None else node.children:
            with np.errstate(over="ignore", invalid="ignore"):  # `place` refuses what is not finite
                matrix = _operation(step, self) @ matrix
        return matrix

    def _floats(self, name: str, default: tuple[float, ...], counts: tuple[int, ...]) -> tuple[float, ...]:
        node = self.values.get(name)
        if node is None:
            return default
        words = node.attributes.get("value", "").replace(",", " ").split()
        if len(words) not in counts or ":" in "".join(words):
            raise self.fail(
                f"'{name}' is {quoted(node.attributes.get('value', ''))}", "Give a number or an rgb colour."
            )
        return tuple(_number(word, self) for word in words)


def _number(word: str, plugin: Plugin) -> float:
    try:
        value = float(word)
    except ValueError:
        raise plugin.fail(f"{quoted(word)} is not a number") from None
    if not np.isfinite(value):
        raise plugin.fail(f"{quoted(word)} is not finite")
    return value


def _operation(step: Node, plugin: Plugin) -> Floats:
    def triple(text: str) -> Floats:
        words = text.replace(",", " ").split()
        if len(words) != 3:
            raise plugin.fail(f"{quoted(text)} in a transform is not three numbers")
        return np.array([_number(word, plugin) for word in words])

    def axes(default: float) -> Floats:
        if "value" in step.attributes:
            words = step.attributes["value"].replace(",", " ").split()
            return np.full(3, _number(words[0], plugin)) if len(words) == 1 else triple(step.attributes["value"])
        return np.array([_number(step.attributes.get(axis, str(default)), plugin) for axis in "xyz"])

    matrix = np.eye(4)
    if step.tag == "translate":
        matrix[:3, 3] = axes(0.0)
    elif step.tag == "scale":
        matrix[:3, :3] = np.diag(axes(1.0))
    elif step.tag == "rotate":
        angle = np.deg2rad(_number(step.attributes.get("angle", "0"), plugin))
        matrix[:3, :3] = axis_rotation(axes(0.0), float(angle), plugin)
    elif step.tag == "matrix":
        values = [_number(w, plugin) for w in step.attributes.get("value", "").replace(",", " ").split()]
        if len(values) == 16:
            matrix = np.array(values).reshape(4, 4)
        elif len(values) == 9:
            matrix[:3, :3] = np.array(values).reshape(3, 3)
        else:
            raise plugin.fail(f"a matrix has {len(values)} numbers")
    elif step.tag == "lookat":
        origin, target = triple(step.attributes.get("origin", "0 0 0")), triple(step.attributes.get("target", "0 0 1"))
        forward = _unit(target - origin, plugin)
        left = _unit(np.cross(triple(step.attributes.get("up", "0 1 0")), forward), plugin)
        matrix[:3] = np.stack([left, np.cross(forward, left), forward, origin], axis=1)
    else:
        raise plugin.fail(f"the transform {quoted(step.tag)} is not read")
    return matrix


def axis_rotation(axis: Floats, angle: float, plugin: Plugin) -> Floats:
    """Rotation [3, 3] about an axis of any length by radians (Rodrigues)."""
    x, y, z = _unit(axis, plugin)
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.asarray(np.eye(3) + np.sin(angle) * cross + (1.0 - np.cos(angle)) * cross @ cross)


def _unit(vector: Floats, plugin: Plugin) -> Floats:
    length = float(np.linalg.norm(vector))
    if length == 0.0:
        raise plugin.fail("a direction in a transform has no length")
    return vector / length


def substituted(node: Node, variables: Mapping[str, str], where: str) -> dict[str, str]:
    """The attributes of an element with `$name` replaced; InputError for a name without a default."""
    out = {}
    for key, value in node.attributes.items():
        for name in sorted(variables, key=len, reverse=True) if "$" in value else ():
            grown = len(value) + value.count(f"${name}") * len(variables[name])
            check_count(grown, MAX_VALUE, "characters in one value with its variables", f"{where}, line {node.line}")
            value = value.replace(f"${name}", variables[name])
        if "$" in value:
            raise InputError(
                f"line {node.line}: {quoted(value)} names a variable without a default",
                where=where,
                remedy="Add a <default>.",
            )
        out[key] = value
    return out
