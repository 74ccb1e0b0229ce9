"""Requests that no honest client sends: name, the request, and the answer that it must get.

Ordinary ones are a `Call`; those that a client library would not send (lies about lengths, broken chunks) are a `Raw`,
written to the socket as they stand. `word` must be in the sentence (place, cause, remedy) of the problem document.
"""

import hashlib
import json
import struct
import zlib
from collections.abc import Iterator, Mapping
from copy import deepcopy
from dataclasses import dataclass, field
from typing import Any, Final

SCENE: Final = b"a scene"
SHA: Final = hashlib.sha256(SCENE).hexdigest()
JOB: Final[Mapping[str, Any]] = {
    "name": "hostile",
    "preset": "draft",
    "bundle": {"entry": "a.glb", "files": {"a.glb": SHA}},
}
WORKER: Final[Mapping[str, Any]] = {
    "name": "w",
    "kinds": ["prepare"],
    "memory_bytes": 1 << 30,
    "threads": 1,
    "device": "none",
    "version": "VERSION",
}
JSON: Final = {"Content-Type": "application/json"}
NOBODY: Final = "0" * 32


@dataclass(frozen=True)
class Call:
    """A request by an ordinary client."""

    name: str
    method: str
    path: str
    status: int
    word: str
    body: bytes | None = None
    headers: Mapping[str, str] = field(default_factory=dict)
    token: str | None = "owner"  # None: no header at all; any other word is sent as it is


@dataclass(frozen=True)
class Raw:
    """Bytes for the socket; TOKEN in them is replaced. `statuses`: 0 stands for a connection that is closed."""

    name: str
    data: bytes
    statuses: tuple[int, ...]
    word: str = ""
    cut: bool = False  # no more comes, and the other side is told so


def posted(name: str, path: str, document: Any, status: int, word: str, **headers: str) -> Call:
    """A POST of JSON."""
    body = document if isinstance(document, bytes) else json.dumps(document).encode()
    return Call(name, "POST", path, status, word, body, {**JSON, **headers})


def changed(place: str, value: Any, base: Mapping[str, Any] = JOB) -> dict[str, Any]:
    """The base document with the value at a dotted place."""
    document = deepcopy(dict(base))
    node: Any = document
    *path, leaf = place.split(".")
    for part in path:
        node = node.setdefault(part, {})
    node[leaf] = value
    return document


def job(name: str, place: str, value: Any, status: int = 422, word: str | None = None) -> Call:
    """A job request that is wrong in one place."""
    return posted(f"job: {name}", "/v1/jobs", changed(place, value), status, place if word is None else word)


CAMERA: Final = {"position": [0, 1, 4], "target": [0, 0, 0], "fov_deg": 40}

WRONG_TYPES: Final[Mapping[str, tuple[Any, ...]]] = {
    "name": (7, None, [], {}, True),
    "preset": (7, [], {}, True),
    "set": ("render.samples=1", 7, [7], {"render.samples": 1}),
    "settings": ("draft", 7, [], {"preset": 7}),
    "bundle": ("a.glb", 7, None, []),
    "bundle.entry": (7, None, [], {}),
    "bundle.files": ("a.glb", 7, None, [], {"a.glb": 7}, {"a.glb": None}, {"a.glb": []}),
    "bundle.environment": ("sky.exr", 7, []),
    "gates": ("low", 7, [], None),
    "gates.log_mse_rel": ("low", [], {}),
    "gates.flip": (7, [], None, {"front": "low"}),
    "cameras": ("front", 7, [], None, {"front": 7}),
    "priority": ("high", None, 1.5, [], {}),
    "labels": ("a=b", 7, [], None, {"a": 7}, {"a": None}),
}
"""Values of a wrong type, field by field of a job request."""

OUT_OF_BOUNDS: Final[Mapping[str, tuple[Any, ...]]] = {
    "lightmap.resolution": (7, 8193, -1, 10**30, 1.5),
    "lightmap.padding": (0, 17),
    "lightmap.tile": (3, 65),
    "render.image_size": (0, 17, 512),
    "render.samples": (0, 65537, -(2**63)),
    "render.max_depth": (-1, 65),
    "fit.lobes": (0, 65),
    "fit.steps": (0, 10**7),
    "fit.learning_rate": (0, 2, "nan", "inf", "1e999"),
    "fit.checkpoint_s": (0, 1e9),
    "package.environment_size": (8, 2048),
    "seed": (-1, 2**32),
}


