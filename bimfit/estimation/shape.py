"""A component's shape freedoms, estimated from all stations of a joint and pooled where the data say so.

At each station the evidence of a shape is the beam likelihood integrated over the component's pose, so that
what a pose explains is never taken for shape. Its logarithm is quadratic near the best shape: three nodes a
freedom give a site, the sites of a joint give one shape for all, one that drifts, or one a station.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bimfit.config import FitConfig, SensorConfig, ShapeConfig
from bimfit.estimation.components import reshaped
from bimfit.estimation.posterior import Posterior
from bimfit.estimation.result import StationEstimate
from bimfit.geometry.joint_section import JointSection
from bimfit.geometry.pose import Array
from bimfit.geometry.shape import deformed, has_freedom
from bimfit.geometry.slice import Slice

_ROUNDS = 3
_UNSEEN = {"thickness": 0.33}
_UNSEEN_ELSE = 0.6
"""A posterior deviation over that share of the prior's: what there is to say is the prior's, not the data's.
From above a back face shows only in where a few grazing beams end, so a thickness must be seen well."""
_NU = 4.0
_SPREADS = (0.0, 0.05, 0.1, 0.2, 0.4, 0.8)


@dataclass(frozen=True)
class Shape:
    """A component's shape along a joint, one row a station and one column a freedom.

    Attributes
    ----------
    names : tuple of str
    value, sd : ndarray, shape (n, k)
        Difference from the design and its standard deviation, rad or m; NaN for what cannot be seen.
    covariance : ndarray, shape (n, k, k)
        Of the freedoms that are seen; 0 for the others.
    gain : ndarray, shape (n, 3, k)
        How the component's pose (u, v, theta) moves with each freedom; 0 for those that are not seen.
    unseen, at_limit : ndarray of bool, shape (k,) and (n, k)
    model : tuple of str
        How each freedom was pooled: ``constant``, ``linear`` or ``station``; "" where it is not seen.
    """

    names: tuple[str, ...]
    value: Array
    sd: Array
    covariance: Array
    gain: Array
    unseen: NDArray[np.bool_]
    at_limit: NDArray[np.bool_]
    model: tuple[str, ...]

    def at(self, station: int) -> dict[str, float]:
        """The freedoms of one station that are seen."""
        row = self.value[station].tolist()
        return {name: x for name, x in zip(self.names, row, strict=True) if math.isfinite(x)}


@dataclass(frozen=True)
class _Sites:
    """Each station's say about the freedoms about a common centre, in units of the priors."""

    slope: Array
    information: Array
    gain: Array
    known: NDArray[np.bool_]


def estimate_shape(
    stations: Sequence[StationEstimate],
    sections: Sequence[JointSection],
    slices: Sequence[Slice],
    which: int,
    shape: ShapeConfig,
    sensor: SensorConfig,
    fit: FitConfig,
) -> Shape | None:
    """Estimate the freedoms of component ``which`` along a joint.

    Parameters
    ----------
    stations, sections, slices : sequence
        One a station; the sections are the design.

    Returns
    -------
    Shape or None
        None where no freedom is asked for that the component has, or no station has a pose.
    """
    known = [e.components[which].pose is not None for e in stations]
    names = tuple(
        name
        for name in shape.freedoms
        if any(has_freedom(s, which, name) for s, k in zip(sections, known, strict=True) if k)
    )
    if not names:
        return None
    prior = np.array([shape.freedoms[name] for name in names])
    k = len(names)
    centre, step = np.zeros(k), np.full(k, 0.7)
    sites, pooled = None, np.eye(k)
    for _ in range(_ROUNDS):
        sites = _sites(stations, sections, slices, which, names, prior, centre, step, (sensor, fit))
        if not sites.known.any():
            return None
        change, pooled = _pooled(sites, centre)
        centre = np.clip(centre + change, -shape.limit, shape.limit)
        step = np.clip(1.5 * np.sqrt(np.diag(pooled)), 0.1, 0.7)
    assert sites is not None
    # the last sites are about the centre before its last step
    return _along(sites, centre - change, change, pooled, stations, names, prior, shape.limit)


