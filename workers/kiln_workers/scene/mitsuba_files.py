"""All files of a Mitsuba scene as one XML document, checked before Mitsuba's parser sees a character of it.

A scene is a stranger's. So `<include>`, `<default>` and `<path>` are carried out here: every name of a file is held to
the bundle, counts and lengths are bounded, and what the bake has no use for (sensors, films, integrators, media) is
left out. Names are looked for as Mitsuba's file resolver does: in the folders of `<path>`, the last one first, then
beside the entry; and at last beside the file that names them. Spectra that Mitsuba's RGB variants cannot evaluate are
written as pairs of wavelength and value; `#rrggbb`, `<srgb>` and `<blackbody>` of Mitsuba 0.6 as what they mean.
"""

import posixpath
import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final
from xml.sax.saxutils import quoteattr

import numpy as np

from kiln_schemas.errors import InputError
from kiln_schemas.formats import MITSUBA_INCLUDES, MITSUBA_UNUSED
from kiln_schemas.text import quoted
from kiln_workers.scene.bundle import BundleFolder
from kiln_workers.scene.images import linear_of_srgb
from kiln_workers.scene.limits import MAX_ENTRIES, MAX_TEXT_BYTES, check_count
from kiln_workers.scene.xml_nodes import Node, parse_xml

MAX_VARIABLES: Final = 256
MAX_VALUE: Final = 1 << 16
"""Characters of a value that names variables, once they are filled in: variables of variables grow without bound."""
MAX_CHARACTERS: Final = 1 << 28
"""Of the document with all its includes and variables."""
MAX_SPECTRUM_BYTES: Final = 1 << 16
"""Of a file of wavelengths and values."""
OBJECTS: Final = frozenset({"shape", "bsdf", "emitter", "texture"})
VALUES: Final = frozenset(
    {"float", "integer", "boolean", "string", "rgb", "spectrum", "point", "vector", "transform", "ref", "alias"}
)
STEPS: Final = frozenset({"translate", "rotate", "scale", "matrix", "lookat"})
KNOWN: Final = OBJECTS | VALUES | STEPS | {"subsurface"}
PAIR_SPECTRA: Final = frozenset({"regular", "irregular", "blackbody", "d65", "uniform"})
DEFAULT_VERSION: Final = "3.0.0"
# Planck's law per nanometre, SI units: Mitsuba's `blackbody`.
LIGHT_SPEED: Final = 2.99792458e8
PLANCK: Final = 6.62607004e-34
BOLTZMANN: Final = 1.38064852e-23


@dataclass
class Document:
    """One element a line; `places` says for each line which file and line it comes from."""

    lines: list[str] = field(default_factory=list)
    places: list[tuple[str, int]] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    unused: set[str] = field(default_factory=set)  # ids of what was left out
    characters: int = 0

    @property
    def text(self) -> str:
        return "\n".join(self.lines)

    def add(self, line: str, where: str, number: int) -> None:
        self.characters += len(line)
        check_count(len(self.lines), 2 * MAX_ENTRIES, "elements with all its includes", where)
        check_count(self.characters, MAX_CHARACTERS, "characters with all its variables", where)
        self.lines.append(line)
        self.places.append((where, number))


def read_document(folder: Path, entry: str) -> Document:
    """The scene `entry` of the bundle in `folder` with all that it includes."""
    files = _Files(folder, entry)
    root = files.root(entry)
    if root.tag != "scene":
        raise InputError(f"begins with {quoted(f'<{root.tag}>')}, not with <scene>", where=entry)
    files.out.add(f"<scene version={quoteattr(root.attributes.get('version', DEFAULT_VERSION))}>", entry, root.line)
    for child in root.children:
        files.element(child, entry, top=True)
    files.out.add("</scene>", entry, root.line)
    return files.out


