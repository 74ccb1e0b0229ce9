"""From a reader's raw vertices and faces to a `Mesh` in world space: checks, transform, winding, normals, clean-up.

Every reader ends here, so that what counts as a bad vertex, a degenerate face or a missing normal is decided once.
Rules: positions must be finite; a transform of negative determinant flips the winding, so that the outward side stays
outward (glTF 2.0, 3.7.4); missing normals become flat ones, for which vertices are split (glTF 2.0, 3.7.2.1);
degenerate faces are dropped with a note.
"""

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from kiln_schemas.errors import InputError
from kiln_schemas.text import told
from kiln_workers.scene.limits import MAX_COORDINATE, MAX_MESHES, MAX_TRIANGLES, NAME_LENGTH, check_count
from kiln_workers.scene.model import Float32, Mesh

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]

SLIVER = 1e-7
"""A face whose height is below this part of its longest edge is degenerate (float32 cannot tell its plane)."""


@dataclass(frozen=True)
class RawMesh:
    """A primitive as a file gives it, in its own space."""

    name: str
    positions: Floats  # [V, 3]
    faces: Ints  # [F, 3]
    material: int
    normals: Floats | None = None  # [V, 3], any length
    uv: Floats | None = None  # [V, 2], v downwards
    lightmap_uv: Floats | None = None  # [V, 2]
    more_uv: tuple[Floats, ...] = ()  # [V, 2] each
    colors: Floats | None = None  # [V, 4] linear RGBA
    tangents: Floats | None = None  # [V, 4] as glTF's TANGENT


def placed_meshes(instances: Iterable[tuple[RawMesh, Floats]]) -> tuple[tuple[Mesh, ...], list[str]]:
    """The meshes of a scene's instances, each with its transform (`place`), under names of their own; and notes."""
    pairs = list(instances)
    meshes: list[Mesh] = []
    notes: list[str] = []
    for name, (raw, transform) in zip(unique_names(raw.name for raw, _ in pairs), pairs, strict=True):
        mesh, more = place(replace(raw, name=name), transform)
        notes += more
        meshes += [mesh] if mesh is not None else []
    return tuple(meshes), notes


def place(raw: RawMesh, transform: Floats | None = None) -> tuple[Mesh | None, list[str]]:
    """The mesh in world space under a 4 x 4 transform (column vectors), None if no face is left, and notes.

    Its positions are float64 still: `origin.about_own_centre` makes them float32 when the whole scene is known.
    """
    _check(raw)
    notes: list[str] = []
    matrix = np.eye(4) if transform is None else np.asarray(transform, dtype=np.float64)
    if not np.isfinite(matrix).all():
        raise InputError("its transform is not finite", where=_where(raw), remedy="Mend the node's transform.")
    linear = matrix[:3, :3]
    with np.errstate(over="ignore", invalid="ignore"):
        placed = raw.positions @ linear.T + matrix[:3, 3]
        _check_rows(np.abs(placed).max(axis=1, initial=0.0) <= MAX_COORDINATE, raw, f"is beyond {MAX_COORDINATE:g} m")
    positions: Floats = placed
    mirrored = bool(np.linalg.det(linear) < 0.0)
    faces = raw.faces[:, ::-1] if mirrored else raw.faces

    keep = sound_faces(positions, faces)
    dropped = len(faces) - int(keep.sum())
    if dropped:
        notes.append(f"Mesh '{raw.name}': {dropped} degenerate face{'s' if dropped > 1 else ''} dropped.")
    if dropped == len(faces):
        return None, notes
    faces = faces[keep]
    used, compact = np.unique(faces, return_inverse=True)
    faces = compact.reshape(-1, 3)
    if raw.normals is None:
        used, faces = used[faces.reshape(-1)], np.arange(faces.size).reshape(-1, 3)
        positions = positions[used]
        normals = np.repeat(face_normals(positions, faces), 3, axis=0)
    else:
        positions = positions[used]
        normals, mended = _transformed_normals(raw.normals[used], linear, positions, faces)
        if mended:
            notes.append(f"Mesh '{raw.name}': {mended} unusable vertex normals replaced by those of its faces.")
    mesh = Mesh(
        name=raw.name,
        positions=np.ascontiguousarray(positions),  # float32 only about the scene's centre
        normals=normals.astype(np.float32),
        faces=faces.astype(np.int32),
        material=raw.material,
        uv=_picked(raw.uv, used),
        lightmap_uv=_picked(raw.lightmap_uv, used),
        more_uv=tuple(values[used].astype(np.float32) for values in raw.more_uv),
        colors=_picked(raw.colors, used),
        tangents=None
        if raw.tangents is None or raw.normals is None
        else _transformed_tangents(raw.tangents[used], linear),
    )
    return mesh, notes


def check_triangle_count(count: int, where: str) -> None:
    """Raise TooLarge beyond the bound; readers call it before they make copies."""
    check_count(count, MAX_TRIANGLES, "triangles with all its instances", where)


def check_mesh_count(count: int, where: str) -> None:
    """The same for the objects."""
    check_count(count, MAX_MESHES, "objects with all its instances", where, "Join objects that share a material.")


def unit(vectors: Floats) -> Floats:
    """Vectors [..., 3] at unit length; zero stays zero."""
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.asarray(np.divide(vectors, length, out=np.zeros_like(vectors), where=length > 0.0))


def face_normals(positions: npt.NDArray[np.float32] | Floats, faces: npt.NDArray[np.integer]) -> Floats:
    """Unit geometric normals [F, 3], counter-clockwise outward; zero where a face has no area."""
    return unit(_double_areas(np.asarray(positions, dtype=np.float64), faces))


