"""How large a scene may be: bounds that are met by counting, before anything of that size is made.

A scene is a stranger's. Its files say how much they hold, and a file of a hundred bytes may say any number; so readers
count first, and what is over a bound is refused as TooLarge with the number and the remedy. What cannot be counted in
advance (how long a reader takes) has a deadline. The bounds are far beyond what a light map of 8192 x 8192 texels can
show; docs/security.md lists them.
"""

import contextlib
import signal
import threading
from collections.abc import Iterator
from types import FrameType
from typing import Final

from kiln_schemas.errors import TooLarge

MAX_FILE_BYTES: Final = 4 << 30
"""Of one file that is read."""
MAX_READ_BYTES: Final = 8 << 30
"""Of all buffers of a glTF file together."""
MAX_JSON_BYTES: Final = 256 << 20
"""Of a glTF document with the buffers that are written in it."""
MAX_JSON_ITEMS: Final = 4_000_000
"""Values in a glTF document, as its commas tell before it is parsed; one takes 150 bytes of memory."""
MAX_TEXT_BYTES: Final = 1 << 30
"""Of OBJ, MTL and XML files."""
MAX_ENTRIES: Final = 200_000
"""Of each table of a glTF document, elements of an XML file, materials of a library."""
MAX_MESHES: Final = 100_000
"""Objects of a scene, every instance counted."""
MAX_TRIANGLES: Final = 20_000_000
"""Of a scene, every instance counted."""
MAX_VERTICES: Final = 3 * MAX_TRIANGLES
MAX_ZEROS: Final = 1 << 24
"""Elements of a glTF accessor that has no bytes in the file."""
MAX_SIDE: Final = 16384
"""Pixels along a side of an image."""
MAX_PIXELS: Final = 1 << 27
"""Of an image: an environment of 16384 x 8192."""
MAX_IMAGE_BYTES: Final = 4 << 30
"""Of all textures together, decoded."""
MAX_COORDINATE: Final = 1e7
"""Metres; a float32 tells whole metres apart there."""
MAX_UV_SETS: Final = 8
"""Of a mesh that textures use; the light map's comes on top."""
NAME_LENGTH: Final = 200
"""Characters of a mesh's, material's or image's name that are kept."""
MAX_COVERAGE: Final = 16.0
"""How many times over a scene's own light-map UV may cover the light map and still be looked at for overlaps."""
READING_S: Final = 900.0
LAYOUT_S: Final = 3600.0
"""For the light map's UV and texels."""


def check_count(count: int, most: int, what: str, where: str, remedy: str = "Simplify it.") -> None:
    """Raise TooLarge beyond the bound."""
    if count > most:
        raise TooLarge(f"has {count} {what}, at most {most} are read", where=where, remedy=remedy)


@contextlib.contextmanager
def deadline(seconds: float, where: str, what: str, remedy: str) -> Iterator[None]:
    """Raise TooLarge in the block, between two steps of the interpreter, after `seconds`; in the main thread only."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def late(_: int, __: FrameType | None) -> None:
        raise TooLarge(f"takes more than {seconds:.0f} s to {what}", where=where, remedy=remedy)

    before = signal.signal(signal.SIGALRM, late)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)