class _Files:
    def __init__(self, folder: Path, entry: str) -> None:
        self.folder = folder
        self.entry = entry
        self.out = Document()
        self.variables: dict[str, str] = {}
        self.paths: list[str] = []  # folders of the bundle, the first is looked into first
        self.outside: set[str] = set()  # folders of `<path>` outside of the bundle, where nothing is looked for
        self.includes = 0

    def root(self, name: str) -> Node:
        return parse_xml(BundleFolder(self.folder, name).read(Path(name).name, "scene", MAX_TEXT_BYTES), name)

    def element(self, node: Node, where: str, top: bool = False) -> None:
        """Write an element, or carry it out."""
        if node.tag == "lookAt":  # of Mitsuba 0.5
            node = Node("lookat", node.attributes, node.line, node.children)
        attributes = self._substituted(node, where)
        if node.tag == "default":
            self.variables.setdefault(attributes.get("name", ""), attributes.get("value", ""))
            check_count(len(self.variables), MAX_VARIABLES, "variables", where)
        elif node.tag == "include":
            self._include(attributes, where, top)
        elif node.tag == "path":
            self.paths = [*self._folders(attributes.get("value", ""), where), *self.paths]
        elif node.tag in MITSUBA_UNUSED:
            self._unused(node, attributes, where)
        elif node.tag in ("srgb", "blackbody") or node.tag in KNOWN:
            self._write(node, attributes, where)
        else:
            raise InputError(
                f"line {node.line}: {quoted(f'<{node.tag}>')} is not read", where=where, remedy="Remove it."
            )

    def _include(self, attributes: dict[str, str], where: str, top: bool) -> None:
        self.includes += 1
        check_count(self.includes, MITSUBA_INCLUDES, "included files", where)
        name = self._found(attributes.get("filename", ""), where, "included file")
        root = self.root(name)
        if root.tag == "scene":
            for child in root.children:
                self.element(child, name, top)
        else:
            self.element(root, name, top)

    def _unused(self, node: Node, attributes: dict[str, str], where: str) -> None:
        """Leave an element out, once the names of files in it are known to stay in the bundle."""
        kind = attributes.get("type", "")
        if node.tag == "integrator":
            self.out.notes.append(f"Integrator {quoted(kind)} ignored: render.max_depth bounds the paths of a bake.")
        elif node.tag == "medium":
            self.out.notes.append(f"Medium {quoted(kind)} ignored: the bake has no participating media.")
        waiting = [node]
        while waiting:
            inner = waiting.pop()
            waiting += inner.children
            self.out.unused.add(inner.attributes.get("id", ""))
            for key in ("filename", "value"):
                if key in inner.attributes and "filename" in (inner.attributes.get("name"), key):
                    BundleFolder(self.folder, where).name(self._substituted(inner, where)[key])

    def _write(self, node: Node, attributes: dict[str, str], where: str) -> None:
        if node.tag == "subsurface":
            self.out.notes.append("Subsurface scattering ignored: the surface is baked as its BSDF has it.")
            return
        node = Node(node.tag, attributes, node.line, node.children)
        if node.tag in ("rgb", "srgb", "spectrum", "blackbody"):
            node = self._colour(node, where)
        elif attributes.get("name") == "filename" and node.tag == "string":
            attributes["value"] = self._found(attributes.get("value", ""), where, "file")
        named = "".join(f" {key}={quoteattr(value)}" for key, value in node.attributes.items())
        if not node.children:
            self.out.add(f"<{node.tag}{named}/>", where, node.line)
            return
        self.out.add(f"<{node.tag}{named}>", where, node.line)
        for child in node.children:
            self.element(child, where)
        self.out.add(f"</{node.tag}>", where, node.line)

    def _found(self, reference: str, where: str, what: str) -> str:
        """The bundle path of a file that an element names."""
        names, refusals = [], []
        for base in (*self.paths, posixpath.dirname(self.entry), posixpath.dirname(where)):
            bundle = BundleFolder(self.folder, posixpath.join(base, "."))
            try:
                names.append(bundle.name(reference))
            except InputError as error:
                refusals.append(InputError(error.detail, where=where, remedy=error.remedy))
                continue
            if bundle.holds(reference):
                return names[-1]
        if not names:
            raise refusals[0]
        remedy = "Add it, or remove what uses it."
        if self.outside:
            outside = ", ".join(f"<path> {quoted(path)}" for path in self.outside)
            remedy = f"{outside} leads out of the scene's folder: put the file beside the scene, under the same name."
        raise InputError(f"the {what} '{names[0]}' is missing", where=where, remedy=remedy)

    def _folders(self, reference: str, where: str) -> list[str]:
        """The folders of the bundle that a `<path>` may mean: beside its file, and beside the entry."""
        folders = []
        for file in dict.fromkeys((where, self.entry)):
            joined = posixpath.normpath(posixpath.join(posixpath.dirname(file), reference))
            try:
                folders.append("" if joined == "." else BundleFolder(self.folder, file).name(reference))
            except InputError:
                self.outside.add(reference)
        if not folders:
            self.out.notes.append(f"<path> {quoted(reference)} ignored: it leads out of the scene's folder.")
        return folders

    def _substituted(self, node: Node, where: str) -> dict[str, str]:
        """The attributes of an element with `$name` replaced; InputError for a name without a default."""
        out = {}
        for key, value in node.attributes.items():
            for name in sorted(self.variables, key=len, reverse=True) if "$" in value else ():
                grown = len(value) + value.count(f"${name}") * len(self.variables[name])
                check_count(
                    grown, MAX_VALUE, "characters in one value with its variables", f"{where}, line {node.line}"
                )
                value = value.replace(f"${name}", self.variables[name])
            if "$" in value:
                raise InputError(
                    f"line {node.line}: {quoted(value)} names a variable without a default",
                    where=where,
                    remedy="Add a <default>.",
                )
            out[key] = value
        return out

    def _colour(self, node: Node, where: str) -> Node:
        """A colour as `<rgb>` of linear numbers or `<spectrum>` of pairs, as Mitsuba 3 reads it in RGB."""
        attributes = {key: value for key, value in node.attributes.items() if key != "intent"}
        name, value = attributes.get("name", ""), attributes.get("value", "").strip()
        try:
            if node.tag == "blackbody":
                value, tag = (
                    planck(float(value_of(attributes, "temperature").rstrip("kK")), _scale(attributes)),
                    "spectrum",
                )
            elif re.fullmatch(r"#[0-9a-fA-F]{6}", value):
                encoded = [int(value[i : i + 2], 16) / 255.0 for i in (1, 3, 5)]
                value, tag = _linear_words(encoded), "rgb"
            elif node.tag == "srgb":
                value, tag = _linear_words([float(word) for word in _split(value)]), "rgb"
            elif attributes.get("type") in PAIR_SPECTRA:
                tag, value = self._pairs(node, attributes["type"], where)
            elif node.tag == "spectrum" and "filename" in attributes:
                tag, value = "spectrum", self._spectrum_file(attributes["filename"], where)
            elif node.tag == "spectrum" and ":" not in value and len(_split(value)) == 3:
                tag = "rgb"  # Mitsuba 0.6, built for three channels
            else:
                return Node(node.tag, attributes, node.line, node.children)
        except (ValueError, OverflowError):
            raise InputError(
                f"line {node.line}: the colour {quoted(value)} is not read",
                where=where,
                remedy="Give numbers, or pairs of wavelength and value.",
            ) from None
        return Node(tag, {"name": name, "value": value}, node.line)

    def _pairs(self, node: Node, kind: str, where: str) -> tuple[str, str]:
        """Tag and value of a spectrum plugin."""
        inner: dict[str, str] = {}
        for child in node.children:
            attributes = self._substituted(child, where)
            inner[attributes.get("name", "")] = attributes.get("value", "")
        if kind == "uniform":
            return "spectrum", _words([float(inner.get("value", "1"))])
        if kind == "d65":
            return "rgb", _words([float(inner.get("scale", "1"))])
        if kind == "blackbody":
            return "spectrum", planck(float(value_of(inner, "temperature")), _scale(inner))
        if "filename" in inner:
            return "spectrum", self._spectrum_file(inner["filename"], where)
        values = [float(word) for word in _split(inner.get("values", ""))]
        if kind == "irregular":
            waves = [float(word) for word in _split(inner.get("wavelengths", ""))]
        else:
            low = inner.get("wavelength_min", inner.get("lambda_min", "360"))
            high = inner.get("wavelength_max", inner.get("lambda_max", "830"))
            waves = [float(wave) for wave in np.linspace(float(low), float(high), len(values))]
        return "spectrum", _joined(waves, values)

    def _spectrum_file(self, reference: str, where: str) -> str:
        name = self._found(reference, where, "spectrum")
        data = BundleFolder(self.folder, "spectrum").read(name, "spectrum", MAX_SPECTRUM_BYTES)
        rows = [line.split(b"#")[0].split() for line in data.splitlines()]
        pairs = [(float(row[0]), float(row[1])) for row in rows if row]
        return _joined([wave for wave, _ in pairs], [value for _, value in pairs])


