"""Legs: runs of facing faces of one pair of elements, and which of them may belong together."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from bimfit.geometry.pose import Array

COMMON = 0.8
"""Share of the shorter one's length that strips of one section have in common."""
SNAP = 1e-3
NEARLY_PARALLEL = 0.998
HOLE = 0.05


@dataclass(frozen=True)
class Lip:
    """Facing faces of a stepped section: where they lie from the spine.

    Attributes
    ----------
    across, out : float
        From the spine to their middle, along u and along the leg's ``side``, m.
    depth : float
        Their own depth, m.
    """

    across: float
    out: float
    depth: float

    def mirrored(self) -> Lip:
        """The same seen along the leg's other way, which turns its side round."""
        return Lip(self.across, -self.out, self.depth)


@dataclass(frozen=True)
class Leg:
    """A run of facing faces, or several of them end to end.

    Attributes
    ----------
    points : ndarray, shape (k, 3)
        Mid-gap line, m.
    u : ndarray, shape (k - 1, 3)
        Directions from A to B.
    length, depth, gap, low, high, area : float
        Of the faces that meet: m and m^2; least and greatest gap.
    legs : tuple of float
        Length of each run.
    closed : bool
    groove : bool
        Found as a pair of prepared edges without a root land.
    lips : tuple of three Lip, optional
        Of a stepped section: the outermost faces against its side, the leading ones, and those towards it.
    square : Leg, optional
        The same stepped section, led by the largest of its faces that are square to the leading ones.
    """

    points: Array
    u: Array
    length: float
    depth: float
    gap: float
    low: float
    high: float
    area: float
    legs: tuple[float, ...]
    closed: bool = False
    groove: bool = False
    lips: tuple[Lip, Lip, Lip] | None = None
    square: Leg | None = None

    @cached_property
    def way(self) -> Array:
        """Direction from the first point to the last; of a closed leg, that of its first run."""
        d = self.points[1] - self.points[0] if self.closed else self.points[-1] - self.points[0]
        return np.asarray(d / np.linalg.norm(d))

    @cached_property
    def middle(self) -> Array:
        """Mean of the points."""
        return np.asarray(self.points.mean(axis=0))

    @cached_property
    def side(self) -> Array:
        """Out of the gap: direction of the depth on the first run."""
        (a, b, c), (x, y, z) = self.way, self.u[0]
        return np.array([b * z - c * y, c * x - a * z, a * y - b * x])

    @property
    def straight(self) -> bool:
        """Whether it has two points only."""
        return len(self.points) == 2


def likely_pairs(
    legs: Sequence[Leg], *, parallel: float, turn: tuple[float, float], near: bool = False, row: bool = False
) -> list[tuple[int, int]]:
    """Pairs of straight legs whose axes are parallel and whose u directions have a cosine within ``turn``.

    With ``near``, their sections also lie within reach of one another; with ``row``, they may be runs of one
    strip.
    """
    way = np.array([leg.way for leg in legs])
    u = np.array([leg.u[0] for leg in legs])
    straight = np.array([leg.straight for leg in legs])
    cosine = u @ u.T
    good = (np.abs(way @ way.T) >= parallel) & (cosine >= turn[0]) & (cosine <= turn[1])
    good &= straight[:, None] & straight[None, :]
    if near:
        middle = np.array([leg.middle for leg in legs])
        depth, gap = np.array([leg.depth for leg in legs]), np.abs([leg.gap for leg in legs])
        apart = middle[None] - middle[:, None]
        along = np.einsum("ijk,ik->ij", apart, way)
        half = 0.5 * np.array([np.linalg.norm(leg.points[-1] - leg.points[0]) for leg in legs])
        length = np.array([leg.length for leg in legs])
        # a little more than what decides, which is measured along the first one's way
        common = half[:, None] + half - np.abs(along) * 0.999 + 1e-6
        good &= common >= 0.99 * COMMON * np.minimum(length[:, None], length)
        apart = apart - along[..., None] * way[:, None]
        reach = 0.5 * (depth[:, None] + depth) + 1.5 * np.maximum(gap[:, None], gap) + 5e-3
        good &= np.linalg.norm(apart, axis=2) <= reach + 0.01 * np.maximum(depth[:, None], depth)
    if row:
        middle, side = np.array([leg.middle for leg in legs]), np.array([leg.side for leg in legs])
        depth, gap = np.array([leg.depth for leg in legs]), np.array([leg.gap for leg in legs])
        apart, deeper = middle[None] - middle[:, None], np.maximum(depth[:, None], depth)
        half = 0.5 * np.array([np.linalg.norm(leg.points[-1] - leg.points[0]) for leg in legs])
        hole = np.abs(np.einsum("ijk,ik->ij", apart, way)) - half[:, None] - half
        # a little more than what decides, which is measured square to the first one's way
        loose = 0.02 * np.linalg.norm(apart, axis=2) + 1e-6
        good &= np.abs(np.einsum("ijk,ik->ij", apart, u)) <= SNAP + loose
        good &= np.abs(np.einsum("ijk,ik->ij", apart, side)) <= 0.1 * deeper + loose
        good &= (hole >= -0.005 - loose) & (hole <= HOLE + loose)
        good &= np.abs(depth[:, None] - depth) <= 0.2 * deeper + 1e-9
        good &= np.abs(gap[:, None] - gap) <= 2.0 * SNAP + 1e-9
    return [(int(i), int(j)) for i, j in np.argwhere(np.triu(good, 1))]
