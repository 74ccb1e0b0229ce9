"""What to do with a scene in a format that is not read: the program that converts it."""

from collections.abc import Mapping
from typing import Final

CONVERTERS: Final[Mapping[str, str]] = {
    ".fbx": "Convert it with FBX2glTF, or open it in Blender and export glTF.",
    ".blend": "Open it in Blender and export glTF.",
    **dict.fromkeys(
        (".dae", ".3ds", ".x3d", ".usd", ".usda", ".usdc", ".usdz", ".abc"), "Import it into Blender and export glTF."
    ),
    **dict.fromkeys((".max", ".ma", ".mb", ".c4d", ".skp"), "Export glTF (or FBX, for FBX2glTF) from its own program."),
}