def planck(kelvin: float, scale: float = 1.0) -> str:
    """A black body's radiance in W/(m^2 sr nm), 5 nm apart over Mitsuba's wavelengths, as `<spectrum>` has it."""
    if not 0.0 < kelvin < 1e6:
        raise ValueError("no temperature")
    waves = np.arange(360.0, 831.0, 5.0)
    metres = 1e-9 * waves
    c2 = PLANCK * LIGHT_SPEED / (BOLTZMANN * kelvin)
    values = scale * 1e-9 * 2.0 * PLANCK * LIGHT_SPEED**2 / metres**5 / np.expm1(np.minimum(c2 / metres, 700.0))
    return _joined([float(wave) for wave in waves], [float(value) for value in values])


def value_of(attributes: dict[str, str], name: str) -> str:
    """An attribute that has to be there; ValueError without it."""
    if name not in attributes:
        raise ValueError(name)
    return attributes[name]


def _scale(attributes: dict[str, str]) -> float:
    return float(attributes.get("scale", "1"))


def _joined(waves: list[float], values: list[float]) -> str:
    if len(waves) < 2 or len(waves) != len(values) or not np.isfinite([*waves, *values]).all():
        raise ValueError("no pairs")
    return ", ".join(f"{wave:.9g}:{value:.9g}" for wave, value in zip(waves, values, strict=True))


def _words(values: list[float]) -> str:
    return " ".join(f"{value:.9g}" for value in values)


def _linear_words(encoded: list[float]) -> str:
    """sRGB-encoded values as linear ones."""
    return _words(linear_of_srgb(np.array(encoded)).tolist())


def _split(text: str) -> list[str]:
    return text.replace(",", " ").split()
