"""Third stage of the joint finder, second part: connected pieces as strips with an axis."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bimfit.bim.faces import Index, ranges
from bimfit.bim.narrow import PairFrames, Pieces, strip_labels
from bimfit.geometry.pose import Array

_ANGLE_BIN = np.radians(0.05)
_SHORT_EDGE = 2e-3
_SQUARE = 1e-6


@dataclass(frozen=True)
class Strips:
    """Connected regions in which two faces face each other, each in its pair's mid-plane.

    Attributes
    ----------
    pair : ndarray, shape (n,)
    pieces : Pieces
        Sorted by strip; strip i has ``splits[i]:splits[i + 1]``.
    splits : ndarray, shape (n + 1,)
    area : ndarray, shape (n,)
        m^2.
    gap, gap_min, gap_max : ndarray, shape (n,)
        Mean, least and greatest gap, m.
    axis : ndarray, shape (n, 2)
        Unit direction of the least rectangle's long side.
    centre : ndarray, shape (n, 2)
        The least rectangle's centre.
    length, depth : ndarray, shape (n,)
        The least rectangle's sides, m.
    """

    pair: Index
    pieces: Pieces
    splits: Index
    area: Array
    gap: Array
    gap_min: Array
    gap_max: Array
    axis: Array
    centre: Array
    length: Array
    depth: Array

    def take(self, rows: Index) -> Strips:
        """Some of the strips."""
        sizes = np.diff(self.splits)[rows]
        kept = ranges(self.splits[rows], sizes)
        plain = (
            self.area,
            self.gap,
            self.gap_min,
            self.gap_max,
            self.axis,
            self.centre,
            self.length,
            self.depth,
        )
        return Strips(
            self.pair[rows],
            self.pieces.take(kept),
            np.concatenate([[0], np.cumsum(sizes)]),
            *(values[rows] for values in plain),
        )


def find_strips(frames: PairFrames, pieces: Pieces) -> Strips:
    """Group pieces into strips and measure them."""
    order = np.argsort(pieces.pair, kind="stable")
    pieces = pieces.take(order)
    label = strip_labels(pieces)
    order = np.lexsort((label, pieces.pair))
    pieces, label = pieces.take(order), label[order]
    heads = np.flatnonzero(np.diff(label, prepend=-1))
    splits = np.append(heads, len(label))
    if not len(heads):
        none, flat = np.zeros(0), np.zeros((0, 2))
        splits = np.zeros(1, np.int64)
        return Strips(pieces.pair, pieces, splits, none, none, none, none, flat, flat, none, none)
    area = np.add.reduceat(pieces.area, heads)
    low, high = frames.heights(pieces.pair, pieces.corners)
    gap = high - low
    middle = piece_centroids(pieces)
    low_c, high_c = frames.heights(pieces.pair, middle)
    mean = np.add.reduceat((high_c - low_c) * pieces.area, heads) / area
    axis, centre, length, depth = _least_rectangles(pieces, splits)
    return Strips(
        pieces.pair[heads],
        pieces,
        splits,
        area,
        mean,
        np.minimum.reduceat(gap.min(axis=1), heads),
        np.maximum.reduceat(gap.max(axis=1), heads),
        axis,
        centre,
        length,
        depth,
    )


def piece_centroids(pieces: Pieces) -> Array:
    """Centroids of convex pieces, shape (p, 2)."""
    first = pieces.corners[:, :1]
    p = pieces.corners - first
    q = np.roll(p, -1, axis=1)
    twice = p[..., 0] * q[..., 1] - p[..., 1] * q[..., 0]
    moment = ((p + q) * twice[..., None]).sum(axis=1) / 3.0
    return np.asarray(first[:, 0] + moment / twice.sum(axis=1)[:, None])


def _least_rectangles(pieces: Pieces, splits: Index) -> tuple[Array, Array, Array, Array]:
    """The rectangle of least area about each strip that lies along one of its edges."""
    n = len(splits) - 1
    strip = np.repeat(np.arange(n), np.diff(splits))
    k = pieces.corners.shape[1]
    column = np.arange(k)
    onward = np.where(column + 1 < pieces.count[:, None], column + 1, 0)
    edges = pieces.corners[np.arange(len(strip))[:, None], onward] - pieces.corners
    size = np.linalg.norm(edges, axis=2)
    longest = np.zeros(n)
    np.maximum.at(longest, strip, size.max(axis=1))
    real = (size > np.minimum(_SHORT_EDGE, 0.5 * longest[strip])[:, None]) & (column < pieces.count[:, None])
    row, col = np.nonzero(real)
    angle = np.mod(np.arctan2(edges[row, col, 1], edges[row, col, 0]), np.pi / 2.0)
    bins = np.rint(angle / _ANGLE_BIN).astype(np.int64) % round(np.pi / 2.0 / _ANGLE_BIN)
    # of each strip's directions in one bin the longest edge's stands for all
    order = np.lexsort((-size[row, col], bins, strip[row]))
    owner, bins, angle = strip[row][order], bins[order], angle[order]
    new = (np.diff(owner, prepend=-1) != 0) | (np.diff(bins, prepend=-1) != 0)
    owner, angle = owner[new], angle[new]
    sizes = np.diff(splits)[owner]
    direction = np.repeat(np.arange(len(owner)), sizes)
    piece = ranges(splits[:-1][owner], sizes)
    points = pieces.corners[piece]
    c, s = np.cos(angle)[direction, None], np.sin(angle)[direction, None]
    x, y = points[..., 0] * c + points[..., 1] * s, points[..., 1] * c - points[..., 0] * s
    heads = np.concatenate([[0], np.cumsum(sizes)[:-1]])
    x0, x1 = np.minimum.reduceat(x.min(axis=1), heads), np.maximum.reduceat(x.max(axis=1), heads)
    y0, y1 = np.minimum.reduceat(y.min(axis=1), heads), np.maximum.reduceat(y.max(axis=1), heads)
    rank = np.lexsort((np.arange(len(owner)), np.round((x1 - x0) * (y1 - y0), 9), owner))
    best = rank[np.flatnonzero(np.diff(owner[rank], prepend=-1))]
    c, s = np.cos(angle[best]), np.sin(angle[best])
    xm, ym = 0.5 * (x0 + x1)[best], 0.5 * (y0 + y1)[best]
    wide, tall = (x1 - x0)[best], (y1 - y0)[best]
    along = wide >= tall - _SQUARE  # of a square the same side, whatever rounding says
    axis = np.where(along[:, None], np.stack([c, s], axis=1), np.stack([-s, c], axis=1))
    centre = np.stack([xm * c - ym * s, xm * s + ym * c], axis=1)
    return axis, centre, np.maximum(wide, tall), np.minimum(wide, tall)
