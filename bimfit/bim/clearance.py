"""Fourth stage of the joint finder: what lies between two facing faces."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bimfit.bim.broad import box_pairs
from bimfit.bim.faces import Faces, Index, cross, dot, overlapping, ranges
from bimfit.bim.narrow import PairFrames
from bimfit.bim.strips import Strips, piece_centroids
from bimfit.geometry.pose import Array

TOUCH = 1e-3
CLASH = -1.5e-3
_SAMPLES = 15
_TO_RIM = 2.0 / 3.0
_CLEAR_SHARE = 0.8
_INSIDE = 1e-4
_OWN = 3e-4
_END = 1e-3
_ROWS = 1_000_000
_STANDS_OUT = 0.01
_ACROSS = (-0.25, 0.0, 0.25)


@dataclass(frozen=True)
class Clearance:
    """The verdict on each strip.

    Attributes
    ----------
    state : ndarray of str, shape (n,)
        ``open``, ``touch``, ``clash``, ``filled``, or ``own`` where one of the two lies in the way itself.
    filler : ndarray, shape (n,)
        Element in the gap, or -1.
    """

    state: NDArray[np.str_]
    filler: Index


def judge(faces: Faces, frames: PairFrames, strips: Strips) -> Clearance:
    """Tell clearances, contacts, overlaps and filled gaps apart.

    Up to 15 points a strip; at each the whole way from A to B is looked at, ends included, since a filler may
    take up the whole gap.
    """
    n = len(strips.pair)
    state = np.where(np.abs(strips.gap) <= TOUCH, "touch", "open").astype("<U6")
    state[strips.gap_min < CLASH] = "clash"
    filler = np.full(n, -1, np.int64)
    tested = np.flatnonzero(state != "touch")
    if not len(tested):
        return Clearance(state, filler)
    strip, point, weight = _samples(strips, tested)
    pair = strips.pair[strip]
    low, high = (h[:, 0] for h in frames.heights(pair, point[:, None, :]))
    start = frames.lift(pair, point, low)
    sample, element, own = _hits(faces, frames, pair, start, high - low, strip)
    total = np.bincount(strip, weight, n)
    blocked = np.unique(sample[own])
    own_share = np.bincount(strip[blocked], weight[blocked], n) / np.maximum(total, 1e-300)
    other = np.unique(np.stack([sample[~own], element[~own]]), axis=1)
    shut = np.unique(other[0])
    shut_share = np.bincount(strip[shut], weight[shut], n) / np.maximum(total, 1e-300)
    clear = 1.0 - _CLEAR_SHARE
    filled = (shut_share > clear) & (state == "open")
    state[filled] = "filled"
    state[own_share > clear] = "own"
    rows = np.flatnonzero(filled[strip[other[0]]])
    if len(rows):
        keys = strip[other[0, rows]] * np.int64(len(faces.starts)) + other[1, rows]
        unique, inverse = np.unique(keys, return_inverse=True)
        votes = np.bincount(inverse, weight[other[0, rows]])
        order = np.argsort(np.round(votes, 9), kind="stable")
        filler[unique[order] // len(faces.starts)] = unique[order] % len(faces.starts)
    return Clearance(state, filler)


def _samples(strips: Strips, tested: Index) -> tuple[Index, Array, Array]:
    """Points spread over the strips: (strip, point (k, 2), weight)."""
    chosen = strips.take(tested)
    pieces = chosen.pieces
    strip = np.repeat(tested, np.diff(chosen.splits))
    middle = piece_centroids(pieces)
    # of a rectangle: the centres of nine equal cells
    column = np.arange(pieces.corners.shape[1])
    real = column < pieces.count[:, None]
    onward = np.where(column + 1 < pieces.count[:, None], column + 1, 0)
    onward = pieces.corners[np.arange(len(strip))[:, None], onward]
    rim = np.concatenate([pieces.corners, 0.5 * (pieces.corners + onward)], axis=1)
    points = np.concatenate([middle[:, None], middle[:, None] + _TO_RIM * (rim - middle[:, None])], axis=1)
    row, column = np.nonzero(np.concatenate([np.ones((len(strip), 1), bool), real, real], axis=1))
    owner = strip[row]
    share = pieces.area[row] / (2 * pieces.count[row] + 1)
    heads = np.flatnonzero(np.diff(owner, prepend=-1))
    sizes = np.diff(np.append(heads, len(owner)))
    rank = np.arange(len(owner)) - np.repeat(heads, sizes)
    count = np.repeat(sizes, sizes)
    few = np.minimum(count, _SAMPLES)
    keep = (rank * few) // count != ((rank - 1) * few) // count
    return owner[keep], points[row, column][keep], share[keep]


def _hits(
    faces: Faces, frames: PairFrames, pair: Index, start: Array, reach: Array, strip: Index
) -> tuple[Index, Index, NDArray[np.bool_]]:
    """What the ways from A to B meet: (sample, element, whether it is A or B itself)."""
    way = frames.m[pair]
    end = start + reach[:, None] * way
    heads = np.flatnonzero(np.diff(strip, prepend=-1))
    low_s, high_s = np.minimum(start, end) - 2.0 * _END, np.maximum(start, end) + 2.0 * _END
    low, high = np.minimum.reduceat(low_s, heads), np.maximum.reduceat(high_s, heads)
    sizes = np.diff(np.append(heads, len(strip)))
    group, triangle = nearby_triangles(faces, low, high)
    # the two faces themselves lie at the ends of the way
    face, lead = faces.face_of[triangle], pair[heads[group]]
    other = np.flatnonzero((face < 0) | ((face != frames.a[lead]) & (face != frames.b[lead])))
    group, triangle = group[other], triangle[other]
    found: list[tuple[Index, Index, NDArray[np.bool_]]] = []
    costs = np.cumsum(sizes[group])
    position = 0
    while position < len(group):
        spent = int(costs[position - 1]) if position else 0
        stop = max(position + 1, int(np.searchsorted(costs, spent + _ROWS, side="right")))
        g, t = group[position:stop], triangle[position:stop]
        sample = ranges(heads[g], sizes[g])
        tri = np.repeat(t, sizes[g])
        near = overlapping(low_s[sample], high_s[sample], faces.triangle_low[tri], faces.triangle_high[tri])
        sample, tri = sample[near], tri[near]
        distance = ray_distance(start[sample], way[sample], faces.triangles[tri])
        hit = np.flatnonzero(np.isfinite(distance))
        sample, tri, distance = sample[hit], tri[hit], distance[hit]
        first, last = np.minimum(0.0, reach[sample]), np.maximum(0.0, reach[sample])
        owner = faces.owner[tri]
        mine = (owner == faces.element[frames.a[pair[sample]]]) | (
            owner == faces.element[frames.b[pair[sample]]]
        )
        corners = faces.triangles[tri]
        normal = cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        cosine = dot(normal, way[sample]) / np.maximum(np.sqrt(dot(normal, normal)), 1e-300)
        inside = (distance > first + _INSIDE) & (distance < last - _INSIDE)
        # a filler that fits exactly: it begins where A ends, or ends where B begins
        begins = (np.abs(distance - first) <= _END) & (cosine < -0.5)
        ends = (np.abs(distance - last) <= _END) & (cosine > 0.5)
        own = mine & (distance > first + _OWN) & (distance < last - _OWN)
        keep = own | (~mine & (inside | begins | ends))
        found.append((sample[keep], owner[keep], own[keep]))
        position = stop
    if not found:
        return np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0, bool)
    return (
        np.concatenate([f[0] for f in found]),
        np.concatenate([f[1] for f in found]),
        np.concatenate([f[2] for f in found]),
    )


def covered_sides(
    faces: Faces, origin: Array, u: Array, v: Array, depth: Array, gap: Array, filler: Index
) -> NDArray[np.bool_]:
    """Whether the filler stands out of the gap by more than 10 mm, towards +v and -v: shape (k, 2).

    So do plates and slabs that lie between two elements, and no sealant or mortar. It is looked for in the
    middle of the gap and halfway to either face.

    Parameters
    ----------
    origin, u, v : ndarray, shape (k, stations, 3)
        Mid-gap points, directions across and out of the gap; the majority of the points decides.
    depth, gap : ndarray, shape (k,)
        m.
    filler : ndarray, shape (k,)
        Elements; -1 for none.
    """
    out = np.zeros((len(filler), 2), bool)
    filled = np.flatnonzero(filler >= 0)
    for shift in _ACROSS if len(filled) else ():
        start = origin[filled] + shift * gap[filled, None, None] * u[filled]
        out[filled] |= _stands_out(faces, start, v[filled], depth[filled], filler[filled])
    return out


def _stands_out(faces: Faces, start: Array, v: Array, depth: Array, filler: Index) -> NDArray[np.bool_]:
    k, count, _ = start.shape
    element = np.repeat(filler, count)
    sizes = np.diff(faces.starts)[element]
    row, triangle = np.repeat(np.arange(k * count), sizes), ranges(faces.starts[element], sizes)
    distance = ray_distance(start.reshape(-1, 3)[row], v.reshape(-1, 3)[row], faces.triangles[triangle])
    beyond = 0.5 * depth[row // count] + _STANDS_OUT
    out = np.zeros((k, 2), bool)
    for side, sign in ((0, 1.0), (1, -1.0)):
        # a point lies within a body when an odd number of its faces lie further out
        crossed = np.isfinite(distance) & (sign * distance > beyond)
        inside = np.bincount(row[crossed], minlength=k * count) % 2 == 1
        out[:, side] = inside.reshape(k, count).sum(axis=1) * 2 > count
    return out


def nearby_triangles(faces: Faces, low: Array, high: Array) -> tuple[Index, Index]:
    """Triangles whose boxes overlap given boxes (k, 3): (box, triangle), sorted by box."""
    element_low, element_high = element_boxes(faces)
    box, element = box_pairs(low, high, element_low, element_high)
    order = np.lexsort((element, box))
    box, element = box[order], element[order]
    sizes = np.diff(faces.starts)[element]
    out_box: list[Index] = []
    out_triangle: list[Index] = []
    costs = np.cumsum(sizes)
    position = 0
    while position < len(box):
        spent = int(costs[position - 1]) if position else 0
        stop = max(position + 1, int(np.searchsorted(costs, spent + _ROWS, side="right")))
        some = slice(position, stop)
        b = np.repeat(box[some], sizes[some])
        t = ranges(faces.starts[element[some]], sizes[some])
        near = overlapping(low[b], high[b], faces.triangle_low[t], faces.triangle_high[t])
        out_box.append(b[near])
        out_triangle.append(t[near])
        position = stop
    if not out_box:
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    return np.concatenate(out_box), np.concatenate(out_triangle)


def element_boxes(faces: Faces) -> tuple[Array, Array]:
    """Least and greatest corners of the elements, shape (elements, 3) each."""
    heads = faces.starts[:-1]
    return np.minimum.reduceat(faces.triangle_low, heads), np.maximum.reduceat(faces.triangle_high, heads)


def ray_distance(start: Array, way: Array, triangles: Array) -> Array:
    """Distances (n,) along unit ways to triangles (n, 3, 3), negative behind; inf where they miss.

    Moeller and Trumbore, "Fast, minimum storage ray/triangle intersection" (1997).
    """
    origin = triangles[:, 0]
    e1, e2 = triangles[:, 1] - origin, triangles[:, 2] - origin
    h = cross(way, e2)
    det = dot(e1, h)
    flat = np.abs(det) < 1e-14
    inverse = 1.0 / np.where(flat, 1.0, det)
    s = start - origin
    u = dot(s, h) * inverse
    q = cross(s, e1)
    v = dot(way, q) * inverse
    hit = ~flat & (u >= -1e-9) & (v >= -1e-9) & (u + v <= 1.0 + 1e-9)
    return np.where(hit, dot(e2, q) * inverse, np.inf)
