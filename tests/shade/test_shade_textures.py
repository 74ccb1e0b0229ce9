"""Look-ups against slow loops and against the maps' own pixel directions."""

import numpy as np
import pytest
import torch

from kiln_workers.render.environment import cube_directions, environment_samples, environment_u
from kiln_workers.scene.model import Environment, Image, TextureRef
from kiln_workers.shade import material, textures
from kiln_workers.shade.package import EnvironmentLookup
from kiln_workers.sphere import ggx, octahedral


def slow_bilinear(image: np.ndarray, u: float, v: float) -> np.ndarray:
    """One look-up, by the definition (OpenGL 4.6, section 8.14.3, CLAMP_TO_EDGE)."""
    height, width = image.shape[:2]
    x, y = u * width - 0.5, v * height - 0.5
    total = np.zeros(image.shape[2:])
    for row in (int(np.floor(y)), int(np.floor(y)) + 1):
        for column in (int(np.floor(x)), int(np.floor(x)) + 1):
            weight = (1.0 - abs(x - column)) * (1.0 - abs(y - row))
            total += weight * image[min(max(row, 0), height - 1), min(max(column, 0), width - 1)]
    return total


def test_bilinear_is_the_slow_loop() -> None:
    random = np.random.default_rng(0)
    image, uv = random.random((5, 7, 2, 3)), random.uniform(0.0, 1.0, (300, 2))
    fast = textures.bilinear(torch.from_numpy(image), torch.from_numpy(uv)).numpy()
    slow = np.stack([slow_bilinear(image, u, v) for u, v in uv])
    np.testing.assert_allclose(fast, slow, rtol=1e-12)


def test_a_texel_centre_is_that_texel_and_u_runs_along_columns() -> None:
    image = torch.arange(12.0).reshape(3, 4, 1)
    uv = torch.tensor([[(2 + 0.5) / 4, (1 + 0.5) / 3], [0.0, 0.0], [1.0, 1.0]])
    np.testing.assert_allclose(textures.bilinear(image, uv)[:, 0].numpy(), [6.0, 0.0, 11.0], atol=1e-5)


def test_octahedral_coordinates_are_those_of_the_sphere_module() -> None:
    directions = np.random.default_rng(2).normal(size=(500, 3))
    fast = textures.octahedral_uv(torch.from_numpy(directions)).numpy()
    np.testing.assert_allclose(fast, 0.5 + 0.5 * octahedral.encode(directions), atol=1e-12)


def test_a_cube_map_has_its_own_texels_where_the_packager_says() -> None:
    faces = np.random.default_rng(3).random((6, 5, 5, 3))
    directions = cube_directions(5).reshape(-1, 3)
    found = textures.cube(torch.from_numpy(faces), torch.from_numpy(directions)).numpy()
    np.testing.assert_allclose(found, faces.reshape(-1, 3), atol=1e-9)


def test_u_between_layers_is_exact_for_powers_of_alpha() -> None:
    """U of a small light goes as alpha^-2 towards it and as alpha^2 away from it."""
    alphas = torch.tensor([0.1, 0.2, 0.6])
    layers = torch.stack([alphas**-2, alphas**2, torch.zeros(3)], dim=-1)[:, None, None].expand(3, 4, 4, 3)
    look_up = EnvironmentLookup(layers, alphas, torch.zeros(6, 1, 1, 3))
    alpha = torch.tensor([0.05, 0.1, 0.15, 0.2, 0.3, 0.6, 0.9])
    directions = torch.nn.functional.normalize(torch.randn(7, 3, generator=torch.Generator().manual_seed(0)), dim=-1)
    found = look_up.convolved(directions, alpha).numpy()
    expected = np.clip(alpha.numpy().astype(np.float64), 0.1, 0.6)
    np.testing.assert_allclose(found[:, 0], expected**-2, rtol=1e-4)
    np.testing.assert_allclose(found[:, 1], expected**2, rtol=1e-4)
    assert found[:, 2].max() <= 2e-6


def test_u_near_a_small_sun_is_the_sum_over_the_image() -> None:
    """A sun of one pixel off every grid's centres: each lobe within 7 % of the sum over the environment's pixels."""
    pixels = np.full((256, 512, 3), 0.2, np.float32)
    pixels[70, 333] = 8000.0
    alphas = np.array([0.09, 0.16, 0.36])
    layers, _ = environment_u(Environment(pixels), alphas, 32, "cpu")
    samples = environment_samples(Environment(pixels), 1)
    energy = samples.radiance * samples.solid_angle[:, None]
    sun = samples.direction[70 * 512 + 333]
    directions = octahedral.pixel_directions(32)
    near = directions[directions @ sun > 0.9]
    for layer, alpha in zip(layers, alphas, strict=True):
        cosine = near @ samples.direction.T
        weight = np.maximum(cosine, 0.0) * ggx.distribution(np.sqrt(0.5 * (1.0 + cosine)), alpha)
        exact = weight @ energy / (weight @ samples.solid_angle[:, None]) * 4.0 / (1.0 + alpha**2)
        np.testing.assert_allclose(layer[directions @ sun > 0.9], exact, rtol=0.07)


def test_material_textures_wrap_and_transform() -> None:
    pixels = np.zeros((2, 4, 3), np.float32)
    pixels[0, 1] = (1.0, 0.5, 0.25)
    image = Image("dots", pixels, srgb=False)
    at = np.array([[1.5 / 4, 0.25], [1.5 / 4 + 1.0, 0.25], [1.5 / 4 - 2.0, 1.25], [2.0 - 1.5 / 4, 0.25]])
    found = material.look_up(image, TextureRef(0), at)[:, 0]
    np.testing.assert_allclose(found, [1.0, 1.0, 1.0, 0.0], atol=1e-9)
    mirrored = material.look_up(image, TextureRef(0, wrap=("mirror", "clamp")), at)[:, 0]
    np.testing.assert_allclose(mirrored, [1.0, 0.0, 0.0, 1.0], atol=1e-9)
    moved = TextureRef(0, offset=(0.25, 0.5), scale=(0.5, 1.0))
    np.testing.assert_allclose(material.look_up(image, moved, np.array([[0.25, 0.75]]))[0, :3], (1.0, 0.5, 0.25))


def test_an_equirectangular_image_is_seen_where_it_says() -> None:
    """Row 0 is +Y, the middle column +X, right of it +Z; left and right edges meet."""
    directions = torch.tensor([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, 0.0, -1.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    columns = torch.arange(8.0)[None, :, None].expand(4, 8, 1)
    assert textures.equirectangular(columns, directions[:3])[:, 0].tolist() == pytest.approx([3.5, 5.5, 1.5], abs=1e-5)
    assert textures.equirectangular(columns, directions[3:4]).item() == pytest.approx(3.5, abs=1e-5)  # of 7 and 0
    rows = torch.arange(4.0)[:, None, None].expand(4, 8, 1)
    assert textures.equirectangular(rows, directions[[0, 4]])[:, 0].tolist() == pytest.approx([1.5, 0.0], abs=1e-5)


def test_an_unrolled_cube_is_the_cube() -> None:
    smooth = torch.tensor(cube_directions(64), dtype=torch.float32)
    directions = torch.nn.functional.normalize(torch.randn(500, 3, generator=torch.Generator().manual_seed(1)), dim=-1)
    seen = textures.equirectangular(textures.unrolled(smooth), directions)
    assert (torch.nn.functional.normalize(seen, dim=-1) - directions).abs().max() < 0.02
