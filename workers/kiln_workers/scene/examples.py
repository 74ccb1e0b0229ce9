"""The bundled examples, made by this code alone: `gallery` and `courtyard`.

After Currius et al. 2020, Table 2 (objects and planes of GGX alpha 0.2 ... 0.5 from left to right, lit by emitting arcs
that reflect in them) and Table 3 (the same materials under a sky with a small bright sun, occluded by walls and
columns). Every surface is a `shapes.patch`, with light-map charts laid out by hand for 64 x 64 texels; a cell is
given in units of two texels, its gutter included.
"""

from pathlib import Path
from typing import Final

import numpy as np
import OpenEXR

from kiln_workers.package.glb import encode_glb
from kiln_workers.scene.geometry import Floats
from kiln_workers.scene.model import Environment, Float32, Material, Mesh, Scene
from kiln_workers.scene.shapes import Cell, arc, column, patch, quad, sphere, trefoil, tube
from kiln_workers.scene.sky import clear_sky

ARC_THICKNESS: Final = 0.2
"""Radius of the gallery's glowing tubes in metres: a pixel of a 64 x 64 light field is 0.06 rad wide, and a tube should
be a pixel wide from the far side of the gallery. docs/design/fit.md has the errors with thinner ones."""
ALPHAS: Final = (0.2, 0.3, 0.4, 0.5)
"""GGX alpha of the four sets; glTF's roughness is its square root."""


def write_examples(folder: Path) -> list[Path]:
    """Write gallery.glb, courtyard.glb and courtyard.exr into `folder`; the paths written."""
    folder.mkdir(parents=True, exist_ok=True)
    courtyard = courtyard_scene()
    assert courtyard.environment is not None
    paths = [folder / "gallery.glb", folder / "courtyard.glb", folder / "courtyard.exr"]
    paths[0].write_bytes(encode_glb(gallery_scene()))
    paths[1].write_bytes(encode_glb(courtyard))
    write_exr(paths[2], courtyard.environment.pixels)
    return paths


def write_exr(path: Path, pixels: Float32) -> None:
    """A half-float RGB OpenEXR image of [H, W, 3]."""
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    OpenEXR.File(header, {"RGB": pixels.astype(np.float16)}).write(str(path))