def _job_requests() -> Iterator[Call]:
    for place, values in WRONG_TYPES.items():
        for value in values:
            yield job(f"{place} is {json.dumps(value)}", place, value, word=place.split(".")[-1])
    for place, values in OUT_OF_BOUNDS.items():
        for value in values:
            yield job(f"set {place}={value}", "set", [f"{place}={value}"], word=place)

    many_cameras = {f"c{i}": CAMERA for i in range(33)}
    huge = "9" * 5000
    yield job("a field that there is not", "rootkit", True)
    yield job("a name of 200 letters", "name", "x" * 200)
    yield job("a name with U+0000", "name", "a\0b", word="U+0000")
    yield job("a label with U+0000", "labels", {"a": "b\0"}, word="U+0000")
    yield job("a name with an escape sequence", "name", "\x1b[2J\x1b]0;owned\x07", word="U+001B")
    yield job("a name that is written backwards", "name", "a\u202egpj.exe", word="U+202E")
    yield job("a label with a line break", "labels", {"a": "b\nc"}, word="U+000A")
    yield job("a name with half a surrogate pair", "name", "\ud800")
    yield job("a field's name with half a surrogate pair", "\ud800", 1, word="d800")
    yield job("a label's key with half a surrogate pair", "labels", {"\ud800": "1"}, word="labels")
    yield job("33 labels", "labels", {f"k{i}": "v" for i in range(33)})
    yield job("a label's value of 129 letters", "labels", {"a": "v" * 129})
    yield job("a label's key with a line break", "labels", {"a\r\nSet-Cookie: x": "v"})
    yield job("priority 101", "priority", 101)
    yield job("priority -1", "priority", -1)
    yield job("33 cameras", "cameras", many_cameras)
    yield job("a camera named like a path", "cameras", {"../front": CAMERA})
    yield job("a camera at infinity", "cameras", {"front": {**CAMERA, "position": [0, 1, 1e300]}})
    yield job("a camera that looks at itself", "cameras", {"front": {**CAMERA, "target": [0, 1, 4]}}, word="coincide")
    yield job("a camera with the name of a reference", "cameras", {"front_reference": CAMERA})
    yield job("a gate without its camera", "gates", {"flip": {"front": 0.1}}, word="front")
    yield job("a gate of 0", "gates", {"log_mse_rel": 0})
    yield job("a gate of -1", "gates", {"log_mse_rel": -1})
    yield job("257 overrides", "set", ["seed=1"] * 257)
    yield job("an override of the preset's name", "set", ["preset=x"], word="preset")
    yield job("an override of what is no setting", "set", ["__class__=x"], word="__class__")
    yield job("an override through an attribute", "set", ["render.__dict__.samples=1"], word="__dict__")
    yield job("no file", "bundle.files", {}, word="bundle.files")
    yield job("4097 files", "bundle.files", {f"f{i}": SHA for i in range(4097)})
    yield job("a file's name of 513 letters", "bundle.files", {"a.glb": SHA, "x" * 513: SHA})
    yield job("a folder's name of 300 letters", "bundle.files", {"a.glb": SHA, "x" * 300 + "/b": SHA})
    yield job("a folder's name of 300 bytes", "bundle.files", {"a.glb": SHA, "ü" * 150 + "/b": SHA})
    yield job("a hash in capitals", "bundle.files", {"a.glb": SHA.upper()})
    yield job("a hash of 63 letters", "bundle.files", {"a.glb": SHA[1:]})
    yield job("a hash that is a path", "bundle.files", {"a.glb": "../" + SHA[3:]})
    yield job("a hash with a line break", "bundle.files", {"a.glb": SHA + "\n"})
    yield job("a hash that was not uploaded", "bundle.files", {"a.glb": "e" * 64}, 409, "not uploaded")
    yield job("a scale of 0", "bundle.environment", {"file": "a.glb", "scale": 0}, word="scale")
    yield job("a scale of 1e300", "bundle.environment", {"file": "a.glb", "scale": 1e300}, word="scale")
    yield job("an entry that is not in the bundle", "bundle.entry", "/etc/passwd", word="passwd")
    for path in (
        *(
            "../a",
            "a/../../b",
            "/etc/passwd",
            "//etc/passwd",
            "a//b",
            "./a",
            ".",
            "..",
            "a/",
            "C:/a",
            "c:a",
            "\\\\host\\a",
        ),
        *("a\\..\\b", "a\0b", "a\nb", "a\x1b[2Jb", "~/../a"),
    ):
        yield job(f"the file {path!r}", "bundle.files", {"a.glb": SHA, path: SHA}, word="bundle.files")
    yield job("a file and a folder of one name", "bundle.files", {"a.glb": SHA, "a.glb/b": SHA}, word="a.glb")

    yield posted("JSON of 100000 brackets", "/v1/jobs", b"[" * 100_000, 422, "body")
    yield posted("JSON nested 100000 deep", "/v1/jobs", b'{"name":' * 100_000 + b"1" + b"}" * 100_000, 422, "body")
    yield posted("a number of 5000 digits", "/v1/jobs", b'{"priority": ' + huge.encode() + b"}", 422, "body")
    yield posted("1e999", "/v1/jobs", json.dumps(dict(JOB)).encode()[:-1] + b', "priority": 1e999}', 422, "priority")
    yield posted("NaN", "/v1/jobs", json.dumps(dict(JOB)).encode()[:-1] + b', "priority": NaN}', 422, "priority")
    twice = json.dumps(dict(JOB)).encode()[:-1] + b', "priority": 1, "priority": 999}'
    yield posted("duplicate keys: the last counts", "/v1/jobs", twice, 422, "priority")
    yield posted("invalid UTF-8", "/v1/jobs", b'{"name": "\xff\xfe"}', 422, "UTF-8")
    yield posted("UTF-16", "/v1/jobs", json.dumps(dict(JOB)).encode("utf-16")[:-1], 422, "body")
    yield posted("nothing", "/v1/jobs", b"", 422, "body")
    yield posted("a list", "/v1/jobs", b"[]", 422, "body")
    yield posted("text", "/v1/jobs", b'"job"', 422, "body")
    yield posted("a body of 17 MiB", "/v1/jobs", b'{"name": "' + b"x" * (17 << 20) + b'"}', 413, "bytes")
    yield posted("a field of 10 MiB", "/v1/jobs", changed("name", "x" * (10 << 20)), 422, "name")
    form = {"Content-Type": "application/x-www-form-urlencoded"}
    yield Call("a form in place of JSON", "POST", "/v1/jobs", 422, "body", b"name=x", form)
    plain = {"Content-Type": "text/plain"}
    yield Call("JSON as text/plain", "POST", "/v1/jobs", 422, "body", json.dumps(dict(JOB)).encode(), plain)
    yield Call("JSON without a type", "POST", "/v1/jobs", 422, "body", json.dumps(dict(JOB)).encode())
    zipped = {**JSON, "Content-Encoding": "gzip"}
    bomb = zlib.compress(b" " * (64 << 20), 9)
    yield Call("a compressed body", "POST", "/v1/jobs", 422, "body", bomb, zipped)
    key = {"Idempotency-Key": "k" * 256}
    yield posted("an idempotency key of 256 letters", "/v1/jobs", dict(JOB), 422, "idempotency-key", **key)
    yield posted("an empty idempotency key", "/v1/jobs", dict(JOB), 422, "idempotency-key", **{"Idempotency-Key": ""})


