"""The joint as a whole: components are bodies, not unrelated slices (METHOD, section 5)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Literal, get_args

import numpy as np

from bimfit.errors import ConfigError
from bimfit.estimation import _kernels_knots as kernels
from bimfit.estimation import trend
from bimfit.estimation.borrow import FLAG, SHAKES, at_corner, at_corners, borrow
from bimfit.estimation.cells import SharedCells, shared_cells, with_shared_cells
from bimfit.estimation.checks import DOZEN
from bimfit.estimation.disagreement import disagreements, distance_off
from bimfit.estimation.pooled import pooled
from bimfit.estimation.result import ComponentEstimate, StationEstimate
from bimfit.estimation.trend import Basis, Sites, Trend
from bimfit.geometry.joint_section import JointSection
from bimfit.geometry.pose import Array, Pose2D
from bimfit.geometry.status import Status

Motion = Literal["independent", "const", "rigid", "linear", "smooth", "kinked", "auto"]
_KEEP_KNOT = 30.0
_KINKED_MARGIN = 20.0
_FEW = 3
_STRAIGHT = 2
"""Knots of a motion that has no kink."""
_FEW_PARAMETERS = ("const", "rigid", "linear")
_BOTH = 0.5
"""Stations that count for less than that, both components of them, have moved and are no outliers."""


@dataclass(frozen=True)
class Coupling:
    """How the errors of one component's stations hang together under a model of its motion.

    Attributes
    ----------
    basis : Basis
    spread : ndarray, shape (free, free)
        Covariance of the model's coefficients, what the stations share included.
    corner : ndarray, shape (n, 2)
        The reference corner as designed.
    """

    basis: Basis
    spread: Array
    corner: Array

    def between(self, gradients: Array, poses: Sequence[Pose2D | None]) -> Array:
        """Covariance (n, n) of one figure a station, given its gradient (n, 3) by (u, v, theta) of the pose.

        Zero where there is no pose.
        """
        rows = at_corners(gradients, poses, self.corner)
        H = (self.basis.functions[:, :, None] * rows[:, None, :])[:, self.basis.moves]
        return np.asarray(H @ self.spread @ H.T)


Couplings = tuple[Coupling | SharedCells, Coupling | SharedCells]


@dataclass(frozen=True)
class JointEstimate:
    """All stations of a joint, estimated together.

    Attributes
    ----------
    stations : tuple of StationEstimate
        With the poses and covariances that the model gives.
    model : str
        The motion model used; what ``auto`` chose.
    criterion : dict of str to float
        BIC of every model tried, lower is better.
    knots : ndarray, shape (k,)
        Stations' distances along the joint at which the ``kinked`` model bends, m.
    outliers : tuple of (int, str)
        Stations that disagree with their neighbours, and which component does.
    couplings : tuple of two Coupling or SharedCells, or None
        Of A and B; None where too few stations are known.
    """

    stations: tuple[StationEstimate, ...]
    model: str
    criterion: dict[str, float] = field(default_factory=dict)
    knots: Array = field(default_factory=lambda: np.zeros(0))
    outliers: tuple[tuple[int, str], ...] = ()
    couplings: Couplings | None = None


def estimate_joint(
    estimates: Sequence[StationEstimate], sections: Sequence[JointSection], model: str = "auto"
) -> JointEstimate:
    """Fit a model of motion along the joint to the stations' estimates.

    Parameters
    ----------
    estimates, sections : sequence
        One a station, in the order of the joint.
    model : {"independent", "const", "rigid", "linear", "smooth", "kinked", "auto"}
        ``rigid``: u and v linear, theta constant; ``linear``: theta too, and so little of a bow in u and v as
        comes with turning (:func:`bimfit.estimation.trend.bowed`). ``auto`` chooses by BIC, and
        ``independent`` where less than half of the measured stations are fixed in all directions.

    Returns
    -------
    JointEstimate
        A station without an estimate of its own is given what the model predicts, as ``weak``, where its
        neighbours are near and the model is sure of it; else it stays without one. A station that disagrees
        with its neighbours counts less and is flagged; where its own returns are good in themselves, their
        estimate is what it keeps.

    Raises
    ------
    ConfigError
        For a model of another name.
    """
    if model not in get_args(Motion):
        raise ConfigError(f"unknown motion model {model}", remedy="one of " + ", ".join(get_args(Motion)))
    stations = tuple(estimates)
    parts = (_sites(stations, sections, 0), _sites(stations, sections, 1))
    if min(int(p.known.sum()) for p in parts) < _FEW:
        return JointEstimate(stations, "independent")
    corners = [np.array([section.gap.mouth[which] for section in sections]) for which in (0, 1)]
    if model == "independent" or (model == "auto" and not _mostly_sound(stations)):
        still = _bases("smooth", parts, np.zeros(0))
        a, b = (
            shared_cells(*every) for every in zip(parts, still, _fit_pair(parts, still), corners, strict=True)
        )
        return JointEstimate(stations, "independent", couplings=(a, b))
    fits: dict[str, tuple[Trend, Trend]] = {}
    bases: dict[str, tuple[Basis, Basis]] = {}
    criterion: dict[str, float] = {}
    knots = np.zeros(0)
    for name in ("const", "rigid", "linear", "smooth", "kinked") if model == "auto" else (model,):
        if name == "kinked":
            screen = fits.get("smooth") or _fit_pair(parts, _bases("smooth", parts, knots))
            knots = _find_knots(parts, _weights(screen))
            if len(knots) == _STRAIGHT and "linear" in fits:
                continue  # no kink
        bases[name] = _bases(name, parts, knots)
        pair = _fit_pair(parts, bases[name])
        if name == "linear":
            bases[name] = (trend.bowed(bases[name][0], pair),) * 2
            pair = _fit_pair(parts, bases[name])
        fits[name] = pair
        # the smooth model's two hyper-parameters a component are fitted too
        freedom = sum(t.freedom for t in pair) + (4.0 if name == "smooth" else 0.0)
        if name == "kinked":
            freedom = 6.0 * len(knots) + 2.0 * (len(knots) - 2)
        count = sum(int(p.known.sum()) for p in parts)
        criterion[name] = sum(t.deviance for t in pair) + freedom * math.log(count)
    chosen, fitted, final = _refined(stations, sections, parts, fits, bases, criterion)
    bent = knots if chosen == "kinked" else np.zeros(0)
    apart = disagreements(stations, sections, parts, fitted, bent)
    out, outliers = _apply(stations, sections, parts, apart)
    one, two = (Coupling(b, t.spread, c) for b, t, c in zip(final, fitted, corners, strict=True))
    return JointEstimate(out, chosen, criterion, bent, outliers, (one, two))


def _refined(
    stations: tuple[StationEstimate, ...],
    sections: Sequence[JointSection],
    parts: tuple[Sites, Sites],
    fits: dict[str, tuple[Trend, Trend]],
    bases: dict[str, tuple[Basis, Basis]],
    criterion: dict[str, float],
) -> tuple[str, tuple[Trend, Trend], tuple[Basis, Basis]]:
    """The model chosen, its trends with all that beams tell of them, and their bases.

    A motion of few parameters is judged by all beams at once; where they contradict it, another is chosen, if
    there is one. In other motions the cells between beams are what stations share.
    """
    name = _choose(criterion)
    trends: list[Trend] = []
    for which, sites in enumerate(parts):
        basis = bases[name][which]
        rough = with_shared_cells(sites, basis, fits[name][which])
        better = None
        if name in _FEW_PARAMETERS:
            better, borne_out = pooled(stations, sections, which, sites, basis, rough)
            others = {n: c for n, c in criterion.items() if n not in _FEW_PARAMETERS}
            if not borne_out and others:
                return _refined(stations, sections, parts, fits, bases, others)
        trends.append(rough if better is None else better)
    return name, (trends[0], trends[1]), bases[name]


def _mostly_sound(stations: Sequence[StationEstimate]) -> bool:
    """Whether at least half of the stations that are measured are fixed in all directions.

    Where ranges leave a direction free at most stations, as in a lap that no beam looks into, they are no
    Gaussian sites: a model built on them wanders off and does not know it. Doubt about a component's shape,
    which is weak too, is no such reason.
    """
    measured = [e for e in stations if e.status.measured]
    return 2 * sum(_fixed(e) for e in measured) >= len(measured)


def _fixed(station: StationEstimate) -> bool:
    """Whether nothing but the shape of a component is in doubt, if anything is."""
    doubted = [c for c in station.components if c.status.name != "ok"]
    if station.status.name != "weak" or not doubted or station.through == 0 or station.virtual:
        return station.status.name == "ok"
    return all(c.status.name == "weak" and not c.weak_direction and c.n_inliers > DOZEN for c in doubted)


def _fit_pair(parts: tuple[Sites, Sites], bases: tuple[Basis, Basis]) -> tuple[Trend, Trend]:
    return trend.fit(parts[0], bases[0]), trend.fit(parts[1], bases[1])


def _choose(criterion: dict[str, float]) -> str:
    best = min(criterion, key=lambda name: criterion[name])
    if best == "kinked" and criterion.get("smooth", math.inf) < criterion["kinked"] + _KINKED_MARGIN:
        return min((n for n in criterion if n != "kinked"), key=lambda name: criterion[name])
    return best


def _bases(name: str, parts: tuple[Sites, Sites], knots: Array) -> tuple[Basis, Basis]:
    s = parts[0].s
    if name == "smooth":
        a, b = (trend.smooth(s, _roughness(p)) for p in parts)
        return a, b
    if name == "kinked":
        functions = trend.hats(s, knots)
        basis = Basis(functions, np.ones((len(knots), 3), bool))
    else:
        basis = trend.polynomial(s, turning=name == "linear", moving=name != "const")
    return basis, basis


def _roughness(sites: Sites) -> tuple[float, float]:
    """The smooth model's two hyper-parameters, by marginal likelihood."""
    from scipy.optimize import minimize

    span = max(float(np.ptp(sites.s)), 1e-3)
    unit = np.array([1e-2, 1e-1]) / span**1.5
    value = trend.Evidence(sites)

    def cost(log: Array) -> float:
        clipped = np.clip(log, -9.0, 7.0)
        q = unit * np.exp(clipped)
        return -value((float(q[0]), float(q[1]))) + float(np.square(log - clipped).sum())

    starts = [np.array([a, b]) for a in (-5.0, 0.0, 4.0) for b in (-5.0, 0.0, 4.0)]
    begin = min(starts, key=cost)
    best = minimize(cost, begin, method="Nelder-Mead", options={"xatol": 0.05, "fatol": 0.05, "maxfev": 80})
    q = unit * np.exp(np.clip(best.x, -9.0, 7.0))
    return float(q[0]), float(q[1])


