"""A mesh made fit for use: vertices that are one merged, triangles wound outwards."""

from __future__ import annotations

from typing import Any

import numpy as np

from bimfit.geometry.pose import Array

_WELD = 1e-6
_FLAT = 1e-4
"""Volume over area to the power 3/2 below which a surface is a sheet, with no inside."""


def welded(vertices: Array, faces: Any) -> tuple[Any, Any]:
    """Merge vertices within 1 um and drop faces that collapse: (kept vertex indices, faces)."""
    keys = np.rint(vertices / _WELD).astype(np.int64)
    order = np.lexsort(keys.T)
    new = np.any(np.diff(keys[order], axis=0, prepend=keys[order][:1] - 1) != 0, axis=1)
    group = np.empty(len(keys), np.int64)
    group[order] = np.cumsum(new) - 1
    corners = group[faces]
    a, b, c = corners.T
    corners = corners[(a != b) & (b != c) & (c != a)]
    return order[new], corners


def wound_outwards(vertices: Array, faces: Any) -> Any:
    """Turn triangles so that their surface looks outwards, counter-clockwise.

    Connected triangles are first made to agree across the edges that two of them share. Each connected
    surface is then turned so that it encloses a positive volume, about its own middle where it is open. A
    surface inside another one may be its void and a sheet has no inside: they stay as most of them are.

    Parameters
    ----------
    vertices : ndarray, shape (n, 3)
        About some middle, m: map coordinates would drown the volume.
    faces : ndarray of int, shape (m, 3)

    Returns
    -------
    ndarray of int, shape (m, 3)
    """
    directed = faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    edges = np.sort(directed, axis=1)
    keys = edges[:, 0] * np.int64(len(vertices)) + edges[:, 1]
    order = np.argsort(keys, kind="stable")
    counts = np.unique(keys, return_counts=True)[1]
    heads = np.cumsum(counts) - counts
    pairs = heads[counts == 2]
    one, two = order[pairs], order[pairs + 1]
    agree = directed[one, 0] != directed[two, 0]
    closed = bool(np.all(counts == 2) and agree.all())
    if closed and float(_volumes(vertices, faces).sum()) >= 0.0:
        return faces
    turn, surface = _agreeing(len(faces), one // 3, two // 3, agree)
    out = np.where(turn[:, None], faces[:, ::-1], faces)
    for chosen in _surfaces(surface):
        if _is_inside_out(vertices, out[chosen], turn[chosen], _lies_within(vertices, faces, chosen)):
            out[chosen] = out[chosen][:, ::-1]
    return out


def _agreeing(count: int, a: Any, b: Any, agree: Any) -> tuple[Any, Any]:
    """Which of ``count`` triangles to turn, so that neighbours a and b agree, and each one's surface.

    Every triangle has two nodes, as it is and turned; neighbours tie their nodes so that they agree. The
    lower-numbered sheet of a surface is kept. Where both are one (a band with a twist) nothing is turned.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    other = np.where(agree, b, b + count)
    rows, columns = np.concatenate([a, a + count]), np.concatenate([other, (other + count) % (2 * count)])
    graph = coo_array((np.ones(len(rows), np.int8), (rows, columns)), shape=(2 * count, 2 * count))
    label = connected_components(graph, directed=False)[1]
    return label[:count] > label[count:], np.minimum(label[:count], label[count:])


def _surfaces(surface: Any) -> list[Any]:
    order = np.argsort(surface, kind="stable")
    return np.split(order, np.flatnonzero(np.diff(surface[order])) + 1)


def _is_inside_out(vertices: Array, faces: Any, turned: Any, within: bool) -> bool:
    corners = vertices[faces]
    corners = corners - corners.mean(axis=(0, 1))
    vector = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = 0.5 * np.linalg.norm(vector, axis=1)
    volume = float(np.einsum("ij,ij->", corners[:, 0], vector)) / 6.0
    if within or abs(volume) < _FLAT * float(area.sum()) ** 1.5:
        return float(area[turned].sum()) > float(area[~turned].sum())
    return volume < 0.0


def _lies_within(vertices: Array, faces: Any, chosen: Any) -> bool:
    """Whether a surface lies in the box of the rest of the mesh."""
    rest = np.ones(len(faces), bool)
    rest[chosen] = False
    if not rest.any():
        return False
    mine, others = vertices[faces[chosen]].reshape(-1, 3), vertices[faces[rest]].reshape(-1, 3)
    return bool(
        np.all(mine.min(axis=0) > others.min(axis=0)) and np.all(mine.max(axis=0) < others.max(axis=0))
    )


def _volumes(vertices: Array, faces: Any) -> Array:
    a, b, c = vertices[faces].transpose(1, 0, 2)
    return np.asarray(np.einsum("ij,ij->i", a, np.cross(b, c)))
