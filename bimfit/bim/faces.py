"""First stage of the joint finder: the plane faces of every element."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from bimfit.geometry.mesh import TriangleMesh
from bimfit.geometry.pose import Array

Index = NDArray[np.int64]

_NORMAL_BIN = 2e-3
_OFFSET_BIN = 4e-4
_SLIVER = 2e-5


@dataclass(frozen=True)
class Faces:
    """Plane faces of many elements, with all their triangles.

    Attributes
    ----------
    origin : ndarray, shape (3,)
        What was subtracted from world coordinates, m.
    triangles : ndarray, shape (m, 3, 3)
    owner : ndarray, shape (m,)
        Element of each triangle.
    starts : ndarray, shape (elements + 1,)
        Where each element's triangles start in ``triangles``.
    element, normal, offset, low, high, area
        Of each face: element, outward unit normal, plane offset (n . p), bounding box, m^2.
    plates, corners : ndarray, shapes (p, 4, 3) and (p,)
        Convex pieces of the faces, of 3 or 4 corners; of three, the last is repeated.
    splits : ndarray
        Plates of face i are ``splits[i]:splits[i + 1]``.
    face_of : ndarray, shape (m,)
        Face of each triangle, or -1.
    """

    origin: Array
    triangles: Array
    owner: Index
    starts: Index
    element: Index
    normal: Array
    offset: Array
    low: Array
    high: Array
    area: Array
    plates: Array
    corners: Index
    splits: Index
    face_of: Index

    @cached_property
    def plate_low(self) -> Array:
        """Least corners of the plates, shape (p, 3)."""
        return least(self.plates)

    @cached_property
    def plate_high(self) -> Array:
        """Greatest corners of the plates, shape (p, 3)."""
        return greatest(self.plates)

    @cached_property
    def triangle_low(self) -> Array:
        """Least corners of the triangles, shape (m, 3)."""
        return least(self.triangles)

    @cached_property
    def triangle_high(self) -> Array:
        """Greatest corners of the triangles, shape (m, 3)."""
        return greatest(self.triangles)


def find_faces(meshes: Sequence[TriangleMesh], *, min_area: float, min_diagonal: float) -> Faces:
    """Group each element's triangles into plane faces.

    Triangles of one element belong to one face when their planes agree; a surface's facets remain apart.

    Parameters
    ----------
    meshes : sequence of TriangleMesh
    min_area, min_diagonal : float
        Faces below these are dropped, m^2 and m.
    """
    counts = np.array([len(mesh.faces) for mesh in meshes], np.int64)
    starts = np.concatenate([[0], np.cumsum(counts)])
    boxes = np.stack([mesh.bounds for mesh in meshes])
    origin = 0.5 * (boxes[:, 0].min(axis=0) + boxes[:, 1].max(axis=0))
    triangles = np.concatenate([(mesh.vertices - origin)[mesh.faces] for mesh in meshes])
    owner = np.repeat(np.arange(len(meshes)), counts)
    vector = 0.5 * cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    area = np.linalg.norm(vector, axis=1)
    longest = np.linalg.norm(triangles - np.roll(triangles, 1, axis=1), axis=2).max(axis=1)
    sound = np.flatnonzero(2.0 * area > _SLIVER * longest)
    normal = vector[sound] / np.maximum(area[sound, None], 1e-300)
    centre = 0.5 * (boxes[:, 0] + boxes[:, 1]) - origin
    local = np.einsum("ij,ij->i", normal, triangles[sound, 0] - centre[owner[sound]])
    label = _agreeing(owner[sound], normal, local)
    order = np.argsort(label, kind="stable")
    members, label = sound[order], label[order]
    heads = np.flatnonzero(np.diff(label, prepend=-1))
    splits = np.append(heads, len(members))
    corners = triangles[members]
    low = np.minimum.reduceat(least(corners), heads)
    high = np.maximum.reduceat(greatest(corners), heads)
    total = np.add.reduceat(area[members], heads)
    keep = (total >= min_area) & (np.linalg.norm(high - low, axis=1) >= min_diagonal)
    summed = np.add.reduceat(vector[members], heads)[keep]
    unit = summed / np.linalg.norm(summed, axis=1, keepdims=True)
    weighted = np.add.reduceat(corners.mean(axis=1) * area[members, None], heads)[keep] / total[keep, None]
    sizes = np.diff(splits)[keep]
    kept = members[ranges(splits[:-1][keep], sizes)]
    face_of = np.full(len(triangles), -1, np.int64)
    face_of[kept] = np.repeat(np.arange(len(sizes)), sizes)
    plates, corner_count, plate_counts = _plates(triangles[kept], sizes, unit)
    return Faces(
        origin=origin,
        triangles=triangles,
        owner=owner,
        starts=starts,
        element=owner[members[heads[keep]]],
        normal=unit,
        offset=np.einsum("ij,ij->i", unit, weighted),
        low=low[keep],
        high=high[keep],
        area=total[keep],
        plates=plates,
        corners=corner_count,
        splits=np.concatenate([[0], np.cumsum(plate_counts)]),
        face_of=face_of,
    )


def _plates(triangles: Array, sizes: Index, normal: Array) -> tuple[Array, Index, Index]:
    """Triangles (m, 3, 3) of faces of those sizes as plates: pairs that make a convex face become one.

    Returns the plates, their corner counts and how many each face has.
    """
    heads = np.cumsum(sizes) - sizes
    plates = np.concatenate([triangles, triangles[:, 2:]], axis=1)
    corners = np.full(len(triangles), 3)
    pairs = np.flatnonzero(sizes == 2)
    one, two = triangles[heads[pairs]], triangles[heads[pairs] + 1]
    same = (one[:, :, None] == two[:, None]).all(axis=3)
    shared_one, shared_two = same.any(axis=2), same.any(axis=1)
    good = np.flatnonzero((shared_one.sum(axis=1) == 2) & (shared_two.sum(axis=1) == 2))
    lone, far = np.argmin(shared_one[good], axis=1), np.argmin(shared_two[good], axis=1)
    turned = [one[good, (lone + step) % 3] for step in range(3)]
    quad = np.stack([turned[0], turned[1], two[good, far], turned[2]], axis=1)
    edge = np.roll(quad, -1, axis=1) - quad
    bend = dot(cross(edge, np.roll(edge, -1, axis=1)), normal[pairs[good], None])
    convex = good[np.all(bend >= 0.0, axis=1) | np.all(bend <= 0.0, axis=1)]
    head = heads[pairs[convex]]
    plates[head] = quad[np.isin(good, convex)]
    corners[head] = 4
    kept = np.ones(len(triangles), bool)
    kept[head + 1] = False
    counts = sizes.copy()
    counts[pairs[convex]] = 1
    return plates[kept], corners[kept], counts


def least(values: Array) -> Array:
    """Minimum over the second axis, which is short: faster than NumPy's own reduction of such an axis."""
    out = values[:, 0]
    for k in range(1, values.shape[1]):
        out = np.minimum(out, values[:, k])
    return out


