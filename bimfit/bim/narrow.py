"""Third stage of the joint finder: where two faces really face each other."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bimfit.bim.faces import Faces, Index, components, dot, greatest, least, overlapping, ranges
from bimfit.geometry.pose import Array

_TOUCH = 2e-4
_MIN_PIECE = 1e-7
_ROWS = 400_000


@dataclass(frozen=True)
class Pieces:
    """Convex pieces of facing faces, in the plane midway between the two.

    Attributes
    ----------
    pair : ndarray, shape (p,)
        Which pair of faces.
    corners : ndarray, shape (p, k, 2)
        Coordinates along the pair's axes, m; rows beyond ``count`` repeat the last corner.
    count : ndarray, shape (p,)
    area : ndarray, shape (p,)
        m^2.
    """

    pair: Index
    corners: Array
    count: Index
    area: Array

    def take(self, rows: Index) -> Pieces:
        """Some of the pieces."""
        return Pieces(self.pair[rows], self.corners[rows], self.count[rows], self.area[rows])


@dataclass(frozen=True)
class PairFrames:
    """For each pair of faces: the mid-plane's axes e1, e2 and normal m (from A to B), and both faces over it.

    ``height_a`` and ``height_b`` (k, 3) are (slope along e1, along e2, constant).
    """

    a: Index
    b: Index
    e1: Array
    e2: Array
    m: Array
    height_a: Array
    height_b: Array

    def heights(self, pair: Index, points: Array) -> tuple[Array, Array]:
        """Height of A and of B over the mid-plane's origin at points (..., 2) of the pairs."""
        shape = (len(pair),) + (1,) * (points.ndim - 2)
        out = []
        for plane in (self.height_a[pair], self.height_b[pair]):
            slope1, slope2, constant = (plane[:, k].reshape(shape) for k in range(3))
            out.append(slope1 * points[..., 0] + slope2 * points[..., 1] + constant)
        return out[0], out[1]

    def lift(self, pair: Index, points: Array, height: Array) -> Array:
        """Points (n, 2) at heights (n,) in the finder's coordinates, shape (n, 3)."""
        return np.asarray(
            points[:, :1] * self.e1[pair] + points[:, 1:2] * self.e2[pair] + height[:, None] * self.m[pair]
        )


def pair_frames(faces: Faces, a: Index, b: Index) -> PairFrames:
    """Mid-planes of face pairs."""
    na, nb = faces.normal[a], faces.normal[b]
    m = na - nb
    m = m / np.linalg.norm(m, axis=1, keepdims=True)
    least = np.eye(3)[np.argmin(np.abs(m), axis=1)]
    e1 = np.cross(m, least)
    e1 = e1 / np.linalg.norm(e1, axis=1, keepdims=True)
    e2 = np.cross(m, e1)
    heights = []
    for n, offset in ((na, faces.offset[a]), (nb, faces.offset[b])):
        along = np.einsum("ij,ij->i", n, m)
        terms = [-np.einsum("ij,ij->i", n, e1), -np.einsum("ij,ij->i", n, e2), offset]
        heights.append(np.stack(terms, axis=1) / along[:, None])
    return PairFrames(a, b, e1, e2, m, heights[0], heights[1])


def facing_pieces(faces: Faces, frames: PairFrames, *, least_gap: float, max_gap: float) -> Pieces:
    """Clip each plate of A against each of B in their mid-plane, and by the gap between them."""
    sizes = np.diff(faces.splits)[frames.b]
    chunks: list[Pieces] = []
    ends = np.cumsum(sizes * np.maximum(1, np.diff(faces.splits)[frames.a]))
    for low, high in _chunks(ends, _ROWS):
        rows = np.arange(low, high)
        pieces = _clip_pairs(faces, frames, rows, least_gap, max_gap)
        if len(pieces.pair):
            chunks.append(pieces)
    if not chunks:
        return Pieces(np.zeros(0, np.int64), np.zeros((0, 3, 2)), np.zeros(0, np.int64), np.zeros(0))
    widest = max(c.corners.shape[1] for c in chunks)
    corners = [
        np.pad(c.corners, ((0, 0), (0, widest - c.corners.shape[1]), (0, 0)), mode="edge") for c in chunks
    ]
    return Pieces(
        np.concatenate([c.pair for c in chunks]),
        np.concatenate(corners),
        np.concatenate([c.count for c in chunks]),
        np.concatenate([c.area for c in chunks]),
    )