def _routes() -> Iterator[Call]:
    for what in ("jobs", "tasks", "workers"):
        tail = {"jobs": "", "tasks": "/log", "workers": "/orders/drain"}[what]
        method = "POST" if what == "workers" else "GET"
        for name in (
            "%00",
            "..%2f..%2fetc%2fpasswd",
            "%ff%fe",
            "x" * 8000,
            "'; DROP TABLE jobs; --",
            "%0d%0aX-Evil:%201",
        ):
            status, word = (422, "U+0000") if name == "%00" else (404, "no")
            yield Call(f"{what}: the id {name[:30]!r}", method, f"/v1/{what}/{name}{tail}", status, word)
    art = f"/v1/jobs/{NOBODY}/artifacts"
    for name in (
        "../../token",
        "..%2f..%2ftoken",
        "%2e%2e/%2e%2e/token",
        "/etc/passwd",
        "%00",
        "a%00.html",
        "x" * 4000,
    ):
        yield Call(f"artifact {name[:30]!r}", "GET", f"{art}/{name}", 404, "")
    for name in ("../token", "..%2ftoken", SHA.upper(), SHA[1:], SHA + "0", "%00" * 64, "x" * 64):
        yield Call(f"blob {name[:30]!r}", "GET", f"/v1/blobs/{name}", 404 if "/" in name or "%2f" in name else 422, "")
    yield Call("the range 9-1 of a blob", "GET", f"/v1/blobs/{SHA}", 200, "", None, {"Range": "bytes=9-1"})
    for spec in ("bytes=99-", "bytes=99-100", "bytes=-0", "bytes=" + "9" * 18 + "-"):
        yield Call(f"the range {spec}", "GET", f"/v1/blobs/{SHA}", 416, "Range", None, {"Range": spec})
    for spec in ("bytes=" + "9" * 5000 + "-", "bytes=0-" + "9" * 5000, "bytes=a-b", "bytes=0-0," * 500, "lines=0-1"):
        yield Call(f"the range {spec[:20]} is ignored", "GET", f"/v1/blobs/{SHA}", 200, "", None, {"Range": spec})
    yield Call("a cursor that is SQL", "GET", "/v1/jobs?cursor=' OR 1=1 --", 422, "cursor")
    yield Call("a search for U+0000", "GET", "/v1/jobs?q=%00", 422, "U+0000")
    yield Call("a label that is U+0000", "GET", "/v1/jobs?label=a%3D%00", 422, "is not a label")
    yield Call("a search of 200 letters", "GET", "/v1/jobs?q=" + "x" * 200, 422, "q")
    yield Call("limit 10**30", "GET", f"/v1/jobs?limit={10**30}", 422, "limit")
    yield Call("after 2**64", "GET", f"/v1/jobs/{NOBODY}/events?after={2**64}", 422, "after")
    headers = {"Last-Event-ID": "9" * 400}
    yield Call("a last event of 400 digits", "GET", f"/v1/jobs/{NOBODY}/events", 422, "Last-Event-ID", None, headers)
    yield Call("a method that there is not", "BREW", "/v1/jobs", 405, "method")
    yield Call("a route that there is not", "GET", "/v1/../../etc/passwd", 404, "route")
    yield Call("tracing", "TRACE", "/v1/jobs", 405, "method")


