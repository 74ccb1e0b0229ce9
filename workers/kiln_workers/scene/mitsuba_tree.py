"""A checked Mitsuba document as a tree of plugins: Mitsuba's own parser reads it, and brings old versions up to date.

`mitsuba.parser` knows transforms, colours, spectra, camelCase names of versions before 2.0 and aliases. No plugin is
ever made from what a scene says; references are followed here, to a bounded depth. Colours are what Mitsuba's RGB
variants make of them: a spectrum of a light, of a reflectance and of an index of refraction are three different things.
"""

import re
from bisect import bisect_right
from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import accumulate
from typing import Any, Final

import numpy as np

from kiln_schemas.errors import InputError, TooLarge
from kiln_schemas.text import QUOTE_LENGTH, quoted, told
from kiln_workers.render.backend import select_variant
from kiln_workers.render.jit import dr, mi
from kiln_workers.scene.geometry import Floats
from kiln_workers.scene.mitsuba_files import Document

Colour = tuple[float, float, float]

MAX_NESTING: Final = 16
"""Of plugins in plugins, references included."""
REMEDY: Final = "Use one of the plugins and values that lightkiln reads (docs/scene-input.md)."


@dataclass(eq=False)
class Plugin:
    """A plugin: its values, and the plugins in it with the names under which they are given to it."""

    tag: str
    kind: str
    where: str
    line: int
    properties: Any  # mi.Properties
    children: list[tuple[str, "Plugin"]] = field(default_factory=list)

    def fail(self, detail: str, remedy: str = REMEDY) -> InputError:
        """An InputError that names this plugin and its line."""
        return InputError(
            f"line {self.line}, {self.tag} {quoted(self.kind)}: {detail}", where=self.where, remedy=remedy
        )

    @property
    def label(self) -> str:
        """How notes call it."""
        return f"{self.tag.upper() if self.tag == 'bsdf' else self.tag.capitalize()} {quoted(self.kind)}"

    @property
    def names(self) -> list[str]:
        """Of its values; children are not among them."""
        return [name for name in list(self.properties.keys()) if not self._is_child(name)]

    def has(self, name: str) -> bool:
        """Whether it has this value or child."""
        return name in self.properties

    def all(self, tag: str) -> list["Plugin"]:
        """Its children of one tag, in order."""
        return [child for _, child in self.children if child.tag == tag]

    def child(self, name: str) -> "Plugin | None":
        """The child of this name."""
        return next((child for role, child in self.children if role == name), None)

    def number(self, name: str, default: float) -> float:
        """A finite float or integer."""
        value = self.properties[name] if self.has(name) else default
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise self.fail(f"'{name}' is not a number")
        if not np.isfinite(value):
            raise self.fail(f"'{name}' is not finite")
        return float(value)

    def whole(self, name: str, default: int) -> int:
        """An integer."""
        value = self.number(name, default)
        if value != int(value):
            raise self.fail(f"'{name}' is {value}, not a whole number")
        return int(value)

    def flag(self, name: str, default: bool = False) -> bool:
        """A boolean."""
        value = self.properties[name] if self.has(name) else default
        if not isinstance(value, bool):
            raise self.fail(f"'{name}' is not true or false")
        return value

    def text(self, name: str, default: str = "") -> str:
        """A string."""
        value = self.properties[name] if self.has(name) else default
        if not isinstance(value, str):
            raise self.fail(f"'{name}' is no string")
        return value

    def vector(self, name: str, default: Colour) -> Floats:
        """A point or vector [3]."""
        value = np.array(self.properties[name] if self.has(name) else default, dtype=np.float64)
        if value.shape != (3,) or not np.isfinite(value).all():
            raise self.fail(f"'{name}' is not three finite numbers")
        return value

    def transform(self, name: str = "to_world") -> Floats:
        """A 4 x 4 matrix for column vectors."""
        if not self.has(name):
            return np.eye(4)
        if str(self.properties.type(name)) != "Type.Transform":
            raise self.fail(f"'{name}' is not a transform")
        return np.array(self.properties[name].matrix, dtype=np.float64)

    def radiance(self, name: str, default: float = 1.0) -> Colour:
        """A light's colour."""
        return self._colour(name, (default,) * 3, "get_emissive_texture")

    def reflectance(self, name: str, default: float = 0.5) -> Colour:
        """A colour of at most 1."""
        red, green, blue = (min(value, 1.0) for value in self._colour(name, (default,) * 3, "get_texture"))
        return red, green, blue

    def unbounded(self, name: str, default: float) -> Colour:
        """A colour of any size: an index of refraction."""
        return self._colour(name, (default,) * 3, "get_unbounded_texture")

    def _is_child(self, name: str) -> bool:
        return "Reference" in str(self.properties.type(name))

    def _colour(self, name: str, default: Colour, getter: str) -> Colour:
        if not self.has(name):
            return default
        kind = str(self.properties.type(name)).removeprefix("Type.")
        value = self.properties[name]
        if kind in ("Float", "Integer"):
            values = np.full(3, self.number(name, 0.0))
        elif kind == "Color":
            values = np.array([value[channel] for channel in range(3)], dtype=np.float64)
        elif kind == "Vector":
            values = self.vector(name, default)
        elif kind == "Spectrum":
            holder = mi.Properties("colour")
            holder["value"] = value
            try:
                texture = getattr(holder, getter)("value")
                values = np.array(texture.eval(dr.zeros(mi.SurfaceInteraction3f)), dtype=np.float64).reshape(-1)
            except RuntimeError as error:
                raise self.fail(f"the spectrum '{name}' is not read: {_short(str(error))}") from None
            values = np.broadcast_to(values, 3)
        else:
            raise self.fail(f"'{name}' is no colour")
        if not np.isfinite(values).all():
            raise self.fail(f"'{name}' is not finite")
        if values.min() < -1e-3 * max(values.max(), 0.0):
            raise self.fail(f"'{name}' is negative")
        red, green, blue = (max(float(channel), 0.0) for channel in values)
        return red, green, blue