def _chunks(ends: Index, most: int) -> list[tuple[int, int]]:
    """Split rows with these cumulated costs into runs of about ``most`` each."""
    out, low, spent = [], 0, 0
    while low < len(ends):
        high = max(low + 1, int(np.searchsorted(ends, spent + most, side="right")))
        out.append((low, high))
        low, spent = high, int(ends[high - 1])
    return out


def _clip_pairs(faces: Faces, frames: PairFrames, rows: Index, least_gap: float, max_gap: float) -> Pieces:
    b = frames.b[rows]
    sizes = np.diff(faces.splits)
    pair = np.repeat(rows, sizes[b])
    of_b = ranges(faces.splits[b], sizes[b])
    reach = max(max_gap, -least_gap) + 2e-3
    fa = frames.a[pair]
    near = overlapping(
        faces.low[fa] - reach, faces.high[fa] + reach, faces.plate_low[of_b], faces.plate_high[of_b]
    )
    pair, of_b = pair[near], of_b[near]
    fa = frames.a[pair]
    which = np.repeat(np.arange(len(pair)), sizes[fa])
    of_a = ranges(faces.splits[fa], sizes[fa])
    pair, of_b = pair[which], of_b[which]
    clip, poly = _flat(faces, frames, pair, of_a), _flat(faces, frames, pair, of_b)
    near = overlapping(least(clip), greatest(clip), least(poly), greatest(poly))
    pair, clip, poly, count = pair[near], clip[near], poly[near], faces.corners[of_b[near]]
    turn = np.sign(polygon_area(clip, signed=True))
    for k in range(4):
        p, q = clip[:, k], clip[:, (k + 1) % 4]
        edge = (q - p) * turn[:, None]
        side = edge[:, None, 0] * (poly[..., 1] - p[:, None, 1]) - edge[:, None, 1] * (
            poly[..., 0] - p[:, None, 0]
        )
        poly, count, keep = _clip(poly, count, side)
        poly, count, pair, clip, turn = poly[keep], count[keep], pair[keep], clip[keep], turn[keep]
    for sign, limit in ((1.0, least_gap), (-1.0, max_gap)):
        low, high = frames.heights(pair, poly)
        poly, count, keep = _clip(poly, count, sign * (high - low - limit))
        poly, count, pair = poly[keep], count[keep], pair[keep]
    area = polygon_area(poly)
    keep = area > _MIN_PIECE
    return Pieces(pair[keep], poly[keep], count[keep], area[keep])


def _flat(faces: Faces, frames: PairFrames, pair: Index, plates: Index) -> Array:
    """Plates in the mid-planes of their pairs, shape (n, 4, 2)."""
    corners = faces.plates[plates]
    flat = np.empty((len(pair), 4, 2))
    flat[..., 0] = dot(corners, frames.e1[pair][:, None])
    flat[..., 1] = dot(corners, frames.e2[pair][:, None])
    return flat


def polygon_area(corners: Array, *, signed: bool = False) -> Array:
    """Shoelace areas of polygons (n, k, 2), whose last corner may be repeated."""
    p = corners - corners[:, :1]
    x, y = p[..., 0], p[..., 1]
    area = 0.5 * (x * np.roll(y, -1, axis=1) - y * np.roll(x, -1, axis=1)).sum(axis=1)
    return np.asarray(area if signed else np.abs(area))