def _sites(
    stations: Sequence[StationEstimate],
    sections: Sequence[JointSection],
    slices: Sequence[Slice],
    which: int,
    names: tuple[str, ...],
    prior: Array,
    centre: Array,
    step: Array,
    settings: tuple[SensorConfig, FitConfig],
) -> _Sites:
    n, k = len(stations), len(names)
    nodes = _nodes(centre, step)
    slope, information = np.zeros((n, k)), np.zeros((n, k, k))
    gain, known = np.zeros((n, 3, k)), np.zeros(n, bool)
    for i, (station, section, slice_) in enumerate(zip(stations, sections, slices, strict=True)):
        if station.components[which].pose is None or station.combined is None:
            continue
        able = [has_freedom(section, which, name) for name in names]
        profiles = [
            deformed(section, which, _named(names, row * prior, able)).components[which] for row in nodes
        ]
        found = reshaped(section, slice_, station, which, profiles, *settings)
        if any(p is None for p in found):
            continue
        known[i] = True
        slope[i], information[i], gain[i] = _quadratic([p for p in found if p is not None], step)
    return _Sites(slope, information, gain, known)


def _named(names: Sequence[str], row: Array, able: Sequence[bool]) -> Mapping[str, float]:
    return {name: x for name, x, can in zip(names, row.tolist(), able, strict=True) if can}


def _nodes(centre: Array, step: Array) -> Array:
    """The centre, a node on both sides of it a freedom, and two a pair of freedoms."""
    k = len(centre)
    rows = [np.zeros(k)]
    for a in range(k):
        rows += [step * np.eye(k)[a], -step * np.eye(k)[a]]
    for a in range(k):
        for b in range(a):
            both = step * (np.eye(k)[a] + np.eye(k)[b])
            rows += [both, -both]
    return centre + np.array(rows)


def _quadratic(found: Sequence[Posterior], step: Array) -> tuple[Array, Array, Array]:
    """Slope and negative curvature of the log evidence, and the slope of the pose."""
    k = len(step)
    L = np.array([p.evidence for p in found])
    poses = np.array([p.pose.as_array() for p in found])
    up, down = L[1 : 2 * k : 2], L[2 : 2 * k + 1 : 2]
    slope = (up - down) / (2.0 * step)
    curve = np.diag((up + down - 2.0 * L[0]) / step**2)
    at = 2 * k + 1
    for a in range(k):
        for b in range(a):
            mixed = L[at] + L[at + 1] - up[a] - down[a] - up[b] - down[b] + 2.0 * L[0]
            curve[a, b] = curve[b, a] = mixed / (2.0 * step[a] * step[b])
            at += 2
    values, axes = np.linalg.eigh(-curve)
    information = (axes * np.maximum(values, 0.0)) @ axes.T
    gain = (poses[1 : 2 * k : 2] - poses[2 : 2 * k + 1 : 2]).T / (2.0 * step)
    return slope, information, gain


def _pooled(sites: _Sites, centre: Array) -> tuple[Array, Array]:
    """One Newton step of the shape that all stations share, and its covariance; units of the priors.

    A station that pulls much harder than its information allows counts less (Student weights).
    """
    k = len(centre)
    weight = sites.known.astype(float)
    change = np.zeros(k)
    cov = np.eye(k)
    for _ in range(6):
        total = np.einsum("i,iab->ab", weight, sites.information) + np.eye(k)
        cov = np.linalg.inv(total)
        change = cov @ (weight @ sites.slope - centre)
        pull = sites.slope - sites.information @ change
        spread = sites.information + 1e-3 * np.eye(k)
        d2 = np.einsum("ia,ia->i", pull, np.linalg.solve(spread, pull[:, :, None])[:, :, 0])
        weight = sites.known * np.minimum((_NU + k) / (_NU + d2), 1.0)
    return np.clip(change, -2.0, 2.0), cov


