"""Documents at the bounds of the interface's contracts, made from the OpenAPI document.

`sample` makes a document that fits a schema, `variants` all those that differ from a document in one place: by a value
just inside, at or just outside a bound, by numbers that break arithmetic, by odd text, by a wrong type, by a field too
many or too few. The schemas say which of them must be refused.
"""

import json
import math
import re
from collections.abc import Iterator, Mapping
from copy import deepcopy
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from kiln_schemas import __version__

DOCUMENT: Final[Mapping[str, Any]] = json.loads(
    (Path(__file__).parents[2] / "schemas/generated/openapi.json").read_text()
)
HUGE: Final = 5 << 20
"""Characters of a string that no contract takes: more than PostgreSQL's and libpq's buffers hold at once."""
DEEP: Final = 2000
WORDS: Final = (
    *("0" * 64, "render.samples=8", "a.glb", "text/plain", "http://127.0.0.1:9/", "UTC", "08:00:00"),
    *("a", "hostile", "draft", "internal", "2026-01-01T00:00:00Z", "0" * 43, "0" * 32),
)
"""Of these the first one that fits a string's schema is its sample."""
SHORTENED: Final = frozenset({"detail", "remedy", "where", "notes", "message"})
"""Texts that tell people something: of a longer one the contract keeps the beginning (`kiln_schemas.text.told`)."""
ODD_TEXT: Final[Mapping[str, str]] = {
    "U+0000": "a\0b",
    "half a surrogate pair": "\ud800",
    "an escape sequence": "\x1b[2J\x1b]0;owned\x07",
    "a change of direction": "a\u202egpj.exe",
    "a line separator": "a\u2028b",
    "no character": "\uffff\ufdd0",
    "a thousand marks on a letter": "e" + "\u0301" * 1000,
    "letters outside of the first plane": "\U0001f600" * 40,
    "HTML": "<img src=x onerror=alert(1)>",
    "SQL": "'; DROP TABLE jobs; --",
    "a template": "{{7*7}}${7*7}%s%n",
    "white space": "\u3000\u00a0\t\n ",
}
RAW_NUMBERS: Final = ("NaN", "Infinity", "-Infinity", "1e999", "-1e999", "1" + "0" * 400, "9" * 5000)
"""As they stand in JSON: no contract takes any of them."""
EDGE_NUMBERS: Final = (1e308, -1e308, 1e-308, 5e-324, -0.0, 2**31, 2**53 + 1, 2**63, -(2**63), 0.1)


@dataclass(frozen=True)
class Raw:
    """JSON text that stands for itself in a document."""

    text: str


@dataclass(frozen=True)
class Variant:
    """A document, what is odd about it, and whether its schema refuses it."""

    name: str
    document: Any
    refused: bool

    def body(self) -> bytes:
        """As JSON, with halves of surrogate pairs as escapes and raw numbers as they stand."""
        raws: list[str] = []

        def encode(node: Any) -> Any:
            if isinstance(node, Raw):
                raws.append(node.text)
                return f"\x02{len(raws) - 1}\x03"
            if isinstance(node, dict):
                return {key: encode(value) for key, value in node.items()}
            return [encode(value) for value in node] if isinstance(node, list | tuple) else node

        text = json.dumps(encode(self.document))
        return re.sub(r'"\\u0002(\d+)\\u0003"', lambda found: raws[int(found[1])], text).encode()


def resolved(schema: Mapping[str, Any]) -> Mapping[str, Any]:
    """The schema itself, where it is a reference, and of an optional value the one that is not null."""
    while True:
        if "$ref" in schema:
            schema = DOCUMENT["components"]["schemas"][schema["$ref"].rsplit("/", 1)[1]]
        elif "anyOf" in schema:
            schema = next(branch for branch in schema["anyOf"] if branch.get("type") != "null")
        else:
            return schema