def gallery_scene() -> Scene:
    """Four strips of floor of rising roughness, a ball and a knot on each, arcs of light behind and between them."""
    materials: list[Material] = []
    meshes: list[Mesh] = []
    for k, alpha in enumerate(ALPHAS):
        materials += [
            _metal(f"floor alpha {alpha}", (0.56, 0.57, 0.60), alpha),
            _metal(f"gold alpha {alpha}", (0.95, 0.68, 0.32), alpha),
            _metal(f"copper alpha {alpha}", (0.93, 0.53, 0.42), alpha),
        ]
        x = -3.9 + 2.6 * k
        floor = quad(_at(x - 1.3, 0, 3.0), _at(2.6, 0, 0), _at(0, 0, -6.0))
        meshes += [
            patch(f"floor {k}", floor, (1, 1), Cell(7 * k, 0, 7, 13), 3 * k),
            patch(f"ball {k}", sphere(_at(x + 0.45, 0.56, 1.1), 0.55), (28, 28), Cell(7 * k, 13, 7, 7), 3 * k + 1),
            patch(
                f"knot {k}",
                tube(trefoil(_at(x - 0.3, 0.98, -0.75), 0.78, 0.35), 0.165),
                (128, 10),
                Cell(14 * (k % 2), 20 + 4 * (k // 2), 14, 4),
                3 * k + 2,
            ),
        ]
    materials.append(Material("wall", base_color=(0.42, 0.42, 0.46, 1.0), roughness=0.9))
    wall = quad(_at(-5.2, 0, -3.0), _at(10.4, 0, 0), _at(0, 3.4, 0))
    meshes.append(patch("wall", wall, (1, 1), Cell(0, 28, 28, 4), len(materials) - 1))
    for number, (centre, radius, turn, colour) in enumerate(_gallery_arcs()):
        materials.append(Material(f"light {number}", base_color=(0.0, 0.0, 0.0, 1.0), emission=colour))
        cell = Cell(28 + 2 * (number % 2), 8 * (number // 2), 2, 8, turned=True)
        curve = tube(arc(centre, radius, turn), ARC_THICKNESS)
        meshes.append(patch(f"arc {number}", curve, (40, 8), cell, len(materials) - 1))
    return Scene(tuple(meshes), tuple(materials))


def _gallery_arcs() -> list[tuple[Floats, float, float, tuple[float, float, float]]]:
    """Centre, radius in metres, turn in radians and radiance of each arc of light."""
    return [
        (_at(-3.9, 0, -2.3), 1.15, 0.0, (5.6, 1.7, 0.56)),
        (_at(-1.3, 0, -2.3), 1.15, 0.0, (1.2, 3.8, 1.6)),
        (_at(1.3, 0, -2.3), 1.15, 0.0, (0.88, 2.4, 6.0)),
        (_at(3.9, 0, -2.3), 1.15, 0.0, (4.8, 1.04, 3.6)),
        (_at(0.0, 0, 0.1), 2.3, 0.0, (4.0, 3.6, 2.96)),
    ]


def courtyard_scene() -> Scene:
    """A walled court: an arcade at the back, a pillar that throws its shadow over the floor, balls and a knot."""
    materials = [_metal(f"floor alpha {alpha}", (0.58, 0.55, 0.50), alpha) for alpha in ALPHAS]
    materials += [_metal(f"ball alpha {alpha}", (0.90, 0.78, 0.62), alpha) for alpha in ALPHAS]
    plaster, stone, clay, copper = range(8, 12)
    materials += [
        Material("plaster", base_color=(0.66, 0.53, 0.41, 1.0), roughness=0.95),
        Material("stone", base_color=(0.62, 0.60, 0.55, 1.0), roughness=0.75),
        Material("clay", base_color=(0.46, 0.20, 0.11, 1.0), roughness=0.85),
        _metal("copper alpha 0.2", (0.93, 0.53, 0.42), 0.2),
    ]
    meshes: list[Mesh] = []
    for k in range(4):
        floor = quad(_at(-5.0 + 2.5 * k, 0, 4.0), _at(2.5, 0, 0), _at(0, 0, -8.0))
        meshes.append(patch(f"floor {k}", floor, (1, 1), Cell(7 * k, 0, 7, 13), k))
    meshes += _walls(plaster, clay)
    for k in range(4):
        ball = sphere(_at(-3.75 + 2.5 * k, 0.61, 1.2 + 0.5 * (k % 2)), 0.6)
        meshes.append(patch(f"ball {k}", ball, (24, 24), Cell((14, 19, 0, 5)[k], (18, 18, 23, 23)[k], 5, 5), 4 + k))
    knot = tube(trefoil(_at(0.0, 1.02, -0.6), 0.82, 0.4), 0.17)
    meshes.append(patch("knot", knot, (128, 10), Cell(10, 23, 16, 5), copper))

    column_cells = [(28, 0), (28, 4), (28, 8), (28, 12), (28, 16), (24, 18)]
    feet = [_at(-4.0 + 2.0 * k, 0, -2.4) for k in range(5)] + [_at(2.5, 0, 3.2)]
    for k, (foot, (left, top)) in enumerate(zip(feet, column_cells, strict=True)):
        shaft = column(foot, 0.24, 2.0 if k < 5 else 2.6)
        meshes.append(patch(f"column {k}", shaft, (24, 20), Cell(left, top, 4, 4), stone))
    for k in range(4):
        curve = tube(arc(_at(-3.0 + 2.0 * k, 2.0, -2.4), 1.0), 0.2)
        cell = Cell(28 + 2 * (k % 2), 20 + 6 * (k // 2), 2, 6, turned=True)
        meshes.append(patch(f"arch {k}", curve, (24, 10), cell, stone))
    return Scene(tuple(meshes), tuple(materials), environment=Environment(courtyard_sky()))


def courtyard_sky(width: int = 1024) -> Float32:
    """The courtyard's sky [W/2, W, 3]: the sun stands high on the right, in front; 4 times the sky's irradiance."""
    sun = _at(0.62, 0.68, 0.40)
    return clear_sky(width, sun / np.linalg.norm(sun), turbidity=2.6, sky_irradiance=1.6, sun_to_sky=4.0)


def _walls(plaster: int, clay: int) -> list[Mesh]:
    """Three walls 3.2 m high and 0.3 m thick: plaster inside, clay on top, outside and at the two ends."""
    thick, up = 0.3, _at(0, 3.2, 0)
    back = (_at(-5.0, 0, -4.0), _at(10.0, 0, 0), _at(0, 0, -thick))
    left = (_at(-5.0, 0, 4.0), _at(0, 0, -8.0), _at(-thick, 0, 0))
    right = (_at(5.0, 0, -4.0), _at(0, 0, 8.0), _at(thick, 0, 0))
    cells = [
        (Cell(0, 13, 14, 5), Cell(0, 28, 14, 2), Cell(14, 30, 5, 2)),
        (Cell(14, 13, 14, 5), Cell(14, 28, 14, 2), Cell(19, 30, 5, 2)),
        (Cell(0, 18, 14, 5), Cell(0, 30, 14, 2), Cell(24, 30, 4, 2)),
    ]
    meshes = []
    for k, ((corner, along, out), (face, top, outside)) in enumerate(zip((back, left, right), cells, strict=True)):
        # The back wall's outside goes around the corners.
        more = thick * along / np.linalg.norm(along) if k == 0 else _at(0, 0, 0)
        start, length = corner - more, along + 2.0 * more
        meshes += [
            patch(f"wall {k}", quad(corner, along, up), (1, 1), face, plaster),
            patch(f"wall top {k}", quad(start + up, length, out), (1, 1), top, clay),
            patch(f"wall outside {k}", quad(start + out + length, -length, up), (1, 1), outside, clay),
        ]
    for k, x in enumerate((-5.0 - thick, 5.0)):
        end = quad(_at(x, 0, 4.0), _at(thick, 0, 0), up)
        meshes.append(patch(f"wall end {k}", end, (1, 1), Cell(26, 23 + 2 * k, 2, 2), clay))
    return meshes


def _metal(name: str, colour: tuple[float, float, float], alpha: float) -> Material:
    return Material(name, base_color=(*colour, 1.0), metallic=1.0, roughness=float(np.sqrt(alpha)))


def _at(x: float, y: float, z: float) -> Floats:
    return np.array([x, y, z], dtype=np.float64)
