"""KTX 2 textures with Basis Universal (KHR_texture_basisu: ETC1S or UASTC), decoded to RGBA with opengl_basisu.

The header (Khronos KTX 2.0, section 3) says how large the picture is and how long its data become once inflated. Both
are held to the bounds, and to each other, before the transcoder is given the file.
"""

import struct
from typing import Final

import numpy as np
import numpy.typing as npt
import opengl_basisu

from kiln_schemas.errors import InputError
from kiln_workers.scene.limits import MAX_PIXELS, MAX_SIDE, check_count

HEADER: Final = struct.Struct("<12s9I4I2Q")
LEVEL: Final = struct.Struct("<3Q")
MOST_LEVELS: Final = 16
BLOCK_BYTES: Final = 16
"""Of 4 x 4 pixels, at the most."""


def decode_ktx2(data: bytes, where: str, most_bytes: int) -> npt.NDArray[np.uint8]:
    """The largest level as [H, W, 4] bytes, as they are stored; InputError names `where`."""
    if len(data) < HEADER.size:
        raise _damaged("its header is cut off", where)
    _, vk_format, _, width, height, depth, layers, faces, levels, scheme, *_ = HEADER.unpack_from(data)
    size = f"({width} x {height})"
    check_count(max(width, height), MAX_SIDE, f"pixels along a side {size}", where, "Make it smaller.")
    check_count(width * height, MAX_PIXELS, f"pixels {size}", where, "Make it smaller.")
    decoded = "bytes when it is decoded beside the others"
    check_count(width * height * 4, most_bytes, decoded, where, "Use smaller textures.")
    if vk_format != 0:
        raise InputError(
            f"is a KTX2 texture of Vulkan's format {vk_format}, not of Basis Universal",
            where=where,
            remedy="Save it as PNG or JPEG, or as KTX2 with ETC1S or UASTC.",
        )
    if not width or not height or depth > 1 or layers > 1 or faces != 1 or levels > MOST_LEVELS or scheme > 2:
        raise _damaged("it is no single picture", where)
    for level in range(max(levels, 1)):
        if HEADER.size + (level + 1) * LEVEL.size > len(data):
            raise _damaged("its index of levels is cut off", where)
        offset, length, inflated = LEVEL.unpack_from(data, HEADER.size + level * LEVEL.size)
        blocks = -(-max(width >> level, 1) // 4) * -(-max(height >> level, 1) // 4)
        if offset + length > len(data) or inflated > blocks * BLOCK_BYTES:
            raise _damaged(f"level {level} announces {inflated} bytes for {blocks} blocks", where)
    try:
        texture = opengl_basisu.open(data)
        pixels = np.asarray(texture.transcode("rgba8").data)
    except Exception as error:  # bindings of a C++ transcoder: whatever they raise says that the file is no texture
        raise _damaged(f"Basis Universal's transcoder says: {error}", where) from None
    if pixels.shape != (height, width, 4):
        raise _damaged(f"it becomes {pixels.shape}, not {height} x {width} pixels", where)
    rgba = np.ascontiguousarray(pixels, dtype=np.uint8)
    return rgba if texture.has_alpha else np.ascontiguousarray(rgba[..., :3])


def _damaged(detail: str, where: str) -> InputError:
    return InputError(f"is a damaged KTX2 texture: {detail}", where=where, remedy="Save it again.")