def branches(schema: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    """The schemas one of which a value has to fit."""
    schema = resolved(schema)
    return [resolved(branch) for branch in schema["oneOf"]] if "oneOf" in schema else [schema]


def sample(schema: Mapping[str, Any], name: str = "") -> Any:
    """The plainest value that fits, with all its fields; `name` is that of the field."""
    schema = branches(schema)[0]
    if "const" in schema:
        return schema["const"]
    if "enum" in schema:
        return schema["enum"][0]
    match schema.get("type"):
        case "object" if "properties" in schema:
            return {key: sample(value, key) for key, value in schema["properties"].items()}
        case "object":
            return {}
        case "array" if "prefixItems" in schema:
            return [sample(item) for item in schema["prefixItems"]]
        case "array":
            return [sample(schema["items"], name) for _ in range(max(1, schema.get("minItems", 0)))]
        case "boolean":
            return True
        case "integer":
            return int(_least(schema))
        case "number":
            return min(float(_least(schema)), schema.get("maximum", 1.0))
        case "string":
            return __version__ if name == "version" else _word(schema)
        case _:
            return None


def variants(schema: Mapping[str, Any], document: Any, place: tuple[str | int, ...] = ()) -> Iterator[Variant]:
    """All documents that differ from `document` in one place at or below `place`, which fits `schema`."""
    schema = _branch_of(schema, _at(document, place))
    for what, value, refused in _values(schema, _at(document, place)):
        refused &= not (isinstance(value, str) and schema.get("type") == "string" and SHORTENED & set(place))
        yield Variant(f"{_dotted(place)} is {what}", _with(document, place, value), refused)
    value = _at(document, place)
    if isinstance(value, dict):
        _, entries = _entries(schema)
        for key in value:
            yield from variants(schema.get("properties", {}).get(key, entries), document, (*place, key))
    elif isinstance(value, list) and value:
        below = schema.get("items") or schema["prefixItems"][0]
        yield from variants(below, document, (*place, 0))


def _values(schema: Mapping[str, Any], value: Any) -> Iterator[tuple[str, Any, bool]]:
    """What to put in the place of a value: its name, itself, and whether it must be refused."""
    yield "deep JSON", Raw("[" * DEEP + "]" * DEEP), True
    yield "very deep JSON", Raw('{"a":' * 100_000 + "1" + "}" * 100_000), True
    match schema.get("type"):
        case "string":
            yield from _strings(schema, value)
        case "integer" | "number":
            yield from _numbers(schema)
        case "array":
            yield from _lists(schema, value)
        case "object":
            yield from _objects(schema, value)
        case "boolean":
            yield from (("text", "perhaps", True), ("a list", [], True), ("2", 2, True))


def _strings(schema: Mapping[str, Any], value: str) -> Iterator[tuple[str, Any, bool]]:
    closed = "enum" in schema or "const" in schema
    yield f"{HUGE} letters", "x" * HUGE, "maxLength" in schema or closed
    yield "1500000 letters", "x" * 1_500_000, "maxLength" in schema or closed
    yield "a number", 7, True
    yield "a list", [], True
    yield "an object", {}, True
    if not closed:
        for name, text in ODD_TEXT.items():
            yield name, text, _breaks(schema, text)
    if "maxLength" in schema:
        for length in range(max(0, schema["maxLength"] - 1), schema["maxLength"] + 2):
            text = (value + (value[-1:] or "x") * length)[:length]
            yield f"{length} letters", text, length > schema["maxLength"] or _breaks(schema, text)
    if schema.get("minLength", 0) > 0:
        text = value[: schema["minLength"] - 1]
        yield f"{len(text)} letters", text, True


def _numbers(schema: Mapping[str, Any]) -> Iterator[tuple[str, Any, bool]]:
    whole = schema["type"] == "integer"
    for text in RAW_NUMBERS:
        # A whole number of many digits is a number of JSON; only a bound makes it one too great.
        yield text[:20], Raw(text), not text.isdigit() or "maximum" in schema or "exclusiveMaximum" in schema
    for number in EDGE_NUMBERS:
        yield repr(number), number, _outside(schema, number)
    for bound in {
        schema[key] for key in ("minimum", "maximum", "exclusiveMinimum", "exclusiveMaximum") if key in schema
    }:
        near = (
            (int(bound) - 1, int(bound), int(bound) + 1)
            if whole
            else (math.nextafter(bound, -math.inf), float(bound), math.nextafter(bound, math.inf))
        )
        for number in near:
            yield f"{number!r}, at the bound {bound:g}", number, _outside(schema, number)
    yield "text", "many", True
    yield "a list", [1], True


def _lists(schema: Mapping[str, Any], value: list[Any]) -> Iterator[tuple[str, Any, bool]]:
    yield "text", "many", True
    yield "an object", {"a": 1}, True
    yield "a list of nothing known", [None], True
    item = value[0] if value else sample(schema["items"])
    least, most = schema.get("minItems", 0), schema.get("maxItems")
    if least:
        yield f"{least - 1} items", [item] * (least - 1), True
    if most is not None:
        for count in (most - 1, most, most + 1):
            yield f"{count} items", [item] * count, count > most or count < least
    elif len(json.dumps(item, default=str)) < 100:
        yield "100000 items", [item] * 100_000, False


def _objects(schema: Mapping[str, Any], value: dict[str, Any]) -> Iterator[tuple[str, Any, bool]]:
    yield "text", "many", True
    yield "a list", [value], True
    if "properties" in schema:
        yield "with a field too many", {**value, "rootkit": True}, schema.get("additionalProperties") is False
        for key in schema.get("required", ()):
            yield f"without {key}", {name: item for name, item in value.items() if name != key}, True
            yield f"with {key} null", {**value, key: None}, True
        return
    names, inner = _entries(schema)
    item = next(iter(value.values())) if value else sample(inner)
    for what, text in ODD_TEXT.items():
        yield f"with {what} as a key", {**value, text: item}, _breaks(names, text)
    yield f"with a key of {HUGE} letters", {**value, "x" * HUGE: item}, "maxLength" in names
    if "maxProperties" in schema:
        most = schema["maxProperties"]
        for count in (most - 1, most, most + 1):
            filled = dict(list(value.items())[:count]) | {f"k{i}": item for i in range(count - len(value))}
            yield f"{count} entries", filled, count > most


def _entries(schema: Mapping[str, Any]) -> tuple[Mapping[str, Any], Mapping[str, Any]]:
    """Of an object without named fields the schemas of its keys and of its values."""
    names = schema.get("propertyNames", {})
    for pattern, inner in schema.get("patternProperties", {}).items():
        return {**names, "pattern": pattern}, inner
    return names, schema.get("additionalProperties") or {}


def _outside(schema: Mapping[str, Any], number: float) -> bool:
    """Whether a number lies outside of its schema's bounds."""
    if schema["type"] == "integer" and number != int(number):
        return True
    return (
        number < schema.get("minimum", -math.inf)
        or number > schema.get("maximum", math.inf)
        or number <= schema.get("exclusiveMinimum", -math.inf)
        or number >= schema.get("exclusiveMaximum", math.inf)
    )


def _breaks(schema: Mapping[str, Any], text: str) -> bool:
    """Whether a text is longer, shorter or of another pattern than its schema allows."""
    pattern = schema.get("pattern")
    return (
        len(text) > schema.get("maxLength", math.inf)
        or len(text) < schema.get("minLength", 0)
        or (pattern is not None and not re.search(pattern, text))
    )


def _least(schema: Mapping[str, Any]) -> Any:
    """The default of a number, else the least one within its bounds that is not 0."""
    if isinstance(schema.get("default"), int | float):
        return schema["default"]
    return max(1, schema.get("minimum", 1), schema.get("exclusiveMinimum", 0) + 1)


def _word(schema: Mapping[str, Any]) -> str:
    if isinstance(schema.get("default"), str) and schema["default"]:
        return str(schema["default"])
    if schema.get("format") == "time":
        return "08:00:00"
    if schema.get("format") == "date-time":
        return "2026-01-01T00:00:00Z"
    fitting = [word for word in reversed(WORDS) if not _breaks(schema, word)]
    if not fitting:
        raise ValueError(f"no sample fits {schema}: add one to WORDS")
    return fitting[0]


def _branch_of(schema: Mapping[str, Any], value: Any) -> Mapping[str, Any]:
    """Of several schemas the one that the value says it is of."""
    found = branches(schema)
    if len(found) > 1 and isinstance(value, dict):
        return next(branch for branch in found if branch["properties"]["kind"]["const"] == value["kind"])
    return found[0]


def _at(document: Any, place: tuple[str | int, ...]) -> Any:
    for part in place:
        document = document[part]
    return document


def _with(document: Any, place: tuple[str | int, ...], value: Any) -> Any:
    if not place:
        return value
    document = deepcopy(document)
    _at(document, place[:-1])[place[-1]] = value
    return document


def _dotted(place: tuple[str | int, ...]) -> str:
    return ".".join(map(str, place)) or "the body"