def _sites(estimates: tuple[StationEstimate, ...], sections: Sequence[JointSection], which: int) -> Sites:
    """Stations' estimates of one component's reference corner, freed of their priors."""
    n = len(estimates)
    value, precision, step = np.zeros((n, 3)), np.zeros((n, 3, 3)), np.full(n, np.nan)
    share = np.ones(n)
    for i, (estimate, section) in enumerate(zip(estimates, sections, strict=True)):
        c = estimate.components[which]
        if c.pose is None or c.covariance is None or not c.status.measured:
            continue
        if not estimate.status.measured and estimate.components[1 - which].status.measured:
            continue  # what is wrong with it is not the other component's alone
        corner = section.gap.mouth[which]
        J = at_corner(c.pose, corner)
        x = _motion_of(c.pose, corner)
        total = np.linalg.inv(J @ c.covariance @ J.T)
        alone, at = total, total @ x
        if c.prior is not None and c.posterior is not None:
            arm = c.pose.apply(corner) - c.posterior.pivot
            K = np.array([[1.0, 0.0, -arm[1]], [0.0, 1.0, arm[0]], [0.0, 0.0, 1.0]])
            before = np.linalg.inv((K * np.square(c.prior_sd)) @ K.T)
            alone, at = total - before, at - before @ _motion_of(c.prior, corner)
        values, axes = np.linalg.eigh(alone)
        floor = 1e-6 * values[-1]
        precision[i] = (axes * np.maximum(values, floor)) @ axes.T
        value[i] = np.linalg.solve(precision[i], at) if values[0] > floor else x
        step[i] = c.corner_step
        if c.posterior is not None and c.posterior.weak_sd_ranges > 0.0:
            share[i] = max(1.0 - (c.posterior.weak_sd / c.posterior.weak_sd_ranges) ** 2, 0.0)
    s = np.array([e.s for e in estimates])
    return Sites(s, value, precision, step, share)


