"""Which corners of a mesh are one vertex of its surface: welded by position, parted where more than two faces meet.

Exporters split vertices at creases and texture seams, so an unwrapper that goes by vertex numbers sees a heap of loose
pieces. Modellers also put sheets back to back, or let three walls meet at an edge: there a surface is the faces that
continue each other best. Faces are joined over an edge if they run along it in opposite directions (the same side is
outward); among several such pairs those with the most similar normals are joined first.
"""

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from kiln_workers.scene.geometry import Floats, Ints, face_normals


def surface_corners(positions: Floats, faces: Ints, least: float = -2.0) -> Ints:
    """Number of the surface vertex [F, 3] at each corner, 0 ... n-1, for positions [V, 3] and faces [F, 3].

    Faces whose normals have a smaller cosine than `least` do not continue each other.
    """
    welded = np.unique(positions + 0.0, axis=0, return_inverse=True)[1].reshape(-1)[faces]
    start, end = welded.reshape(-1), welded[:, [1, 2, 0]].reshape(-1)
    low, high = np.minimum(start, end), np.maximum(start, end)
    order = np.lexsort((np.arange(len(start)), high, low))
    fresh = np.diff(low[order], prepend=-1).astype(bool) | np.diff(high[order], prepend=-1).astype(bool)
    first = np.flatnonzero(fresh)
    count = np.diff(first, append=len(order))

    two = first[count == 2]
    pairs = np.stack([order[two], order[two + 1]], axis=1)
    pairs = pairs[start[pairs[:, 0]] == end[pairs[:, 1]]]
    normals = face_normals(positions, faces)
    more = [
        pair
        for begin, number in zip(first[count > 2], count[count > 2], strict=True)
        for pair in _best_pairs(order[begin : begin + number], start, normals)
    ]
    joined = np.concatenate([pairs, np.array(more, dtype=np.int64).reshape(-1, 2)])
    joined = joined[np.einsum("pc,pc->p", normals[joined[:, 0] // 3], normals[joined[:, 1] // 3]) >= least]
    # Half-edge h runs from corner h to the next corner of its face; its partner runs the other way.
    following = np.arange(len(start)).reshape(-1, 3)[:, [1, 2, 0]].reshape(-1)
    a, b = joined[:, 0], joined[:, 1]
    one, other = np.concatenate([a, following[a]]), np.concatenate([following[b], b])
    graph = coo_array((np.ones(len(one), np.int8), (one, other)), shape=(len(start), len(start)))
    return np.asarray(connected_components(graph, directed=False)[1].reshape(-1, 3), dtype=np.int64)


def _best_pairs(edges: Ints, start: Ints, normals: Floats) -> list[tuple[int, int]]:
    """Disjoint pairs of half-edges that run in opposite directions, the most similar normals first."""
    forward = edges[start[edges] == start[edges[0]]]
    backward = edges[start[edges] != start[edges[0]]]
    likeness = normals[forward // 3] @ normals[backward // 3].T
    out: list[tuple[int, int]] = []
    for index in np.argsort(-likeness, axis=None, kind="stable"):
        i, j = divmod(int(index), len(backward))
        if likeness[i, j] > -2.0:
            out.append((int(forward[i]), int(backward[j])))
            likeness[i, :] = likeness[:, j] = -3.0
    return out
