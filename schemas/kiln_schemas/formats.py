"""What is known of scene formats by those who collect a scene and those who read it."""

from collections.abc import Mapping
from typing import Final

MITSUBA_INCLUDES: Final = 64
"""Files that a Mitsuba scene includes at most, over all; so a file may not include itself for ever."""
MITSUBA_UNUSED: Final = frozenset({"sensor", "integrator", "film", "sampler", "rfilter", "medium", "phase", "volume"})
"""Elements of Mitsuba's XML whose files a bake does without."""

CONVERTERS: Final[Mapping[str, str]] = {
    ".fbx": "Convert it with FBX2glTF, or open it in Blender and export glTF.",
    ".blend": "Open it in Blender and export glTF.",
    **dict.fromkeys(
        (".dae", ".3ds", ".x3d", ".usd", ".usda", ".usdc", ".usdz", ".abc"), "Import it into Blender and export glTF."
    ),
    **dict.fromkeys((".max", ".ma", ".mb", ".c4d", ".skp"), "Export glTF (or FBX, for FBX2glTF) from its own program."),
}
"""By suffix: what to do with a scene in a format that is not read."""
