"""A path-traced picture denoised for looking, by Intel's Open Image Denoise, guided by base colour and normals.

Never for measuring: where the denoiser errs, it errs smoothly, and that would count as light. So the picture's file is
marked (`image_files`), and reading it for a measurement is refused (`package.read_exr`). The library is an extra,
`lightkiln[denoise]`, which brings no other torch.
"""

from importlib.util import find_spec

import numpy as np

from kiln_schemas.errors import MachineLacks
from kiln_workers.scene.model import Float32


def check_denoiser() -> None:
    """MachineLacks where the library is not installed: before the picture is traced, and not after."""
    if find_spec("pyoidn") is None:
        raise MachineLacks(
            "Open Image Denoise is not installed",
            where="--denoise",
            remedy="Run: pip install 'lightkiln[denoise]', or leave --denoise out.",
        )


def denoised(picture: Float32, albedo: Float32, normal: Float32) -> Float32:
    """Radiance [H, W, 3] without noise; `albedo` in [0, 1] and `normal` in [-1, 1] [H, W, 3] say where edges are."""
    import pyoidn

    albedo = np.clip(albedo, 0.0, 1.0)
    try:
        out = pyoidn.denoise(picture, albedo=albedo, normal=normal, hdr=True)
    except RuntimeError as error:
        raise MachineLacks(f"Open Image Denoise fails: {error}", where="--denoise", remedy="Leave it out.") from None
    return np.asarray(np.maximum(out, 0.0), np.float32)
