"""Named queries, read once from the .sql files of this package.

A query begins with a line `-- name: NAME` and at least one comment line that describes it.
Parameters are psycopg's `%(name)s`.
"""

import re
from functools import cache
from importlib import resources
from typing import Final

from kiln_schemas.errors import InternalError

_HEAD: Final = re.compile(r"^-- name: ([a-z_]+)\n((?:-- .*\n)*)", re.MULTILINE)


def parse_queries(text: str, source: str) -> dict[str, bytes]:
    """The queries of one file by name; a query without a description or with a name used twice is a defect."""
    parts = _HEAD.split(text)[1:]
    queries: dict[str, bytes] = {}
    for name, description, body in zip(parts[0::3], parts[1::3], parts[2::3], strict=True):
        if not description or not body.strip() or name in queries:
            raise InternalError(f"query '{name}' lacks a description or a body, or is there twice", where=source)
        queries[name] = body.strip().encode()
    return queries


@cache
def all_queries() -> dict[str, bytes]:
    """Every query of the package by name."""
    queries: dict[str, bytes] = {}
    for file in sorted(resources.files(__package__).iterdir(), key=lambda item: item.name):
        if not file.name.endswith(".sql"):
            continue
        found = parse_queries(file.read_text(encoding="utf-8"), file.name)
        if twice := queries.keys() & found.keys():
            raise InternalError(f"queries named twice: {', '.join(sorted(twice))}", where=file.name)
        queries |= found
    return queries