def _tokens() -> Iterator[Call]:
    for what, value in {
        "none": None,
        "an empty one": "",
        "a scheme alone": "Bearer",
        "basic": "Basic b3duZXI6b3duZXI=",
        "a wrong one": "Bearer " + "x" * 43,
        "one of 10000 letters": "Bearer " + "x" * 10_000,
        "SQL": "Bearer ' OR 1=1 --",
        "binary": "Bearer \xff\xfe\x80",
    }.items():
        yield Call(f"token: {what}", "GET", "/v1/jobs", 401, "token", token=value)
    for name in ("", "a/b", "../a", "a\nb", "a\0b", "x" * 65, 7, None):
        body = {"name": name, "scopes": ["read"]}
        yield posted(f"a token named {name!r:.20}", "/v1/tokens", body, 422, "name")
    for scopes in ([], ["root"], "admin", [7], None, ["read"] * 5):
        yield posted(f"a token with the scopes {scopes}", "/v1/tokens", {"name": "t", "scopes": scopes}, 422, "scopes")
    yield Call("to revoke U+0000", "DELETE", "/v1/tokens/%00", 422, "U+0000")


WEBHOOKS: Final = (
    *("file:///etc/passwd", "gopher://127.0.0.1/x", "ftp://host/x", "javascript:alert(1)", "//host/x", "host", ""),
    *(
        "http://user:secret@host/",
        "http://@host/",
        "http://host /",
        "http://host/\r\nX-Evil: 1",
        "http://",
        "http:///x",
    ),
    *("http://169.254.169.254/latest/meta-data/", "http://[fe80::1]/", "http://0.0.0.0/", "http://[::]/"),
    *("http://[::ffff:169.254.169.254]/", "http://2852039166/", "http://0xa9fea9fe/", "http://0251.0376.0251.0376/"),
    *("http://224.0.0.1/", "http://255.255.255.255/", "http://[fd00:ec2::254]/"),
    *("http://host:99999/", "http://host:port/", "http://[::1", "http://host/" + "x" * 3000, "http://a\0b/", 7, None),
)


