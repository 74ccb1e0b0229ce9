"""Collect a scene's files: the entry, what it references, and an environment, as a bundle of hashes.

Only names are read here, with the standard library; whether the files make a scene is the worker's to say. All names
are relative to the scene's folder and must stay inside it, links included (`kiln_schemas.files`), because the bundle is
laid out the same way on the worker, and because a scene's folder may be a stranger's, with links to what is not his. So
the entry too may be a link inside its folder only. An environment may lie anywhere; from outside the folder it is added
as `environment/<name>`, and its folder bounds its links.
"""

import codecs
import contextlib
import hashlib
import io
import json
import posixpath
import re
import struct
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from io import BufferedReader
from pathlib import Path
from typing import Any, Final
from urllib.parse import unquote

from pydantic import ValidationError

from kiln_schemas.errors import InputError
from kiln_schemas.files import LeavesFolder, NotRegular, is_inside, open_inside
from kiln_schemas.formats import CONVERTERS, MITSUBA_INCLUDES, MITSUBA_UNUSED, ends_of_path
from kiln_schemas.job import check_bundle, check_bundle_path
from kiln_schemas.tasks import PATH_LENGTH, Bundle, EnvironmentRef
from kiln_schemas.text import told

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
    places: Mapping[str, tuple[Path, str]]
    """Bundle path to a folder and the file's name in it, which `open_inside` opens."""

    @property
    def sources(self) -> dict[str, Path]:
        """Bundle path to file."""
        return {path: folder / name for path, (folder, name) in self.places.items()}

    def by_hash(self) -> dict[str, Path]:
        """One file for each distinct content."""
        return {sha256: self.sources[path] for path, sha256 in self.bundle.files.items()}

    def open(self, sha256: str) -> BufferedReader:
        """The file of this content, opened as it was when it was collected: no link leads out of its folder."""
        path = next(path for path, digest in self.bundle.files.items() if digest == sha256)
        return _open(*self.places[path], path)


def collect(
    scene: Path, environment: Path | None = None, *, scale: float = 1.0, rotation_deg: float = 0.0
) -> LocalBundle:
    """The bundle of `scene`; InputError names what is missing or leaves the folder, and who references it."""
    reader = READERS.get(scene.suffix.lower())
    if not scene.exists():
        raise InputError("there is no such scene file", where=str(scene), remedy="Check the path.")
    if reader is None:
        remedy = CONVERTERS.get(scene.suffix.lower(), f"Known: {', '.join(READERS)}.")
        raise InputError(f"'{scene.suffix}' is not a scene format", where=str(scene), remedy=remedy)
    folder = scene.parent.resolve()
    entry = check_bundle_path(scene.name)
    places, referrers = {entry: (folder, entry)}, {entry: str(scene)}
    _open(folder, entry, str(scene)).close()
    for name, referrer in reader(folder, entry):
        places[name], referrers[name] = (folder, name), referrer
    reference = None
    if environment is not None:
        name, place = _environment_place(folder, environment)
        places[name], referrers[name] = place, str(environment)
        reference = _reference(name, scale, rotation_deg)
    files = {}
    for name, place in sorted(places.items()):
        with _open(*place, referrers[name]) as file:
            files[name] = sha256_of(file, str(place[0] / place[1]))
    return LocalBundle(check_bundle(Bundle(entry=entry, files=files, environment=reference)), places)


def sha256_of(file: BufferedReader, where: str) -> str:
    """Hash of an open file; InputError where it cannot be read."""
    try:
        return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        raise InputError(f"cannot be read: {error.strerror}", where=where) from None


def _open(folder: Path, name: str, referrer: str) -> BufferedReader:
    """The file `name` below `folder`, links followed as long as they stay there; InputError at who names it."""
    try:
        return open_inside(folder, name)
    except LeavesFolder:
        detail, remedy = f"'{name}' is a link that leaves the scene's folder", "Put the file itself there."
    except (FileNotFoundError, NotADirectoryError):
        detail, remedy = f"the file '{name}' is missing", "Add it, or remove what uses it."
    except NotRegular as error:
        detail, remedy = f"'{name}' cannot be read: {error.strerror}", "Put the file itself there."
    except OSError as error:
        detail, remedy = f"'{name}' cannot be read: {error.strerror}", "Make it readable, or remove what uses it."
    raise InputError(detail, where=referrer, remedy=remedy)