def _along(
    sites: _Sites,
    about: Array,
    change: Array,
    pooled: Array,
    stations: Sequence[StationEstimate],
    names: tuple[str, ...],
    prior: Array,
    limit: float,
) -> Shape:
    """From sites to values: constant unless a drift or a spread explains the stations far better."""
    n, k = sites.slope.shape
    s = np.array([e.s for e in stations])
    value = np.broadcast_to(about + change, (n, k)).copy()
    covariance = np.broadcast_to(pooled, (n, k, k)).copy()
    unseen = np.sqrt(np.diag(pooled)) > [_UNSEEN.get(name, _UNSEEN_ELSE) for name in names]
    model = ["" if u else "constant" for u in unseen]
    for a in np.flatnonzero(~unseen):
        name, row, var = _one_freedom(sites, about, change, int(a), s)
        if name == "constant":
            continue
        model[a] = name
        value[:, a] = row
        covariance[:, a, :] = covariance[:, :, a] = 0.0
        covariance[:, a, a] = var
    value = np.clip(value, -limit, limit)
    sd = np.sqrt(np.einsum("iaa->ia", covariance))
    at_limit = (np.abs(value) > limit - np.maximum(sd, 0.02 * limit)) & ~unseen
    value[:, unseen], sd[:, unseen] = math.nan, math.nan
    covariance[:, unseen, :] = 0.0
    covariance[:, :, unseen] = 0.0
    gain = np.where(unseen, 0.0, sites.gain)
    return Shape(
        names, value * prior, sd * prior, covariance * prior[:, None] * prior[None, :], gain / prior, unseen,
        at_limit, tuple(model),
    )  # fmt: skip


def _one_freedom(sites: _Sites, about: Array, change: Array, a: int, s: Array) -> tuple[str, Array, Array]:
    """Model, value and variance of one freedom at every station, the others where they are pooled."""
    n = len(s)
    info = sites.information[:, a, a]
    use = sites.known & (info > 1e-3)
    if int(use.sum()) < 6:
        return "constant", np.zeros(n), np.zeros(n)
    rest = np.where(np.arange(len(change)) == a, 0.0, change)
    y = about[a] + (sites.slope[:, a] - sites.information[:, a] @ rest) / np.maximum(info, 1e-3)
    t = (s - s.mean()) / max(float(np.ptp(s)), 1e-9)
    cost = 0.5 * math.log(int(use.sum()))
    best: tuple[float, str, float, Array, Array] | None = None
    for name, basis in (("constant", np.ones((n, 1))), ("linear", np.column_stack([np.ones(n), t]))):
        for spread in _SPREADS:
            var = 1.0 / np.maximum(info, 1e-3) + spread**2
            w = np.where(use, 1.0 / var, 0.0)
            cov = np.linalg.inv((basis * w[:, None]).T @ basis + np.eye(basis.shape[1]))
            beta = cov @ (basis.T @ (w * y))
            e2 = (y - basis @ beta) ** 2
            fit = -0.5 * float(np.sum(np.where(use, np.log(var) + 7.0 * np.log1p(e2 * w / 6.0), 0.0)))
            score = fit - (cost + 2.0) * (basis.shape[1] - 1 + (spread > 0.0))
            if best is None or score > best[0]:
                best = score, name, spread, basis @ beta, np.einsum("ia,ab,ib->i", basis, cov, basis)
    assert best is not None
    _, name, spread, mean, mean_var = best
    if spread == 0.0:
        return name, mean, mean_var
    own = np.where(use, info, 0.0)
    var = 1.0 / (own + 1.0 / spread**2)
    value = var * (own * np.where(use, y, 0.0) + mean / spread**2)
    return "station", value, var + (var / spread**2) ** 2 * mean_var
