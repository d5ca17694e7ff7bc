"""A joint's residuals pooled along it: whether its components have the designed shape (METHOD, section 5).

A single slice cannot tell a bow of a few millimetres from noise; the same place on the component, seen in all
slices of the joint, can. Returns are put into bins by where their beams should have met the surface, for
where they lie depends on their noise; and of every slice by itself what a motion of the component explains is
taken out (least squares with a pose a station as nuisance), so that errors of its pose do not count.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bimfit.estimation.result import StationEstimate
from bimfit.geometry.joint_section import JointSection
from bimfit.geometry.pose import Array
from bimfit.geometry.profile import Profile

Ints = NDArray[np.int64]
BINS = 10
_LEAST = 12
"""Returns that a bin needs."""
_SHARE = 0.05
"""Share of the returns that a face needs to be looked at."""
_FEWEST = 4
_CLEAR = 2.0
_FLAT = 1e-6
_MOTION = 0.1
"""Combinations of bins with less than this share of the best one's information are motions of the whole."""


@dataclass(frozen=True)
class Departure:
    """How far a component's surface lies from its design, on average along the joint.

    Attributes
    ----------
    places : ndarray, shape (k, 2)
        Middles of the bins, on the designed component, m.
    offset, sd : ndarray, shape (k,)
        Mean distance of the returns in front of the designed surface (outward positive), what a rigid
        motion of each station explains taken out, and its standard deviation, m.
    chi2 : float
        Of all offsets, a degree of freedom; NaN without bins.
    freedom : int
        Bins less what a rigid motion takes.
    bow : float
        How many standard deviations a parabola along the outline is away from none.
    bend : float
        Root mean square of that parabola, what a rigid motion explains taken out, m.
    """

    places: Array
    offset: Array
    sd: Array
    chi2: float
    freedom: int
    bow: float
    bend: float

    @property
    def worst(self) -> float:
        """The offset that is largest in size, m; 0 without bins."""
        return float(self.offset[np.argmax(np.abs(self.offset))]) if len(self.offset) else 0.0

    @property
    def rms(self) -> float:
        """Root mean square of the offsets less what noise adds to it, m."""
        if not len(self.offset):
            return 0.0
        return math.sqrt(max(float(np.mean(self.offset**2 - self.sd**2)), 0.0))

    @property
    def score(self) -> float:
        """By how many standard deviations chi-square is too large (Wilson-Hilferty); 0 without bins."""
        if self.freedom < 1:
            return 0.0
        k = 2.0 / (9.0 * self.freedom)
        return (math.cbrt(self.chi2) - (1.0 - k)) / math.sqrt(k)


NOTHING = Departure(np.zeros((0, 2)), np.zeros(0), np.zeros(0), math.nan, 0, 0.0, 0.0)


def departure(
    stations: Sequence[StationEstimate],
    sections: Sequence[JointSection],
    which: int,
    *,
    correlation: float = 0.0,
    bins: int = BINS,
) -> Departure:
    """Pool the residuals of component ``which`` (0 for A, 1 for B) along the joint.

    Parameters
    ----------
    stations, sections : sequence
        One a station; those whose component is rejected or has no pose do not count.
    correlation : float
        Of neighbouring beams' noise: pooled means are that much less certain.
    bins : int
        Of equal count along the component's outline.
    """
    parts = [
        _Returns.of(station, section.components[which], which, k)
        for k, (station, section) in enumerate(zip(stations, sections, strict=True))
    ]
    pooled = _Returns.joined([part for part in parts if part is not None])
    if pooled is None:
        return NOTHING
    groups = _groups(pooled.faces, pooled.along, bins)
    if len(groups) < _FEWEST:
        return NOTHING
    return _binned(pooled, groups, correlation)


@dataclass(frozen=True)
class _Returns:
    """Returns of one component, a row each.

    Attributes
    ----------
    station, faces : ndarray, shape (n,)
        Which station, and which edge of the profile.
    along : ndarray, shape (n,)
        Of the beam's foot, along the outline, m.
    feet, normals : ndarray, shape (n, 2)
        On the designed component.
    z, lean : ndarray, shape (n,)
        See :class:`~bimfit.estimation.result.Residuals`.
    """

    station: Ints
    faces: Ints
    along: Array
    feet: Array
    normals: Array
    z: Array
    lean: Array

    @classmethod
    def of(cls, station: StationEstimate, profile: Profile, which: int, k: int) -> _Returns | None:
        """Those of one station that belong to their face for certain; None where there are hardly any."""
        c = station.components[which]
        r = c.residuals
        if c.pose is None or not c.status.measured or len(r.feet) < _LEAST:
            return None
        feet = c.pose.inverse().apply(r.feet)
        along, clear, normals = on_outline(profile, feet, r.faces)
        # near an edge, a beam that meets the other face is taken for one of this
        keep = clear > _CLEAR * station.sensor.sigma
        every = cls(np.full(len(along), k), r.faces, along, feet, normals, r.residuals, r.lean)
        return every.take(keep)

    def take(self, rows: Ints | NDArray[np.bool_]) -> _Returns:
        """Some of them."""
        return _Returns(
            self.station[rows], self.faces[rows], self.along[rows], self.feet[rows], self.normals[rows],
            self.z[rows], self.lean[rows],
        )  # fmt: skip

    @classmethod
    def joined(cls, parts: Sequence[_Returns]) -> _Returns | None:
        """All in one; None where there are none."""
        if not parts:
            return None
        rows = [(p.station, p.faces, p.along, p.feet, p.normals, p.z, p.lean) for p in parts]
        return cls(*(np.concatenate(column) for column in zip(*rows, strict=True)))