def _read(folder: Path, name: str) -> bytes:
    with _open(folder, name, name) as file:
        return file.read()


def _environment_place(folder: Path, environment: Path) -> tuple[str, tuple[Path, str]]:
    """An environment's bundle path, and the folder and name by which it is opened."""
    if not environment.exists():
        raise InputError("there is no such environment file", where=str(environment), remedy="Check --env.")
    parent = environment.parent.resolve()
    if parent.is_relative_to(folder):
        name = check_bundle_path((parent / environment.name).relative_to(folder).as_posix())
        return name, (folder, name)
    return check_bundle_path(f"environment/{environment.name}"), (parent, environment.name)


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
        document: Any = json.loads(_read(folder, name))
    except (ValueError, RecursionError):
        raise InputError("is not JSON", where=name, remedy="Export the scene again.") from None
    yield from _gltf_uris(document, name)


def _glb(folder: Path, name: str) -> References:
    broken = InputError("is not a GLB file", where=name, remedy="Export the scene again.")
    with _open(folder, name, name) as file:
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
    for arguments in _statements(folder, name, {"mtllib"}):
        # A name may hold spaces, and a statement may hold several names: the file system decides.
        for library in [arguments] if is_inside(folder, _joined(name, arguments)) else arguments.split():
            path = _joined(name, library)
            if is_inside(folder, path):
                _open(folder, path, name).close()
                yield path, name
                yield from _mtl(folder, path)


def _mtl(folder: Path, name: str) -> References:
    keys = {"map_ka", "map_kd", "map_ks", "map_ke", "map_ns", "map_d", "map_bump", "map_pr", "map_pm", "map_ps"}
    for arguments in _statements(folder, name, keys | {"bump", "disp", "decal", "refl", "norm"}):
        yield _joined(name, _map_file(arguments)), name


def _statements(folder: Path, name: str, keys: set[str]) -> Iterator[str]:
    """Arguments of the statements with one of these keywords, line by line."""
    with _open(folder, name, name) as file:
        wide = file.read(2) in (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)
    encoding = "utf-16" if wide else "utf-8-sig"
    with io.TextIOWrapper(_open(folder, name, name), encoding=encoding, errors="replace") as file:
        for line in file:
            words = line.split(None, 1)
            if len(words) == 2 and words[0].lower() in keys:
                yield words[1].strip()


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


def _collada(folder: Path, name: str) -> References:
    """Textures that are in the folder; the reader leaves the others out, with a note."""
    for node in _parsed(folder, name).iter():
        if node.tag.rpartition("}")[2] in ("init_from", "ref") and node.text:
            yield from _texture(folder, name, node.text)


def _fbx(folder: Path, name: str) -> References:
    """Textures that are in the folder. FBX compresses arrays alone, so names stand in binary files as they are."""
    data = _read(folder, name)
    binary = re.finditer(rb"(?:Relative)?File[nN]ameS(.{4})", data, re.DOTALL)
    found = [data[match.end() : match.end() + min(struct.unpack("<I", match[1])[0], PATH_LENGTH)] for match in binary]
    found += re.findall(rb'(?:Relative)?File[nN]ame: *"([^"\r\n]{1,512})"', data)
    for reference in dict.fromkeys(found):
        yield from _texture(folder, name, reference.decode(errors="replace"))


def _texture(folder: Path, name: str, reference: str) -> References:
    """The file that `scene.texture_files` finds for the path of a texture."""
    for end in ends_of_path(reference):
        with contextlib.suppress(InputError):  # no name of a bundle
            path = _joined(name, end)
            if is_inside(folder, path):
                yield path, name
                return


