"""Loops from the segments of a mesh that is not a clean solid."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from bimfit.geometry.pose import Array

SNAP = 20e-6
"""Ends of segments this near to one another meet, m."""
_GRID = 1e-7
_STRAIGHT_ON = float(np.cos(np.radians(1.0)))

Ids = NDArray[np.int64]


def unique_within(points: Array, tolerance: float) -> Ids:
    """For each point (n, d), the index of the point that stands for its cluster.

    Points within ``tolerance`` of one another, directly or in a chain, are one cluster; its first point
    stands for it.
    """
    from scipy.spatial import cKDTree

    ids = np.arange(len(points), dtype=np.int64)
    whole = np.flatnonzero(np.isfinite(points).all(axis=1))
    if len(whole) < 2:
        return ids
    pairs = whole[cKDTree(points[whole]).query_pairs(tolerance, output_type="ndarray")]
    while len(pairs):
        before = ids.copy()
        least = np.minimum(ids[pairs[:, 0]], ids[pairs[:, 1]])
        np.minimum.at(ids, pairs[:, 0], least)
        np.minimum.at(ids, pairs[:, 1], least)
        ids = ids[ids]
        if np.array_equal(ids, before):
            break
    return ids


def heal(segments: Array) -> tuple[list[Array], Array, NDArray[np.bool_]]:
    """Close, node and sort segments into areas.

    Ends within 20 um meet. Dangling ends are paired, the nearest first, and joined by straight closings;
    what the segments then enclose is material where it lies inside an odd number of outlines or, by the vote
    of the segments' directions, inside two overlapping bodies (winding number of 2).

    Parameters
    ----------
    segments : ndarray, shape (k, 2, 2)
        Directed, material to the left where the mesh is wound as it should be.

    Returns
    -------
    loops : list of ndarray
        Outer loops counter-clockwise, holes clockwise.
    closings : ndarray, shape (m, 2, 2)
        The segments that were made up.
    doubtful : ndarray of bool, shape (m,)
        Which of them go their own way. The others run straight on from a segment that is there, as where a
        triangle of a flat face is missing, and may be taken for surface.
    """
    import shapely

    points, ends = _snapped(segments)
    if not len(ends):
        return [], np.zeros((0, 2, 2)), np.zeros(0, bool)
    made_up = _closings(points, ends)
    doubtful = np.array([not _runs_on(points, ends, pair) for pair in made_up], bool)
    ends = np.concatenate([ends, made_up])
    whole = points[ends]
    noded = shapely.union_all(shapely.linestrings(whole), grid_size=_GRID)
    areas = shapely.get_parts(shapely.polygonize([noded]))
    if not len(areas):
        return [], points[made_up], doubtful
    inside = _material(shapely.get_coordinates(shapely.point_on_surface(areas)), whole)
    # on the same grid, so that neighbours share their border exactly
    merged = shapely.union_all(areas[inside], grid_size=_GRID)
    loops = []
    for part in shapely.get_parts(shapely.orient_polygons(merged)):
        loops += [np.asarray(ring.coords)[:-1] for ring in (part.exterior, *part.interiors)]
    return loops, points[made_up], doubtful


def _snapped(segments: Array) -> tuple[Array, Ids]:
    """Points (n, 2) and the segments between them (k, 2), snapped, split where an end lies on them."""
    points = segments.reshape(-1, 2)
    ends = unique_within(points, SNAP)[np.arange(len(points))].reshape(-1, 2)
    ends = _distinct(ends)
    loose = _odd(ends)
    if len(loose) and len(ends):
        ends = _distinct(_split(points, ends, loose))
    return points, ends


def _distinct(ends: Ids) -> Ids:
    """Without segments of no length and without repeats of the same direction."""
    ends = ends[ends[:, 0] != ends[:, 1]]
    return np.asarray(np.unique(ends, axis=0), np.int64)


def _odd(ends: Ids) -> Ids:
    """Points where an odd number of segments ends."""
    # A segment that is there both ways counts twice: it is a border of two touching bodies, or a sheet.
    names, count = np.unique(ends, return_counts=True)
    return np.asarray(names[count % 2 == 1], np.int64)


def _split(points: Array, ends: Ids, loose: Ids) -> Ids:
    """Split segments on whose inside a loose end lies."""
    start = points[ends[:, 0]]
    along = points[ends[:, 1]] - start
    size = np.maximum(np.linalg.norm(along, axis=1), 1e-300)
    offset = points[loose][:, None] - start[None]
    where = np.einsum("ijk,jk->ij", offset, along) / size
    aside = np.abs(offset[..., 0] * along[:, 1] - offset[..., 1] * along[:, 0]) / size
    on = (aside < SNAP) & (where > SNAP) & (where < size - SNAP)
    out = [tuple(pair) for pair in ends[~on.any(axis=0)]]
    for k in np.flatnonzero(on.any(axis=0)):
        stops = loose[on[:, k]][np.argsort(where[on[:, k], k])]
        chain = [ends[k, 0], *stops, ends[k, 1]]
        out += list(pairwise(chain))
    return np.array(out, np.int64).reshape(-1, 2)


def _closings(points: Array, ends: Ids) -> Ids:
    """Pairs of dangling ends, nearest first, shape (m, 2)."""
    loose = _odd(ends)
    if len(loose) < 2:
        return np.zeros((0, 2), np.int64)
    place = points[loose]
    first, second = np.triu_indices(len(loose), 1)
    distance = np.linalg.norm(place[first] - place[second], axis=1)
    free = np.ones(len(loose), bool)
    out = []
    for k in np.argsort(distance, kind="stable"):
        i, j = first[k], second[k]
        if free[i] and free[j]:
            free[[i, j]] = False
            out.append((loose[i], loose[j]))
    return np.array(out, np.int64).reshape(-1, 2)


def _runs_on(points: Array, ends: Ids, pair: Ids) -> bool:
    """Whether a closing continues, at either of its ends, a segment that ends there."""
    for here, there in (pair, pair[::-1]):
        ahead = points[there] - points[here]
        others = np.concatenate([ends[ends[:, 1] == here, 0], ends[ends[:, 0] == here, 1]])
        behind = points[here] - points[others]
        cosine = behind @ ahead / (np.linalg.norm(behind, axis=1) * np.linalg.norm(ahead) + 1e-300)
        if np.any(cosine > _STRAIGHT_ON):
            return True
    return False


def _material(places: Array, segments: Array) -> NDArray[np.bool_]:
    """Which places (n, 2) lie in material, by parity and by the winding number."""
    x, y = places[:, 0, None], places[:, 1, None]
    (x0, y0), (x1, y1) = segments[:, 0].T, segments[:, 1].T
    # half-open, so that a vertex at the height of the place counts once
    spans = (y0 > y) != (y1 > y)
    rise = np.where(y1 == y0, 1.0, y1 - y0)
    right = spans & (x0 + (x1 - x0) * (y - y0) / rise > x)
    odd = right.sum(axis=1) % 2 == 1
    a0 = np.arctan2(y0 - y, x0 - x)
    turn = np.arctan2(y1 - y, x1 - x) - a0
    turn = np.mod(turn + np.pi, 2.0 * np.pi) - np.pi
    winding = turn.sum(axis=1) / (2.0 * np.pi)
    area = 0.5 * float(np.sum(x0 * y1 - x1 * y0))
    if area < 0.0:  # the whole mesh is inside out
        winding = -winding
    return np.asarray(odd | (winding > 1.5), np.bool_)
