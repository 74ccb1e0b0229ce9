"""Text that strangers wrote (names in scenes, words of requests) made fit to be told: short, and inert on a terminal.

It reaches databases, logs and terminals. PostgreSQL takes no U+0000, UTF-8 no half of a surrogate pair, and an escape
sequence or a change of direction in a name would let it rewrite the sentence around it.
"""

import re
from typing import Annotated, Final

from pydantic import AfterValidator, BeforeValidator, Field

UNFIT: Final = re.compile(r"[\x00-\x08\x0b-\x1f\x7f-\x9f\u2028-\u202e\u2066-\u2069\ud800-\udfff]")
"""Control characters but tab and line feed, line separators, marks of direction, halves of surrogate pairs."""
LINE_BREAK: Final = re.compile(r"[\t\n]")
DETAIL_LENGTH: Final = 4000
PLACE_LENGTH: Final = 300
NOTE_LENGTH: Final = 500
QUOTE_LENGTH: Final = 40
"""Of a value in a file that an error quotes."""


def told(text: str, length: int = DETAIL_LENGTH) -> str:
    r"""At most `length` characters of `text`, and what is not fit to be shown as its escape (`\x1b`)."""
    shown = UNFIT.sub(lambda match: match[0].encode("unicode_escape").decode(), text[: length + 1])
    return shown if len(shown) <= length else f"{shown[: length - 1]}…"


def quoted(text: str, length: int = QUOTE_LENGTH) -> str:
    """A value that a file's author wrote, in quotation marks, at most `length` characters of it, fit to be told.

    For values of attributes, numbers and keywords of JSON and XML, which are cut out of a file whose form was found
    good. Of formats of lines (OBJ, MTL, PLY), for which any text passes, no message quotes anything: it names the line.
    """
    return f"'{told(text, length)}'"


def is_line(text: str) -> bool:
    """Whether it is one line fit to be shown as it is."""
    return not (UNFIT.search(text) or LINE_BREAK.search(text))


def check_line(text: str) -> str:
    """The text unchanged, ValueError where it is not one line fit to be shown as it is."""
    found = UNFIT.search(text) or LINE_BREAK.search(text)
    if found:
        raise ValueError(f"holds the control character U+{ord(found[0]):04X}")
    return text


def _told(length: int) -> BeforeValidator:
    return BeforeValidator(lambda value: told(value, length) if isinstance(value, str) else value)


Line = Annotated[str, AfterValidator(check_line)]
"""A name that a client gives."""
Told = Annotated[str, Field(max_length=DETAIL_LENGTH), _told(DETAIL_LENGTH)]
"""What is told to people."""
Place = Annotated[str, Field(max_length=PLACE_LENGTH), _told(PLACE_LENGTH)]
"""A place in an input: a file, a mesh, a field."""
Note = Annotated[str, Field(max_length=NOTE_LENGTH), _told(NOTE_LENGTH)]
"""A remark on a scene, with names from it."""
Log = Annotated[
    str,
    BeforeValidator(lambda value: UNFIT.sub("\ufffd", value) if isinstance(value, str) else value),
    Field(max_length=65536),
]
"""What a process printed."""
