"""Sheets back to back in one place: the same light in any order; a room turned inside out is told of."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import pytest

from kiln_workers.render.tile import TexelBatch, TileRenderer
from kiln_workers.scene.lamps import lamp_notes
from kiln_workers.scene.model import LightKind, Material, Mesh, PunctualLight, Scene
from kiln_workers.scene.sheets import part_sheets
from kiln_workers.scene.texel_map import TexelState
from kiln_workers.scene.texels import build_texel_map

Quad = Callable[..., Mesh]

MATERIALS = (
    Material("wall", (0.7, 0.7, 0.7, 1.0)),
    Material("lamp", (0.0, 0.0, 0.0, 1.0), emission=(8.0, 8.0, 8.0)),
    Material("foil", (0.7, 0.7, 0.7, 1.0), double_sided=True),
)
SIZE = 24


def room(quad: Quad, inward: bool = True, material: int = 0) -> list[Mesh]:
    """A closed box of 3 x 2 x 2.4 m, turned by an odd angle, six sheets with a chart each."""
    turn = np.array([[0.8, 0.0, 0.6], [0.36, 0.8, -0.48], [-0.48, 0.6, 0.64]])
    o, a, b, c = (turn @ v for v in ((-1.5, 0, -1.2), (3.0, 0, 0), (0, 2.0, 0), (0, 0, 2.4)))
    sides = [(o, c, a), (o + b, a, c), (o, a, b), (o + c, b, a), (o, b, c), (o + a, c, b)]
    out = []
    for number, (at, s, t) in enumerate(sides):
        mesh = quad(at, s, t, material) if inward else quad(at, t, s, material)
        uv = np.array([[0, 1], [1, 1], [1, 0], [0, 0]]) * 0.27 + [0.02, 0.023] + np.array([number % 3, number // 3]) / 3
        out.append(replace(mesh, lightmap_uv=uv.astype(np.float32)))
    return out


def lamp(quad: Quad) -> Mesh:
    mesh = quad((-0.3, 0.8, -0.3), (0.6, 0, 0), (0, 0, 0.6), 1)
    return replace(
        mesh, lightmap_uv=(np.array([[0, 1], [1, 1], [1, 0], [0, 0]]) * 0.2 + [0.05, 0.72]).astype(np.float32)
    )


def turned_over(mesh: Mesh, other_diagonal: bool) -> Mesh:
    """The copy on the back, its chart where nothing else is."""
    faces = np.array([[1, 0, 3], [1, 3, 2]] if other_diagonal else [[0, 2, 1], [0, 3, 2]], np.int32)
    uv = np.array([[0.5, 0.9], [0.52, 0.9], [0.52, 0.88], [0.5, 0.88]], np.float32)
    return replace(mesh, faces=faces, normals=-mesh.normals, lightmap_uv=uv)


def irradiance(meshes: Sequence[Mesh], walls: Sequence[int], renderer: Callable[..., TileRenderer]) -> np.ndarray:
    """Of the texels [T, 3] of some meshes, in their order."""
    scene = part_sheets(Scene(tuple(meshes), MATERIALS), "cpu")
    texel_map = build_texel_map(scene, SIZE, "cpu")
    state = np.where(texel_map.state == TexelState.VALID, texel_map.mesh, -1)
    place = tuple(np.concatenate(parts) for parts in zip(*(np.nonzero(state == wall) for wall in walls), strict=True))
    render = renderer(scene, samples=1, irradiance_samples=1024).render(TexelBatch.of(texel_map, place))
    assert not render.enclosed.any()
    return render.irradiance


@pytest.mark.parametrize("order", ["earlier", "later", "one mesh", "other diagonal", "double-sided copy", "noise"])
def test_copies_on_the_back_change_nothing(order: str, quad: Quad, renderer: Callable[..., TileRenderer]) -> None:
    """Fault 06: an outer skin as earlier or later nodes, in the same mesh, cut otherwise, or a rounding error away."""
    walls = room(quad)
    copies = [turned_over(wall, order == "other diagonal") for wall in walls]
    if order == "double-sided copy":
        copies = [replace(copy, material=2) for copy in copies]
    if order == "noise":
        copies = [replace(copy, positions=np.nextafter(copy.positions, np.float32(9.0))) for copy in copies]
    wanted = irradiance([*walls, lamp(quad)], range(6), renderer)
    if order == "earlier":
        found = irradiance([*copies, *walls, lamp(quad)], range(6, 12), renderer)
    elif order == "one mesh":
        joined = [
            replace(
                a,
                positions=np.concatenate([b.positions, a.positions]),
                normals=np.concatenate([b.normals, a.normals]),
                faces=np.concatenate([b.faces, a.faces + 4]),
                uv=None,
                lightmap_uv=np.concatenate([b.lightmap_uv, a.lightmap_uv]),
            )
            for a, b in zip(walls, copies, strict=True)
        ]
        found = irradiance([*joined, lamp(quad)], range(6), renderer)
        at = [len(found) - len(wanted)]
        assert at[0] <= 6  # the copies' own tiny chart
        return np.testing.assert_allclose(np.median(found), np.median(wanted), rtol=0.03)
    else:
        found = irradiance([*walls, *copies, lamp(quad)], range(6), renderer)
    np.testing.assert_allclose(found, wanted, rtol=0.02, atol=0.01 * wanted.max())


def test_only_sheets_in_one_place_are_moved_and_hardly(quad: Quad) -> None:
    walls = room(quad)
    alone = Scene((*walls, lamp(quad)), MATERIALS)
    assert part_sheets(alone, "cpu") is alone
    doubled = replace(alone, meshes=(*alone.meshes, turned_over(walls[0], False)))
    parted = part_sheets(doubled, "cpu")
    shifts = [np.abs(a.positions - b.positions).max() for a, b in zip(parted.meshes, doubled.meshes, strict=True)]
    assert 0.0 < shifts[0] < 1e-4 and 0.0 < shifts[7] < 1e-4 and not any(shifts[1:7])
    assert any("back to back" in note for note in parted.notes)


@pytest.mark.parametrize("kind", ["mesh", "point", "spot"])
def test_a_room_turned_inside_out_is_told_of(kind: str, quad: Quad) -> None:
    """Fault 16."""
    light = PunctualLight("bulb", LightKind(kind if kind != "mesh" else "point"), (5.0, 5.0, 5.0), (0.0, 0.5, 0.0))

    def notes(inward: bool, material: int = 0) -> tuple[str, ...]:
        walls = room(quad, inward, material)
        meshes = [*walls, lamp(quad)] if kind == "mesh" else walls
        return lamp_notes(Scene(tuple(meshes), MATERIALS, lights=() if kind == "mesh" else (light,)), "cpu")

    (note,) = notes(inward=False)
    assert "Nothing in the scene is lit" in note and "backs of one-sided faces" in note and "double-sided" in note
    assert notes(inward=True) == () and notes(inward=False, material=2) == ()


@pytest.mark.parametrize("shared", [False, True])
def test_a_bent_sheet_of_two_faces_stays_in_one_piece(shared: bool) -> None:
    """A quarter of a pipe and its copy on the back in one mesh: each moves out of the other and none of it comes apart.

    With a vertex for each corner of a face, as after flat shading, and with vertices that both sides share.
    """
    columns, rows = 8, 5
    angle = np.linspace(0.0, np.pi / 2.0, columns)
    ring = np.stack([np.cos(angle), np.sin(angle), np.zeros(columns)], axis=1)
    points = (ring[None] + np.arange(rows)[:, None, None] * np.array([0.0, 0.0, 0.3])).reshape(-1, 3)
    corner = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)).reshape(-1)
    right, up = corner + 1, corner + columns
    outer = np.concatenate([np.stack([corner, right, up + 1], 1), np.stack([corner, up + 1, up], 1)])
    faces = np.concatenate([outer, outer[:, ::-1]])
    if not shared:
        points, faces = points[faces.reshape(-1)], np.arange(faces.size).reshape(-1, 3)
    normals = np.tile(np.float32([1.0, 0.0, 0.0]), (len(points), 1))
    sheet = Mesh("pipe", points.astype(np.float32), normals, faces.astype(np.int32), 0)
    (moved,) = part_sheets(Scene((sheet,), MATERIALS), "cpu").meshes
    assert len(moved.faces) == len(faces)
    places = [moved.positions[part].reshape(-1, 3) for part in np.split(moved.faces, 2)]
    assert [len(np.unique(place, axis=0)) for place in places] == [columns * rows] * 2
    outside, inside = (np.linalg.norm(place[:, :2], axis=1) for place in places)
    assert outside.min() > 1.0 > inside.max() and outside.max() - inside.min() < 1e-4
