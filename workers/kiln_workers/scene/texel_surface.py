"""What a material's textures make of a texel: the GGX alpha at its point, and the mapped normal averaged over it.

A texel stands for the surface under its square, so its shading normal is the mean of the mapped ones there: irradiance
is linear in the normal as long as nothing that shines is cut off by the horizon. SIDE x SIDE points of the square are
looked up, those beyond the texel's triangle as if it went on; where they are further apart than the map's pixels are, a
smaller copy of the map, of means of its vectors, takes its place (Williams 1983).
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from kiln_workers.scene import normal_maps
from kiln_workers.scene.lookup import Floats, Ints, look_up, transformed
from kiln_workers.scene.model import Float32, Mesh, Scene, TextureRef

MIN_ALPHA: Final = 0.002
SIDE: Final = 4
"""Points along a texel's side at which its normal map is looked up."""
BLOCK: Final = 1 << 18
"""Texels that are looked up at once: bounds memory."""
MOST_COPIES_BYTES: Final = 1 << 27
"""What may be kept of smaller copies of normal maps."""
BEYOND: Final = 1.0
"""Heights of a triangle by which it is thought to go on at most."""


@dataclass(frozen=True)
class Squares:
    """S texels of one mesh, each with its place in a triangle."""

    corner: Ints  # [S, 3] the triangle's vertices in the mesh
    weight: Floats  # [S, 3] barycentrics of its point
    gradient: Floats  # [S, 3, 2] of the barycentrics by one texel, across and down

    def __getitem__(self, rows: Ints) -> "Squares":
        return Squares(self.corner[rows], self.weight[rows], self.gradient[rows])

    def interpolated(self, values: Float32, weight: Floats | None = None) -> Floats:
        """A vertex attribute [V, C] at the points [S, C], or at those of other barycentrics."""
        weight = self.weight if weight is None else weight
        return np.asarray(np.einsum("sk,skc->sc", weight, values[self.corner].astype(np.float64)))


@dataclass(frozen=True)
class TexelSurface:
    """S texels of a scene by the F faces of all its meshes, in their order."""

    scene: Scene
    face: Ints  # [S]
    weight: Floats  # [S, 3] barycentrics of each texel's point
    flat: Floats  # [F, 3, 2] the faces in the light map, in texels
    copies: "CopiesOfMaps"

    def alpha(self) -> Floats:
        """GGX alpha [S], at least MIN_ALPHA."""
        out = np.zeros(len(self.face))
        for mesh, rows, squares in self._blocks():
            out[rows] = _alpha(self.scene, mesh, squares)
        return out

    def shading_normals(self) -> Floats:
        """Normals [S, 3], not of unit length: interpolated, or the mean of the mapped ones."""
        out = np.zeros((len(self.face), 3))
        for mesh, rows, squares in self._blocks():
            reference = self.scene.materials[mesh.material].normal_texture
            if reference is None or mesh.tangents is None or mesh.uv_of(reference) is None:
                out[rows] = squares.interpolated(mesh.normals)
                continue
            copies = self.copies.of(self.scene.images[reference.image].pixels)
            out[rows] = _mapped_normals(
                mesh, squares, copies, reference, self.scene.materials[mesh.material].normal_scale
            )
        return out

    def _normal_image(self, number: int) -> int:
        """The image of a mesh's normal map, -1 where it has none: meshes that share one follow each other."""
        reference = self.scene.materials[self.scene.meshes[number].material].normal_texture
        return -1 if reference is None else reference.image

    def _blocks(self) -> Iterator[tuple[Mesh, Ints, Squares]]:
        """The texels of each mesh, at most BLOCK at a time, with their numbers."""
        first = np.cumsum([0] + [len(mesh.faces) for mesh in self.scene.meshes])
        order = np.argsort(self.face, kind="stable")
        start = np.searchsorted(self.face[order], first)
        for number in sorted(np.flatnonzero(np.diff(start)).tolist(), key=self._normal_image):
            mesh = self.scene.meshes[number]
            for at in range(start[number], start[number + 1], BLOCK):
                rows = order[at : min(at + BLOCK, start[number + 1])]
                face = self.face[rows]
                corner = mesh.faces[face - first[number]].astype(np.int64)
                yield mesh, rows, Squares(corner, self.weight[rows], gradients(self.flat[face]))


def gradients(flat: Floats) -> Floats:
    """Change [F, 3, 2] of the barycentrics by one texel across and down, of triangles `flat` [F, 3, 2] in texels.

    Zero for triangles of less than a hundredth of a texel.
    """
    (bx, by), (cx, cy) = (flat[:, 1] - flat[:, 0]).T, (flat[:, 2] - flat[:, 0]).T
    area = bx * cy - by * cx
    scale = np.where(np.abs(area) > 0.02, 1.0 / np.where(area == 0.0, 1.0, area), 0.0)
    b, c = np.stack([cy, -cx], axis=1) * scale[:, None], np.stack([-by, bx], axis=1) * scale[:, None]
    return np.stack([-b - c, b, c], axis=1)


