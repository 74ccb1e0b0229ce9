"""Closed rooms of many shapes, each flat wall with a light-map chart of its own at an odd place and angle."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from kiln_workers.scene.model import Material, Mesh, Scene

Floats = npt.NDArray[np.float64]
Polygon = Sequence[int]

WALL = Material("wall", (0.8, 0.8, 0.8, 1.0))


@dataclass(frozen=True)
class Room:
    """A solid's corners and its convex faces, counter-clockwise seen from within."""

    corners: Floats  # [V, 3]
    walls: tuple[Polygon, ...]


def box(size: tuple[float, float, float] = (4.0, 2.5, 3.2)) -> Room:
    return prism([(-0.5, -0.5), (0.5, -0.5), (0.5, 0.5), (-0.5, 0.5)], size)


def prism(outline: Sequence[tuple[float, float]], size: tuple[float, float, float] = (4.0, 2.5, 3.2)) -> Room:
    """A convex outline (x, z), counter-clockwise in x and z, from floor to ceiling."""
    count = len(outline)
    flat = np.array([(x, 0.0, z) for x, z in outline])
    corners = np.concatenate([flat, flat + np.array([0.0, 1.0, 0.0])]) * size
    walls = [tuple(range(count)), tuple(range(2 * count - 1, count - 1, -1))]
    walls += [(i, i + count, (i + 1) % count + count, (i + 1) % count) for i in range(count)]
    return inward(corners, walls)


def polygon(sides: int) -> Room:
    angle = 2.0 * np.pi * (np.arange(sides) + 0.3) / sides
    return prism(list(zip(0.5 * np.cos(angle), 0.5 * np.sin(angle), strict=True)))


def tetrahedron() -> Room:
    corners = np.array([(1.0, 1, 1), (1, -1, -1), (-1, 1, -1), (-1, -1, 1)]) * 1.7
    return inward(corners, [(0, 1, 2), (0, 1, 3), (0, 2, 3), (1, 2, 3)])


def octahedron() -> Room:
    corners = np.concatenate([np.eye(3), -np.eye(3)]) * [2.0, 1.3, 1.7]
    walls = [(a, b, c) for a in (0, 3) for b in (1, 4) for c in (2, 5)]
    return inward(corners, walls)


def wedge() -> Room:
    """A thin wedge: two walls meet at 8 degrees."""
    return prism([(0.0, 0.0), (1.0, -0.07), (1.0, 0.07)])


def inward(corners: Floats, walls: Sequence[Polygon]) -> Room:
    """Every wall turned so that it faces the middle of the corners."""
    middle = corners.mean(axis=0)
    turned = []
    for wall in walls:
        a, b, c = corners[list(wall[:3])]
        facing = np.dot(np.cross(b - a, c - a), middle - a) > 0.0
        turned.append(tuple(wall) if facing else tuple(wall[::-1]))
    return Room(corners, tuple(turned))


def rotated(room: Room, seed: int) -> Room:
    """The room turned at random and moved off the origin."""
    rng = np.random.default_rng(seed)
    turn, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    turn *= np.sign(np.linalg.det(turn))
    return Room(room.corners @ turn.T + rng.uniform(-3.0, 3.0, 3), room.walls)


def sliced(room: Room, width: float) -> Room:
    """A strip of the given width cut off along the first edge of each wall, as triangles."""
    corners = [tuple(corner) for corner in room.corners]
    walls: list[Polygon] = []
    for wall in room.walls:
        points = [np.asarray(corners[i]) for i in wall]
        into = [(points[-1] - points[0]), (points[2] - points[1])]
        ends = [points[k] + width * into[k] / np.linalg.norm(into[k]) for k in (0, 1)]
        first = len(corners)
        corners += [tuple(end) for end in ends]
        walls += [(wall[0], wall[1], first + 1), (wall[0], first + 1, first), (first, first + 1, *wall[2:])]
    return Room(np.array(corners), tuple(walls))


def closed_scene(
    room: Room, seed: int = 0, resolution: int = 64, material: Material = WALL, one_mesh: bool = False
) -> Scene:
    """The room's walls; their charts lie in a grid of cells, each turned and moved at random within its own."""
    rng = np.random.default_rng(seed)
    planes = _planes(room)
    across = int(np.ceil(np.sqrt(len(planes))))
    cell = resolution / across
    meshes = []
    for number, walls in enumerate(planes):
        points, uv, faces = _chart(room, walls)
        angle = rng.uniform(0.0, 2.0 * np.pi) if number % 2 else 0.0
        cosine, sine = np.cos(angle), np.sin(angle)
        uv = uv @ np.array([[cosine, sine], [-sine, cosine]])
        uv -= uv.min(axis=0)
        scale = (cell - 4.0) / uv.max()
        origin = np.array([number % across, number // across]) * cell + rng.uniform(1.0, 2.0, 2)
        normal = np.cross(points[faces[0][1]] - points[faces[0][0]], points[faces[0][2]] - points[faces[0][0]])
        meshes.append(
            Mesh(
                name=f"wall {number}",
                positions=points.astype(np.float32),
                normals=np.repeat(normal[None] / np.linalg.norm(normal), len(points), axis=0).astype(np.float32),
                faces=np.array(faces, np.int32),
                material=0,
                lightmap_uv=((uv * scale + origin) / resolution).astype(np.float32),
            )
        )
    return Scene((_joined(meshes),) if one_mesh else tuple(meshes), (material,))


def _planes(room: Room) -> list[list[Polygon]]:
    """Walls by the plane that they lie in."""
    groups: dict[tuple[float, ...], list[Polygon]] = {}
    for wall in room.walls:
        a, b, c = room.corners[list(wall[-3:])]
        normal = np.cross(b - a, c - a)
        normal /= np.linalg.norm(normal)
        groups.setdefault(tuple(np.round([*normal, normal @ a], 5) + 0.0), []).append(wall)
    return list(groups.values())


def _chart(room: Room, walls: Sequence[Polygon]) -> tuple[Floats, Floats, list[tuple[int, int, int]]]:
    """Corners of a plane's walls, their coordinates in the plane [V, 2] in metres, and triangles."""
    used = sorted({index for wall in walls for index in wall})
    points = room.corners[used]
    a, b, c = room.corners[list(walls[-1][-3:])]
    normal = np.cross(b - a, c - a)
    x = (b - a) / np.linalg.norm(b - a)
    y = np.cross(normal / np.linalg.norm(normal), x)
    faces = [
        (used.index(wall[0]), used.index(wall[k]), used.index(wall[k + 1]))
        for wall in walls
        for k in range(1, len(wall) - 1)
    ]
    return points, np.stack([points @ x, points @ y], axis=1), faces


def _joined(meshes: Sequence[Mesh]) -> Mesh:
    offsets = np.cumsum([0] + [len(mesh.positions) for mesh in meshes])
    return Mesh(
        name="room",
        positions=np.concatenate([mesh.positions for mesh in meshes]),
        normals=np.concatenate([mesh.normals for mesh in meshes]),
        faces=np.concatenate([m.faces + o for m, o in zip(meshes, offsets, strict=False)]).astype(np.int32),
        material=0,
        lightmap_uv=np.concatenate([mesh.lightmap_uv for mesh in meshes if mesh.lightmap_uv is not None]),
    )