def greatest(values: Array) -> Array:
    """Maximum over the second axis, which is short."""
    out = values[:, 0]
    for k in range(1, values.shape[1]):
        out = np.maximum(out, values[:, k])
    return out


def dot(a: Array, b: Array) -> Array:
    """Products of vectors (..., 3), summed over the last axis."""
    return np.asarray(a[..., 0] * b[..., 0] + a[..., 1] * b[..., 1] + a[..., 2] * b[..., 2])


def cross(a: Array, b: Array) -> Array:
    """Cross products of vectors (n, 3); written out, which is faster than NumPy's."""
    out = np.empty(np.broadcast_shapes(a.shape, b.shape))
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        np.subtract(a[..., j] * b[..., k], a[..., k] * b[..., j], out=out[..., i])
    return out


def overlapping(low_a: Array, high_a: Array, low_b: Array, high_b: Array) -> NDArray[np.bool_]:
    """Whether boxes (n, d) overlap."""
    out = np.ones(len(low_a), bool)
    for k in range(low_a.shape[1]):
        out &= (low_b[:, k] <= high_a[:, k]) & (high_b[:, k] >= low_a[:, k])
    return out


def ranges(starts: Index, sizes: Index) -> Index:
    """Concatenate ``arange(start, start + size)`` for all of them."""
    total = int(sizes.sum())
    if not total:
        return np.zeros(0, np.int64)
    ends = np.cumsum(sizes)
    return np.asarray(np.arange(total) + np.repeat(starts - (ends - sizes), sizes))


def components(count: int, a: Index, b: Index) -> Index:
    """Label of each of ``count`` nodes: nodes that edges (a, b) connect share one."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    graph = coo_array((np.ones(len(a), np.int8), (a, b)), shape=(count, count))
    return np.asarray(connected_components(graph, directed=False)[1], np.int64)


def _agreeing(owner: Index, normal: Array, offset: Array) -> Index:
    """Label triangles of one element whose planes share a bin of either of two shifted lattices."""
    place = np.column_stack([normal / _NORMAL_BIN, offset / _OFFSET_BIN])
    n = len(owner)
    groups = [_hashed(owner, np.floor(place + shift).astype(np.int64)) for shift in (0.0, 0.5)]
    first, second = (np.unique(g, return_inverse=True)[1] for g in groups)
    # nodes: the bins of the first lattice, then those of the second; a triangle ties its two bins together
    shift = int(first.max(initial=-1)) + 1
    label = components(shift + int(second.max(initial=-1)) + 1, first, second + shift)
    return label[first] if n else np.zeros(0, np.int64)


def _hashed(owner: Index, cells: Index) -> NDArray[np.uint64]:
    mix = owner.astype(np.uint64) * np.uint64(0x9E3779B97F4A7C15)
    for column in cells.T:
        mix ^= column.astype(np.uint64)
        mix *= np.uint64(0xBF58476D1CE4E5B9)
        mix ^= mix >> np.uint64(31)
    return mix
