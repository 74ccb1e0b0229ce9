"""Statements of Wavefront's text formats: number of the line, keyword, and the rest.

A file may begin with a byte-order mark: UTF-8's and both of UTF-16 are understood.
"""

import codecs
import io
from collections.abc import Iterator


def statements(data: bytes) -> Iterator[tuple[int, str, str]]:
    """Number, keyword and the rest of every statement; a line that ends with a backslash goes on in the next."""
    joined, first = "", 0
    wide = data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
    text = io.TextIOWrapper(io.BytesIO(data), "utf-16" if wide else "utf-8-sig", errors="replace")
    for number, line in enumerate(text, start=1):
        first = first or number
        line = line.rstrip("\n")
        if line.endswith("\\"):
            joined += line[:-1] + " "
            continue
        words = (joined + line).split("#", 1)[0].split(None, 1)
        if words:
            yield first, words[0], words[1].strip() if len(words) > 1 else ""
        joined, first = "", 0
