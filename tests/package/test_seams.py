"""The seams of a light map: found where a smooth surface is cut, closed by least squares, against a dense reference."""

import numpy as np
import pytest

from kiln_workers.package import seams
from kiln_workers.package.dilate import plan_fill
from kiln_workers.package.half import layers_to_lobes, lobes_to_layers
from kiln_workers.package.seams import Stitcher, bilinear, seam_points
from kiln_workers.scene.model import Material, Mesh, Scene
from kiln_workers.scene.shapes import Cell, patch, quad, sphere
from kiln_workers.scene.texels import rasterise_texels

SIZE = 64


def ring(t: np.ndarray) -> np.ndarray:
    """A circle of radius 1 m in the plane y = 0."""
    angle = 2.0 * np.pi * t
    return np.stack([np.cos(angle), np.zeros_like(angle), np.sin(angle)], axis=-1)


def scene_of(*meshes: Mesh) -> Scene:
    return Scene(meshes, (Material("grey"),))


@pytest.fixture(scope="module")
def ball() -> Scene:
    return scene_of(patch("ball", sphere(np.zeros(3), 1.0), (32, 32), Cell(4, 4, 10, 10), 0))


def points_of(scene: Scene, uv: np.ndarray) -> np.ndarray:
    """The surface points [S, 3] at light-map coordinates [S, 2], triangle by triangle."""
    out = np.full((len(uv), 3), np.nan)
    for mesh in scene.meshes:
        assert mesh.lightmap_uv is not None
        for face in mesh.faces:
            a, b, c = mesh.lightmap_uv[face].astype(np.float64)
            edges = np.stack([b - a, c - a], axis=1)
            if abs(np.linalg.det(edges)) < 1e-12:
                continue
            part = np.linalg.solve(edges, (uv - a).T).T
            weights = np.stack([1.0 - part.sum(axis=1), part[:, 0], part[:, 1]], axis=1)
            inside = (weights > -1e-4).all(axis=1)
            out[inside] = weights[inside] @ mesh.positions[face].astype(np.float64)
    return out


def test_both_sides_of_a_seam_are_the_same_point_of_the_surface(ball: Scene) -> None:
    found = seam_points(ball, SIZE)
    assert len(found.first) > 40
    first, second = points_of(ball, found.first), points_of(ball, found.second)
    assert np.isfinite(first).all() and np.isfinite(second).all()
    assert np.abs(first - second).max() < 1e-3
    assert np.abs(found.first - found.second).max(axis=1).min() > 1e-6


def test_a_crease_and_an_uncut_edge_are_no_seams() -> None:
    floor = patch(
        "floor", quad(np.zeros(3), np.array([2.0, 0, 0]), np.array([0, 0, -2.0])), (4, 4), Cell(0, 0, 10, 10), 0
    )
    wall = patch(
        "wall", quad(np.zeros(3), np.array([2.0, 0, 0]), np.array([0, 2.0, 0])), (4, 4), Cell(12, 0, 10, 10), 0
    )
    assert not len(seam_points(scene_of(floor), SIZE).first)
    assert not len(seam_points(scene_of(floor, wall), SIZE).first)


def test_two_meshes_that_continue_each_other_share_a_seam() -> None:
    left = patch(
        "left", quad(np.zeros(3), np.array([2.0, 0, 0]), np.array([0, 0, -2.0])), (1, 1), Cell(0, 0, 10, 10), 0
    )
    right = patch(
        "right",
        quad(np.array([2.0, 0, 0]), np.array([2.0, 0, 0]), np.array([0, 0, -2.0])),
        (1, 1),
        Cell(12, 0, 10, 10),
        0,
    )
    assert len(seam_points(scene_of(left, right), SIZE).first) > 10


def light(points: np.ndarray) -> np.ndarray:
    """A smooth light on the ball [S, 3]."""
    x, y, z = points.T
    return np.stack([1.5 + x + 0.3 * y, 2.0 + np.sin(3.0 * z), 1.2 + x * y], axis=1).astype(np.float32)