def _clip(poly: Array, count: Index, side: Array) -> tuple[Array, Index, NDArray[np.bool_]]:
    """Keep the part of convex polygons (n, k, 2) where ``side`` (n, k), affine, is not negative.

    Sutherland and Hodgman's step for all of them at once. Returns polygons with one more column, their
    counts and which have any area left.
    """
    valid = np.arange(poly.shape[1]) < count[:, None]
    inside = (side >= 0.0) & valid
    number = inside.sum(axis=1)
    keep = number > 0
    crossed = np.flatnonzero(keep & (number < count))
    total = count.copy()
    out = poly
    if len(crossed):
        some, total[crossed] = _cut(
            poly[crossed], count[crossed], side[crossed], inside[crossed], valid[crossed]
        )
        wider = max(0, some.shape[1] - poly.shape[1])
        out = np.concatenate([poly, np.repeat(poly[:, -1:], wider, axis=1)], axis=1)
        out[crossed, : some.shape[1]] = some
        out[crossed, some.shape[1] :] = some[:, -1:]
    keep &= total >= 3
    return out, total, keep


def _cut(
    poly: Array,
    count: Index,
    side: Array,
    inside: NDArray[np.bool_],
    valid: NDArray[np.bool_],
) -> tuple[Array, Index]:
    """The clipping step for polygons that the line crosses."""
    n, k, _ = poly.shape
    column = np.arange(k)
    onward = np.where(column + 1 < count[:, None], column + 1, 0)
    row = np.arange(n)[:, None]
    crossing = valid & (inside != inside[row, onward])
    next_side = side[row, onward]
    with np.errstate(divide="ignore", invalid="ignore"):
        t = np.where(crossing, side / (side - next_side), 0.0)
    cut = poly + t[..., None] * (poly[row, onward] - poly)
    emit = np.empty((n, 2 * k), bool)
    emit[:, ::2], emit[:, 1::2] = inside, crossing
    points = np.empty((n, 2 * k, 2))
    points[:, ::2], points[:, 1::2] = poly, cut
    total = emit.sum(axis=1)
    slot = np.cumsum(emit, axis=1) - 1
    width = int(total.max())
    out = np.zeros((n, width, 2))
    r, c = np.nonzero(emit)
    out[r, slot[r, c]] = points[r, c]
    # repeat the last corner, so that areas and extents may ignore the count
    last = np.minimum(np.arange(width)[None, :], np.maximum(total - 1, 0)[:, None])
    return out[row, last], total


def strip_labels(pieces: Pieces) -> Index:
    """Label pieces of one pair that touch within 0.2 mm, shape (p,); pieces come sorted by pair."""
    n = len(pieces.pair)
    heads = np.flatnonzero(np.diff(pieces.pair, prepend=-1))
    sizes = np.diff(np.append(heads, n))
    position = np.arange(n) - np.repeat(heads, sizes)
    after = np.repeat(sizes, sizes) - position - 1
    i = np.repeat(np.arange(n), after)
    j = ranges(np.arange(n) + 1, after)
    low, high = least(pieces.corners), greatest(pieces.corners) + _TOUCH
    near = overlapping(low[i], high[i], low[j], high[j])
    i, j = i[near], j[near]
    close = ~(_separated(pieces, i, j) | _separated(pieces, j, i))
    return components(n, i[close], j[close])


def _separated(pieces: Pieces, i: Index, j: Index) -> NDArray[np.bool_]:
    """Whether an edge of piece i has piece j beyond it, by more than 0.2 mm."""
    p, q = pieces.corners[i], pieces.corners[j]
    out = np.zeros(len(i), bool)
    turn = np.sign(polygon_area(p, signed=True))
    k = p.shape[1]
    for c in range(k):
        onward = np.where(c + 1 < pieces.count[i], c + 1, 0)
        edge = p[np.arange(len(i)), onward] - p[:, c]
        size = np.hypot(edge[:, 0], edge[:, 1])
        scale = turn / np.maximum(size, 1e-12)
        nx, ny = edge[:, 1] * scale, -edge[:, 0] * scale
        beyond = least(q[..., 0] * nx[:, None] + q[..., 1] * ny[:, None]) - (
            p[:, c, 0] * nx + p[:, c, 1] * ny
        )
        out |= (beyond > _TOUCH) & (size > 1e-6) & (c < pieces.count[i])
    return out
