"""Every string, list, dict and number of every contract has a bound, and a request over it is refused."""

import importlib
import pkgutil
from collections.abc import Iterator
from typing import Any

import pytest

import kiln_schemas
from kiln_schemas.base import DETAIL_BYTES, Contract
from kiln_schemas.errors import InputError
from kiln_schemas.job import EventView
from kiln_schemas.manifest import Manifest
from kiln_schemas.text import DETAIL_LENGTH, told

MODULES = [
    importlib.import_module(f"kiln_schemas.{module.name}") for module in pkgutil.iter_modules(kiln_schemas.__path__)
]
MODULES.append(importlib.import_module("kiln_service.config"))
CONTRACTS = sorted(
    {
        value
        for module in MODULES
        for value in vars(module).values()
        if isinstance(value, type) and issubclass(value, Contract) and value is not Contract
    },
    key=lambda contract: contract.__name__,
)
FIGURES_OF_A_FILE = {
    "Manifest.lightmap.*",
    "Manifest.textures.*.*",
}
"""Of any type: a manifest is a file, which is never sent to a coordinator; who reads it bounds its bytes."""


def unbounded(schema: dict[str, Any], whole: dict[str, Any], path: str, seen: frozenset[str]) -> Iterator[str]:
    """Places in a JSON schema that allow values of any size."""
    if "$ref" in schema:
        name = schema["$ref"].rpartition("/")[2]
        if name not in seen:
            yield from unbounded(whole["$defs"][name], whole, path, seen | {name})
        return
    if "enum" in schema or "const" in schema or schema.get("x-maxBytes"):
        return
    for key in ("anyOf", "oneOf", "allOf"):
        if key in schema:
            for choice in schema[key]:
                yield from unbounded(choice, whole, path, seen)
            return
    match schema.get("type"):
        case "string":
            if "maxLength" not in schema and schema.get("format") not in {"date-time", "time"}:
                yield f"{path}: a string of any length"
        case "integer" | "number":
            if not (
                {"maximum", "exclusiveMaximum"} & schema.keys() and {"minimum", "exclusiveMinimum"} & schema.keys()
            ):
                yield f"{path}: a number of any size"
        case "array":
            if "maxItems" not in schema:
                yield f"{path}: a list of any length"
            for item in [*schema.get("prefixItems", []), *([schema["items"]] if "items" in schema else [])]:
                yield from unbounded(item, whole, f"{path}.*", seen)
        case "object":
            for name, field in schema.get("properties", {}).items():
                yield from unbounded(field, whole, f"{path}.{name}", seen)
            values = [*schema.get("patternProperties", {}).values()]
            more = schema.get("additionalProperties", False)
            if more is not False:
                values.append({} if more is True else more)
            if values and "maxProperties" not in schema:
                yield f"{path}: a dict of any size"
            if "propertyNames" in schema:
                yield from unbounded({"type": "string"} | schema["propertyNames"], whole, f"{path} (key)", seen)
            elif more is not False:
                yield f"{path} (key): a string of any length"
            for value in values:
                yield from unbounded(value, whole, f"{path}.*", seen)
        case "boolean" | "null":
            return
        case _:
            if path not in FIGURES_OF_A_FILE:
                yield f"{path}: anything"


@pytest.mark.parametrize("contract", CONTRACTS, ids=lambda contract: contract.__name__)
def test_everything_in_a_contract_is_bounded(contract):
    schema = contract.model_json_schema()
    assert not list(unbounded(schema, schema, contract.__name__, frozenset({contract.__name__})))


def test_the_walk_sees_what_is_unbounded():
    class Loose(Contract):
        text: str
        items: tuple[int, ...]
        table: dict[str, float]
        anything: Any

    schema = Loose.model_json_schema()
    found = list(unbounded(schema, schema, "Loose", frozenset()))
    assert len(found) == 7, found


def test_all_contracts_are_walked():
    assert len(CONTRACTS) > 60 and Manifest in CONTRACTS


@pytest.mark.parametrize("text", ["x" * 10**6, "\x1b" * 10**6, "\u2028" * DETAIL_LENGTH])
def test_told_text_keeps_its_bound_when_it_is_escaped(text):
    assert len(told(text)) <= DETAIL_LENGTH
    assert len(InputError(text, where=text, remedy=text).problem().model_dump_json()) < 30_000


def test_what_is_known_of_an_event_is_bounded():
    event = {"id": 1, "at": "2026-01-01T00:00:00Z", "job_id": "j", "kind": "k", "actor": "a"}
    EventView.model_validate(event | {"detail": {"text": "x" * (DETAIL_BYTES - 100)}})
    with pytest.raises(ValueError, match="bytes of JSON"):
        EventView.model_validate(event | {"detail": {"text": "x" * DETAIL_BYTES}})
