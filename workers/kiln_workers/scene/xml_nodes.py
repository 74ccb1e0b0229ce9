"""A small XML reader for scene files from strangers: elements, attributes and text, no document type, no entities.

Built straight on expat: a DOCTYPE ends the reading before any entity can be declared, so neither files nor the network
can be reached and nothing can be expanded without bound. Depth and number of elements are bounded.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Final
from xml.parsers import expat

from kiln_schemas.errors import InputError, TooLarge
from kiln_schemas.text import told
from kiln_workers.scene.limits import MAX_ENTRIES

MAX_DEPTH: Final = 32


@dataclass(slots=True, eq=False)
class Node:
    """An element; `line` is where it begins."""

    tag: str
    attributes: dict[str, str]
    line: int
    children: list["Node"] = field(default_factory=list)
    text: str = ""  # where it has no children

    def child(self, *path: str) -> "Node | None":
        """The first element that is found down the path of tags; None where there is none."""
        node: Node | None = self
        for tag in path:
            node = next((child for child in node.children if child.tag == tag), None) if node else None
        return node

    def all(self, *tags: str) -> list["Node"]:
        """The children of these tags."""
        return [child for child in self.children if child.tag in tags]

    def below(self) -> Iterator["Node"]:
        """The element and all in it, in the file's order."""
        stack = [self]
        while stack:
            node = stack.pop()
            yield node
            stack += reversed(node.children)


def parse_xml(data: bytes, where: str, depth: int = MAX_DEPTH, elements: int = MAX_ENTRIES) -> Node:
    """The root element, with at most so many elements within each other and in all; InputError names the line."""
    root = Node("", {}, 0)
    stack = [root]
    count = 0
    pieces: list[str] = []
    parser = expat.ParserCreate()
    parser.buffer_text = True
    parser.buffer_size = 1 << 20

    def start(tag: str, attributes: dict[str, str]) -> None:
        nonlocal count
        count += 1
        if len(stack) > depth or count > elements:
            raise TooLarge("nests too deeply or has too many elements", where=where, remedy="Simplify it.")
        pieces.clear()
        node = Node(tag, attributes, parser.CurrentLineNumber)
        stack[-1].children.append(node)
        stack.append(node)

    def end(tag: str) -> None:
        node = stack.pop()
        if not node.children:
            node.text = "".join(pieces)
        pieces.clear()

    def refuse(*_: object) -> None:
        raise InputError(
            "declares a document type or entities, which are not read", where=where, remedy="Remove the DOCTYPE."
        )

    parser.StartElementHandler, parser.EndElementHandler, parser.CharacterDataHandler = start, end, pieces.append
    parser.StartDoctypeDeclHandler = parser.EntityDeclHandler = refuse
    try:
        parser.Parse(data, True)
    except (expat.ExpatError, LookupError, ValueError) as error:  # the latter two of encodings
        raise InputError(
            f"is not well-formed XML: {told(str(error), 80)}", where=where, remedy="Mend the file."
        ) from None
    return root.children[0]