def test_seams_close_and_the_light_near_them_is_no_less_true(ball: Scene) -> None:
    texels = rasterise_texels(ball, SIZE)
    valid = texels.state == 1
    fill = plan_fill(valid, texels.chart)
    values = np.zeros((SIZE, SIZE, 3), np.float32)
    values[valid] = light(texels.position[valid])
    filled = fill.nearest(values)
    stitcher = Stitcher(ball, fill)
    stitched = stitcher.stitch(filled)

    within = np.diff(texels.chart, axis=1) == 0
    neighbours = np.abs(np.diff(filled, axis=1))[within & valid[:, 1:] & valid[:, :-1]].mean()
    before, after = (float(np.abs(stitcher.jumps(each)).mean()) for each in (filled, stitched))
    assert before > 0.5 * neighbours
    assert after < 0.05 * neighbours

    near = np.random.default_rng(1).uniform(0.0, 1.0, (4000, 2))
    truth = points_of(ball, near)
    near, truth = near[np.isfinite(truth[:, 0])], truth[np.isfinite(truth[:, 0])]
    used, weights = bilinear(near, SIZE, SIZE)
    touched = np.flatnonzero((np.abs(stitched - filled) > 1e-6).any(axis=-1))
    beside = np.isin(used, touched).any(axis=1)
    errors = [
        np.abs(np.einsum("sk,skc->sc", weights, each.reshape(-1, 3)[used]) - light(truth))[beside].mean()
        for each in (filled, stitched)
    ]
    assert beside.sum() > 50
    assert errors[1] < errors[0]


def test_the_sparse_solution_is_that_of_dense_least_squares() -> None:
    size = 20
    ball = scene_of(patch("ball", sphere(np.zeros(3), 1.0), (16, 16), Cell(1, 1, 5, 5), 0))
    texels = rasterise_texels(ball, size)
    fill = plan_fill(texels.state == 1, texels.chart)
    values = fill.nearest(np.random.default_rng(2).uniform(0.0, 1.0, (size, size, 2)).astype(np.float32))
    stitcher = Stitcher(ball, fill)

    rows = []
    for one, other in zip(stitcher.points.first, stitcher.points.second, strict=True):
        row = np.zeros(size * size)
        for sign, point in ((1.0, one), (-1.0, other)):
            at, weights = bilinear(point[None], size, size)
            np.add.at(row, at[0], sign * weights[0])
        rows.append(row)
    jump = np.array(rows)
    weight = np.where(fill.distance().ravel() == 0.0, seams.ANCHOR, seams.FILLED)
    system = np.concatenate([jump, np.diag(np.sqrt(weight))])
    flat = values.reshape(-1, 2).astype(np.float64)
    right = np.concatenate([np.zeros((len(jump), 2)), np.sqrt(weight)[:, None] * flat])
    reference = np.linalg.lstsq(system, right, rcond=None)[0]
    np.testing.assert_allclose(stitcher.stitch(values).reshape(-1, 2), reference, atol=2e-5)


def test_texels_away_from_seams_keep_their_bytes(ball: Scene) -> None:
    texels = rasterise_texels(ball, SIZE)
    fill = plan_fill(texels.state == 1, texels.chart)
    values = fill.nearest(np.random.default_rng(3).uniform(0.0, 1.0, (SIZE, SIZE, 3)).astype(np.float32))
    stitcher = Stitcher(ball, fill)
    used = {
        int(t)
        for points in (stitcher.points.first, stitcher.points.second)
        for t in bilinear(points, SIZE, SIZE)[0].ravel()
    }
    changed = set(np.flatnonzero((stitcher.stitch(values) != values).any(axis=-1)).tolist())
    assert changed and changed <= used
    np.testing.assert_array_equal(stitcher.stitch(values), stitcher.stitch(values))


def test_a_scene_without_seams_is_left_as_it_is() -> None:
    floor = scene_of(
        patch("floor", quad(np.zeros(3), np.array([2.0, 0, 0]), np.array([0, 0, -2.0])), (1, 1), Cell(0, 0, 10, 10), 0)
    )
    texels = rasterise_texels(floor, SIZE)
    fill = plan_fill(texels.state == 1, texels.chart)
    values = np.random.default_rng(4).uniform(0.0, 1.0, (SIZE, SIZE, 3)).astype(np.float32)
    np.testing.assert_array_equal(Stitcher(floor, fill).stitch(values), values)


def test_lobes_agree_across_a_seam_after_their_axes_are_normalised(ball: Scene) -> None:
    texels = rasterise_texels(ball, SIZE)
    valid = texels.state == 1
    fill = plan_fill(valid, texels.chart)
    lobes = np.zeros((SIZE, SIZE, 1, 7), np.float32)
    axis = texels.position[valid] + np.array([0.0, 2.0, 0.0], np.float32)
    lobes[valid, 0, :3] = axis / np.linalg.norm(axis, axis=1, keepdims=True)
    lobes[valid, 0, 3] = 10.0 + 5.0 * texels.position[valid][:, 0]
    lobes[valid, 0, 4:] = light(texels.position[valid])
    stitcher = Stitcher(ball, fill)
    jumps = []
    for each in (fill.nearest(lobes), stitcher.stitch(fill.nearest(lobes))):
        stored = layers_to_lobes(lobes_to_layers(each)[0])
        jumps.append(np.abs(stitcher.jumps(stored)).mean(axis=0)[0])
    assert (jumps[1] < 0.2 * jumps[0] + 1e-6).all(), jumps
