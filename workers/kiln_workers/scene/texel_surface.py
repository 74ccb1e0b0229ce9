"""What a material's textures make of a texel: the GGX alpha at its point, and the mapped normal averaged over it.

A texel stands for the surface under its square, so its shading normal is the mean of the mapped ones there: irradiance
is linear in the normal as long as nothing that shines is cut off by the horizon. SIDE x SIDE points of the square are
looked up, those beyond the texel's triangle as if it went on; where they are further apart than the map's pixels are, a
smaller copy of the map, of means of its vectors, takes its place (Williams 1983).
"""

from dataclasses import dataclass
from typing import Final

import numpy as np

from kiln_workers.scene import normal_maps
from kiln_workers.scene.images import linear_pixels
from kiln_workers.scene.lookup import Floats, Ints, look_up, transformed
from kiln_workers.scene.model import Float32, Mesh, Scene, TextureRef

MIN_ALPHA: Final = 0.002
SIDE: Final = 4
"""Points along a texel's side at which its normal map is looked up."""
BEYOND: Final = 1.0
"""Heights of a triangle by which it is thought to go on at most."""


@dataclass(frozen=True)
class Squares:
    """S texels of a scene, each with its place in a triangle."""

    mesh: Ints  # [S]
    corner: Ints  # [S, 3] the triangle's vertices in the mesh
    weight: Floats  # [S, 3] barycentrics of its point
    gradient: Floats  # [S, 3, 2] of the barycentrics along a texel's side, in columns and rows

    def __getitem__(self, rows: Ints) -> "Squares":
        return Squares(self.mesh[rows], self.corner[rows], self.weight[rows], self.gradient[rows])

    def interpolated(self, values: Float32, weight: Floats | None = None) -> Floats:
        """A vertex attribute [V, C] at the points [S, C], or at those of other barycentrics."""
        weight = self.weight if weight is None else weight
        return np.asarray(np.einsum("sk,skc->sc", weight, values[self.corner].astype(np.float64)))


def gradients(flat: Floats) -> Floats:
    """Change [F, 3, 2] of the barycentrics by one texel across and down, of triangles `flat` [F, 3, 2] in texels.

    Zero for triangles of less than a hundredth of a texel.
    """
    (bx, by), (cx, cy) = (flat[:, 1] - flat[:, 0]).T, (flat[:, 2] - flat[:, 0]).T
    area = bx * cy - by * cx
    scale = np.where(np.abs(area) > 0.02, 1.0 / np.where(area == 0.0, 1.0, area), 0.0)
    b, c = np.stack([cy, -cx], axis=1) * scale[:, None], np.stack([-by, bx], axis=1) * scale[:, None]
    return np.stack([-b - c, b, c], axis=1)


def alpha(scene: Scene, squares: Squares) -> Floats:
    """GGX alpha [S], at least MIN_ALPHA."""
    out = np.zeros(len(squares.mesh))
    for mesh, rows, own in _by_mesh(scene, squares):
        material = scene.materials[mesh.material]
        reference, uv = material.metallic_roughness_texture, mesh.uv_of(material.metallic_roughness_texture)
        roughness = np.full(len(rows), material.roughness)
        if reference is not None and uv is not None:
            pixels = linear_pixels(scene.images[reference.image])[..., 1:2]
            roughness *= look_up(pixels, reference, own.interpolated(uv))[:, 0]
        out[rows] = np.maximum(roughness**2, MIN_ALPHA)
    return out


def shading_normals(scene: Scene, squares: Squares) -> Floats:
    """Normals [S, 3], not of unit length: interpolated, and where there is a normal map the mean of the mapped ones."""
    out = np.zeros((len(squares.mesh), 3))
    for mesh, rows, own in _by_mesh(scene, squares):
        reference = scene.materials[mesh.material].normal_texture
        uv = mesh.uv_of(reference)
        if reference is None or uv is None or mesh.tangents is None:
            out[rows] = own.interpolated(mesh.normals)
            continue
        copies = _smaller_copies(linear_pixels(scene.images[reference.image])[..., :3])
        scale = scene.materials[mesh.material].normal_scale
        levels = _levels(own, transformed(uv, reference) * copies[0].shape[1::-1], len(copies))
        for level in np.unique(levels):
            at = np.flatnonzero(levels == level)
            out[rows[at]] = _mean_mapped(own[at], mesh, uv, copies[level], reference, scale)
    return out


def _by_mesh(scene: Scene, squares: Squares) -> list[tuple[Mesh, Ints, Squares]]:
    """Each mesh with the numbers of its texels, and these."""
    order = np.argsort(squares.mesh, kind="stable")
    numbers, first = np.unique(squares.mesh[order], return_index=True)
    parts = np.split(order, first[1:])
    return [(scene.meshes[number], rows, squares[rows]) for number, rows in zip(numbers, parts, strict=True)]


def _mean_mapped(
    squares: Squares, mesh: Mesh, uv: Float32, pixels: Float32, reference: TextureRef, scale: float
) -> Floats:
    """Sum [S, 3] of the mapped normals at points all over each square."""
    assert mesh.tangents is not None
    total = np.zeros((len(squares.mesh), 3))
    steps = (np.arange(SIDE) + 0.5) / SIDE - 0.5
    for offset in np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2):
        weight = np.maximum(squares.weight + squares.gradient @ offset, -BEYOND)
        weight /= weight.sum(axis=1, keepdims=True)
        normal = squares.interpolated(mesh.normals, weight)
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-30)
        texels = look_up(pixels, reference, squares.interpolated(uv, weight))
        total += normal_maps.mapped(normal, squares.interpolated(mesh.tangents, weight), texels, scale)
    return total


def _levels(squares: Squares, place: Floats, count: int) -> Ints:
    """Which of `count` copies [S] is looked up, from the places [V, 2] of the vertices in the map, in its pixels."""
    moves = np.einsum("skt,skc->stc", squares.gradient, place[squares.corner])  # pixels by a texel across, and down
    between = np.linalg.norm(moves, axis=2).max(axis=1) / SIDE
    level = np.clip(np.ceil(np.log2(np.maximum(between, 1e-30))), 0, count - 1)
    return np.asarray(level, np.int64)


def _smaller_copies(pixels: Float32) -> list[Float32]:
    """The image and its means over ever larger pixels; from the second on the sides are powers of two."""
    out = [pixels]
    while max(out[-1].shape[:2]) > 1:
        last = out[-1]
        for axis in (0, 1):
            size = last.shape[axis]
            if size > 1:
                last = _shrunk(last, axis, 1 << (size - 1).bit_length() - 1)
        out.append(last)
    return out


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