def _webhooks() -> Iterator[Call]:
    for url in WEBHOOKS:
        yield posted(f"the webhook {str(url)[:40]!r}", "/v1/webhooks", {"url": url}, 422, "url")
    hook = {"url": "http://127.0.0.1:9/", "events": ["job.everything"]}
    yield posted("a webhook for an event that there is not", "/v1/webhooks", hook, 422, "events")


def _workers() -> Iterator[Call]:
    for place, value, word in (
        ("name", "a\0b", "U+0000"),
        ("name", 7, "name"),
        ("name", "x" * 129, "name"),
        ("kinds", [], "kinds"),
        ("kinds", ["mine"], "kinds"),
        ("kinds", ["prepare"] * 1000, "kinds"),
        ("memory_bytes", 2**63, "memory_bytes"),
        ("memory_bytes", -1, "memory_bytes"),
        ("threads", 2**31, "threads"),
        ("threads", 0, "threads"),
        ("device", "x" * 10_000, "device"),
        ("device", "a\0b", "U+0000"),
        ("name", "\x1b[2J", "U+001B"),
    ):
        body = changed(place, value, WORKER)
        yield posted(f"a worker with {place}={value!r:.20}", "/v1/workers", body, 422, word)
    other = changed("version", "0.0.0", WORKER)
    yield posted("a worker of another version", "/v1/workers", other, 409, "version")
    claim = {"kinds": ["prepare"], "wait_s": 0}
    for worker in ("7", "x" * 5000, NOBODY, "null"):
        yield posted(f"a claim by the worker {worker[:20]!r}", f"/v1/workers/{worker}/claim", claim, 404, "worker")
    yield posted("a claim by the worker U+0000", "/v1/workers/%00/claim", claim, 422, "U+0000")
    for wait in (-1, 31, 1e300, "long", None):
        body = {**claim, "wait_s": wait}
        yield posted(f"a claim that waits {wait!r}", f"/v1/workers/{NOBODY}/claim", body, 422, "wait_s")
    problem = {"title": "t", "status": 500, "detail": "d", "code": "internal"}
    for attempt in (2**31, -(2**63), 10**30):
        beat = {"task_id": NOBODY, "attempt": attempt}
        yield posted(f"a beat of attempt {attempt}", f"/v1/workers/{NOBODY}/heartbeat", beat, 422, "attempt")
        failure = {"attempt": attempt, "problem": problem, "retryable": True}
        yield posted(f"a failure of attempt {attempt}", f"/v1/tasks/{NOBODY}/fail", failure, 422, "attempt")
    beat = {"task_id": "a\0b", "attempt": 1}
    yield posted("a beat for U+0000", f"/v1/workers/{NOBODY}/heartbeat", beat, 422, "U+0000")
    log = {"task_id": NOBODY, "attempt": 1, "log": "x" * 65537}
    yield posted("a log of 65537 letters", f"/v1/workers/{NOBODY}/heartbeat", log, 422, "log")
    for name in ("../../.bashrc", "/etc/passwd", "a/../b", "..", ".", "a//b", "a\\b", "a\nb", "a\0b", "x" * 201, ""):
        artifact = {"name": name, "sha256": SHA, "size": 1, "media_type": "text/plain"}
        result = {"kind": "package", "artifacts": [artifact], "seconds": 1}
        body = {"attempt": 1, "result": result}
        yield posted(f"the artifact {name[:20]!r}", f"/v1/tasks/{NOBODY}/commit", body, 422, "name")
    for media_type in ("text/html\r\nX-Evil: 1", "x" * 300, "a\0b", "", "text"):
        artifact = {"name": "a.html", "sha256": SHA, "size": 1, "media_type": media_type}
        body = {"attempt": 1, "result": {"kind": "package", "artifacts": [artifact], "seconds": 1}}
        yield posted(f"an artifact of {media_type[:20]!r}", f"/v1/tasks/{NOBODY}/commit", body, 422, "media_type")
    artifact = {"name": "a", "sha256": SHA, "size": 2**63, "media_type": "text/plain"}
    body = {"attempt": 1, "result": {"kind": "package", "artifacts": [artifact], "seconds": 1}}
    yield posted("an artifact of 2**63 bytes", f"/v1/tasks/{NOBODY}/commit", body, 422, "size")
    for key, value in (("row", 2**63), ("row", -1), ("size", 0), ("texels", 10**30)):
        tile = {"row": 0, "column": 0, "size": 8, "texels": 1, key: value}
        result = {"kind": "render", "tile": tile, "paths": 1, "overflows": 0, "invalid": 0, "seconds": 1}
        body = {"attempt": 1, "result": result}
        yield posted(f"a tile with {key}={value}", f"/v1/tasks/{NOBODY}/commit", body, 422, key)


