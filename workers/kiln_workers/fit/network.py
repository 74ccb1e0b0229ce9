"""The encoder of Currius et al. 2020, section 4: 4 x [3x3 convolution, 2x2 max pooling, ReLU], then one linear layer.

Input per texel are the logarithm of the exposure-normalised radiance and, as a fourth channel, max(v.n, 0), which
tells the network where the horizon is. The parameters live in one flat vector: one optimiser update, one
checkpoint array, and gradients of concurrent micro-batches that add up in a fixed order. Convolution weights lie as
[out, row, column, in], so that the kernels see channels-last tensors (twice as fast on CPUs as planar ones).
"""

import math
from dataclasses import dataclass
from functools import cached_property, lru_cache
from itertools import pairwise

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from kiln_schemas.conventions import LOBE_PARAMETERS
from kiln_workers.fit.lobes import constrain
from kiln_workers.sphere import octahedral

CHANNELS = (4, 32, 64, 128, 256)
LAST_LAYER_GAIN = 0.1
"""Scale of the last layer's start: outputs are small, so a fit starts from the even picture of `lobes`."""

INPUT_GAIN = 8.0
"""Brings the input, whose spread is about 0.2, above one: the first layers learn sooner."""


@dataclass(frozen=True)
class Shape:
    """What determines the network: side of the image R and number of lobes N."""

    image_size: int
    lobes: int

    @cached_property
    def layers(self) -> list[tuple[int, ...]]:
        """Shapes of the parameters, in the order in which they lie in the flat vector."""
        out: list[tuple[int, ...]] = []
        for inputs, outputs in pairwise(CHANNELS):
            out += [(outputs, 3, 3, inputs), (outputs,)]
        features = (self.image_size // 16) ** 2 * CHANNELS[-1]
        return [*out, (self.lobes * LOBE_PARAMETERS, features), (self.lobes * LOBE_PARAMETERS,)]

    @property
    def size(self) -> int:
        """Number of parameters."""
        return sum(math.prod(layer) for layer in self.layers)


def initial_parameters(shape: Shape, seed: int) -> Tensor:
    """Flat start [P]: He et al. 2015 for the convolutions, a small last layer, zero biases."""
    rng = np.random.default_rng([seed, 0x6E6574])
    parts: list[np.ndarray] = []
    for layer in shape.layers:
        fan_in = math.prod(layer[1:])
        gain = LAST_LAYER_GAIN / math.sqrt(fan_in) if len(layer) == 2 else math.sqrt(2.0 / fan_in)
        values = rng.standard_normal(math.prod(layer)) * gain if len(layer) > 1 else np.zeros(layer)
        parts.append(values.astype(np.float32))
    return torch.from_numpy(np.concatenate(parts))


def split(shape: Shape, flat: Tensor) -> list[Tensor]:
    """The layers as views into the flat vector [P]."""
    sizes = [math.prod(layer) for layer in shape.layers]
    return [part.view(layer) for part, layer in zip(torch.split(flat, sizes), shape.layers, strict=True)]


def network_input(images: Tensor, normals: Tensor, exposure: float) -> Tensor:
    """Channels-last input [T, 4, R, R] from radiance [T, R, R, 3] (any float type) and normals [T, 3]."""
    size = images.shape[1]
    logarithm = torch.log1p(images.float() * exposure)
    cosine = normals @ pixel_centres(size).to(normals.device).T  # [T, R * R]
    stacked = torch.cat([logarithm, cosine.clamp(min=0.0).view(-1, size, size, 1)], dim=-1)
    return stacked.permute(0, 3, 1, 2)


def encode(layers: list[Tensor], inputs: Tensor) -> Tensor:
    """Unconstrained outputs [T, N, 7] of inputs [T, 4, R, R]; `layers` as from `split`."""
    hidden = inputs
    for weight, bias in zip(layers[:-2:2], layers[1:-2:2], strict=True):
        hidden = functional.conv2d(hidden, weight.permute(0, 3, 1, 2), bias, padding=1)
        hidden = functional.relu(functional.max_pool2d(hidden, 2))
    features = hidden.permute(0, 2, 3, 1).flatten(1)
    return functional.linear(features, layers[-2], layers[-1]).view(len(inputs), -1, LOBE_PARAMETERS)


def lobes(layers: list[Tensor], images: Tensor, normals: Tensor, exposure: float) -> Tensor:
    """Lobes [T, N, 7] in exposure-normalised radiance of images [T, R, R, 3] with normals [T, 3]."""
    return constrain(encode(layers, INPUT_GAIN * network_input(images, normals, exposure)), normals)


@lru_cache(maxsize=4)
def pixel_centres(size: int) -> Tensor:
    """Directions [R * R, 3] of the pixel centres, row-major. Shared: do not write."""
    return torch.from_numpy(octahedral.pixel_directions(size).reshape(-1, 3).astype(np.float32))


@lru_cache(maxsize=4)
def solid_angles(size: int) -> Tensor:
    """Solid angles [R * R] of the pixels, row-major. Shared: do not write."""
    return torch.from_numpy(octahedral.pixel_solid_angles(size).reshape(-1).astype(np.float32))
