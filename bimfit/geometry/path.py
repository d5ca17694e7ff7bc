"""The way a joint takes through the world."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bimfit.geometry.frame import SectionFrame
from bimfit.geometry.pose import Array

SMOOTH_TURN = math.radians(20.0)
"""Legs that turn by less than this may be facets of a curve."""

_STRAIGHT_RATIO = 3.0
_CHUNK = 1 << 15
_NEWTON_STEPS = 4


@dataclass(frozen=True, eq=False)
class JointPath:
    """A polyline with a section's axes on every leg.

    Three or more legs that turn by less than 20 degrees from one to the next are facets of a curve: between
    them the axes turn steadily, so that sections of an arc are radial. At a sharper corner, and between two
    legs alone, each leg keeps its own axes.

    Attributes
    ----------
    points : ndarray, shape (k, 3)
        The spine, midway in the gap, m. A closed path repeats its first point at the end.
    u, v : ndarray, shape (k - 1, 3)
        Unit axes of each leg: across the gap and out of the mouth; u x v points along the leg.
    closed : bool
        Whether the end meets the start.
    """

    points: Array
    u: Array
    v: Array
    closed: bool = False

    def __post_init__(self) -> None:
        k = len(self.points)
        if k < 2 or self.points.shape != (k, 3) or self.u.shape != (k - 1, 3) or self.v.shape != (k - 1, 3):
            raise ValueError("a path takes k points (k, 3) and k - 1 axes u and v (k - 1, 3)")
        way = self.points[1:] - self.points[:-1]
        squared = np.einsum("ij,ij->i", way, way)
        if not ((squared >= 1e-18) & (squared < np.inf)).all():
            raise ValueError("a path's points must be finite and apart from one another")
        if self.closed and np.linalg.norm(self.points[0] - self.points[-1]) > 1e-9:
            raise ValueError("a closed path must end where it starts")
        # written out: np.cross costs more than all the rest of this
        u, v = self.u[:, [1, 2, 0]], self.v[:, [2, 0, 1]]
        along = u * v - self.u[:, [2, 0, 1]] * self.v[:, [1, 2, 0]]
        if not (np.einsum("ij,ij->i", along, way) > 0.0).all():
            raise ValueError("u x v must point along the path")

    @classmethod
    def restored(cls, points: Array, u: Array, v: Array, *, closed: bool) -> JointPath:
        """A path from the arrays of another, which were checked when that was made."""
        path = object.__new__(cls)
        path.__dict__.update(points=points, u=u, v=v, closed=closed)
        return path

    @classmethod
    def straight(cls, start: ArrayLike, end: ArrayLike, u: ArrayLike) -> JointPath:
        """A single leg from its ends (3,) and a rough u direction (3,); v completes n = u x v."""
        a, b = np.asarray(start, float), np.asarray(end, float)
        n = (b - a) / np.linalg.norm(b - a)
        across = _reject(np.asarray(u, float)[None], n[None])
        return cls(np.stack([a, b]), across, np.cross(n, across))

    @property
    def leg_lengths(self) -> Array:
        """Length of every leg, m, shape (k - 1,)."""
        return np.asarray(np.linalg.norm(np.diff(self.points, axis=0), axis=1))

    @property
    def leg_directions(self) -> Array:
        """Unit direction of every leg, shape (k - 1, 3)."""
        return np.diff(self.points, axis=0) / self.leg_lengths[:, None]

    @cached_property
    def stops(self) -> Array:
        """Distance along the path at every point, m, shape (k,)."""
        return np.concatenate([[0.0], np.cumsum(self.leg_lengths)])

    @property
    def length(self) -> float:
        """Length, m."""
        return float(self.stops[-1])

    @property
    def curved(self) -> bool:
        """Whether some of the legs are facets of a curve."""
        return bool(self._smooth.any())

    def rough_frame(self, s: float) -> SectionFrame:
        """The section's axes at ``s``, with the origin on the spine.

        Parameters
        ----------
        s : float
            Distance along the path, m; outside [0, length] the nearest end is taken, or, where the path is
            closed, it goes round.
        """
        s = s % self.length if self.closed and not 0.0 <= s <= self.length else min(max(s, 0.0), self.length)
        leg = int(np.clip(np.searchsorted(self.stops, s, side="right") - 1, 0, len(self.u) - 1))
        t = (s - self.stops[leg]) / self.leg_lengths[leg]
        legs, share = np.array([leg]), np.array([t])
        n = self._tangent(legs, share)
        starts, ends = self._leg_axes
        u = _reject((1.0 - t) * starts[1][legs] + t * ends[1][legs], n)
        origin = (1.0 - t) * self.points[leg] + t * self.points[leg + 1]
        return SectionFrame(origin, u[0], np.cross(n[0], u[0]), n[0])

    def project(self, points: ArrayLike) -> tuple[Array, NDArray[np.float64]]:
        """Where on the path the points (n, 3) belong.

        On a straight leg that is the nearest point of the path; on a curve it is the station whose section
        plane holds the point.

        Returns
        -------
        s : ndarray, shape (n,)
            Distance along the path, m, within [0, length].
        distance : ndarray, shape (n,)
            Distance from the path at ``s``, m.
        """
        p = np.asarray(points, float).reshape(-1, 3)
        s, distance = np.empty(len(p)), np.empty(len(p))
        for low in range(0, len(p), _CHUNK):
            part = slice(low, low + _CHUNK)
            s[part], distance[part] = self._project_chunk(p[part])
        return s, distance

    def flipped(self) -> JointPath:
        """The same joint from its other mouth: v turned round and the direction reversed, n = u x v."""
        return JointPath(self.points[::-1].copy(), self.u[::-1].copy(), -self.v[::-1], self.closed)

    def swapped(self) -> JointPath:
        """The same mouth with A and B exchanged: u turned round and the direction reversed."""
        return JointPath(self.points[::-1].copy(), -self.u[::-1], self.v[::-1].copy(), self.closed)

    def _project_chunk(self, p: Array) -> tuple[Array, Array]:
        best = np.full(len(p), np.inf)
        leg, share = np.zeros(len(p), np.int64), np.zeros(len(p))
        for i, (start, way) in enumerate(zip(self.points[:-1], np.diff(self.points, axis=0), strict=True)):
            offset = p - start
            t = np.clip(offset @ (way / (way @ way)), 0.0, 1.0)
            offset -= t[:, None] * way
            squared = np.einsum("ij,ij->i", offset, offset)
            nearer = squared < best
            best[nearer], share[nearer], leg[nearer] = squared[nearer], t[nearer], i
        on_curve = np.flatnonzero(self._curved_legs[leg])
        if len(on_curve):
            leg[on_curve], share[on_curve] = self._refine(p[on_curve], leg[on_curve], share[on_curve])
            foot = self._at(leg[on_curve], share[on_curve])
            best[on_curve] = np.einsum("ij,ij->i", p[on_curve] - foot, p[on_curve] - foot)
        return self.stops[leg] + share * self.leg_lengths[leg], np.sqrt(best)

    def _refine(self, p: Array, leg: NDArray[np.int64], share: Array) -> tuple[NDArray[np.int64], Array]:
        """Newton on (p - c(s)) . n(s) = 0 along a curve; stays within its run of facets."""
        lengths, count = self.leg_lengths, len(self.u)
        step = 1e-4
        for _ in range(_NEWTON_STEPS):
            ahead = np.where(share < 0.5, step, -step)
            here = np.einsum("ij,ij->i", p - self._at(leg, share), self._tangent(leg, share))
            there = np.einsum("ij,ij->i", p - self._at(leg, share + ahead), self._tangent(leg, share + ahead))
            slope = (there - here) / ahead
            # beyond the centre of curvature the slope changes sign, and no section holds the point
            good = slope < -0.05 * lengths[leg]
            share = share - np.where(good, here / np.where(good, slope, -1.0), 0.0)
            for _ in range(2):
                over, under = share > 1.0, share < 0.0
                onward = np.where(over, leg + 1, np.where(under, leg - 1, leg))
                onward = onward % count if self.closed else np.clip(onward, 0, count - 1)
                joined = np.where(over, self._smooth[leg + 1], np.where(under, self._smooth[leg], False))
                move = joined & (onward != leg)
                rest = np.where(over, share - 1.0, share) * lengths[leg] / lengths[onward]
                share = np.where(move, np.where(over, rest, 1.0 + rest), share)
                leg = np.where(move, onward, leg)
            share = np.clip(share, 0.0, 1.0)
        return leg, share

    def _at(self, leg: NDArray[np.int64], share: Array) -> Array:
        return np.asarray(self.points[leg] + share[:, None] * (self.points[leg + 1] - self.points[leg]))

    def _tangent(self, leg: NDArray[np.int64], share: Array) -> Array:
        """Section normals at shares (m,) of legs (m,): turned steadily from start to end, shape (m, 3)."""
        starts, ends = self._leg_axes
        return _turned(starts[0][leg], ends[0][leg], share)

    @cached_property
    def _smooth(self) -> NDArray[np.bool_]:
        """For every point, whether its two legs are facets of one curve, shape (k,)."""
        n = self.leg_directions
        k = len(self.points)
        out = np.zeros(k, bool)
        if len(n) < 3:
            return out
        before = np.arange(k) - 1
        after = np.arange(k)
        if self.closed:
            before, after = before % len(n), after % len(n)
            inner = slice(0, k)
        else:
            inner = slice(1, k - 1)
        cosine = math.cos(SMOOTH_TURN)
        i, j = before[inner], after[inner]
        gentle = np.einsum("ij,ij->i", n[i], n[j]) > cosine
        out[inner] = gentle & (np.einsum("ij,ij->i", self.u[i], self.u[j]) > cosine)
        # two legs that meet at a slight angle are a polyline, not a curve
        lonely = (
            out & ~(np.roll(out, 1) | np.roll(out, -1)) if not self.closed else out & (out[:-1].sum() < 2)
        )
        return out & ~lonely

    @cached_property
    def _curved_legs(self) -> NDArray[np.bool_]:
        return np.asarray(self._smooth[:-1] | self._smooth[1:])

    @cached_property
    def _leg_axes(self) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
        """The axes (n, u) at every leg's start and end, each of shape (k - 1, 3)."""
        n = self.leg_directions
        u = _reject(self.u, n)
        start_n, start_u, end_n, end_u = n.copy(), u.copy(), n.copy(), u.copy()
        count, lengths, smooth = len(n), self.leg_lengths, self._smooth
        for p in np.flatnonzero(smooth).tolist():
            i, j = (p - 1) % count, p % count
            w = _turn_share(lengths[i], lengths[j])
            tangent = _turned(n[i : i + 1], n[j : j + 1], np.array([w]))
            end_n[i] = start_n[j] = tangent[0]
            end_u[i] = start_u[j] = _reject((1.0 - w) * u[i : i + 1] + w * u[j : j + 1], tangent)[0]
        # at the ends of a curve its outermost facets keep turning as they do at their inner end
        for i in range(count):
            outer, inner = not smooth[i], not smooth[i + 1]
            if outer == inner:
                continue
            neighbour = (i + 1) % count if outer else (i - 1) % count
            if lengths[i] > _STRAIGHT_RATIO * lengths[neighbour]:
                continue
            if outer:
                start_n[i] = _mirrored(end_n[i], n[i])
                start_u[i] = _reject(_mirrored(end_u[i], u[i])[None], start_n[i : i + 1])[0]
            else:
                end_n[i] = _mirrored(start_n[i], n[i])
                end_u[i] = _reject(_mirrored(start_u[i], u[i])[None], end_n[i : i + 1])[0]
        return (start_n, start_u), (end_n, end_u)