def _blobs() -> Iterator[Call]:
    octets = {"Content-Type": "application/octet-stream"}
    yield Call("bytes with another hash", "PUT", f"/v1/blobs/{'e' * 64}", 422, "sha256", b"lies", octets)
    yield Call("bytes under a path", "PUT", "/v1/blobs/..%2f..%2ftoken", 404, "", b"lies", octets)
    yield Call("bytes under no hash", "PUT", "/v1/blobs/" + "z" * 64, 422, "sha256", b"lies", octets)
    yield posted("4097 hashes", "/v1/blobs/missing", {"sha256": [SHA] * 4097}, 422, "sha256")
    yield posted("a hash that is a path", "/v1/blobs/missing", {"sha256": ["../../token"]}, 422, "sha256")
    yield posted("gc in the past", "/v1/gc", {"days": -1}, 422, "days")
    yield posted("gc for ever", "/v1/gc", b'{"days": 1e999}', 422, "days")


def _pages() -> Iterator[Call]:
    """What browsers ask, by a program that is none."""
    form = {"Content-Type": "application/x-www-form-urlencoded"}

    def sent(name: str, path: str, body: bytes, status: int, word: str, **headers: str) -> Call:
        return Call(f"page: {name}", "POST", path, status, word, body, {**form, **headers})

    yield sent("a form of 10000 fields", "/login", b"&".join(b"f%d=1" % i for i in range(10_000)), 422, "fields")
    yield sent("a form of 17 MiB", "/login", b"token=" + b"x" * (17 << 20), 413, "bytes")
    for origin in ("http://evil.example", "null", "http://[::1", "http://127.0.0.1:99999", "\xff"):
        yield sent(f"from {origin!r}", "/login", b"token=x", 403, "another site", Origin=origin)
    yield sent("from another site", "/login", b"token=x", 403, "another site", **{"Sec-Fetch-Site": "cross-site"})
    for priority in ("", "high", "-1", "101", "9" * 400, "1.5", "%00", "%C2%B2"):
        path = f"/jobs/{NOBODY}/priority"
        yield sent(f"the priority {priority[:20]!r}", path, f"priority={priority}".encode(), 422, "priority")
    yield sent("an action that there is not", f"/jobs/{NOBODY}/do/explode", b"", 422, "action")
    yield sent("an action on no job", f"/jobs/{NOBODY}/do/cancel", b"", 404, "job")
    yield sent("an action on U+0000", "/jobs/%00/do/cancel", b"", 422, "U+0000")
    yield sent("an order to no worker", f"/workers/{NOBODY}/orders/drain", b"", 404, "worker")
    outside = ("../token", "..%2f..%2ftoken", "%2e%2e/%2e%2e/token", "/etc/passwd", "..\\..\\token")
    for path in (*outside, "%00", "x" * 4000):
        yield Call(f"page: the static file {path[:30]!r}", "GET", f"/static/{path}", 404, "")
    for place in ("-1/0", "0/8192", "99999999999999999999/0", "a/b", "0/%00"):
        yield Call(f"page: the texel {place}", "GET", f"/jobs/{NOBODY}/texels/{place}", 422, "")
        yield Call(f"page: the tile {place}", "GET", f"/jobs/{NOBODY}/tiles/{place}", 422, "")
    yield Call("page: the irradiance of no tile", "GET", f"/jobs/{NOBODY}/irradiance", 422, "tile")
    for path in ("texels", "texels/0/0", "tiles/0/0"):
        yield Call(f"page: {path} of no job", "GET", f"/jobs/{NOBODY}/{path}", 404, "no ")
        yield Call(f"page: {path} of U+0000", "GET", f"/jobs/%00/{path}", 422, "U+0000")
    yield Call("page: jobs named U+0000", "GET", "/jobs?q=%00", 422, "U+0000")
    yield Call("page: a page that is SQL", "GET", "/jobs?cursor='--", 422, "cursor")
    yield Call("page: a task that there is not", "GET", f"/tasks/{NOBODY}", 404, "task")
    yield Call("page: the task U+0000", "GET", "/tasks/%00", 422, "U+0000")
    yield posted("page: no job", "/submit", b"[]", 422, "body")
    yield posted("page: a job of files outside", "/submit", changed("bundle.files", {"../a": SHA}), 422, "bundle.files")
    for cookie in ("kiln_session=x", "kiln_session=" + "x" * 10_000, 'a=b; ;;=;\\"', "\xff=\xfe"):
        yield Call(f"page: the cookie {cookie[:24]!r}", "GET", "/jobs", 401, "", None, {"Cookie": cookie}, None)


