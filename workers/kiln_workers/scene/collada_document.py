"""A Collada file as elements that name each other: look-ups by id, lists of numbers, data sources.

By the specifications of COLLADA 1.4.1 (Barnes and Finch 2008) and 1.5.0. Names of elements are taken without their
namespace's prefix. What refers to another file is not followed: the bundle has one Collada file. Numbers with a decimal
comma, which exporters of some countries' systems write, are understood.
"""

import warnings
from collections import Counter
from dataclasses import dataclass, field
from typing import Any, Final, TypeVar

import numpy as np
import numpy.typing as npt

from kiln_schemas.errors import InputError
from kiln_schemas.text import quoted, told
from kiln_workers.scene.geometry import Floats, Ints
from kiln_workers.scene.limits import MAX_VERTICES, NAME_LENGTH, check_count
from kiln_workers.scene.xml_nodes import Node, parse_xml

MAX_DEPTH: Final = 256
"""Elements within each other: a skeleton is a chain of nodes."""
MAX_ELEMENTS: Final = 1_000_000
"""Of a file; `<polygons>` has one for each polygon."""
ARRAYS: Final = ("float_array", "int_array", "Name_array", "IDREF_array", "SIDREF_array")
Kind = TypeVar("Kind", bound=np.generic)


@dataclass
class Collada:
    """The elements of a file."""

    root: Node
    where: str
    notes: list[str] = field(default_factory=list)
    ids: dict[str, Node] = field(default_factory=dict)
    ignored: Counter[str] = field(default_factory=Counter)

    @classmethod
    def parse(cls, data: bytes, where: str) -> "Collada":
        """InputError where it is no Collada file."""
        root = parse_xml(data, where, MAX_DEPTH, MAX_ELEMENTS)
        document = cls(root, where)
        for node in root.below():
            node.tag = node.tag.rpartition(":")[2]
            if "id" in node.attributes:
                document.ids.setdefault(node.attributes["id"], node)
        if root.tag != "COLLADA":
            raise InputError(f"begins with {quoted(f'<{root.tag}>')}, not with <COLLADA>", where=where)
        return document

    def find(self, url: str, *tags: str) -> Node | None:
        """The element of one of `tags` that a URL or an id names; None where it is not in this file."""
        if url and not url.startswith("#") and "#" in url:
            self.ignored["references to other files"] += 1
            return None
        node = self.ids.get(url.removeprefix("#"))
        return node if node is not None and node.tag in tags else None

    def need(self, node: Node, attribute: str, *tags: str) -> Node:
        """The same, which has to be there."""
        found = self.find(node.attributes.get(attribute, ""), *tags)
        if found is None:
            raise self.fail(node, f"names no <{tags[0]}> by its '{attribute}'")
        return found

    def fail(self, node: Node, detail: str) -> InputError:
        """An error at an element."""
        return InputError(
            f"line {node.line}: <{told(node.tag, NAME_LENGTH)}> {detail}", where=self.where, remedy="Export it again."
        )

    def floats(self, node: Node, count: int | None = None) -> Floats:
        """The numbers [N] of an element; `count` of them if it is given."""
        return self._numbers(node, np.float64, count)

    def ints(self, node: Node) -> Ints:
        """The whole numbers [N] of an element."""
        return self._numbers(node, np.int64, None)

    def lists(self, nodes: list[Node]) -> tuple[Ints, Ints]:
        """The whole numbers [N] of elements of one parent, one after the other, and how many each has."""
        counts = np.array([len(node.text.split()) for node in nodes], dtype=np.int64)
        if not nodes:
            return np.zeros(0, np.int64), counts
        joined = Node(nodes[0].tag, {}, nodes[0].line, text=" ".join(node.text for node in nodes))
        return self.ints(joined), counts

    def float_of(self, node: Node | None, default: float) -> float:
        """The one number of an element."""
        return default if node is None or not node.text.strip() else float(self.floats(node, 1)[0])

    def whole(self, node: Node, attribute: str, default: int) -> int:
        """An attribute that is a count."""
        text = node.attributes.get(attribute, str(default))
        if not (text.isascii() and text.isdigit() and len(text) < 12):
            raise self.fail(node, f"has a '{attribute}' that is no count")
        return int(text)

    def source(self, node: Node) -> Floats:
        """The rows [N, C] of a `<source>`, without the columns that its accessor passes over."""
        accessor = node.child("technique_common", "accessor")
        if accessor is None:
            raise self.fail(node, "has no accessor")
        values = self.floats(self._array(node, accessor))
        stride, offset = self.whole(accessor, "stride", 1), self.whole(accessor, "offset", 0)
        count = self.whole(accessor, "count", 0)
        check_count(count, MAX_VERTICES, "rows of data", self.where)
        if stride < 1 or offset + count * stride > len(values):
            raise self.fail(accessor, f"reads {offset} + {count} x {stride} of {len(values)} numbers")
        rows = values[offset : offset + count * stride].reshape(count, stride)
        # A parameter without a name is passed over; one alone may stand for a whole matrix.
        parameters = accessor.all("param")
        named = [number for number, part in enumerate(parameters) if part.attributes.get("name")]
        if len(parameters) < 2 or len(named) in (0, stride) or named[-1] >= stride:
            return rows
        return np.ascontiguousarray(rows[:, named])

    def words(self, node: Node) -> list[str]:
        """The names of a `<source>` of names."""
        accessor = node.child("technique_common", "accessor")
        return [] if accessor is None else self._array(node, accessor).text.split()

    def _array(self, node: Node, accessor: Node) -> Node:
        found = self.find(accessor.attributes.get("source", ""), *ARRAYS)
        found = found or next(iter(node.all(*ARRAYS)), None)
        if found is None:
            raise self.fail(node, "has no array")
        return found

    def _numbers(self, node: Node, kind: type[Kind], count: int | None) -> npt.NDArray[Any]:
        text = node.text.replace(",", ".") if "," in node.text else node.text
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("error")
                values = np.fromstring(text, kind, sep=" ") if text.strip() else np.zeros(0, kind)
        except (ValueError, DeprecationWarning):
            raise self.fail(node, "holds what is no number") from None
        if count is not None and len(values) != count:
            raise self.fail(node, f"holds {len(values)} numbers, not {count}")
        return values


def name_of(node: Node) -> str:
    """What a person calls an element, fit to be told."""
    name = node.attributes.get("name") or node.attributes.get("id") or node.attributes.get("sid") or ""
    return told(name, NAME_LENGTH)