def face_areas(positions: npt.NDArray[np.float32] | Floats, faces: npt.NDArray[np.integer]) -> Floats:
    """World areas [F] in square metres."""
    cross = _double_areas(np.asarray(positions, dtype=np.float64), faces)
    return np.asarray(0.5 * np.linalg.norm(cross, axis=1))


def corner_angles(corners: Floats) -> Floats:
    """Angle [F, 3] at each corner of triangles [F, 3, 3]; a right one at a side of no length."""
    ahead = unit(np.roll(corners, -1, axis=1) - corners)
    behind = unit(np.roll(corners, 1, axis=1) - corners)
    return np.asarray(np.arccos(np.clip(np.einsum("fcd,fcd->fc", ahead, behind), -1.0, 1.0)))


def smooth_normals(positions: Floats, faces: npt.NDArray[np.integer]) -> Floats:
    """Area-weighted unit vertex normals [V, 3]; zero at vertices that no face uses."""
    total = np.zeros((len(positions), 3))
    cross = _double_areas(positions, faces)
    for corner in range(3):
        np.add.at(total, faces[:, corner], cross)
    return unit(total)


def unique_names(names: Iterable[str]) -> list[str]:
    """The names in order, shortened, repeated ones with ` (2)`, ` (3)`, ... appended."""
    seen: dict[str, int] = {}
    out = []
    for name in (told(name, NAME_LENGTH) for name in names):
        seen[name] = seen.get(name, 0) + 1
        out.append(name if seen[name] == 1 else f"{name} ({seen[name]})")
    return out


def _double_areas(positions: Floats, faces: npt.NDArray[np.integer]) -> Floats:
    a, b, c = (positions[faces[:, corner]] for corner in range(3))
    return np.asarray(np.cross(b - a, c - a))


def sound_faces(positions: Floats, faces: Ints) -> npt.NDArray[np.bool_]:
    """Which faces [F] are no slivers (see `SLIVER`)."""
    corners = positions[faces]  # [F, 3, 3]
    longest = (np.diff(corners[:, [0, 1, 2, 0]], axis=1) ** 2).sum(axis=2).max(axis=1)
    cross = np.linalg.norm(_double_areas(positions, faces), axis=1)
    return np.asarray(cross > SLIVER * longest)


def _transformed_normals(normals: Floats, linear: Floats, positions: Floats, faces: Ints) -> tuple[Floats, int]:
    # The cofactor matrix is det(M) M^-T and exists for singular M too; its sign is taken out for mirrors.
    a, b, c = linear[:, 0], linear[:, 1], linear[:, 2]
    cofactor = np.stack([np.cross(b, c), np.cross(c, a), np.cross(a, b)], axis=1)
    sign = -1.0 if np.linalg.det(linear) < 0.0 else 1.0
    bad = np.asarray(~np.isfinite(normals).all(axis=1))
    world = np.where(bad[:, None], 0.0, normals) @ (sign * cofactor).T
    length = np.linalg.norm(world, axis=1, keepdims=True)
    bad |= length[:, 0] <= 1e-30
    world = world / np.where(length > 1e-30, length, 1.0)
    if bad.any():
        world[bad] = smooth_normals(positions, faces)[bad]
    return world, int(bad.sum())


def _transformed_tangents(tangents: Floats, linear: Floats) -> Float32:
    """Tangents [V, 4] go with the surface; a mirror turns the handedness over. Those of no length become 0."""
    world = np.where(np.isfinite(tangents[:, :3]), tangents[:, :3], 0.0) @ linear.T
    length = np.linalg.norm(world, axis=1, keepdims=True)
    world = world / np.where(length > 1e-30, length, 1.0)
    hand = np.where(tangents[:, 3:] < 0.0, -1.0, 1.0) * (-1.0 if np.linalg.det(linear) < 0.0 else 1.0)
    return np.concatenate([world, hand], axis=1).astype(np.float32)


def _check(raw: RawMesh) -> None:
    _check_rows(np.isfinite(raw.positions).all(axis=1), raw, "is not a finite number")
    if len(raw.faces) and (raw.faces.min() < 0 or raw.faces.max() >= len(raw.positions)):
        outside = (raw.faces < 0) | (raw.faces >= len(raw.positions))
        face = int(np.argmax(outside.any(axis=1)))
        raise InputError(
            f"face {face} names vertex {raw.faces[face][outside[face]][0]}, but there are {len(raw.positions)}",
            where=_where(raw),
            remedy="Export the mesh again.",
        )
    attributes = [("UV", uv) for uv in (raw.uv, *raw.more_uv)] + [
        ("light-map UV", raw.lightmap_uv),
        ("colour", raw.colors),
    ]
    for label, values in attributes:
        if values is not None and not np.isfinite(values).all():
            vertex = int(np.argmax(~np.isfinite(values).all(axis=1)))
            raise InputError(f"the {label} of vertex {vertex} is not a finite number", where=_where(raw))


def _check_rows(good: npt.ArrayLike, raw: RawMesh, what: str) -> None:
    if not np.all(good):
        vertex = int(np.argmin(good))
        raise InputError(
            f"the position of vertex {vertex} {what} ({', '.join(str(x) for x in raw.positions[vertex])})",
            where=_where(raw),
            remedy="Mend the mesh.",
        )


def _picked(values: Floats | None, rows: Ints) -> Float32 | None:
    return None if values is None else values[rows].astype(np.float32)


def _where(raw: RawMesh) -> str:
    return f"mesh '{raw.name}'"