def _raw() -> Iterator[Raw]:
    def request(head: str, body: bytes = b"", method: str = "POST", path: str = "/v1/jobs") -> bytes:
        lines = [
            f"{method} {path} HTTP/1.1",
            "Host: x",
            "Authorization: Bearer TOKEN",
            "Content-Type: application/json",
        ]
        return "\r\n".join([*lines, *head.splitlines(), "", ""]).encode("latin-1") + body

    blob = f"/v1/blobs/{SHA}"
    small = json.dumps(dict(JOB)).encode()
    chunk = f"{1 << 20:x}\r\n".encode() + b"x" * (1 << 20) + b"\r\n"
    yield Raw("a length that is no number", request("Content-Length: many", small), (400,))
    yield Raw("a negative length", request("Content-Length: -5", small), (400,))
    yield Raw("two lengths", request("Content-Length: 5\nContent-Length: 6", small), (400,))
    yield Raw("a length and chunks", request("Content-Length: 5\nTransfer-Encoding: chunked", b"0\r\n\r\n"), (400, 422))
    yield Raw("an encoding that there is not", request("Transfer-Encoding: rot13", small), (400, 501))
    yield Raw("no length and no chunks", request(""), (422,), "body")
    yield Raw("less than was announced", request(f"Content-Length: {len(small) + 99}", small), (0, 400), cut=True)
    yield Raw("a chunk whose length lies", request("Transfer-Encoding: chunked", b"zz\r\nabc\r\n"), (0, 400), cut=True)
    yield Raw("17 MiB in chunks", request("Transfer-Encoding: chunked", chunk * 17 + b"0\r\n\r\n"), (413,), "bytes")
    announced = request("Content-Length: 99999999999999999", b"x", "PUT", blob)
    yield Raw("a blob of 10**17 bytes announced", announced, (413,), "bytes")
    nines = request("Content-Length: " + "9" * 400, b"x", "PUT", blob)
    yield Raw("a blob's length of 400 digits", nines, (400, 413))
    yield Raw("a blob cut short", request("Content-Length: 100", b"x", "PUT", blob), (0, 400), cut=True)
    yield Raw("a header of 128 KiB", request("X-Long: " + "x" * (128 << 10), b""), (0, 400, 431))
    yield Raw("5000 headers", request("\n".join(f"X-{i}: {'x' * 20}" for i in range(5000))), (0, 400, 431))
    yield Raw("a header with a line folded into it", request("X-A: b\n X-Evil: 1\nContent-Length: 0"), (400, 422))
    yield Raw(
        "no HTTP at all", b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03" + struct.pack(">I", 7), (0, 400), cut=True
    )
    yield Raw("HTTP/9.9", request("Content-Length: 0").replace(b"HTTP/1.1", b"HTTP/9.9"), (0, 400, 422, 505))
    yield Raw("a path with a line break", b"GET /v1/jobs\x0b HTTP/1.1\r\nHost: x\r\n\r\n", (0, 400, 401))


CALLS: Final = [*_job_requests(), *_routes(), *_tokens(), *_webhooks(), *_workers(), *_blobs(), *_pages()]
RAW: Final = list(_raw())
