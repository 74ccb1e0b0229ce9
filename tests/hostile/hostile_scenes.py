"""Bundles that no honest exporter writes, made by code: each with the words that its refusal must say.

A builder is given a folder outside of every bundle, in which secrets lie, and returns the bundle's files. What is not
hostile in a file is right, so that a reader which overlooks the hostile part takes the scene.
"""

import base64
import gzip
import io
import json
import struct
import zipfile
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

Files = dict[str, bytes]
SECRETS: Final = ("secret.bin", "secret.png", "secret.obj", "secret.mtl", "secret.ply", "secret.xml", "secret.exr")


@dataclass(frozen=True)
class Bad:
    """A scene to be refused: its files, by `build`; `word` is in the sentence; the first file is the entry."""

    name: str
    word: str
    build: Callable[[Path], Files]
    environment: str | None = None


# glTF


@dataclass
class Gltf:
    """A lit triangle as a document to be spoilt, and its one buffer."""

    data: bytearray = field(default_factory=bytearray)
    views: list[dict[str, Any]] = field(default_factory=list)
    accessors: list[dict[str, Any]] = field(default_factory=list)

    def add(self, packed: bytes, component: int, kind: str, count: int) -> int:
        """An accessor of its own view."""
        self.views.append({"buffer": 0, "byteOffset": len(self.data), "byteLength": len(packed)})
        self.data += packed + b"\0" * (-len(packed) % 4)
        view = {"bufferView": len(self.views) - 1}
        self.accessors.append({**view, "componentType": component, "type": kind, "count": count})
        return len(self.accessors) - 1

    def document(self) -> dict[str, Any]:
        uri = "data:application/octet-stream;base64," + base64.b64encode(bytes(self.data)).decode()
        return {
            "asset": {"version": "2.0"},
            "scenes": [{"nodes": [0]}],
            "nodes": [{"mesh": 0}],
            "meshes": [
                {
                    "name": "lamp",
                    "primitives": [{"attributes": {"POSITION": 0, "NORMAL": 2}, "indices": 1, "material": 0}],
                }
            ],
            "materials": [{"name": "light", "emissiveFactor": [1, 1, 1]}],
            "accessors": self.accessors,
            "bufferViews": self.views,
            "buffers": [{"uri": uri, "byteLength": len(self.data)}],
        }


