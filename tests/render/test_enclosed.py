"""Which texels lie inside something, of materials with one side and with two; no lit texel is taken for such a one."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import pytest

from kiln_workers.render.tile import TexelBatch, TileImages, TileRenderer
from kiln_workers.scene.model import Environment, LightKind, Material, Mesh, PunctualLight, Scene

Quad = Callable[..., Mesh]
Corner = tuple[float, float, float]

WHITE = Environment(np.ones((8, 16, 3), np.float32))
LAMP = PunctualLight("lamp", LightKind.POINT, (20.0, 20.0, 20.0), (1.1, 2.0, 1.3))
SIDES = pytest.mark.parametrize("double_sided", [False, True])


def solid(quad: Quad, low: Corner, high: Corner, without: Sequence[str] = (), inward: bool = False) -> list[Mesh]:
    """A box of six sheets; `without` names sides such as '-y'."""
    (x0, y0, z0), (x1, y1, z1) = low, high
    a, b, c = (x1 - x0, 0.0, 0.0), (0.0, y1 - y0, 0.0), (0.0, 0.0, z1 - z0)
    sides = {
        "-x": (low, c, b),
        "+x": ((x1, y0, z0), b, c),
        "-y": (low, a, c),
        "+y": ((x0, y1, z0), c, a),
        "-z": (low, b, a),
        "+z": ((x0, y0, z1), a, b),
    }
    parts = [parts for name, parts in sides.items() if name not in without]
    return [quad(o, t, s) if inward else quad(o, s, t) for o, s, t in parts]


def floor(quad: Quad, half: float = 4.0) -> Mesh:
    return quad((-half, 0, -half), (0, 0, 2 * half), (2 * half, 0, 0))


def baked(
    renderer: Callable[..., TileRenderer],
    texels: Callable[..., TexelBatch],
    meshes: Sequence[Mesh],
    points: Sequence[Sequence[float]],
    double_sided: bool = False,
    light: Environment | PunctualLight | None = LAMP,
    color: float = 0.8,
) -> TileImages:
    """Floor points, a tenth of a metre across, in a scene of one material."""
    material = Material("m", (color, color, color, 1.0), double_sided=double_sided)
    scene = Scene(tuple(meshes), (material,), lights=(light,) if isinstance(light, PunctualLight) else ())
    scene = replace(scene, environment=light if isinstance(light, Environment) else None)
    batch = replace(texels(points), texel_size=np.full(len(points), 0.1, np.float32))
    return renderer(scene, irradiance_samples=4096).render(batch)


@SIDES
@pytest.mark.parametrize("light", [LAMP, WHITE], ids=["lamp", "sky"])
def test_inside_of_solids(
    double_sided: bool, light: Environment | PunctualLight, quad: Quad, texels: Callable, renderer: Callable
) -> None:
    """A floor in a room, with a box standing in it, one that overlaps it, a wall, and a box without a bottom."""
    meshes = [
        *solid(quad, (-4, 0, -4), (4, 3, 4), without=("+y",) if light is WHITE else (), inward=True),
        *solid(quad, (-1, -0.1, -1), (0, 1, 0)),
        *solid(quad, (-0.2, -0.1, -0.7), (0.6, 0.4, -0.2)),
        *solid(quad, (-4.2, -0.1, 2.0), (4.2, 3.2, 2.2)),
        *solid(quad, (2.0, 0.0, -2.0), (3.0, 0.5, -1.0), without=("-y",)),
    ]
    inside = [(-0.5, 0, -0.9), (-0.9, 0, -0.1), (-0.1, 0, -0.5), (0.5, 0, -0.3), (0.0, 0, 2.1), (3.9, 0, 2.1)]
    inside += [(2.5, 0, -1.5), (2.05, 0, -1.95)]
    outside = [(0.1, 0, 0.1), (-1.05, 0, -0.5), (0.65, 0, -0.4), (0.0, 0, 1.9), (0.0, 0, 2.3), (1.9, 0, -1.5)]
    images = baked(renderer, texels, meshes, [*inside, *outside], double_sided, light)
    assert images.enclosed.tolist() == [True] * len(inside) + [False] * len(outside)


@SIDES
def test_what_is_lit_is_not_inside(double_sided: bool, quad: Quad, texels: Callable, renderer: Callable) -> None:
    """A room whose walls face in, and one that is a cube whose faces face out, each with a lamp and a rug."""
    rug = quad((-0.5, 0.01, -0.5), (0, 0, 1), (1, 0, 0))
    for inward in (True, False):
        meshes = [rug, *solid(quad, (-2, 0, -2), (2, 3, 2), inward=inward)]
        images = baked(renderer, texels, meshes, [(0, 0.01, 0), (0.4, 0.01, 0.4)], double_sided)
        assert not images.enclosed.any() and (images.irradiance > 0.1).all()


@SIDES
@pytest.mark.parametrize("light", [LAMP, WHITE], ids=["lamp", "sky"])
def test_an_open_shelter_is_not_inside(
    double_sided: bool, light: Environment | PunctualLight, quad: Quad, texels: Callable, renderer: Callable
) -> None:
    """Backs all around but for one side; on a black ground hardly any light of a lamp comes in."""
    shelter = solid(quad, (-1, 0, -1), (1, 0.5, 1), without=("-y", "-z"))
    images = baked(renderer, texels, [floor(quad), *shelter], [(0, 0, 0.9), (0, 0, 0)], double_sided, light, 0.0)
    assert not images.enclosed.any()
    assert (images.irradiance.max() < 1e-4) == (light is LAMP)  # a black face reflects 4 %


def covered_by(height: float, x: float, z: float, half: float = 2.0) -> float:
    """Form factor from a point of the floor to a parallel square above it, by quadrature."""
    count = 2000
    grid = (np.arange(count) + 0.5) / count * 2.0 * half - half
    square = (grid[:, None] - x) ** 2 + (grid[None, :] - z) ** 2 + height**2
    return float((height**2 / (np.pi * square**2)).sum() * (2.0 * half / count) ** 2)


@SIDES
@pytest.mark.parametrize("height", [0.1, 0.25, 1.0])
def test_light_under_a_roof(
    double_sided: bool, height: float, quad: Quad, texels: Callable, renderer: Callable
) -> None:
    """Fault 03: a black floor of 8 x 8 m under a black roof of 4 x 4 m that faces the sky, radiance 1."""
    roof = quad((-2, height, -2), (0, 0, 4), (4, 0, 0))
    points = [(0, 0, 0), (1, 0, 0), (1.5, 0, 1.5), (1.95, 0, 0), (3, 0, 0)]
    images = baked(renderer, texels, [floor(quad), roof], points, double_sided, WHITE, 0.0)
    assert not images.enclosed.any()
    truth = [np.pi * (1.0 - covered_by(height, x, z)) for x, _, z in points]
    np.testing.assert_allclose(images.irradiance[:, 0], truth, rtol=0.05, atol=0.02)
