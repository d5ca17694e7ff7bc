"""One motion of a component judged by all beams along the joint at once, not by its stations' Gaussians.

A station knows a corner across the gap as a box: between the last beam that meets it and the first that does
not. Boxes are no Gaussians. Under a motion with few parameters they cut each other down: wherever the corner
drifts across a beam it is fixed sharply, and where it does not drift it may be anywhere in one and the same
box, however many stations there are. So the parameters' posterior is sampled under the beams' joint
likelihood, from a Student proposal that the stations' Gaussian answer starts and that adapts in steps
(tempered population Monte Carlo).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from bimfit.estimation import _kernels_pooled as kernels
from bimfit.estimation.borrow import FLAG
from bimfit.estimation.likelihood import Ints
from bimfit.estimation.result import StationEstimate
from bimfit.estimation.trend import NODES, Basis, Mask, Sites, Trend
from bimfit.geometry.joint_section import JointSection
from bimfit.geometry.pose import Array

_NU = 6
_DRAWS = 1024
_ROUNDS = 20
_ENOUGH = 0.06
"""Effective share of the draws that a step of the tempering keeps."""
_WIDER = 1.5
"""How much wider, as a variance, the proposal is than what was found."""
_REST = 0.01
"""And that share of the last proposal: never degenerate, however few draws count."""
_EFFECTIVE = 200.0
"""So many draws, and two rounds of them, must count at the full likelihood."""
_JUMPED = 0.5
_FEW = 3


@dataclass(frozen=True)
class Beams:
    """All beams of one component along a joint, as the kernels take them (see _kernels_pooled).

    Attributes
    ----------
    edges : ndarray, shape (M, 6)
        As designed, less the corner.
    row, first : ndarray, shape (n + 1,)
        Where the edges and the beams of every station begin.
    beams, origin : ndarray, shape (9, N) and (2, N)
        Origins less the corner as designed.
    margin, bearing : ndarray, shape (n,)
    """

    edges: Array
    row: Ints
    beams: Array
    origin: Array
    first: Ints
    margin: Array
    bearing: Array

    @classmethod
    def of(
        cls, stations: Sequence[StationEstimate], sections: Sequence[JointSection], which: int, use: Mask
    ) -> Beams:
        """Those of the stations in ``use``; the others have none."""
        rows, beams, origins = [], [], []
        margin, bearing = np.zeros(len(stations)), np.zeros(len(stations))
        for i, (station, section) in enumerate(zip(stations, sections, strict=True)):
            p = station.components[which].posterior
            if not use[i] or p is None or p.heard is None:
                rows.append(np.zeros((0, 6)))
                beams.append(np.zeros((9, 0)))
                origins.append(np.zeros((2, 0)))
                continue
            corner = section.gap.mouth[which]
            rows.append(p.heard.rows - np.r_[corner, corner, 0.0, 0.0])
            beams.append(p.heard.beams)
            origins.append(p.heard.origin - corner[:, None])
            margin[i], bearing[i] = p.heard.margin, p.heard.bearing
        return cls(
            np.concatenate(rows), _ends([len(r) for r in rows]), np.concatenate(beams, axis=1),
            np.concatenate(origins, axis=1), _ends([b.shape[1] for b in beams]), margin, bearing,
        )  # fmt: skip

    def of_stations(self, keep: Mask) -> Beams:
        """The beams of the stations for which ``keep`` holds."""
        return self.take(np.repeat(keep, np.diff(self.first)))

    def expanded(self, place: Array, design: Array, spread: Array) -> tuple[Array, Array, Beams]:
        """What all but the doubtful beams say of a motion design @ x beyond ``place``: q.x - x.Q x / 2.

        Parameters
        ----------
        place, design, spread : ndarray, shape (n, 3), (n, 3, k) and (k, k)
            ``spread``: covariance of x.

        Returns
        -------
        Q, q, doubtful
            The doubtful ones may meet another edge, or none, within that spread.
        """
        n = len(place)
        H, g = np.empty((n, 3, 3)), np.empty((n, 3))
        doubtful = np.empty(self.beams.shape[1], bool)
        kernels.expand(
            self.edges, self.row, self.beams, self.origin, self.first, self.bearing,
            np.ascontiguousarray(place), design @ spread @ design.transpose(0, 2, 1), H, g, doubtful,
        )  # fmt: skip
        Q = np.einsum("iak,iab,ibl->kl", design, H, design)
        return Q, np.einsum("iak,ia->k", design, g), self.take(doubtful)

    def likelihood(self, place: Array, functions: Array, draws: Array) -> Array:
        """Log-likelihood (m,) of motions sum_k functions_k draws_k beyond ``place``, draws (m, k, 3)."""
        out = np.empty(len(draws))
        kernels.log_likelihoods(
            self.edges, self.row, self.beams, self.origin, self.first, self.margin, self.bearing,
            np.ascontiguousarray(place), np.ascontiguousarray(functions), draws, out,
        )  # fmt: skip
        return out

    def take(self, keep: Mask) -> Beams:
        """The beams for which ``keep`` holds."""
        first = np.concatenate([[0], np.cumsum(keep)])[self.first]
        return replace(
            self,
            beams=np.ascontiguousarray(self.beams[:, keep]),
            origin=np.ascontiguousarray(self.origin[:, keep]),
            first=first,
        )


def _ends(counts: Sequence[int]) -> Ints:
    return np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)


@lru_cache(maxsize=16)
def _draws(dimensions: int) -> tuple[Array, Array]:
    """Student deviates (nu = 6), shape (1024, dimensions), and their log density."""
    from scipy.special import gammaln
    from scipy.stats import chi2, norm, qmc

    d = dimensions
    uniform = qmc.Sobol(d + 1, scramble=True, rng=np.random.default_rng(1)).random(_DRAWS)
    z = norm.ppf(uniform[:, :d]) * np.sqrt(_NU / chi2.ppf(uniform[:, d:], _NU))
    constant = gammaln((_NU + d) / 2) - gammaln(_NU / 2) - 0.5 * d * math.log(_NU * math.pi)
    return z, constant - 0.5 * (_NU + d) * np.log1p((z**2).sum(axis=1) / _NU)


def pooled(
    stations: Sequence[StationEstimate],
    sections: Sequence[JointSection],
    which: int,
    sites: Sites,
    basis: Basis,
    rough: Trend,
) -> tuple[Trend | None, bool]:
    """A component's trend under the joint likelihood of all its beams, and whether they bear the motion out.

    Parameters
    ----------
    which : int
        0 for A, 1 for B.
    sites, basis, rough
        The component's stations, the motion's functions with a prior on their coefficients (``penalty``), and
        what the stations' Gaussians say of it, what they share included.

    Returns
    -------
    Trend or None
        None where too few stations have beams to be heard, the sampling does not settle, or the motion is not
        borne out.
    bool
        False where the beams of the stations are far better explained by every station's own estimate.
    """
    known = int(sites.known.sum())
    use = sites.known & (rough.distance <= FLAG) & (rough.jump < _JUMPED)
    if 2 * int(use.sum()) < known:
        return None, False
    use &= np.array([_heard(station, which) for station in stations])
    count = int(use.sum())
    if count < _FEW or 2 * count < known:
        return None, True
    beams = Beams.of(stations, sections, which, use)
    trend = rough
    step = -(-count // NODES)
    if step > 1:  # some of the stations first: all of them then have hardly a beam that is in doubt
        some = np.zeros(len(use), bool)
        some[np.flatnonzero(use)[::step]] = True
        found = _sampled(beams.of_stations(some), basis, trend)
        if found is None:
            return None, True
        trend = _moved(trend, basis, *found)
    found = _sampled(beams, basis, trend)
    if found is None:
        return None, True
    trend = _moved(trend, basis, *found)
    if _excess(beams, sites, trend, use) > _excess_by_chance(3 * count):
        return None, False
    return trend, True


def _heard(station: StationEstimate, which: int) -> bool:
    p = station.components[which].posterior
    return p is not None and p.heard is not None and not station.virtual


def _moved(trend: Trend, basis: Basis, mean: Array, cov: Array) -> Trend:
    """The trend with other coefficients, which differ by ``mean``, and their covariance."""
    X = _design(basis)
    return replace(trend, value=trend.value + X @ mean, covariance=X @ cov @ X.transpose(0, 2, 1), spread=cov)


def _design(basis: Basis) -> Array:
    """Motion of every station by each coefficient that is free, shape (n, 3, free)."""
    n, k = basis.functions.shape
    X = np.zeros((n, 3, k, 3))
    for a in range(3):
        X[:, a, :, a] = basis.functions
    return X.reshape(n, 3, 3 * k)[:, :, basis.moves.ravel()]


def _precision(basis: Basis) -> Array:
    """Prior precision of the coefficients that are free, shape (free, free)."""
    k, free = len(basis.moves), basis.moves.ravel()
    P = np.zeros((k, 3, k, 3))
    if basis.penalty is not None:
        for a in range(3):
            P[:, a, :, a] = basis.penalty[:, :, a]
    return P.reshape(3 * k, 3 * k)[np.ix_(free, free)]


def _sampled(beams: Beams, basis: Basis, trend: Trend) -> tuple[Array, Array] | None:
    """Mean and covariance of how the coefficients differ from the trend; None where that does not settle."""
    X, free = _design(basis), basis.moves.ravel()
    shape = _WIDER * trend.spread
    Q, q, doubtful = beams.expanded(trend.value, X, shape)
    Q += _precision(basis)
    z, density = _draws(len(q))
    full = np.zeros((len(z), free.size))
    centre, power = np.zeros(len(q)), 0.0
    calm: list[tuple[float, Array, Array]] = []
    for turn in range(_ROUNDS):
        try:
            # other draws of the same density every time
            x = centre + (-1) ** turn * np.roll(z, turn, axis=1) @ np.linalg.cholesky(shape).T
        except np.linalg.LinAlgError:
            return None
        full[:, free] = x
        log = doubtful.likelihood(trend.value, basis.functions, full.reshape(-1, *basis.moves.shape))
        log += x @ q - 0.5 * np.einsum("sk,kl,sl->s", x, Q, x) - density
        power, w = _tempered(log, power)
        centre = w @ x
        cov = ((x - centre) * w[:, None]).T @ (x - centre)
        shape = _WIDER * cov + _REST * shape
        if power == 1.0:
            calm.append((float(1.0 / np.sum(w * w)), centre, cov))
            if len(calm) > 1 and sum(count for count, _, _ in calm) >= _EFFECTIVE:
                break
    return _together(calm) if len(calm) > 1 else None


def _together(parts: Sequence[tuple[float, Array, Array]]) -> tuple[Array, Array]:
    """Mean and covariance of several sets of draws, given by how many each is worth, and its own two."""
    total = sum(count for count, _, _ in parts)
    mean = np.asarray(sum(count / total * part for count, part, _ in parts))
    cov = sum(count / total * (own + np.outer(part - mean, part - mean)) for count, part, own in parts)
    return mean, np.asarray(cov)


def _tempered(log: Array, power: float) -> tuple[float, Array]:
    """The highest power, above the last one, at which enough draws count; and their weights there."""
    low, power = power, 1.0
    for _ in range(12):
        w = np.exp(power * (log - log.max()))
        w /= w.sum()
        if 1.0 / np.sum(w * w) >= _ENOUGH * len(w):
            break
        power = low + 0.5 * (power - low)
    return power, w


def _excess(beams: Beams, sites: Sites, trend: Trend, use: Mask) -> float:
    """By how much more log-likelihood the stations' own estimates explain all beams than the trend does."""
    own = np.where(use[:, None], sites.value, trend.value)
    Q, q, doubtful = beams.expanded(trend.value, (own - trend.value)[:, :, None], np.ones((1, 1)))
    still = np.ones((len(own), 1)), np.zeros((1, 1, 3))
    gain = doubtful.likelihood(own, *still) - doubtful.likelihood(trend.value, *still)
    return float(gain[0] + q[0] - 0.5 * Q[0, 0])


def _excess_by_chance(freedom: int) -> float:
    """What :func:`_excess` is seldom beyond, for so many figures that are the stations' own."""
    # Wilson and Hilferty's chi-square quantile, one in ten thousand
    k = 2.0 / (9.0 * freedom)
    return 0.5 * freedom * (1.0 - k + 3.72 * math.sqrt(k)) ** 3