def triangle(positions: Sequence[float] = (0, 0, 0, 1, 0, 0, 0, 1, 0)) -> Gltf:
    made = Gltf()
    made.add(struct.pack(f"<{len(positions)}f", *positions), 5126, "VEC3", len(positions) // 3)
    made.add(struct.pack("<3H", 0, 1, 2), 5123, "SCALAR", 3)
    made.add(
        struct.pack(f"<{len(positions)}f", *([0, 0, 1] * (len(positions) // 3))), 5126, "VEC3", len(positions) // 3
    )
    return made


def put(document: Any, place: str, value: Any) -> Any:
    """The value at a dotted place, numbers being indices; the document itself."""
    node = document
    *path, leaf = place.split(".")
    for part in path:
        node = node[int(part)] if isinstance(node, list) else node.setdefault(part, {})
    if isinstance(node, list):
        node[int(leaf)] = value
    else:
        node[leaf] = value
    return document


def spoilt(name: str, word: str, *changes: tuple[str, Any], base: Gltf | None = None) -> Bad:
    """The triangle with values put at places."""

    def build(outside: Path) -> Files:
        document = (base or triangle()).document()
        for place, value in changes:
            put(document, place, value(outside) if callable(value) else value)
        return {"scene.gltf": json.dumps(document).encode()}

    return Bad(f"glTF: {name}", word, build)


def raw(name: str, word: str, content: bytes | Callable[[], bytes], entry: str = "scene.gltf", **more: bytes) -> Bad:
    """A file of these bytes."""

    def build(_: Path) -> Files:
        return {entry: content if isinstance(content, bytes) else content(), **more}

    return Bad(f"{entry.rpartition('.')[2]}: {name}", word, build)


def glb(*chunks: tuple[int, bytes], version: int = 2, length: int | None = None) -> bytes:
    body = b"".join(struct.pack("<II", len(data), kind) + data for kind, data in chunks)
    return struct.pack("<4sII", b"glTF", version, 12 + len(body) if length is None else length) + body


JSON_CHUNK: Final = 0x4E4F534A
TEXTURED: Final = (
    ("materials.0.pbrMetallicRoughness", {"baseColorTexture": {"index": 0}}),
    ("textures", [{"source": 0}]),
)


def _uris() -> Iterator[Bad]:
    uris: Mapping[str, tuple[Any, str]] = {
        "two dots": ("../secret.bin", "leaves the bundle"),
        "two dots in the middle": ("a/../../secret.bin", "leaves the bundle"),
        "two dots, quoted": ("%2e%2e/secret.bin", "leaves the bundle"),
        "two dots and a slash, quoted": ("..%2fsecret.bin", "leaves the bundle"),
        "an absolute path": (lambda outside: str(outside / "secret.bin"), "leaves the bundle"),
        "/etc/passwd": ("/etc/passwd", "leaves the bundle"),
        "file://": (lambda outside: (outside / "secret.bin").as_uri(), "missing"),
        "http://": ("http://127.0.0.1:9/secret.bin", "missing"),
        "backslashes": ("..\\secret.bin", "leaves the bundle"),
        "a share": ("\\\\host\\share\\secret.bin", "leaves the bundle"),
        "a drive": ("C:/secret.bin", "leaves the bundle"),
        "U+0000": ("secret.bin\0.png", "control character"),
        "U+0000, quoted": ("secret.bin%00.png", "control character"),
        "an escape sequence": ("\x1b[2J\x1b]0;owned\x07", "\\x1b[2J"),
        "300 letters": ("x" * 300, "longer than"),
        "a million letters": ("y" * 1_000_000, "longer than"),
        "5000 folders": ("a/" * 5000 + "b", "longer than"),
        "the folder itself": (".", "leaves the bundle"),
        "nothing": ("", "leaves the bundle"),
        "/dev/zero": ("/dev/zero", "leaves the bundle"),
        "/proc/self/environ": ("../../../../../../proc/self/environ", "leaves the bundle"),
        "data without a comma": ("data:application/octet-stream;base64", "comma"),
        "data that is not base64": ("data:;base64,%%%%", "decoded"),
        "data that is no byte": ("data:,\u20ac", "decoded"),
    }
    for name, (uri, word) in uris.items():
        yield spoilt(f"buffer, {name}", word, ("buffers.0.uri", uri))
        if not name.startswith("data"):
            yield spoilt(f"image, {name}", word, *TEXTURED, ("images", [{"uri": uri}]), ("images.0.uri", uri))


def _documents() -> Iterator[Bad]:
    yield raw("nothing", "valid glTF", b"")
    yield raw("text", "valid glTF", b"solid cube")
    yield raw("invalid UTF-8", "valid glTF", b'{"asset": {"version": "\xff\xfe"}}')
    yield raw("half a surrogate pair", "is glTF", b'{"asset": {"version": "\\ud800"}}')
    yield raw("100000 brackets", "valid glTF", b"[" * 100_000)
    deep = b'{"asset": {"version": "2.0"}, "extras": ' + b'{"a":' * 100_000 + b"1" + b"}" * 100_000 + b"}"
    yield raw("nested 100000 deep", "valid glTF", deep)
    yield raw(
        "a number of 100000 digits", "valid glTF", b'{"asset": {"version": "2.0"}, "scene": ' + b"9" * 100_000 + b"}"
    )
    yield raw("NaN", "valid glTF", b'{"asset": {"version": "2.0"}, "nodes": [{"scale": [NaN, 1, 1]}]}')
    yield raw("1e999", "finite", b'{"asset": {"version": "2.0"}, "nodes": [{"scale": [1e999, 1, 1]}]}')
    yield raw("duplicate keys, the last counts", "meshes", b'{"asset": {"version": "2.0"}, "meshes": [], "meshes": 7}')
    empty = b'{"asset":{"version":"2.0"},"nodes":[' + b"{}," * (10**7 - 1) + b"{}]}"
    yield raw("ten million nodes", "at most 4000000", lambda: empty)
    children = b'{"asset":{"version":"2.0"},"nodes":[{"children":[' + b"1," * (10**6) + b"1]}]}"
    yield raw("a million children", "at most 200000", lambda: children)
    many = b'{"asset":{"version":"2.0"},"extensionsUsed":[' + b'"",' * 200_000 + b'""]}'
    yield raw("200001 extensions", "at most 200000", lambda: many)
    yield spoilt("no version", "version", ("asset", {}))
    yield spoilt("version 3", "glTF 3.0", ("asset.version", "3.0"))
    yield spoilt("splats", "KHR_gaussian_splatting", ("extensionsRequired", ["KHR_gaussian_splatting"]))
    for place, value in (
        *(("nodes", "many"), ("nodes", {}), ("nodes", [7]), ("nodes.0.mesh", "x"), ("nodes.0.mesh", -1)),
        *(("nodes.0.mesh", 2**31), ("nodes.0.mesh", 1.5), ("nodes.0.matrix", [1] * 15), ("nodes.0.matrix", "identity")),
        *(("nodes.0.translation", [0, 0]), ("nodes.0.translation", ["a", 0, 0]), ("nodes.0.children", 7)),
        *(("scene", -1), ("scene", "first"), ("scenes", [[]]), ("meshes", [None]), ("meshes.0.primitives", {})),
        *(("meshes.0.primitives.0.attributes", []), ("meshes.0.primitives.0.attributes", {"POSITION": None})),
        *(("meshes.0.primitives.0.mode", 7), ("meshes.0.primitives.0.indices", -1), ("accessors.0.count", -1)),
        *(
            ("accessors.0.count", 0),
            ("accessors.0.count", 2**31),
            ("accessors.0.count", 10**30),
            ("accessors.0.count", "many"),
        ),
        *(("accessors.0.componentType", 5124), ("accessors.0.type", "VEC5"), ("accessors.0.byteOffset", -4)),
        *(("bufferViews.0.byteLength", -1), ("bufferViews.0.byteOffset", 2**41), ("bufferViews.0.byteStride", 1)),
        *(("bufferViews.0.byteStride", 256), ("buffers.0.byteLength", -1), ("buffers.0.uri", 7), ("buffers", None)),
        *(("materials.0.emissiveFactor", [2, 0, 0]), ("materials.0.alphaMode", "MAYBE"), ("materials.0.name", 7)),
        *(("materials.0.extensions", {"KHR_materials_emissive_strength": 7}), ("extensionsUsed", "all")),
    ):
        last = next(part for part in reversed(place.split(".")) if not part.isdigit())
        yield spoilt(f"{place} is {str(value)[:20]}", last, (place, value))
    strong = {"KHR_materials_emissive_strength": {"emissiveStrength": -1}}
    yield spoilt("negative light", "greater", ("materials.0.extensions", strong))
    yield spoilt("rough beyond 1", "roughness", ("materials.0.pbrMetallicRoughness", {"roughnessFactor": 2}))


def _ranges() -> Iterator[Bad]:
    primitive = "meshes.0.primitives.0"
    yield spoilt("a mesh that there is not", "mesh 7", ("nodes.0.mesh", 7))
    yield spoilt("a scene that there is not", "scene 7", ("scene", 7))
    yield spoilt("a child that there is not", "node 9", ("nodes.0.children", [9]))
    yield spoilt("an accessor that there is not", "accessor 99", (f"{primitive}.attributes.POSITION", 99))
    yield spoilt("indices that there are not", "accessor 99", (f"{primitive}.indices", 99))
    yield spoilt("a material that there is not", "material 5", (f"{primitive}.material", 5))
    yield spoilt("a view that there is not", "buffer view 99", ("accessors.0.bufferView", 99))
    yield spoilt("a buffer that there is not", "buffer 3", ("bufferViews.0.buffer", 3))
    yield spoilt("a buffer without bytes", "buffer 0", ("buffers", [{"byteLength": 80}]))
    yield spoilt("a buffer that is shorter than it says", "should have", ("buffers.0.byteLength", 10**9))
    yield spoilt("a view beyond its buffer", "ends at byte", ("bufferViews.0.byteLength", 10**6))
    yield spoilt("a view far beyond its buffer", "ends at byte", ("bufferViews.0.byteOffset", 2**39))
    yield spoilt("an accessor beyond its view", "leaves its buffer view", ("accessors.0.count", 4))
    yield spoilt("an accessor of 2**31-1", "at most", ("accessors.0.count", 2**31 - 1))
    yield spoilt("an accessor that begins behind its view", "leaves its", ("accessors.0.byteOffset", 2**39))
    yield spoilt("a stride less than an element", "leaves its", ("bufferViews.0.byteStride", 4))
    yield spoilt("a stride beyond the view", "leaves its", ("bufferViews.0.byteStride", 252))
    yield spoilt("positions in two dimensions", "VEC2", ("accessors.0.type", "VEC2"))
    yield spoilt("indices that are floats", "unsigned", ("accessors.1.componentType", 5126), ("accessors.1.count", 1))
    yield spoilt("indices beyond the vertices", "names vertex", ("accessors.0.count", 2), ("accessors.2.count", 2))
    yield spoilt("fewer normals than vertices", "NORMAL", ("accessors.2.count", 2))
    nothing = {"componentType": 5126, "type": "VEC3"}
    yield spoilt("2**31-1 zeros", "at most", ("accessors.0", {**nothing, "count": 2**31 - 1}))
    yield spoilt("50 million zeros", "has no bytes", ("accessors.0", {**nothing, "count": 50_000_000}))
    sparse = {"count": 2, "indices": {"bufferView": 1, "componentType": 5123}, "values": {"bufferView": 0}}
    for name, word, change in (
        ("more values than there are", "sparse", {"count": 9}),
        ("2**31-1 values", "sparse", {"count": 2**31 - 1}),
        ("indices that do not rise", "do not rise", {"indices": {"bufferView": 0, "componentType": 5121}}),
        ("indices beyond it", "leave it", {"count": 3, "indices": {"bufferView": 3, "componentType": 5123}}),
        ("values of a view that there is not", "buffer view 77", {"values": {"bufferView": 77}}),
        (
            "indices of a view that there is not",
            "buffer view 77",
            {"indices": {"bufferView": 77, "componentType": 5123}},
        ),
        ("values that leave their view", "leaves its", {"values": {"bufferView": 0, "byteOffset": 30}}),
    ):
        base = triangle()
        base.add(struct.pack("<3H", 0, 1, 9), 5123, "SCALAR", 3)
        yield spoilt(f"sparse, {name}", word, ("accessors.0.sparse", {**sparse, **change}), base=base)


def _geometry() -> Iterator[Bad]:
    inf, nan = float("inf"), float("nan")
    yield spoilt("a NaN position", "vertex 1", base=triangle((0, 0, 0, nan, 0, 0, 0, 1, 0)))
    yield spoilt("an infinite position", "vertex 2", base=triangle((0, 0, 0, 1, 0, 0, 0, -inf, 0)))
    yield spoilt("a position at 3e38", "beyond", base=triangle((0, 0, 0, 3e38, 0, 0, 0, 1, 0)))
    yield spoilt("no area", "no faces", base=triangle((1, 1, 1) * 3))
    yield spoilt("a line", "no faces", base=triangle((0, 0, 0, 1, 1, 1, 2, 2, 2)))
    yield spoilt("scaled to nothing", "no faces", ("nodes.0.scale", [0, 0, 0]))
    yield spoilt("scaled by 1e300 twice", "not finite", ("nodes", _chain(2, {"scale": [1e300] * 3})))
    yield spoilt("a matrix of 1e308", "not finite", ("nodes", _chain(2, {"matrix": [1e308] * 16})))
    yield spoilt("moved by 1e300", "beyond", ("nodes.0.translation", [1e300, 0, 0]))
    yield spoilt("a chain of 20000 nodes", "not finite", ("nodes", _chain(20_000, {"scale": [1.5] * 3})))
    yield spoilt("a node that is its own child", "reached twice", ("nodes.0.children", [0]))
    ring = [{"mesh": 0, "children": [1]}, {"children": [2]}, {"children": [0]}]
    yield spoilt("a ring of nodes", "reached twice", ("nodes", ring))
    twins = [{"children": [1, 2]}, {"children": [3]}, {"children": [3]}, {"mesh": 0}]
    yield spoilt("a node with two parents", "reached twice", ("nodes", twins))
    yield spoilt("a root named twice", "reached twice", ("scenes.0.nodes", [0, 0]))
    yield spoilt("only a ring, without scenes", "no faces", ("nodes", ring), ("scenes", []))
    yield spoilt("points", "no faces", ("meshes.0.primitives.0.mode", 0))
    yield spoilt("no positions", "no faces", ("meshes.0.primitives.0.attributes", {}))
    yield spoilt("no light", "nothing in the scene emits", ("materials", [{}]))
    crowd = {"extensions": {"EXT_mesh_gpu_instancing": {"attributes": {"TRANSLATION": 3}}}, "mesh": 0}
    zeros = {"componentType": 5126, "type": "VEC3", "count": 10**7}
    yield spoilt("ten million instances", "at most 100000", ("nodes.0", crowd), ("accessors", [*_three(), zeros]))
    few = {**zeros, "count": 60_000}
    two = [{"children": [1, 2]}, crowd, crowd]
    yield spoilt("twice 60000 instances", "at most 100000", ("nodes", two), ("accessors", [*_three(), few]))
    uneven = put(json.loads(json.dumps(crowd)), "extensions.EXT_mesh_gpu_instancing.attributes.SCALE", 0)
    yield spoilt("uneven instances", "instancing", ("nodes.0", uneven), ("accessors", [*_three(), few]))
    none = {"extensions": {"EXT_mesh_gpu_instancing": {"attributes": {}}}, "mesh": 0}
    yield spoilt("instances of nothing", "instancing", ("nodes.0", none))
    base = triangle()
    base.add(struct.pack("<3H", 0, 1, 2) * 5000, 5123, "SCALAR", 15_000)
    nodes = [{"children": list(range(1, 5001))}, *({"mesh": 0} for _ in range(5000))]
    many = (("nodes", nodes), ("meshes.0.primitives.0.indices", 3))
    yield spoilt("25 million triangles by instances", "at most 20000000", *many, base=base)
    lights = {
        "KHR_lights_punctual": {"lights": [{"type": "spot", "spot": {"innerConeAngle": 1, "outerConeAngle": 0.5}}]}
    }
    use = ("nodes.0.extensions", {"KHR_lights_punctual": {"light": 0}})
    yield spoilt("a cone inside out", "inner cone", ("extensions", lights), use)
    sun = {"KHR_lights_punctual": {"lights": [{"type": "directional", "intensity": -1}]}}
    yield spoilt("a negative sun", "greater", ("extensions", sun), use)
    yield spoilt("a light that there is not", "light 0", use)
    flat = {"KHR_lights_punctual": {"lights": [{"type": "directional"}]}}
    yield spoilt("a sun without direction", "no direction", ("extensions", flat), use, ("nodes.0.scale", [0, 0, 0]))


def _three() -> list[dict[str, Any]]:
    return triangle().accessors


def _chain(count: int, link: dict[str, Any]) -> list[dict[str, Any]]:
    """Nodes, each the child of the one before; the last has the mesh."""
    return [*({**link, "children": [i + 1]} for i in range(count - 1)), {**link, "mesh": 0}]


def _binaries() -> Iterator[Bad]:
    text = json.dumps(triangle().document()).encode()
    good = glb((JSON_CHUNK, text))
    yield raw("cut in its header", "cut off", good[:15], "scene.glb")
    yield raw("cut in its chunk", "should have", good[:-10], "scene.glb")
    yield raw("a length that lies", "should have", glb((JSON_CHUNK, text), length=2**31), "scene.glb")
    yield raw(
        "a chunk that lies", "leaves the file", good[:12] + struct.pack("<II", 2**31, JSON_CHUNK) + text, "scene.glb"
    )
    yield raw("version 1", "version 1", glb((JSON_CHUNK, text), version=1), "scene.glb")
    yield raw("no JSON", "no JSON chunk", glb((0x004E4942, text)), "scene.glb")
    yield raw(
        "200000 chunks of nothing", "no JSON", lambda: glb(*((kind, b"") for kind in range(200_000))), "scene.glb"
    )
    yield raw("a zip", "valid glTF", zipped({"../../evil": b"x"}), "scene.glb")
    yield raw("a gzip bomb", "valid glTF", gzip.compress(b"\0" * (64 << 20)), "scene.glb")
    yield raw("a format that is not read", "not a scene format", b"BLENDER-v300", "scene.blend")
    yield raw("no suffix", "not a scene format", b"v 0 0 0", "scene")


def zipped(files: Mapping[str, bytes]) -> bytes:
    archive = io.BytesIO()
    with zipfile.ZipFile(archive, "w") as writer:
        for name, data in files.items():
            writer.writestr(name, data)
    return archive.getvalue()


# Images


def png(width: int, height: int, *, depth: int = 1, rows: bytes | None = None, crc: int = 0) -> bytes:
    """A grey picture; of so few bits that a large one is small."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data) ^ crc)

    head = struct.pack(">IIBBBBB", width, height, depth, 0, 0, 0, 0)
    body = zlib.compress(b"\0" * ((1 + (width * depth + 7) // 8) * height) if rows is None else rows, 9)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", body) + chunk(b"IEND", b"")


def jpeg(width: int, height: int) -> bytes:
    """The headers of a JPEG file, and no picture."""
    frame = struct.pack(">BHHB", 8, height, width, 1) + b"\1\x11\0"
    return b"\xff\xd8\xff\xc0" + struct.pack(">H", 2 + len(frame)) + frame + b"\xff\xda\0\x08\1\1\0\0\x3f\0\xff\xd9"


def hdr(width: int, height: int, body: bytes = b"") -> bytes:
    return b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n" + f"-Y {height} +X {width}\n".encode() + body


def exr(window: tuple[int, int, int, int], *, channels: int = 3, display: tuple[int, ...] | None = None) -> bytes:
    """The header of an OpenEXR file, and no picture."""

    def attribute(name: str, kind: str, data: bytes) -> bytes:
        return name.encode() + b"\0" + kind.encode() + b"\0" + struct.pack("<I", len(data)) + data

    listed = b"".join(
        f"C{i:05}".encode() + b"\0" + struct.pack("<IBBBBII", 1, 0, 0, 0, 0, 1, 1) for i in range(channels)
    )
    return (
        struct.pack("<II", 20000630, 2)
        + attribute("channels", "chlist", listed + b"\0")
        + attribute("compression", "compression", b"\0")
        + attribute("dataWindow", "box2i", struct.pack("<4i", *window))
        + attribute("displayWindow", "box2i", struct.pack("<4i", *(display or window)))
        + attribute("lineOrder", "lineOrder", b"\0")
        + attribute("pixelAspectRatio", "float", struct.pack("<f", 1.0))
        + attribute("screenWindowCenter", "v2f", struct.pack("<2f", 0, 0))
        + attribute("screenWindowWidth", "float", struct.pack("<f", 1.0))
        + b"\0"
    )


def textured(name: str, word: str, content: bytes | Callable[[], bytes], file: str = "picture.png") -> Bad:
    """The triangle with this picture."""

    def build(_: Path) -> Files:
        document = triangle().document()
        for place, value in (*TEXTURED, ("images", [{"uri": file}])):
            put(document, place, value)
        return {"scene.gltf": json.dumps(document).encode(), file: content if isinstance(content, bytes) else content()}

    return Bad(f"image: {name}", word, build)


def under(name: str, word: str, content: bytes, file: str = "sky.exr") -> Bad:
    """A triangle under this sky."""
    scene = json.dumps(triangle().document()).encode()
    return Bad(f"sky: {name}", word, lambda _: {"scene.gltf": scene, file: content}, file)


def _images() -> Iterator[Bad]:
    large = 100_000
    yield textured("PNG of 10^5 x 10^5", "picture.png", lambda: png(large, large, rows=b"\0"))
    yield textured("PNG of 2^31-1 x 2^31-1", "picture.png", lambda: png(2**31 - 1, 2**31 - 1, rows=b"\0"))
    yield textured("PNG of 0 x 0", "picture.png", png(0, 0, rows=b""))
    yield textured("PNG of 16384 x 16384 in 35 kB", "16384 x 16384", lambda: png(16384, 16384))
    yield textured("JPEG of 65500 x 65500", "picture.jpg", jpeg(65500, 65500), "picture.jpg")
    yield textured("HDR of 10^5 x 10^5", "100000", hdr(large, large), "picture.hdr")
    yield textured("HDR of 10^18 x 10^18", "picture.hdr", hdr(10**18, 10**18), "picture.hdr")
    yield textured("HDR of -5 x -5", "picture.hdr", hdr(-5, -5), "picture.hdr")
    yield textured("EXR of 10^5 x 10^5", "100000x100000", exr((0, 0, large - 1, large - 1)), "picture.exr")
    yield textured("EXR whose window is inside out", "picture.exr", exr((10, 10, 0, 0)), "picture.exr")
    yield textured("EXR of 2^32 x 2^32", "picture.exr", exr((-(2**31), -(2**31), 2**31 - 1, 2**31 - 1)), "picture.exr")
    cropped = exr((0, 0, 7, 7), display=(0, 0, 99, 99))
    yield textured("EXR with two windows", "display window", cropped, "picture.exr")
    yield textured("EXR of 20000 channels", "picture.exr", exr((0, 0, 7, 7), channels=20_000), "picture.exr")
    yield textured("EXR without pixels", "picture.exr", exr((0, 0, 4095, 4095)), "picture.exr")
    yield textured("PNG cut off", "picture.png", png(64, 64)[:50])
    yield textured("PNG without its rows", "picture.png", png(64, 64, rows=b"\0"))
    yield textured("PNG with wrong sums", "picture.png", png(64, 64, crc=1))
    yield textured("JPEG cut off", "picture.jpg", b"\xff\xd8\xff", "picture.jpg")
    yield textured("SVG", "neither PNG", b"<svg xmlns='http://www.w3.org/2000/svg'/>")
    yield textured("GIF", "neither PNG", b"GIF89a" + b"\0" * 20)
    yield textured("TIFF", "neither PNG", b"II*\0" + b"\0" * 20)
    yield textured("a zip", "neither PNG", zipped({"a.png": png(4, 4)}))
    yield textured("a gzip", "neither PNG", gzip.compress(png(4, 4)))
    yield textured("text", "neither PNG", b"hello")
    for kind in (2, 10, 1, 9):
        head = struct.pack("<BBBHHBHHHHBB", 0, kind % 8 == 1, kind, 0, 0, 24, 0, 0, 65535, 65535, 24, 0)
        yield textured(f"TGA of kind {kind}, 65535 x 65535", "cannot be decoded", head + bytes(99))
    yield textured("TGA cut off", "picture", struct.pack("<BBBHHBHHHHBB", 0, 0, 10, 0, 0, 0, 0, 0, 64, 64, 24, 0))
    bmp = b"BM" + struct.pack("<IIIIiiHHIIiiII", 99, 0, 54, 40, 10**5, 10**5, 1, 24, 0, 0, 0, 0, 0, 0)
    yield textured("BMP of 10^5 x 10^5", "cannot be decoded", bmp + bytes(99))
    yield textured("BMP cut off", "picture", b"BM" + bytes(20))
    yield textured("nothing", "neither PNG", b"")
    yield textured(
        "what begins like HDR", "picture.png", b"#?" + b"\0\0\2" + b"\0" * 9 + struct.pack("<HHBB", 9, 9, 24, 0)
    )
    yield under("a PNG", "Radiance HDR", png(8, 4), "sky.png")
    yield under("text", "OpenEXR", b"hello")
    yield under("EXR of 10^5 x 10^5", "100000x100000", exr((0, 0, large - 1, large - 1)))
    yield under("HDR that is square", "twice as wide", hdr(2, 2, b"\x80\x80\x80\x80" * 4), "sky.hdr")
    yield under("HDR of 10^5 x 5*10^4", "100000x50000", hdr(large, large // 2), "sky.hdr")
    # Of scene files
    yield spoilt("a texture that there is not", "texture 0", TEXTURED[0])
    yield spoilt("an image that there is not", "image 0", *TEXTURED)
    yield spoilt("a texture without a source", "no image that is read", TEXTURED[0], ("textures", [{}]))
    yield spoilt("a sampler that there is not", "sampler 4", TEXTURED[0], ("textures", [{"source": 0, "sampler": 4}]))
    yield spoilt("an image of nothing", "neither a URI", *TEXTURED, ("images", [{}]))
    yield spoilt("an image in a view that there is not", "buffer view 50", *TEXTURED, ("images", [{"bufferView": 50}]))
    yield spoilt("an image that is the geometry", "neither PNG", *TEXTURED, ("images", [{"bufferView": 0}]))


# OBJ and PLY

FACE: Final = "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"
LAMP: Final = "newmtl lamp\nKe 1 1 1\n"


def obj(name: str, word: str, text: str | Callable[[Path], str], library: str | Callable[[Path], str] = LAMP) -> Bad:
    """An OBJ file with a library beside it."""

    def build(outside: Path) -> Files:
        body = text if isinstance(text, str) else text(outside)
        return {
            "scene.obj": ("mtllib lib.mtl\nusemtl lamp\n" + body).encode("utf-8", "surrogateescape"),
            "lib.mtl": (library if isinstance(library, str) else library(outside)).encode(),
        }

    return Bad(f"OBJ: {name}", word, build)


def _objs() -> Iterator[Bad]:
    for name, path in (
        ("two dots", "../secret.mtl"),
        ("an absolute path", "/etc/passwd"),
        ("two dots in the middle", "a/../../secret.mtl"),
        ("a backslash", "..\\secret.mtl"),
        ("300 letters", "x" * 300),
    ):
        word = "longer than" if name == "300 letters" else "leaves the bundle"
        yield obj(f"library, {name}", word, f"mtllib {path}\n" + FACE)
        yield obj(f"map, {name}", word, FACE, LAMP + f"map_Kd {path}\n")
        yield obj(f"map of light, {name}", word, FACE, LAMP + f"map_Ke -s 1 1 1 {path}\n")
    yield obj("library outside", "leaves the bundle", lambda outside: f"mtllib {outside}/secret.mtl\n" + FACE)
    yield obj("map outside", "leaves the bundle", FACE, lambda outside: LAMP + f"map_Kd {outside}/secret.png\n")
    yield obj("map of 100000 words", "map statement", FACE, LAMP + "map_Kd -s " + "1 " * 100_000 + "\n")
    yield obj("map that is missing", "missing", FACE, LAMP + "map_Kd gone.png\n")
    yield obj("map that is the library", "neither PNG", FACE, LAMP + "map_Kd lib.mtl\n")
    yield obj("colour of letters", "Kd", FACE, LAMP + "Kd red\n")
    yield obj("colour of NaN", "Kd", FACE, LAMP + "Kd nan 0 0\n")
    yield obj("negative light", "Ke", FACE, "newmtl lamp\nKe -1 0 0\n")
    yield obj("infinite light", "Ke", FACE, "newmtl lamp\nKe inf 0 0\n")
    library = "".join(f"newmtl m{i}\n" for i in range(200_001))
    yield obj("200001 materials", "at most 200000", FACE, library)
    yield obj("vertex 0", "line 6", FACE.replace("f 1", "f 0"))
    yield obj("vertex 2^31", "line 6", FACE.replace("f 1", f"f {2**31}"))
    yield obj("vertex 10^400", "line 6", FACE.replace("f 1", "f 1" + "0" * 400))
    yield obj("vertex of 5000 digits", "line 6", FACE.replace("f 1", "f " + "9" * 5000))
    yield obj("vertex -9", "line 6", FACE.replace("f 1", "f -9"))
    yield obj("a texture vertex that there is not", "line 6", FACE.replace("f 1", "f 1/7"))
    yield obj("NaN", "vertex 1", FACE.replace("v 1", "v nan"))
    yield obj("infinity", "vertex 1", FACE.replace("v 1", "v -inf"))
    yield obj("1e400", "vertex 1", FACE.replace("v 1", "v 1e400"))
    yield obj("1e30", "beyond", FACE.replace("v 1", "v 1e30"))
    yield obj("letters", "line 4", FACE.replace("v 1", "v one"))
    yield obj("two coordinates", "line 3", FACE.replace("v 0 0 0", "v 0 0"))
    yield obj("two corners", "line 6", FACE.replace("f 1 2 3", "f 1 2"))
    yield obj("no area", "no faces", FACE.replace("v 0 1 0", "v 2 0 0"))
    yield obj("no faces", "no faces", FACE.replace("f", "# f"))
    yield obj("bytes", "no faces", "\0\1\2\udcff\udcfe" * 1000)
    yield obj("a line of a megabyte", "line 3", "v " + "9" * (1 << 20) + " x y\n" + FACE)
    objects = FACE + "".join(f"o {i}\nf 1 2 3\n" for i in range(100_001))
    yield obj("100001 objects", "at most 100000", objects)
    yield raw("nothing", "no faces", b"", "scene.obj")
    yield raw("no light", "nothing in the scene emits", FACE.encode(), "scene.obj")
    yield raw("UTF-16 without its mark", "no faces", FACE.encode("utf-16-le"), "scene.obj")


def ply(name: str, word: str, header: str, body: bytes = b"", form: str = "ascii 1.0") -> Bad:
    text = f"ply\nformat {form}\n{header}end_header\n".encode() + body
    return raw(name, word, text, "scene.ply")


XYZ: Final = "property float x\nproperty float y\nproperty float z\n"
LIST: Final = "property list uchar int vertex_indices\n"


def _plys() -> Iterator[Bad]:
    little = "binary_little_endian 1.0"
    corners = struct.pack("<9f", 0, 0, 0, 1, 0, 0, 0, 1, 0)

    def header(vertices: object = 3, faces: object = 1, rest: str = LIST) -> str:
        return f"element vertex {vertices}\n{XYZ}element face {faces}\n{rest}"

    yield ply("2^31-1 vertices", "rows of vertex", header(vertices=2**31 - 1), corners, little)
    yield ply("10^17 vertices", "rows of vertex", header(vertices=10**17), corners, little)
    yield ply("10^40 vertices", "rows of vertex", header(vertices=10**40), corners, little)
    yield ply("2^31-1 faces", "rows of face", header(faces=2**31 - 1), corners, little)
    yield ply("2^31-1 faces in letters", "rows of face", header(faces=2**31 - 1), b"0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n")
    yield ply("-5 vertices", "scene.ply", header(vertices=-5), corners, little)
    yield ply("many vertices", "is not understood", header(vertices="many"), corners, little)
    counts = header(rest="property list uint int vertex_indices\n")
    yield ply(
        "a face of 2^32-1 corners", "scene.ply", counts, corners + struct.pack("<I3i", 2**32 - 1, 0, 1, 2), little
    )
    yield ply("a face that is cut off", "scene.ply", header(), corners + b"\3\0\0", little)
    yield ply("a corner beyond", "names vertex", header(), corners + struct.pack("<B3i", 3, 0, 1, 7), little)
    yield ply("a corner before", "names vertex -7", header(), corners + struct.pack("<B3i", 3, 0, 1, -7), little)
    nan = struct.pack("<9f", 0, 0, 0, float("nan"), 0, 0, 0, 1, 0)
    yield ply("NaN", "vertex 1", header(), nan + struct.pack("<B3i", 3, 0, 1, 2), little)
    yield ply("a type that there is not", "is not understood", header().replace("float x", "quad x"), corners, little)
    yield ply("a format that there is not", "is not understood", header(), corners, "rot13 1.0")
    yield ply("letters", "cannot be read", header(), b"a b c\nd e f\ng h i\n3 0 1 2\n")
    yield ply(
        "a texture file outside",
        "nothing in the scene emits",
        "comment TextureFile /etc/passwd\n" + header(),
        b"0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n",
    )
    yield raw("no header", "no PLY file", b"ply\n", "scene.ply")
    yield raw("nothing", "no PLY file", b"", "scene.ply")
    yield raw("a header without an end", "scene.ply", b"ply\nformat ascii 1.0\n" + b"comment x\n" * 10_000, "scene.ply")


# Mitsuba


def xml(name: str, word: str, body: str | Callable[[Path], str], head: str = "", **more: bytes) -> Bad:
    """A scene with a lit rectangle and this."""

    def build(outside: Path) -> Files:
        inner = body if isinstance(body, str) else body(outside)
        lamp = '<shape type="rectangle"><emitter type="area"/></shape>'
        return {"scene.xml": f'{head}<scene version="3.0.0">{inner}{lamp}</scene>'.encode(), **more}

    return Bad(f"Mitsuba: {name}", word, build)


def lit(radiance: str) -> str:
    """A sky of this radiance."""
    return f'<emitter type="constant">{radiance}</emitter>'


def file_of(kind: str, name: str) -> str:
    tag = "emitter" if kind == "envmap" else "shape"
    return f'<{tag} type="{kind}"><string name="filename" value="{name}"/></{tag}>'


LAUGHS: Final = "".join(f'<!ENTITY l{i} "{f"&l{i - 1};" * 10}">' for i in range(1, 10))


def _xmls() -> Iterator[Bad]:
    bomb = f'<!DOCTYPE scene [<!ENTITY l0 "lol">{LAUGHS}]>'
    yield xml("billion laughs", "DOCTYPE", "&l9;", bomb)
    yield xml("an external entity", "DOCTYPE", "&x;", '<!DOCTYPE scene [<!ENTITY x SYSTEM "file:///etc/passwd">]>')
    remote = '<!DOCTYPE scene [<!ENTITY % x SYSTEM "http://127.0.0.1:9/x.dtd"> %x;]>'
    yield xml("a parameter entity", "DOCTYPE", "", remote)
    yield xml("a document type elsewhere", "DOCTYPE", "", '<!DOCTYPE scene SYSTEM "file:///etc/passwd">')
    scene = f'<?xml version="1.0" encoding="utf-16"?>{bomb}<scene>&l9;</scene>'
    yield raw("billion laughs in UTF-16", "DOCTYPE", scene.encode("utf-16"), "scene.xml")
    yield xml("an undeclared entity", "not well-formed", "&nothing;")
    inclusion = '<xi:include xmlns:xi="http://www.w3.org/2001/XInclude" href="file:///etc/passwd"/>'
    yield xml("XInclude", "xi:include", inclusion)
    sheet = '<?xml-stylesheet href="file:///etc/passwd"?>'
    yield xml("a style sheet and a wrong shape", "shape 'x'", '<shape type="x"/>', sheet)
    for name, path, word in (
        ("two dots", "../secret.KIND", "leaves the bundle"),
        ("/etc/passwd", "/etc/passwd", "leaves the bundle"),
        ("two dots in the middle", "a/../../secret.KIND", "leaves the bundle"),
        ("a backslash", "..\\secret.KIND", "leaves the bundle"),
        ("file://", "file:///etc/passwd", "missing"),
        ("the scene itself", "scene.xml", ""),
    ):
        for kind, suffix in (("obj", "obj"), ("ply", "ply"), ("envmap", "exr")):
            if (name, kind) == ("the scene itself", "obj"):
                continue  # an OBJ file without faces, which is no fault
            yield xml(f"{kind}, {name}", word, file_of(kind, path.replace("KIND", suffix)))
    yield xml("a shape outside", "leaves the bundle", lambda outside: file_of("ply", f"{outside}/secret.ply"))
    yield xml("a sky outside", "leaves the bundle", lambda outside: file_of("envmap", f"{outside}/secret.exr"))
    parts = '<default name="up" value=".."/>' + file_of("ply", "$up/secret.ply")
    yield xml("two dots in a variable", "leaves the bundle", parts)
    yield xml("a variable without a value", "$HOME", file_of("ply", "$HOME/secret.ply"))
    yield xml("includes two dots", "leaves the bundle", '<include filename="../secret.xml"/>')
    yield xml(
        "includes what is outside", "leaves the bundle", lambda outside: f'<include filename="{outside}/secret.xml"/>'
    )
    yield xml("includes itself", "included files", '<include filename="scene.xml"/>')
    yield xml("includes itself twice", "included files", '<include filename="scene.xml"/>' * 2)
    yield xml("includes itself a thousand times", "included files", '<include filename="scene.xml"/>' * 1000)
    ring = b'<scene><include filename="scene.xml"/></scene>'
    yield xml("a ring of includes", "included files", '<include filename="b.xml"/>', **{"b.xml": ring})
    yield xml("includes nothing", "leaves the bundle", "<include/>")
    growing = '<default name="a" value="xxxxxxxxxx"/>' + "".join(
        f'<default name="{chr(98 + i)}" value="{f"${chr(97 + i)}" * 10}"/>' for i in range(12)
    )
    yield xml("variables of variables", "with its variables", growing)
    yield xml("300 variables", "variables", "".join(f'<default name="v{i}" value="1"/>' for i in range(300)))
    for name in ("/etc", "..", "../outside"):
        yield xml(f"<path> {name}", "leads out of", f'<path value="{name}"/>' + file_of("ply", "passwd"))
        yield xml(
            f"an include by <path> {name}", "leads out of", f'<path value="{name}"/><include filename="secret.xml"/>'
        )
    yield xml("<alias>", "not found", '<alias id="a" as="b"/>')
    yield xml("a spectrum outside", "leaves the bundle", lit('<spectrum name="radiance" filename="/etc/passwd"/>'))
    yield xml("a spectrum that is none", "is not read", lit('<spectrum name="radiance" filename="scene.xml"/>'))
    spectrum = '<spectrum name="radiance" type="{}"><string name="filename" value="../secret.bin"/></spectrum>'
    for kind in ("regular", "irregular"):
        yield xml(f"a {kind} spectrum outside", "leaves the bundle", lit(spectrum.format(kind)))
    yield xml("a black body of 1e300", "is not read", lit('<blackbody name="radiance" temperature="1e300"/>'))
    yield xml("a spectrum of one pair", "", lit('<spectrum name="radiance" value="400:1"/>'))
    yield xml("a spectrum of NaN", "", lit('<spectrum name="radiance" value="400:nan, 500:1"/>'))
    yield xml("a spectrum out of order", "", lit('<spectrum name="radiance" value="500:1, 400:1"/>'))
    for name in ("../../../etc/passwd", "a/b", ".", "Au\\..", "x" * 500):
        metal = f'<bsdf type="conductor"><string name="material" value="{name}"/></bsdf>'
        yield xml(f"the metal {name[:20]}", "", f'<shape type="cube">{metal}</shape>')
        glass = f'<bsdf type="dielectric"><string name="int_ior" value="{name}"/></bsdf>'
        yield xml(f"the glass {name[:20]}", "", f'<shape type="cube">{glass}</shape>')
    announced = struct.pack("<HH", 0x041C, 4) + zlib.compress(struct.pack("<IxQQ", 0x1000, 50_000_000, 15_000_000))
    yield xml("serialized, 50 million announced", "cut off", file_of("serialized", "a.bin"), **{"a.bin": announced})
    many = struct.pack("<HH", 0x041C, 4) + zlib.compress(struct.pack("<IxQQ", 0x1000, 1 << 62, 1 << 62))
    yield xml("serialized, 2^62 announced", "vertices", file_of("serialized", "a.bin"), **{"a.bin": many})
    endless = struct.pack("<HH", 0x041C, 4) + zlib.compress(b"\1" * 50_000_000)
    yield xml("serialized, a name without an end", "name", file_of("serialized", "a.bin"), **{"a.bin": endless})
    for name, data in (("empty", b""), ("a header", announced[:4]), ("noise", announced[:4] + b"\xff" * 99)):
        yield xml(f"serialized, {name}", "a.bin", file_of("serialized", "a.bin"), **{"a.bin": data})
    doubled = '<bsdf id="b0" type="diffuse"/>' + "".join(
        f'<bsdf id="b{i}" type="blendbsdf"><ref id="b{i - 1}"/><ref id="b{i - 1}"/></bsdf>' for i in range(1, 14)
    )
    fails = '<shape type="cube"><ref id="b13"/><emitter type="point"/></shape>'
    yield xml("references that double 13 times", "area emitter", doubled + fails)
    group = "".join(
        f'<shape type="shapegroup" id="g{i}">'
        + f'<shape type="instance"><ref id="g{i - 1}"/></shape>' * 40
        + "</shape>"
        for i in range(1, 4)
    )
    crowd = '<shape type="shapegroup" id="g0"><shape type="cube"/></shape>' + group
    yield xml("instances of instances", "instances", crowd + '<shape type="instance"><ref id="g3"/></shape>')
    for kind in (
        "serialized",
        "shapegroup",
        "instance",
        "merge",
        "sdfgrid",
        "bsplinecurve",
        "python",
        "../../evil.so",
        "",
    ):
        yield xml(f"the shape {kind!r}", f"shape '{kind}'", f'<shape type="{kind}"/>')
    for kind in ("measured", "mask", "blendbsdf", "bumpmap", "dielectric", "null"):
        bsdf = f'<bsdf type="{kind}"><string name="filename" value="/etc/passwd"/></bsdf>'
        word = "leaves the bundle"
        yield xml(f"the BSDF {kind!r} of a file", word, f'<shape type="cube">{bsdf}</shape>')
    for kind in ("sunsky", "projector", "directionalarea", "timedsunsky"):
        yield xml(f"the emitter {kind!r}", f"emitter '{kind}'", f'<emitter type="{kind}"/>')
    bitmap = '<texture type="bitmap" name="reflectance"><string name="filename" value="/etc/passwd"/></texture>'
    yield xml(
        "a picture outside", "leaves the bundle", f'<shape type="cube"><bsdf type="diffuse">{bitmap}</bsdf></shape>'
    )
    volume = '<medium type="heterogeneous"><string name="filename" value="../x.vol"/></medium>'
    yield xml("a volume outside", "leaves the bundle", volume)
    chain = '<bsdf id="b0" type="diffuse"/>' + "".join(
        f'<bsdf id="b{i}" type="twosided"><ref id="b{i - 1}"/></bsdf>' for i in range(1, 5001)
    )
    yield xml("a chain of 5000 BSDFs", "nests too deeply", chain + '<shape type="cube"><ref id="b5000"/></shape>')
    yield xml("a reference to itself", "within itself", '<bsdf id="a" type="twosided"><ref id="a"/></bsdf>')
    yield xml("a reference to nothing", "names nothing", '<shape type="cube"><ref id="gone"/></shape>')
    nested = "<bsdf type='twosided'>" * 5000 + "</bsdf>" * 5000
    yield xml("5000 elements deep", "nests too deeply", f'<shape type="cube">{nested}</shape>')
    yield xml("200001 elements", "too many elements", '<integer name="a" value="1"/>' * 200_001)
    for name, body in (
        ("a radius of NaN", '<float name="radius" value="nan"/>'),
        ("a radius of 1e999", '<float name="radius" value="1e999"/>'),
        ("a radius of a word", '<float name="radius" value="large"/>'),
        ("a centre of NaN", '<point name="center" value="nan 0 0"/>'),
        ("a matrix of infinities", f'<transform name="to_world"><matrix value="{"inf " * 16}"/></transform>'),
        ("a matrix of 5 numbers", '<transform name="to_world"><matrix value="1 2 3 4 5"/></transform>'),
        ("a view of nothing", '<transform name="to_world"><lookat origin="0 0 0" target="0 0 0"/></transform>'),
        ("a turn about nothing", '<transform name="to_world"><rotate angle="5"/></transform>'),
        ("moved by 1e300", '<transform name="to_world"><translate x="1e300"/></transform>'),
        (
            "scaled by 1e300 twice",
            '<transform name="to_world"><scale value="1e300"/><scale value="1e300"/></transform>',
        ),
        ("a radius of -1", '<float name="radius" value="-1"/>'),
        ("a radius of 0", '<float name="radius" value="0"/>'),
        ("a radius of 1e20", '<float name="radius" value="1e20"/>'),
        ("a value without a value", '<float name="radius"/>'),
        ("a scale of four numbers", '<transform name="to_world"><scale value="1 2 3 4"/></transform>'),
        ("a scale of nothing", '<transform name="to_world"><scale value=""/></transform>'),
    ):
        yield xml(name, "", f'<shape type="sphere">{body}</shape>')
    dark = '<emitter type="constant"><rgb name="radiance" value="-1 0 0"/></emitter>'
    yield xml("negative light", "negative", dark)
    yield xml("two skies", "one environment", '<emitter type="constant"/>' * 2)
    yield raw("nothing", "not well-formed", b"", "scene.xml")
    yield raw("U+0000", "not well-formed", b"<scene>\0</scene>", "scene.xml")
    yield raw("no end", "not well-formed", b"<scene>", "scene.xml")
    yield raw("another root", "<svg>", b"<svg/>", "scene.xml")
    yield raw(
        "an encoding that there is not",
        "not well-formed",
        b'<?xml version="1.0" encoding="rot13"?><scene/>',
        "scene.xml",
    )
    yield raw("nothing in it", "no faces", b"<scene/>", "scene.xml")


# Collada

SHEET: Final = """<geometry id="g"><mesh><source id="p"><float_array id="a">0 0 0 1 0 0 0 1 0</float_array>
  <technique_common><accessor source="#a" count="3" stride="3"/></technique_common></source>
  <vertices id="v"><input semantic="POSITION" source="#p"/></vertices>
  <triangles material="m" count="1"><input semantic="VERTEX" source="#v" offset="0"/><p>0 1 2</p></triangles>
  </mesh></geometry>"""
USED: Final = '<instance_geometry url="#g"/>'


def dae(name: str, word: str, nodes: str = USED, shape: str = SHEET, head: str = "", image: str = "") -> Bad:
    """A lit sheet of Collada, or what is left of it; `image` is the path of its light's texture."""
    picture = f'<library_images><image id="i"><init_from>{image}</init_from></image></library_images>' if image else ""
    glow = '<texture texture="i"/>' if image else "<color>1 1 1 1</color>"

    def build(_: Path) -> Files:
        text = f"""{head}<COLLADA>{picture}<library_materials><material id="m"><instance_effect url="#e"/></material>
          </library_materials><library_effects><effect id="e"><profile_COMMON><technique><lambert><emission>{glow}
          </emission></lambert></technique></profile_COMMON></effect></library_effects>
          <library_geometries>{shape}</library_geometries><library_visual_scenes><visual_scene>
          <node id="n">{nodes}</node></visual_scene></library_visual_scenes></COLLADA>"""
        return {"scene.dae": text.encode()}

    return Bad(f"Collada: {name}", word, build)


def _daes() -> Iterator[Bad]:
    yield dae("billion laughs", "document type", "&l9;", head=f'<!DOCTYPE COLLADA [<!ENTITY l0 "lol">{LAUGHS}]>')
    outside = '<!DOCTYPE COLLADA [<!ENTITY x SYSTEM "file:///etc/passwd">]>'
    yield dae("an external entity", "document type", "&x;", head=outside)
    twice = "".join(f'<node id="k{i}">{f"""<instance_node url="#k{i + 1}"/>""" * 2}</node>' for i in range(50))
    yield dae("copies of copies, 50 times", "nodes with all its instances", f'{twice}<node id="k50">{USED}</node>')
    yield dae("a node that holds itself", "hold themselves", '<instance_node url="#n"/>')
    yield dae("300 nodes deep", "nests too deeply", "<node>" * 300 + "</node>" * 300)
    yield dae("100001 instances", "at most 100000", USED * 100_001)
    yield dae("a geometry in another file", "names no", '<instance_geometry url="file:///etc/passwd#g"/>')
    yield dae("a geometry that is a node", "names no", '<instance_geometry url="#n"/>')
    yield dae("moved by NaN", "not finite", "<translate>nan 0 0</translate>" + USED)
    yield dae("moved by 1e300", "beyond", "<translate>1e300 0 0</translate>" + USED)
    yield dae("scaled by 1e300 twice", "not finite", "<scale>1e300 1 1</scale>" * 2 + USED)
    for what, old, new, word in (
        ("10^11 rows", 'count="3" stride', 'count="99999999999" stride', "rows of data"),
        ("rows of 10^11", 'stride="3"', 'stride="99999999999"', "numbers"),
        ("a negative count", 'count="3" stride', 'count="-3" stride', "no count"),
        ("10^11 numbers a corner", 'offset="0"', 'offset="99999999999"', "to a corner"),
        ("a corner of 10^30", "0 1 2<", f"0 1 {10**30}<", "of 3"),
        ("corners of letters", "0 1 2<", "a b c<", "no number"),
        ("points of letters", "0 0 0 1", "x y z w", "no number"),
        ("points of NaN", "0 0 0 1", "nan 0 0 1", "vertex 0"),
        ("a source of itself", 'source="#p"', 'source="#v"', "names no"),
        ("polygons of 10^18 corners", "<p>", f"<vcount>{10**18}</vcount><p>", "vcount"),
        ("polygons of -1 corners", "<p>", "<vcount>-1 4</vcount><p>", "vcount"),
    ):
        shape = SHEET.replace(old, new)
        yield dae(what, word, shape=shape.replace("triangles", "polylist") if "polygons" in what else shape)
    for path in ("/etc/passwd", "../secret.png", "file:///etc/passwd", "http://127.0.0.1:9/secret.png", "gone.png"):
        # What leads out of the bundle is no texture; this one is the only light.
        yield (
            dae(f"the light of {path}", "neither PNG", image="scene.dae")
            if path == "gone.png"
            else dae(f"light of {path}", "nothing in the scene emits", image=path)
        )
    yield raw("nothing", "not well-formed", b"", "scene.dae")
    yield raw("another root", "not with <COLLADA>", b"<svg/>", "scene.dae")
    yield raw("1000001 elements", "too many elements", b"<COLLADA>" + b"<p/>" * 1_000_001 + b"</COLLADA>", "scene.dae")
    yield raw("nothing in it", "no faces", b"<COLLADA/>", "scene.dae")


# FBX


def fbx_record(name: bytes, properties: Sequence[bytes] = (), inner: bytes = b"", at: int = 0) -> bytes:
    """A binary record that begins at `at`; `inner` are the records in it."""
    packed = b"".join(properties)
    inner = inner + bytes(13) if inner else b""
    end = at + 13 + len(name) + len(packed) + len(inner)
    return struct.pack("<IIIB", end, len(properties), len(packed), len(name)) + name + packed + inner


def fbx_file(records: Callable[[int], bytes]) -> bytes:
    head = b"Kaydara FBX Binary  \0\x1a\0" + struct.pack("<I", 7400)
    return head + records(len(head)) + bytes(13)


def _fbxs() -> Iterator[Bad]:
    def array(kind: bytes, length: int, stored: bytes) -> bytes:
        return kind + struct.pack("<III", length, 1, len(stored)) + stored

    zeros = array(b"d", 8 << 20, zlib.compress(bytes(64 << 20), 9))
    bomb = fbx_file(lambda at: fbx_record(b"Objects", [zeros, zeros], at=at))
    for name, word, data in (
        ("nothing", "cannot be read as FBX", b""),
        ("text", "cannot be read as FBX", b"hello"),
        ("an OBJ file", "cannot be read as FBX", FACE.encode()),
        ("a header alone", "fbx", fbx_file(lambda _: b"")),
        ("noise behind a header", "cannot be read as FBX", fbx_file(lambda _: bytes(range(1, 256)) * 9)),
        ("a record that ends before it begins", "fbx", fbx_file(lambda _: struct.pack("<IIIB", 5, 1, 9, 3) + b"abc")),
        ("arrays that inflate 1000 times", "when they are inflated", bomb),
        (
            "an array of 2^32-1 numbers",
            "when they are inflated",
            fbx_file(lambda at: fbx_record(b"V", [array(b"d", 2**32 - 1, zlib.compress(b"1"))], at=at)),
        ),
        ("300 records deep", "cannot be read as FBX", b"; FBX 7.4.0 project file\nO: " + b"{ O: " * 300),
        ("a list of 10^12 numbers", "fbx", b"; FBX 7.4.0 project file\nV: *1000000000000 { a: 1 }"),
    ):
        yield raw(name, word, data, "scene.fbx")


SCENES: Final = [
    *(*_uris(), *_documents(), *_ranges(), *_geometry(), *_binaries(), *_images()),
    *(*_objs(), *_plys(), *_xmls(), *_daes(), *_fbxs()),
]
GOOD: Final = Bad("a lit triangle", "", lambda _: {"scene.gltf": json.dumps(triangle().document()).encode()})
"""What all these would be if they were not spoilt."""