def _motion_of(pose: Pose2D, corner: Array) -> Array:
    return np.array([*(pose.apply(corner) - corner), pose.theta])


def _weights(screen: tuple[Trend, Trend]) -> tuple[Array, Array]:
    """What each station counts for where knots are looked for: in full where both components disagree.

    Then the joint has jumped, and more knots are what explains it.
    """
    a, b = (t.weight for t in screen)
    jumps = np.maximum(a, b) < _BOTH
    return np.where(jumps, 1.0, a), np.where(jumps, 1.0, b)


def _find_knots(parts: tuple[Sites, Sites], weights: Sequence[Array]) -> Array:
    """Knots shared by both components: added while they pay, moved, and dropped where they do not."""
    s = np.ascontiguousarray(parts[0].s - parts[0].s.mean())
    sums = np.empty((2, len(s) + 1, kernels.COLUMNS))
    for sites, weight, out in zip(parts, weights, sums, strict=True):
        kernels.prefix_sums(s, sites.value, sites.precision * weight[:, None, None], out)
    known = parts[0].known | parts[1].known
    at = np.flatnonzero(known)
    known[at[:2]] = known[at[-2:]] = False
    step = -(-len(s) // trend.NODES)
    if step > 1:  # stations that dense do not each need a knot
        known &= np.arange(len(s)) % step == 0
    knots = np.zeros(min(len(s), trend.NODES) + 2, np.int64)
    knots[:2] = at[0], at[-1]
    count = kernels.find_knots(s, sums, known, _KEEP_KNOT, 3 * step, knots)
    return np.asarray(parts[0].s[knots[:count]])


def _apply(
    stations: tuple[StationEstimate, ...],
    sections: Sequence[JointSection],
    parts: tuple[Sites, Sites],
    fits: tuple[Trend, Trend],
) -> tuple[tuple[StationEstimate, ...], tuple[tuple[int, str], ...]]:
    """Stations with the model's poses, and those that disagree with it."""
    out: list[StationEstimate] = []
    outliers: list[tuple[int, str]] = []
    agreeing = parts[0].known & parts[1].known & (fits[0].distance <= FLAG) & (fits[1].distance <= FLAG)
    borrowed = borrow(stations, sections, parts, fits, agreeing)
    for i, (station, section) in enumerate(zip(stations, sections, strict=True)):
        if i in borrowed:
            out.append(borrowed[i])
            continue
        components: list[ComponentEstimate] = []
        status = station.status
        for which in (0, 1):
            c, t = station.components[which], fits[which]
            if not parts[which].known[i]:
                components.append(c)
                continue
            corner = section.gap.mouth[which]
            pose, covariance = _mixed(t, i, corner, c)
            if t.distance[i] > FLAG:
                outliers.append((i, "AB"[which]))
                off = distance_off(parts[which], t, i)
                reason = f"its own returns put it {1e3 * off:.1f} mm away from what its neighbours say"
                if status.name == "weak" and off > SHAKES:
                    # a place that no gap bears out and no neighbour either is none
                    status = Status("rejected", f"component {'AB'[which]}: {reason}, and {status.reason}")
                if status.name == "ok":
                    status = Status("ambiguous", f"component {'AB'[which]}: {reason}")
                if c.status.name == "ok":
                    c = replace(c, status=Status("ambiguous", reason))
            components.append(replace(c, pose=pose, covariance=covariance))
        out.append(replace(station, components=(components[0], components[1]), status=status))
    return tuple(out), tuple(outliers)


def _mixed(t: Trend, i: int, corner: Array, c: ComponentEstimate) -> tuple[Pose2D, Array]:
    """Pose and covariance of a station that follows the model or, maybe, has jumped.

    A jump is no part of any model of the motion: where one is likely, what was measured well stands. Where
    it is uncertain, the two are weighed, and their difference counts as uncertainty.
    """
    x, V = t.value[i], t.covariance[i]
    w = float(t.jump[i]) if c.status.name == "ok" else 0.0
    if w > 1e-3:
        # with its prior, for the ranges alone may say nothing about one direction
        assert c.pose is not None and c.covariance is not None
        own, at = _motion_of(c.pose, corner), at_corner(c.pose, corner)
        apart, spread = own - x, at @ c.covariance @ at.T
        x = x + w * apart
        V = (1.0 - w) * V + w * spread + w * (1.0 - w) * np.outer(apart, apart)
        if w > 1.0 - 1e-3:
            x = own
    pose = Pose2D.about(corner, *(float(y) for y in x))
    J = np.linalg.inv(at_corner(pose, corner))
    return pose, J @ V @ J.T
