"""Collect a scene's files: the entry, what it references, and an environment, as a bundle of hashes.

Only names are read here, with the standard library; whether the files make a scene is the worker's to say. All names
are relative to the scene's folder and must stay inside it, links included, because the bundle is laid out the same way
on the worker. An environment may lie anywhere; from outside the folder it is added as `environment/<name>`.
"""

import hashlib
import json
import posixpath
import re
import struct
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final
from urllib.parse import unquote

from pydantic import ValidationError

from kiln_schemas.errors import InputError
from kiln_schemas.job import check_bundle, check_bundle_path
from kiln_schemas.tasks import Bundle, EnvironmentRef

CHUNK: Final = 1 << 20
GLB_MAGIC: Final = b"glTF"
GLB_JSON: Final = b"JSON"
MTL_OPTION_VALUES: Final[Mapping[str, int]] = {
    "-blendu": 1,
    "-blendv": 1,
    "-bm": 1,
    "-boost": 1,
    "-cc": 1,
    "-clamp": 1,
    "-imfchan": 1,
    "-mm": 2,
    "-texres": 1,
    "-type": 1,
}
"""Options of an MTL map statement and how many values each takes; -o, -s and -t take one to three numbers."""


@dataclass(frozen=True)
class LocalBundle:
    """A bundle and where its files are on this machine."""

    bundle: Bundle
    sources: Mapping[str, Path]
    """Bundle path to file."""

    def by_hash(self) -> dict[str, Path]:
        """One file for each distinct content."""
        return {sha256: self.sources[path] for path, sha256 in self.bundle.files.items()}


def collect(
    scene: Path, environment: Path | None = None, *, scale: float = 1.0, rotation_deg: float = 0.0
) -> LocalBundle:
    """The bundle of `scene`; InputError names what is missing or leaves the folder, and who references it."""
    if not scene.is_file():
        raise InputError("there is no such scene file", where=str(scene), remedy="Check the path.")
    reader = READERS.get(scene.suffix.lower())
    if reader is None:
        known = ", ".join(READERS)
        raise InputError(f"'{scene.suffix}' is not a scene format", where=str(scene), remedy=f"Known: {known}.")
    folder = scene.resolve().parent
    sources = {check_bundle_path(scene.name): scene}
    for name, referrer in reader(folder, scene.name):
        sources[name] = _inside(folder, name, referrer)
    reference = None
    if environment is not None:
        name = _environment_name(folder, environment)
        sources[name] = environment
        reference = _reference(name, scale, rotation_deg)
    files = {name: sha256_of(path) for name, path in sorted(sources.items())}
    return LocalBundle(check_bundle(Bundle(entry=scene.name, files=files, environment=reference)), sources)


def sha256_of(path: Path) -> str:
    """Hash of a file; InputError where it cannot be read."""
    digest = hashlib.sha256()
    try:
        with path.open("rb") as file:
            while chunk := file.read(CHUNK):
                digest.update(chunk)
    except OSError as error:
        raise InputError(f"cannot be read: {error.strerror}", where=str(path)) from None
    return digest.hexdigest()


def _inside(folder: Path, name: str, referrer: str) -> Path:
    """The existing file of a bundle path, links followed."""
    path = folder / name
    if not path.is_file():
        raise InputError(f"the file '{name}' is missing", where=referrer, remedy="Add it, or remove what uses it.")
    if not path.resolve().is_relative_to(folder):
        raise InputError(
            f"'{name}' is a link that leaves the scene's folder", where=referrer, remedy="Put the file itself there."
        )
    return path


def _environment_name(folder: Path, environment: Path) -> str:
    if not environment.is_file():
        raise InputError("there is no such environment file", where=str(environment), remedy="Check --env.")
    real = environment.resolve()
    if real.is_relative_to(folder):
        return check_bundle_path(real.relative_to(folder).as_posix())
    return check_bundle_path(f"environment/{environment.name}")


def _reference(name: str, scale: float, rotation_deg: float) -> EnvironmentRef:
    """The environment with its scale and rotation; InputError where they are out of bounds."""
    try:
        return EnvironmentRef(file=name, scale=scale, rotation_deg=rotation_deg)
    except ValidationError as error:
        first = error.errors()[0]
        flag = {"scale": "--env-scale", "rotation_deg": "--env-rotation"}.get(str(first["loc"][0]), "--env")
        raise InputError(f"{first['input']} is refused: {first['msg']}", where=flag) from None


def _joined(referrer: str, reference: str) -> str:
    """The bundle path of `reference` as written in the file `referrer`."""
    path = posixpath.normpath(posixpath.join(posixpath.dirname(referrer), reference))
    try:
        if "\\" in reference or "\0" in reference:
            check_bundle_path(reference)
        return check_bundle_path(path)
    except InputError as error:
        why = error.detail.replace("the bundle", "the scene's folder")
        raise InputError(f"the file name {why}", where=referrer, remedy=error.remedy) from None


