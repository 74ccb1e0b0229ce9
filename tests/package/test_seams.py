"""The seams of a light map: found where a smooth surface is cut, closed by least squares, against a dense reference."""

import numpy as np
import pytest

from kiln_workers.package import seams
from kiln_workers.package.dilate import plan_fill
from kiln_workers.package.half import layers_to_lobes, lobes_to_layers, normalise_axes
from kiln_workers.package.seams import Stitcher, bilinear, seam_points
from kiln_workers.scene.model import Material, Mesh, Scene
from kiln_workers.scene.shapes import Cell, patch, quad, sphere
from kiln_workers.scene.texels import rasterise_texels
from kiln_workers.sphere.gaussian import evaluate
from kiln_workers.sphere.octahedral import pixel_directions

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
    weight = np.where(fill.distance().ravel() == 0.0, *seams.IRRADIANCE)
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


def lobes_at(points: np.ndarray) -> np.ndarray:
    """One lobe [S, 1, 7] of the ball's points [S, 3]; sharpness and amplitude run over decades, as a fit's do."""
    axes = points + np.array([0.0, 2.0, 0.0])
    sharpness = np.exp(3.0 + 2.0 * points[:, :1] + np.sin(4.0 * points[:, 2:]))
    amplitudes = 0.3 * np.exp(2.0 * points[:, [2, 0, 1]])
    axes = axes / np.linalg.norm(axes, axis=1, keepdims=True)
    return np.concatenate([axes, sharpness, amplitudes], axis=1)[:, None].astype(np.float32)


@pytest.fixture(scope="module")
def lobe_maps(ball: Scene) -> tuple[Stitcher, np.ndarray, np.ndarray]:
    """The stitcher, and the ball's filled lobes [H, W, 1, 7] before and after, as textures hold them."""
    texels = rasterise_texels(ball, SIZE)
    valid = texels.state == 1
    fill = plan_fill(valid, texels.chart)
    lobes = np.zeros((SIZE, SIZE, 1, 7), np.float32)
    lobes[valid] = lobes_at(texels.position[valid])
    filled = fill.nearest(lobes)
    stitcher = Stitcher(ball, fill, seams.LOBES)
    flat = filled.reshape(-1, 1, 7).copy()
    flat[stitcher.texels] = stitcher.solved_lobes(flat[stitcher.texels])
    before, after = (layers_to_lobes(lobes_to_layers(each)[0]) for each in (filled, flat.reshape(filled.shape)))
    return stitcher, before, after


def test_lobes_agree_across_a_seam(lobe_maps: tuple[Stitcher, np.ndarray, np.ndarray]) -> None:
    stitcher, *maps = lobe_maps
    jumps = [np.abs(stitcher.jumps(each)).mean(axis=0)[0] for each in maps]
    assert (jumps[1] < 0.6 * jumps[0] + 1e-6).all(), jumps


def test_lobes_near_a_seam_are_no_less_true(ball: Scene, lobe_maps: tuple[Stitcher, np.ndarray, np.ndarray]) -> None:
    stitcher, *maps = lobe_maps
    points = points_of(ball, stitcher.points.first)
    directions = pixel_directions(16).reshape(-1, 3)
    truth = np.log1p(evaluate(directions, lobes_at(points)))
    errors = []
    for each in maps:
        parts = []
        for side in (stitcher.points.first, stitcher.points.second):
            used, weights = bilinear(side, SIZE, SIZE)
            mixed = normalise_axes(np.einsum("sk,sknc->snc", weights, each.reshape(-1, 1, 7)[used]))
            parts.append(np.log1p(evaluate(directions, mixed)) - truth)
        errors.append(float(np.mean(np.square(parts))))
    assert len(points) > 40
    assert errors[1] < 0.9 * errors[0], errors


def test_lobes_of_texels_with_data_hardly_change(
    ball: Scene, lobe_maps: tuple[Stitcher, np.ndarray, np.ndarray]
) -> None:
    """Each such texel still shows the light field that was fitted to it."""
    _, before, after = lobe_maps
    changed = (before != after).any(axis=(2, 3)) & (rasterise_texels(ball, SIZE).state == 1)
    directions = pixel_directions(16).reshape(-1, 3)
    fitted, found = (np.log1p(evaluate(directions, each[changed].astype(np.float64))) for each in (before, after))
    assert changed.sum() > 40
    assert np.mean((found - fitted) ** 2) < 0.01 * np.mean(fitted**2)


def test_lobes_are_not_continued_beyond_what_their_texels_hold(
    lobe_maps: tuple[Stitcher, np.ndarray, np.ndarray],
) -> None:
    stitcher = lobe_maps[0]
    random = np.random.default_rng(5)
    lobes = random.normal(size=(len(stitcher.texels), 3, 7))
    lobes[..., 3:] = np.exp(random.uniform(np.log(0.25), np.log(3000.0), lobes[..., 3:].shape))
    lobes[:, 2, 4:] = 0.0
    closed = stitcher.solved_lobes(lobes.astype(np.float32))
    assert closed[:, :2, 3:].min() > 0.25 / 4.0 and closed[..., 3:].max() < 4.0 * 3000.0
    assert (closed[:, 2, 4:].astype(np.float16) == 0.0).all()
