"""What is known of scene formats by those who collect a scene and those who read it."""

import posixpath
import re
from collections.abc import Iterator, Mapping
from typing import Final
from urllib.parse import unquote

MITSUBA_INCLUDES: Final = 64
"""Files that a Mitsuba scene includes at most, over all; so a file may not include itself for ever."""
MITSUBA_UNUSED: Final = frozenset({"sensor", "integrator", "film", "sampler", "rfilter", "medium", "phase", "volume"})
"""Elements of Mitsuba's XML whose files a bake does without."""

MOST_PATH: Final = 1024
"""Characters of a texture's path that are looked at."""
MOST_FOLDERS: Final = 32
"""Folders of it."""

CONVERTERS: Final[Mapping[str, str]] = {
    ".zae": "Unpack it, as a ZIP archive, and give the .dae file in it.",
    ".blend": "Open it in Blender and export glTF.",
    **dict.fromkeys(
        (".3ds", ".x3d", ".usd", ".usda", ".usdc", ".usdz", ".abc"), "Import it into Blender and export glTF."
    ),
    **dict.fromkeys((".max", ".ma", ".mb", ".c4d", ".skp"), "Export glTF (or FBX, for FBX2glTF) from its own program."),
}
"""By suffix: what to do with a scene in a format that is not read."""


def ends_of_path(reference: str) -> Iterator[str]:
    """The names, relative to a scene's file, by which a texture that Collada or FBX names may be there; best first.

    Both formats keep paths of the author's machine, absolute or with `..`, with backslashes, as URLs. So the longest
    end of a path that is a file in the scene's folder is the texture; what leads out of the folder is never looked for.
    """
    text = reference.strip()[:MOST_PATH].replace("\\", "/")
    for spelled in dict.fromkeys((text, unquote(text))):
        path = re.sub(r"^([a-zA-Z][\w+.-]*:/*|/+)", "", spelled)
        parts = [part for part in posixpath.normpath(path).split("/") if part not in ("", ".", "..")]
        yield from ("/".join(parts[first:]) for first in range(min(len(parts), MOST_FOLDERS)))