References = Iterator[tuple[str, str]]
"""Pairs of a bundle path and the file that references it."""


def _nothing(folder: Path, name: str) -> References:
    yield from ()


def _gltf(folder: Path, name: str) -> References:
    try:
        document: Any = json.loads((folder / name).read_bytes())
    except (ValueError, RecursionError):
        raise InputError("is not JSON", where=name, remedy="Export the scene again.") from None
    yield from _gltf_uris(document, name)


def _glb(folder: Path, name: str) -> References:
    broken = InputError("is not a GLB file", where=name, remedy="Export the scene again.")
    with (folder / name).open("rb") as file:
        head = file.read(20)
        if len(head) < 20 or head[:4] != GLB_MAGIC or head[16:20] != GLB_JSON:
            raise broken
        text = file.read(struct.unpack_from("<I", head, 12)[0])
    try:
        document: Any = json.loads(text)
    except (ValueError, RecursionError):
        raise broken from None
    yield from _gltf_uris(document, name)


def _gltf_uris(document: Any, name: str) -> References:
    for section in ("buffers", "images"):
        entries = document.get(section) if isinstance(document, dict) else None
        for entry in entries if isinstance(entries, list) else ():
            uri = entry.get("uri") if isinstance(entry, dict) else None
            if isinstance(uri, str) and not uri.startswith("data:"):
                yield _joined(name, unquote(uri)), name


def _obj(folder: Path, name: str) -> References:
    """Material libraries and their maps; a library that is missing is left out, as the reader does, who notes it."""
    for arguments in _statements(folder / name, {"mtllib"}):
        # A name may hold spaces, and a statement may hold several names: the file system decides.
        for library in [arguments] if (folder / _joined(name, arguments)).is_file() else arguments.split():
            path = _joined(name, library)
            if (folder / path).is_file():
                yield path, name
                yield from _mtl(_inside(folder, path, name), path)


def _mtl(file: Path, name: str) -> References:
    keys = {"map_ka", "map_kd", "map_ks", "map_ke", "map_ns", "map_d", "map_bump", "map_pr", "map_pm", "map_ps"}
    for arguments in _statements(file, keys | {"bump", "disp", "decal", "refl", "norm"}):
        yield _joined(name, _map_file(arguments)), name


def _statements(path: Path, keys: set[str]) -> Iterator[str]:
    """Arguments of the statements with one of these keywords, line by line."""
    with path.open(encoding="utf-8", errors="replace") as file:
        for line in file:
            key, _, arguments = line.strip().partition(" ")
            if key.lower() in keys and arguments.strip():
                yield arguments.strip()


def _map_file(arguments: str) -> str:
    """The file name of an MTL map statement, behind its options."""
    words = arguments.split()
    while words and words[0] in {*MTL_OPTION_VALUES, "-o", "-s", "-t"}:
        option = words.pop(0)
        if option in MTL_OPTION_VALUES:
            del words[: MTL_OPTION_VALUES[option]]
            continue
        for _ in range(3):
            if len(words) > 1 and re.fullmatch(r"[-+]?[0-9.]+(e[-+]?\d+)?", words[0], re.IGNORECASE):
                words.pop(0)
    return " ".join(words)


class _Elements(ElementTree.TreeBuilder):
    """Builds the tree of a file that declares no document type, hence no entities, in whatever encoding."""

    def __init__(self, where: str) -> None:
        super().__init__()
        self._where = where

    def doctype(self, *_: str | None) -> None:
        """Called before any entity is declared."""
        raise InputError(
            "document types and entities are refused", where=self._where, remedy="Remove them from the XML."
        )


def _mitsuba_xml(folder: Path, name: str) -> References:
    try:
        root = ElementTree.fromstring((folder / name).read_bytes(), ElementTree.XMLParser(target=_Elements(name)))
    except (ElementTree.ParseError, LookupError, ValueError) as error:  # the latter two of encodings
        raise InputError(f"is not XML: {error}", where=name, remedy="Export the scene again.") from None
    defaults = {node.get("name", ""): node.get("value", "") for node in root.iter("default")}
    for node in root.iter("string"):
        value = node.get("value")
        if node.get("name") == "filename" and value:
            yield _joined(name, re.sub(r"\$(\w+)", lambda m: defaults.get(m[1], m[0]), value)), name


READERS: Final[Mapping[str, Callable[[Path, str], References]]] = {
    ".glb": _glb,
    ".gltf": _gltf,
    ".obj": _obj,
    ".ply": _nothing,
    ".xml": _mitsuba_xml,
}