def _alpha(scene: Scene, mesh: Mesh, squares: Squares) -> Floats:
    material = scene.materials[mesh.material]
    reference, uv = material.metallic_roughness_texture, mesh.uv_of(material.metallic_roughness_texture)
    roughness = np.full(len(squares.corner), material.roughness)
    if reference is not None and uv is not None:
        pixels = scene.images[reference.image].pixels
        green = 1 if pixels.shape[2] > 2 else 0
        roughness *= _unit(look_up(pixels[..., green : green + 1], reference, squares.interpolated(uv)), pixels)[:, 0]
    return np.asarray(np.maximum(roughness**2, MIN_ALPHA))


def _mapped_normals(mesh: Mesh, squares: Squares, copies: "Copies", reference: TextureRef, scale: float) -> Floats:
    """Sums [S, 3] of the mapped normals at points all over each square."""
    uv = mesh.uv_of(reference)
    assert uv is not None and mesh.tangents is not None
    levels = _levels(squares, transformed(uv, reference) * copies.pixels.shape[1::-1])
    out = np.zeros((len(squares.corner), 3))
    steps = (np.arange(SIDE) + 0.5) / SIDE - 0.5
    for level in np.unique(levels):
        at = np.flatnonzero(levels == level)
        own = squares[at]
        for offset in np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2):
            weight = np.maximum(own.weight + own.gradient @ offset, -BEYOND)
            weight /= weight.sum(axis=1, keepdims=True)
            normal = own.interpolated(mesh.normals, weight)
            normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-30)
            texels = copies.look_up(int(level), reference, own.interpolated(uv, weight))
            out[at] += normal_maps.mapped(normal, own.interpolated(mesh.tangents, weight), texels, scale)
    return out


def _levels(squares: Squares, place: Floats) -> Ints:
    """Which copy [S] is looked up, from the places [V, 2] of the vertices in the map, in its pixels."""
    moves = np.einsum("skt,skc->stc", squares.gradient, place[squares.corner])  # pixels by a texel across, and down
    between = np.linalg.norm(moves, axis=2).max(axis=1) / SIDE
    return np.asarray(np.ceil(np.log2(np.clip(between, 1.0, 2.0**30))), np.int64)


class Copies:
    """A normal map [H, W, C] and its means over ever larger pixels, made when they are asked for.

    From the first copy on the sides are powers of two.
    """

    def __init__(self, pixels: npt.NDArray[np.uint8] | Float32) -> None:
        self.pixels = pixels
        self._levels: list[npt.NDArray[np.uint8] | Float32] = [
            pixels[..., :3] if pixels.shape[2] > 2 else pixels[..., :1].repeat(3, axis=2)
        ]

    @property
    def nbytes(self) -> int:
        """Bytes of the copies that were made."""
        return sum(pixels.nbytes for pixels in self._levels[1:])

    def look_up(self, level: int, reference: TextureRef, uv: Floats) -> Floats:
        """Texels [P, 3] in 0 ... 1 at a mesh's coordinates, of a copy or the smallest there is."""
        while len(self._levels) <= level and max(self._levels[-1].shape[:2]) > 1:
            pixels = np.asarray(_unit(self._levels[-1].astype(np.float32), self._levels[-1]), np.float32)
            for axis in (0, 1):
                if pixels.shape[axis] > 1:
                    pixels = _shrunk(pixels, axis, 1 << (pixels.shape[axis] - 1).bit_length() - 1)
            self._levels.append(pixels)
        chosen = self._levels[min(level, len(self._levels) - 1)]
        return _unit(look_up(chosen, reference, uv), chosen)


class CopiesOfMaps:
    """The copies of normal maps that were looked up last, at most MOST_COPIES_BYTES of them and one more map's."""

    def __init__(self) -> None:
        self._kept: list[Copies] = []

    def of(self, pixels: npt.NDArray[np.uint8] | Float32) -> Copies:
        """A map's copies."""
        found = next((copies for copies in self._kept if copies.pixels is pixels), None) or Copies(pixels)
        self._kept = [found] + [copies for copies in self._kept if copies is not found]
        while sum(copies.nbytes for copies in self._kept[1:]) > MOST_COPIES_BYTES:
            self._kept.pop()
        return found


def _unit(values: npt.NDArray[np.floating], stored: npt.NDArray[Any]) -> Floats:
    """Values of an image in 0 ... 1, by how its pixels are stored."""
    return np.asarray(values / 255.0 if stored.dtype == np.uint8 else values)


def _shrunk(pixels: Float32, axis: int, size: int) -> Float32:
    """The means of the image over `size` equal parts along an axis."""
    before = pixels.shape[axis]
    if before == 2 * size:
        halves = pixels.reshape(*pixels.shape[:axis], size, 2, *pixels.shape[axis + 1 :])
        return np.asarray(halves.mean(axis=axis + 1), np.float32)
    edges, cells = np.arange(size + 1) * (before / size), np.arange(before)
    overlap = np.minimum(edges[1:, None], cells + 1) - np.maximum(edges[:-1, None], cells)
    share = (np.maximum(overlap, 0.0) * (size / before)).astype(np.float32)  # [size, before]
    return np.asarray(np.moveaxis(np.tensordot(share, pixels, axes=(1, axis)), 0, axis), np.float32)