def _parsed(folder: Path, name: str) -> ElementTree.Element:
    """The tree of an XML file."""
    try:
        return ElementTree.fromstring(_read(folder, name), ElementTree.XMLParser(target=_Elements(name)))
    except (ElementTree.ParseError, LookupError, ValueError) as error:  # the latter two of encodings
        detail = f"is not XML: {told(str(error), 80)}"
        raise InputError(detail, where=name, remedy="Export the scene again.") from None


def _mitsuba_xml(folder: Path, name: str) -> References:
    yield from _MitsubaFiles(folder, name).references(name)


class _MitsubaFiles:
    """What a Mitsuba scene names, in the order of its elements, as the worker looks for it (`scene.mitsuba_files`)."""

    def __init__(self, folder: Path, entry: str) -> None:
        self.folder = folder
        self.entry = entry
        self.defaults: dict[str, str] = {}
        self.paths: list[str] = []
        self.included = [entry]

    def references(self, name: str) -> References:
        """The files that an XML file names, and those of the files that it includes."""
        waiting = [(_parsed(self.folder, name), True)]
        while waiting:
            node, used = waiting.pop()
            yield from self._element(node, name, used)
            waiting += [(child, used and child.tag not in MITSUBA_UNUSED) for child in reversed(node)]

    def _element(self, node: ElementTree.Element, name: str, used: bool) -> References:
        """What one element names, without those in it."""
        if node.tag == "default":
            self.defaults.setdefault(node.get("name", ""), self._filled(node.get("value", "")))
        elif node.tag == "path":
            self.paths = [*self._folders(self._filled(node.get("value", "")), name), *self.paths]
        elif node.tag == "include":
            yield from self._include(self._found(self._filled(node.get("filename", "")), name), name)
        elif node.tag == "spectrum" and node.get("filename"):
            yield self._found(self._filled(node.get("filename", "")), name), name
        elif node.tag == "string" and node.get("name") == "filename" and node.get("value"):
            path = self._found(self._filled(node.get("value", "")), name)
            if used or is_inside(self.folder, path):
                yield path, name

    def _include(self, path: str, name: str) -> References:
        yield path, name
        if path in self.included:
            return
        if len(self.included) > MITSUBA_INCLUDES:
            raise InputError(f"includes more than {MITSUBA_INCLUDES} files", where=name, remedy="Include fewer.")
        self.included.append(path)
        _open(self.folder, path, name).close()
        yield from self.references(path)

    def _filled(self, value: str) -> str:
        """A value with its variables, which is no file's name where it has become longer than one."""
        filled = re.sub(r"\$(\w+)", lambda match: self.defaults.get(match[1], match[0]), value)
        return filled[: PATH_LENGTH + 1]

    def _found(self, reference: str, name: str) -> str:
        """The bundle path of a name: the first that is there, else the first that stays in the folder."""
        paths, refusals = [], []
        for base in (*self.paths, posixpath.dirname(self.entry), posixpath.dirname(name)):
            try:
                paths.append(_joined(posixpath.join(base, "."), reference))
            except InputError as error:
                refusals.append(InputError(error.detail, where=name, remedy=error.remedy))
                continue
            if is_inside(self.folder, paths[-1]):
                return paths[-1]
        if not paths:
            raise refusals[0]
        return paths[0]

    def _folders(self, reference: str, name: str) -> list[str]:
        """The folders that a `<path>` may mean; one that leads out of the scene's folder is ignored."""
        folders = []
        for file in dict.fromkeys((name, self.entry)):
            joined = posixpath.normpath(posixpath.join(posixpath.dirname(file), reference))
            with contextlib.suppress(InputError):
                folders.append("" if joined == "." else _joined(file, reference))
        return folders


READERS: Final[Mapping[str, Callable[[Path, str], References]]] = {
    ".glb": _glb,
    ".gltf": _gltf,
    ".obj": _obj,
    ".ply": _nothing,
    ".xml": _mitsuba_xml,
    ".stl": _nothing,
    ".off": _nothing,
    ".dae": _collada,
    ".fbx": _fbx,
}
