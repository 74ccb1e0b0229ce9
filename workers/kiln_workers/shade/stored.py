"""Incident light from the light-field store instead of the lobes: the algorithm as it were if the fit were perfect.

The same section 6 with the same kernels and albedo, but the integral over the light field a sum over its stored pixels,
and W_E looked up in its stored image. What remains against a path tracer is the algorithm's error; what the lobes add
to it is the fit's. Tiles are read one at a time: memory is bounded.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from kiln_schemas.errors import InputError
from kiln_schemas.settings import Function
from kiln_schemas.tasks import Tile
from kiln_workers.shade import algorithm, textures
from kiln_workers.sphere import octahedral
from kiln_workers.store.light_field import LightFieldStore, open_named

KERNEL_VALUES = 1 << 22
"""Values of D that are computed at once."""

VALID = 1


@dataclass(frozen=True)
class StoredImages:
    """A store as incident light. Texels without data pass their bilinear weight on to their neighbours."""

    store: LightFieldStore
    valid: npt.NDArray[np.bool_]  # [H, W]

    @classmethod
    def open(cls, url: str, shape: tuple[int, int]) -> "StoredImages":
        """Open a store whose light map has `shape`; InputError where it belongs to another package."""
        store = open_named(url)
        if store.shape != shape:
            raise InputError(
                f"its light map is {store.shape[1]} x {store.shape[0]}, the package's {shape[1]} x {shape[0]}",
                where=url,
                remedy="Name the store of the same bake.",
            )
        return cls(store, store.read_texel_map()["state"] == VALID)

    def reflected(self, uv: Tensor, surface: algorithm.Surface, paper: bool = False) -> Tensor:
        kernels = (algorithm.paper_kernel(surface),) if paper else algorithm.reflection_kernels(surface)
        size = self.store.image_size
        directions = torch.from_numpy(octahedral.pixel_directions(size).reshape(-1, 3)).to(uv)
        solid_angles = torch.from_numpy(octahedral.pixel_solid_angles(size).reshape(-1, 1).copy()).to(uv)
        out = torch.zeros_like(surface.normal)
        step = max(1, KERNEL_VALUES // len(directions))
        for image, point, weight in self._texels(Function.LIGHT_FIELD, uv):
            light = image.reshape(-1, 3) * solid_angles
            for part in torch.split(torch.arange(len(point), device=uv.device), step):
                at = point[part]
                for kernel in kernels:
                    out.index_add_(0, at, weight[part, None] * (kernel[at](directions) @ light))
        return out

    def visibility(self, uv: Tensor, directions: Tensor) -> Tensor:
        if Function.VISIBILITY not in self.store.functions:
            return torch.ones_like(directions)
        place = textures.octahedral_uv(directions)
        out = torch.zeros_like(directions)
        for image, point, weight in self._texels(Function.VISIBILITY, uv):
            out.index_add_(0, point, weight[:, None] * textures.bilinear(image, place[point]))
        return out

    def _texels(self, function: Function, uv: Tensor) -> Iterator[tuple[Tensor, Tensor, Tensor]]:
        """Image [R, R, 3] of each texel that points look up, the points [K] and their weights [K]."""
        height, width = self.valid.shape
        rows, columns, weights = textures.corners(height, width, uv)
        texel = rows * width + columns
        weights = weights * torch.from_numpy(self.valid).to(uv.device)[rows, columns]
        weights = weights / weights.sum(-1, keepdim=True).clamp(min=1e-6)
        used = weights.ravel() > 0.0
        points = torch.arange(len(uv), device=uv.device).repeat_interleave(4)[used]
        texel, weights = texel.ravel()[used], weights.ravel()[used]
        order = texel.argsort(stable=True)
        numbers, counts = torch.unique_consecutive(texel[order], return_counts=True)
        sizes = counts.tolist()
        parts = zip(torch.split(points[order], sizes), torch.split(weights[order], sizes), strict=True)
        groups = dict(zip(numbers.tolist(), parts, strict=True))
        for texels, images in self._tiles(function, np.array(sorted(groups), np.int64)):
            for number, image in zip(texels, images, strict=True):
                yield torch.from_numpy(image.astype(np.float32)).to(uv.device), *groups[int(number)]

    def _tiles(
        self, function: Function, texels: npt.NDArray[np.int64]
    ) -> Iterator[tuple[npt.NDArray[np.int64], npt.NDArray[np.float16]]]:
        """The texels [K] (row * W + column) tile by tile with their images."""
        size, width = self.store.tile_size, self.valid.shape[1]
        rows, columns = np.divmod(texels, width)
        tile = rows // size * (-(-width // size)) + columns // size
        for number in np.unique(tile):
            at = tile == number
            row, column = int(rows[at][0]) // size * size, int(columns[at][0]) // size * size
            inside = (rows[at] - row) * size + columns[at] - column
            where = Tile(row=row, column=column, size=size, texels=len(inside))
            yield texels[at], self.store.read_tile(function, where, inside)
