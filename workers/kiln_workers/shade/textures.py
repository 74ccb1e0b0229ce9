"""Texture look-ups as a GPU does them, on tensors: bilinear with texel centres at half-integers and clamped edges.

Values are what the package's files hold (fp16, widened to float32); weights have full precision where a GPU may keep
eight bits. Octahedral and cube maps follow `kiln_schemas.conventions` and the OpenGL 4.6 specification, section 8.13.
"""

import torch
from torch import Tensor

from kiln_workers.shade.lobe_file import LobeFile


def bilinear(image: Tensor | LobeFile, uv: Tensor) -> Tensor:
    """Values [P, ...] of an image [H, W, ...] at coordinates [P, 2] in [0, 1], u along columns; edges clamped."""
    rows, columns, weights = corners(image.shape[0], image.shape[1], uv)
    tail = (1,) * (image.ndim - 2)
    out = torch.zeros((len(uv), *image.shape[2:]), dtype=image.dtype, device=image.device)
    for k in range(4):
        out += image[rows[:, k], columns[:, k]] * weights[:, k].reshape(-1, *tail)
    return out


def corners(height: int, width: int, uv: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Rows, columns and weights, each [P, 4], of the texels that a bilinear look-up at `uv` [P, 2] reads."""
    x = uv[:, 0] * width - 0.5
    y = uv[:, 1] * height - 0.5
    left, top = torch.floor(x), torch.floor(y)
    across, down = x - left, y - top
    columns = torch.stack([left, left + 1.0, left, left + 1.0], dim=-1).long().clamp(0, width - 1)
    rows = torch.stack([top, top, top + 1.0, top + 1.0], dim=-1).long().clamp(0, height - 1)
    weights = torch.stack(
        [(1.0 - across) * (1.0 - down), across * (1.0 - down), (1.0 - across) * down, across * down], dim=-1
    )
    return rows, columns, weights


def octahedral_uv(directions: Tensor) -> Tensor:
    """Texture coordinates [P, 2] in [0, 1] of directions [P, 3] in an octahedral map (`sphere.octahedral.encode`)."""
    p = directions / directions.abs().sum(dim=-1, keepdim=True)
    xy = p[:, :2]
    folded = (1.0 - xy.flip(-1).abs()) * torch.where(xy < 0.0, -1.0, 1.0)
    return 0.5 + 0.5 * torch.where(p[:, 2:] < 0.0, folded, xy)


def equirectangular(image: Tensor, directions: Tensor) -> Tensor:
    """Values [P, C] of an equirectangular image [H, W, C] in directions [P, 3]: the top row is +Y, the middle column
    +X, right of it lies +Z, the last column is followed by the first (docs/package.md)."""
    x, y, z = (directions / directions.norm(dim=-1, keepdim=True)).unbind(-1)
    wrapped = torch.cat([image[:, -1:], image, image[:, :1]], dim=1)
    width = image.shape[1]
    u = 0.5 + torch.atan2(z, x) / (2.0 * torch.pi)
    v = 0.5 - torch.asin(y.clamp(-1.0, 1.0)) / torch.pi
    return bilinear(wrapped, torch.stack([(u * width + 1.0) / (width + 2.0), v], dim=-1))


def unrolled(faces: Tensor) -> Tensor:
    """A cube map [6, S, S, C] as an equirectangular image [2 S, 4 S, C], for packages without environment.exr."""
    height, width = 2 * faces.shape[1], 4 * faces.shape[1]
    polar = torch.pi * (torch.arange(height) + 0.5)[:, None] / height
    along = 2.0 * torch.pi * ((torch.arange(width) + 0.5) / width - 0.5)
    directions = torch.stack(
        [torch.sin(polar) * torch.cos(along), torch.cos(polar).expand(-1, width), torch.sin(polar) * torch.sin(along)],
        dim=-1,
    )
    return cube(faces, directions.reshape(-1, 3)).reshape(height, width, -1)


def cube(faces: Tensor, directions: Tensor) -> Tensor:
    """Values [P, C] of a cube map [6, S, S, C] in directions [P, 3]; bilinear inside a face."""
    size = directions.abs()
    axis = size.argmax(dim=-1)
    major = directions.gather(-1, axis[:, None])[:, 0]
    x, y, z = directions.unbind(-1)
    sign = torch.where(major < 0.0, -1.0, 1.0)
    # Table 8.19: s and t of the faces +X -X, +Y -Y, +Z -Z.
    s = torch.stack([-sign * z, x, sign * x], dim=-1).gather(-1, axis[:, None])[:, 0]
    t = torch.stack([-y, sign * z, -y], dim=-1).gather(-1, axis[:, None])[:, 0]
    uv = 0.5 + 0.5 * torch.stack([s, t], dim=-1) / major.abs()[:, None]
    face = 2 * axis + (major < 0.0).long()
    out = torch.zeros((len(directions), faces.shape[-1]), dtype=faces.dtype, device=faces.device)
    for number in range(6):
        at = face == number
        out[at] = bilinear(faces[number], uv[at])
    return out
