"""Which extensions of glTF are read, which may be passed over without a word, and what to do about the others.

docs/scene-input.md has each extension of Khronos' registry with what becomes of it.
"""

from collections.abc import Sequence
from typing import Final

from kiln_schemas.errors import InputError
from kiln_schemas.text import told
from kiln_workers.scene.limits import NAME_LENGTH

READ: Final = frozenset(
    {
        "EXT_mesh_gpu_instancing",
        "EXT_meshopt_compression",
        "EXT_texture_webp",
        "KHR_draco_mesh_compression",
        "KHR_lights_punctual",
        "KHR_materials_clearcoat",
        "KHR_materials_emissive_strength",
        "KHR_materials_ior",
        "KHR_materials_pbrSpecularGlossiness",
        "KHR_materials_specular",
        "KHR_materials_transmission",
        "KHR_materials_unlit",
        "KHR_mesh_quantization",
        "KHR_meshopt_compression",
        "KHR_node_visibility",
        "KHR_texture_basisu",
        "KHR_texture_transform",
    }
)
HARMLESS: Final = frozenset(
    {
        "KHR_animation_pointer",
        "KHR_interactivity",
        "KHR_materials_variants",
        "KHR_node_hoverability",
        "KHR_node_selectability",
        "KHR_xmp",
        "KHR_xmp_json_ld",
    }
)
"""They change nothing that a bake could show."""
SHADING_ONLY: Final = frozenset(
    {
        "KHR_materials_anisotropy",
        "KHR_materials_diffuse_transmission",
        "KHR_materials_dispersion",
        "KHR_materials_iridescence",
        "KHR_materials_sheen",
        "KHR_materials_volume",
    }
)
"""A material without them is like the one with them; a note says that they are ignored, even where required."""


def check_extensions(used: Sequence[str], required: Sequence[str], where: str) -> list[str]:
    """Notes on what is ignored; InputError for a required extension without which the scene would be another one."""
    for name in required:
        if name not in READ | HARMLESS | SHADING_ONLY:
            raise InputError(
                f"requires the extension {told(name, NAME_LENGTH)}, which is not read",
                where=where,
                remedy=_remedy(name),
            )
    return [f"'{where}': extension {told(name, NAME_LENGTH)} ignored." for name in sorted(set(used) - READ - HARMLESS)]


def _remedy(name: str) -> str:
    if "_texture_" in name:
        return "Export its textures as PNG, JPEG, WebP or KTX2 with Basis Universal."
    if "materials" in name:
        return "Export its materials as metallic-roughness without this extension."
    if "mesh" in name or "compression" in name:
        return "Export its meshes uncompressed, or with Draco or meshopt compression."
    if "light" in name:
        return "Export its lights as KHR_lights_punctual, or use an environment (--env)."
    return "Export it without this extension."
