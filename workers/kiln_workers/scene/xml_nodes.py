"""A small XML reader for scene files from strangers: elements and attributes only, no document type, no entities.

Built straight on expat: a DOCTYPE ends the reading before any entity can be declared, so neither files nor the network
can be reached and nothing can be expanded without bound. Depth and number of elements are bounded.
"""

from dataclasses import dataclass, field
from typing import Final
from xml.parsers import expat

from kiln_schemas.errors import InputError, TooLarge
from kiln_schemas.text import told
from kiln_workers.scene.limits import MAX_ENTRIES

MAX_DEPTH: Final = 32


@dataclass
class Node:
    """An element; `line` is where it begins."""

    tag: str
    attributes: dict[str, str]
    line: int
    children: list["Node"] = field(default_factory=list)


def parse_xml(data: bytes, where: str) -> Node:
    """The root element; InputError names the line at fault."""
    root = Node("", {}, 0)
    stack = [root]
    count = 0
    parser = expat.ParserCreate()

    def start(tag: str, attributes: dict[str, str]) -> None:
        nonlocal count
        count += 1
        if len(stack) > MAX_DEPTH or count > MAX_ENTRIES:
            raise TooLarge("nests too deeply or has too many elements", where=where, remedy="Simplify it.")
        node = Node(tag, attributes, parser.CurrentLineNumber)
        stack[-1].children.append(node)
        stack.append(node)

    def end(tag: str) -> None:
        stack.pop()

    def refuse(*_: object) -> None:
        raise InputError(
            "declares a document type or entities, which are not read", where=where, remedy="Remove the DOCTYPE."
        )

    parser.StartElementHandler, parser.EndElementHandler = start, end
    parser.StartDoctypeDeclHandler = parser.EntityDeclHandler = refuse
    try:
        parser.Parse(data, True)
    except (expat.ExpatError, LookupError, ValueError) as error:  # the latter two of encodings
        raise InputError(
            f"is not well-formed XML: {told(str(error), 80)}", where=where, remedy="Mend the file."
        ) from None
    return root.children[0]