def _groups(faces: Ints, along: Array, bins: int) -> list[Ints]:
    """Returns in bins of about equal count, none across two faces; faces hardly seen are left out."""
    names, counts = np.unique(faces, return_counts=True)
    seen = counts >= max(_SHARE * counts.sum(), 2 * _LEAST)
    out: list[Ints] = []
    for name, count in zip(names[seen], counts[seen], strict=True):
        mine = np.flatnonzero(faces == name)
        mine = mine[np.argsort(along[mine], kind="stable")]
        pieces = max(1, min(round(bins * count / counts[seen].sum()), count // _LEAST))
        out += [np.asarray(piece) for piece in np.array_split(mine, pieces)]
    return out


def on_outline(profile: Profile, feet: Array, faces: Ints) -> tuple[Array, Array, Array]:
    """Where on a profile's outline points lie that are known to belong to certain edges.

    Parameters
    ----------
    feet : ndarray, shape (m, 2)
        On the designed component.
    faces : ndarray, shape (m,)
        The edge of each.

    Returns
    -------
    along, clear : ndarray, shape (m,)
        Distance along the outline, and from the nearer end of the edge, m.
    normals : ndarray, shape (m, 2)
        The outward normal there.
    """
    edges = profile.edges
    d = edges[:, 1] - edges[:, 0]
    size = np.maximum(np.linalg.norm(d, axis=1), 1e-12)
    start = np.concatenate([[0.0], np.cumsum(size)])
    t = ((feet - edges[faces, 0]) * d[faces] / size[faces, None]).sum(axis=1)
    return start[faces] + t, np.minimum(t, size[faces] - t), np.asarray(profile.normals[faces])


def _binned(rows: _Returns, groups: Sequence[Ints], correlation: float) -> Departure:
    """Least squares of one offset a bin, with a motion a station as nuisance parameters."""
    group = np.repeat(np.arange(len(groups)), [len(g) for g in groups])
    rows = rows.take(np.concatenate(groups))
    _, station = np.unique(rows.station, return_inverse=True)
    z, lean, k, n = rows.z, rows.lean, len(groups), int(station.max()) + 1
    moves = _moves(rows)
    # sums a station, and a station and bin
    cell = station * k + group
    gram = np.stack([[np.bincount(station, a * b, n) for a in moves.T] for b in moves.T]).transpose(2, 0, 1)
    seen = np.stack([np.bincount(station, a * z, n) for a in moves.T], axis=1)
    cross = np.stack([np.bincount(cell, a / lean, n * k).reshape(n, k) for a in moves.T], axis=2)
    inverse = np.linalg.pinv(gram, rcond=_FLAT, hermitian=True)
    taken = cross @ inverse
    information = np.diag(np.bincount(group, 1.0 / lean**2, k)) - np.einsum("ska,sla->kl", taken, cross)
    pull = np.bincount(group, z / lean, k) - np.einsum("ska,sa->k", taken, seen)
    size, vectors = np.linalg.eigh(information)
    free = size > _MOTION * size[-1]
    size, vectors = size[free], vectors[:, free]
    offset = vectors @ (vectors.T @ pull / size)
    explained = float(((vectors.T @ pull) ** 2 / size).sum())
    left = float(z @ z) - float(np.einsum("sa,sab,sb->", seen, inverse, seen)) - explained
    freedom = len(size)
    spent = int(np.linalg.matrix_rank(gram, rtol=_FLAT, hermitian=True).sum()) + freedom
    sigma2 = left / max(len(z) - spent, 1) * (1.0 + correlation) / (1.0 - correlation)
    sd = np.sqrt(sigma2 * (vectors**2 / size).sum(axis=1))
    count = np.bincount(group, minlength=k)
    where = np.bincount(group, rows.along, k) / count
    bend = ((where - where.mean()) / max(float(np.ptp(where)), 1e-9)) ** 2
    weight = float(bend @ information @ bend)
    known = weight > _FLAT * size[-1]
    rise = float(bend @ pull) / weight if known else 0.0
    shown = vectors @ (vectors.T @ bend)
    middle = np.stack([np.bincount(group, x, k) / count for x in rows.feet.T], axis=1)
    chi2 = explained / sigma2 / freedom if freedom > 0 else math.nan
    return Departure(
        middle, offset, sd, chi2, freedom, rise * math.sqrt(weight / sigma2),
        abs(rise) * float(np.sqrt(np.mean(shown**2))),
    )  # fmt: skip


def _moves(rows: _Returns) -> Array:
    """What residual a unit of each motion of the component makes, shape (n, 3)."""
    arm = rows.feet - rows.feet.mean(axis=0)
    turn = arm[:, 0] * rows.normals[:, 1] - arm[:, 1] * rows.normals[:, 0]
    moves = np.column_stack([rows.normals, turn / max(float(np.abs(arm).max()), 1e-6)])
    return np.asarray(moves / rows.lean[:, None])