def _turn_share(before: float, after: float) -> float:
    """How much of the turn between two facets lies before their common point.

    On a circle the tangent leaves a chord by half the chord's arc; a leg much longer than its neighbour is
    straight and runs into the curve without a turn.
    """
    if before > _STRAIGHT_RATIO * after:
        return 0.0
    if after > _STRAIGHT_RATIO * before:
        return 1.0
    return before / (before + after)


def _turned(a: Array, b: Array, share: Array) -> Array:
    """Unit vectors (m, 3) on the great arc from a to b, at shares (m,) of its angle."""
    angle = np.arctan2(np.linalg.norm(np.cross(a, b), axis=1), np.einsum("ij,ij->i", a, b))
    size = np.sin(angle)
    flat = size < 1e-9
    size = np.where(flat, 1.0, size)
    wa = np.where(flat, 1.0 - share, np.sin((1.0 - share) * angle) / size)
    wb = np.where(flat, share, np.sin(share * angle) / size)
    out = wa[:, None] * a + wb[:, None] * b
    return np.asarray(out / np.linalg.norm(out, axis=1, keepdims=True))


def _mirrored(vector: Array, axis: Array) -> Array:
    """The unit vector as far beyond ``axis`` as ``vector`` is before it."""
    return np.asarray(2.0 * (vector @ axis) * axis - vector)


def _reject(vectors: Array, normals: Array) -> Array:
    """Unit vectors (m, 3) made square to unit normals (m, 3)."""
    out = vectors - np.einsum("ij,ij->i", vectors, normals)[:, None] * normals
    return np.asarray(out / np.linalg.norm(out, axis=1, keepdims=True))
