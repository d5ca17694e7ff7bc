"""A joint's residuals pooled along it: whether its components have the designed shape (METHOD, section 5).

A single slice cannot tell a bow of a few millimetres from noise; the same place on the component, seen in all
slices of the joint, can.
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


@dataclass(frozen=True)
class Departure:
    """How far a component's surface lies from its design, on average along the joint.

    Attributes
    ----------
    places : ndarray, shape (k, 2)
        Middles of the bins, on the designed component, m.
    offset, sd : ndarray, shape (k,)
        Mean distance of the returns in front of the designed surface (outward positive), what a rigid
        motion explains taken out, and its standard deviation, m.
    chi2 : float
        Sum of (offset / sd)^2, a degree of freedom; NaN without bins.
    freedom : int
        Bins less what a rigid motion takes.
    bow : float
        How many standard deviations a parabola along the outline is away from none.
    """

    places: Array
    offset: Array
    sd: Array
    chi2: float
    freedom: int
    bow: float

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


NOTHING = Departure(np.zeros((0, 2)), np.zeros(0), np.zeros(0), math.nan, 0, 0.0)


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
        One a station; those without a pose do not count.
    correlation : float
        Of neighbouring beams' noise: pooled means are that much less certain.
    bins : int
        Of equal count along the component's outline.
    """
    parts = []
    for station, section in zip(stations, sections, strict=True):
        c = station.components[which]
        if c.pose is None or len(c.residuals.places) < _LEAST:
            continue
        faces = c.residuals.faces
        along, clear, *at = on_outline(
            section.components[which], c.pose.inverse().apply(c.residuals.places), faces
        )
        # near an edge, a beam that meets the other face is taken for one of this
        keep = clear > _CLEAR * station.sensor.sigma
        parts.append((faces[keep], along[keep], *(column[keep] for column in at)))
    if not parts:
        return NOTHING
    faces, along, offset, places, normals = (np.concatenate(column) for column in zip(*parts, strict=True))
    groups = _groups(faces, along, bins)
    if len(groups) < _FEWEST:
        return NOTHING
    return _binned(groups, along, offset, places, normals, correlation)


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


def on_outline(profile: Profile, points: Array, faces: Ints) -> tuple[Array, Array, Array, Array, Array]:
    """Where on a profile's outline points lie that are known to belong to certain edges.

    Parameters
    ----------
    points : ndarray, shape (m, 2)
        On the designed component.
    faces : ndarray, shape (m,)
        The edge of each.

    Returns
    -------
    along, clear, offset : ndarray, shape (m,)
        Distance along the outline, from the nearer end of the edge, and in front of its surface (outward
        positive), m.
    places, normals : ndarray, shape (m, 2)
        The foot of each point on its edge, and the outward normal there.
    """
    edges = profile.edges
    d = edges[:, 1] - edges[:, 0]
    size = np.maximum(np.linalg.norm(d, axis=1), 1e-12)
    start = np.concatenate([[0.0], np.cumsum(size)])
    a, d, normal = edges[faces, 0], d[faces] / size[faces, None], profile.normals[faces]
    w = points - a
    t = (w * d).sum(axis=1)
    clear = np.minimum(t, size[faces] - t)
    return start[faces] + t, clear, np.asarray((w * normal).sum(axis=1)), a + t[:, None] * d, normal


def _binned(
    groups: Sequence[Ints], along: Array, offset: Array, places: Array, normals: Array, correlation: float
) -> Departure:
    """Means in bins, less the rigid motion that explains most of them."""
    mean = np.array([offset[g].mean() for g in groups])
    total = sum(len(g) for g in groups)
    within = sum(float(((offset[g] - m) ** 2).sum()) for g, m in zip(groups, mean, strict=True))
    sigma = math.sqrt(within / max(total - len(groups), 1) * (1.0 + correlation) / (1.0 - correlation))
    sd = np.array([sigma / math.sqrt(len(g)) for g in groups])
    middle = np.array([places[g].mean(axis=0) for g in groups])
    normal = np.array([normals[g].mean(axis=0) for g in groups])
    arm = middle - middle.mean(axis=0)
    scale = max(float(np.abs(arm).max()), 1e-6)
    turn = (arm[:, 0] * normal[:, 1] - arm[:, 1] * normal[:, 0]) / scale
    left, singular, _ = np.linalg.svd(np.column_stack([normal, turn]) / sd[:, None], full_matrices=False)
    left = left[:, singular > 1e-3 * singular[0]]
    z = mean / sd
    z = z - left @ (left.T @ z)
    where = np.array([along[g].mean() for g in groups])
    bend = ((where - where.mean()) / max(float(np.ptp(where)), 1e-9)) ** 2 / sd
    bend = bend - left @ (left.T @ bend)
    size = float(np.linalg.norm(bend))
    bow = float(bend @ z) / size if size > 1e-9 else 0.0
    freedom = len(groups) - left.shape[1]
    chi2 = float(z @ z) / freedom if freedom > 0 else math.nan
    return Departure(middle, z * sd, sd, chi2, freedom, bow)