def parse_document(document: Document) -> list[Plugin]:
    """The plugins at the top of the scene, in order; InputError names file and line of what Mitsuba refuses."""
    if mi.variant() is None:
        select_variant()
    config = mi.parser.ParserConfig(mi.variant())
    try:
        state = mi.parser.parse_string(config, document.text)
        mi.parser.transform_upgrade(config, state)
    except RuntimeError as error:
        raise _refusal(str(error), document) from None
    return [plugin for _, plugin in _Tree(state, document).children(0, MAX_NESTING)]


class _Tree:
    def __init__(self, state: Any, document: Document) -> None:
        self.nodes = list(state.nodes)
        self.numbers = dict(state.id_to_index)
        self.document = document
        self.starts = list(accumulate((len(line.encode()) + 1 for line in document.lines), initial=0))
        self.known: dict[int, Plugin] = {}
        self.heights: dict[int, int] = {}

    def plugin(self, number: int, levels: int) -> Plugin:
        if number in self.known and self.heights[number] <= levels:
            return self.known[number]
        node = self.nodes[number]
        where, line = self.document.places[bisect_right(self.starts, node.offset) - 1]
        tag = str(node.type).removeprefix("ObjectType.").lower()
        plugin = Plugin(tag, node.props.plugin_name(), where, line, node.props)
        if not levels:
            raise TooLarge(
                f"line {line}, {tag} {quoted(plugin.kind)}: nests too deeply, or within itself",
                where=where,
                remedy=f"Nest at most {MAX_NESTING} plugins.",
            )
        plugin.children = list(self.children(number, levels - 1, plugin))
        self.heights[number] = 1 + max((self.heights[n] for n in self._numbers(number, plugin)), default=0)
        self.known[number] = plugin
        return plugin

    def children(self, number: int, levels: int, parent: Plugin | None = None) -> Iterator[tuple[str, Plugin]]:
        for name, child in self._references(number, parent):
            yield name, self.plugin(child, levels)

    def _numbers(self, number: int, parent: Plugin) -> list[int]:
        return [child for _, child in self._references(number, parent)]

    def _references(self, number: int, parent: Plugin | None) -> Iterator[tuple[str, int]]:
        properties = self.nodes[number].props
        for name in list(properties.keys()):
            kind = str(properties.type(name))
            if kind == "Type.ResolvedReference":
                yield name, _index(properties[name])
            elif kind == "Type.Reference":
                target = properties[name].id()
                if target in self.document.unused:
                    continue
                if target not in self.numbers:
                    detail = f"the reference {quoted(target)} names nothing"
                    raise parent.fail(detail) if parent else InputError(detail, where=self.document.places[0][0])
                yield name, self.numbers[target]


def _index(reference: Any) -> int:
    index = reference.index
    return int(index() if callable(index) else index)


def _refusal(message: str, document: Document) -> InputError:
    found = re.search(r"\(line (\d+), col \d+\): (.*)", message, re.DOTALL)
    number = min(int(found[1]) if found else 1, len(document.places))
    where, line = document.places[number - 1]
    return InputError(f"line {line}: {_short(found[2] if found else message)}", where=where, remedy=REMEDY)


def _short(message: str) -> str:
    """A message of Mitsuba's with all that it quotes cut short."""
    message = re.sub(r'"([^"]*)("|$)', lambda match: quoted(match[1]), message)
    return told(re.sub(rf"\S{{{QUOTE_LENGTH + 3},}}", lambda match: told(match[0], QUOTE_LENGTH), message), 200)
