"""From weights to lobes, for the package and for the error at the end of a fit.

Always on the CPU, texel by texel, with single-threaded kernels: kernels choose their order of summation by the
shape of the batch, so this is what makes a texel's lobes the same bytes however the light map is split, on however
many threads.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final, Self

import numpy as np
import torch

from kiln_schemas.conventions import FORMAT_VERSION
from kiln_schemas.errors import InputError
from kiln_workers.fit.lobes import in_scene_units
from kiln_workers.fit.network import Shape, lobes, split
from kiln_workers.fit.pooling import pooled
from kiln_workers.fit.source import Float16, Float32
from kiln_workers.fit.threads import single_threaded_pool
from kiln_workers.scene.container import pack, unpack

_KIND: Final = "fit-weights"


@dataclass(frozen=True)
class Weights:
    """A trained network: what `predict` needs and nothing else."""

    shape: Shape
    exposure: float
    """Factor from scene radiance to exposure-normalised radiance."""
    signal: bool
    """False where the function is zero everywhere: all amplitudes are zero."""
    parameters: Float32  # [P]

    def to_bytes(self) -> bytes:
        """Deterministic bytes, without pickle."""
        header: Mapping[str, Any] = {
            "version": FORMAT_VERSION,
            "image_size": self.shape.image_size,
            "lobes": self.shape.lobes,
            "exposure": self.exposure,
            "signal": self.signal,
        }
        return pack(_KIND, header, {"parameters": self.parameters})

    @classmethod
    def from_bytes(cls, data: bytes) -> Self:
        """Read `to_bytes`; InputError where they are something else."""
        header, arrays = unpack(_KIND, data)
        if header["version"] > FORMAT_VERSION:
            raise InputError(f"weights of format version {header['version']}", remedy="Update lightkiln.")
        shape = Shape(header["image_size"], header["lobes"])
        parameters = arrays["parameters"]
        if parameters.shape != (shape.size,):
            raise InputError(f"{parameters.shape} weights, the network has {shape.size}", where=_KIND)
        return cls(shape, float(header["exposure"]), bool(header["signal"]), parameters)


def predict(weights: bytes | Weights, images: Float16, normals: Float32, *, threads: int = 1) -> Float32:
    """Lobes [T, N, 7] in scene units of images [T, R, R, 3] with unit geometric normals [T, 3].

    The network sees images of its own size: larger ones are pooled.
    Unit axes, positive sharpness, amplitudes within fp16 (textures round the lobes to it).
    """
    network = Weights.from_bytes(weights) if isinstance(weights, bytes) else weights
    layers = split(network.shape, torch.from_numpy(network.parameters.copy()))
    out = np.empty((len(images), network.shape.lobes, 7), np.float32)

    def one(texel: int) -> None:
        picture = torch.from_numpy(pooled(images[texel : texel + 1], network.shape.image_size))
        normal = torch.from_numpy(normals[texel : texel + 1].astype(np.float32))
        with torch.inference_mode():
            found = lobes(layers, picture, normal, network.exposure)
            out[texel] = in_scene_units(found, network.exposure, network.signal).numpy()[0]

    with single_threaded_pool(threads) as pool:
        for _ in pool.map(one, range(len(images))):
            pass
    return out
