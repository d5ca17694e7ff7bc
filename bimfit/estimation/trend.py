"""Gaussian models of how a component moves along a joint (METHOD, section 5).

Every model is linear: at station i the motion of the reference corner is x_i = sum_k B_ik beta_k, with
x = (u, v, theta). Stations enter by what their ranges say alone: precision L_i and L_i x_i.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from bimfit.geometry.pose import Array

Mask = NDArray[np.bool_]
NODES = 150
"""Stations denser than so many along a joint are not each a knot, or a node of the smooth model."""
_NU = 4.0
_JUMP = np.array([0.004, 0.004, 0.035])
"""What a station that jumps is off by, standard deviations in u, v (m) and theta (rad)."""
_OWN, _TURN = 0.003, math.radians(1.0)
_JUMPS = 0.01
"""Share of stations that jump."""


@dataclass(frozen=True)
class Sites:
    """One component along the joint, as its stations see it.

    Attributes
    ----------
    s : ndarray, shape (n,)
    value : ndarray, shape (n, 3)
        u, v (m) and theta (rad) of the motion of the reference corner.
    precision : ndarray, shape (n, 3, 3)
        Inverse covariance without the stations' priors; zero where there is no estimate.
    step : ndarray, shape (n,)
        Bearing of the corner in beam steps; NaN where unknown.
    share : ndarray, shape (n,)
        How much of what is known across the gap the beams tell that just miss the corner, and not ranges.
    """

    s: Array
    value: Array
    precision: Array
    step: Array
    share: Array

    @property
    def known(self) -> Mask:
        """Which stations say anything."""
        return np.asarray(np.trace(self.precision, axis1=1, axis2=2) > 0.0)


@dataclass(frozen=True)
class Trend:
    """A fitted model of one component.

    Attributes
    ----------
    value, covariance : ndarray, shape (n, 3) and (n, 3, 3)
        At every station.
    weight : ndarray, shape (n,)
        What each station counted for; 1 where it agrees.
    distance : ndarray, shape (n,)
        Squared Mahalanobis distance of each station from the fit without it; 0 where unknown.
    jump : ndarray, shape (n,)
        Probability that a station is off by more than noise explains, such as a sensor that was knocked.
    deviance : float
        -2 log likelihood of the stations, Student with 4 degrees of freedom, up to a constant.
    freedom : float
        Effective number of parameters.
    spread : ndarray, shape (free, free)
        Covariance of the coefficients that are free.
    """

    value: Array
    covariance: Array
    weight: Array
    distance: Array
    jump: Array
    deviance: float
    freedom: float
    spread: Array = field(repr=False)


@dataclass(frozen=True)
class Basis:
    """Functions along the joint and the coordinates that each of them moves.

    Attributes
    ----------
    functions : ndarray, shape (n, k)
        Three or fewer, or else at most two neighbouring ones differ from zero at a station.
    moves : ndarray of bool, shape (k, 3)
    penalty : ndarray, shape (k, k, 3), or None
        Prior precision of the coefficients, one matrix a coordinate.
    """

    functions: Array
    moves: Mask
    penalty: Array | None = None

    @cached_property
    def local(self) -> tuple[NDArray[np.int64], Array]:
        """The first of the functions that count at every station (n,), and their values (n, 2 or 3)."""
        if self.functions.shape[1] <= 3:
            return np.zeros(len(self.functions), np.int64), self.functions
        first = np.minimum(np.argmax(self.functions != 0.0, axis=1), self.functions.shape[1] - 2)
        at = first[:, None] + np.arange(2)
        return first, np.take_along_axis(self.functions, at, axis=1)


def hats(s: Array, knots: Array) -> Array:
    """Piecewise linear functions that are 1 at their own knot, shape (n, k)."""
    return np.stack([np.interp(s, knots, row) for row in np.eye(len(knots))], axis=1)


def polynomial(s: Array, *, turning: bool, moving: bool = True) -> Basis:
    """A constant, and a slope for u and v (``moving``) and for theta (``turning``)."""
    t = (s - s.mean()) / max(float(np.ptp(s)), 1e-9)
    moves = np.array([[True, True, True], [moving, moving, turning]])
    return Basis(np.stack([np.ones_like(t), t], axis=1), moves)


def bowed(basis: Basis, pair: tuple[Trend, Trend]) -> Basis:
    """A linear motion that may bow a little: what moves within a joint that turns moves along a curve.

    ``pair`` is the motion of both components as far as it is linear.

    A shift d(t) of a component within a joint that has turned by phi(t) is seen as R(phi(t)) d(t): with both
    linear in t from -1/2 to 1/2, over which they change by D and Phi, that bows by 4 t^2 (Phi perp(D) / 4).
    What of their turning and their drift the joint has and what they have of their own is not known: Phi is
    of the size of their changes of angle and a degree besides, and D of half of what they drift apart by and
    3 mm besides.
    """
    t = basis.functions[:, 1]
    a, b = (p.value[-1] - p.value[0] for p in pair)
    turn = math.sqrt(0.5 * float(a[2] ** 2 + b[2] ** 2) + _TURN**2)
    sd = 0.25 * turn * math.hypot(0.5 * float(np.hypot(*(b - a)[:2])), _OWN)
    functions = np.column_stack([basis.functions, 4.0 * t * t - 1.0 / 3.0])
    penalty = np.zeros((3, 3, 3))
    penalty[2, 2, :2] = sd**-2
    return Basis(functions, np.vstack([basis.moves, [[True, True, False]]]), penalty)


def nodes(s: Array) -> Array:
    """Where the smooth model's functions peak: at every station, or, where these are many, at some."""
    step = -(-len(s) // NODES)
    return s if step == 1 else np.unique(np.r_[s[::step], s[-1]])


def smooth(s: Array, roughness: tuple[float, float]) -> Basis:
    """An integrated random walk: slopes change by N(0, roughness^2 h) over h, for u and v and for theta."""
    at = nodes(s)
    walk = bends(at)
    penalty = np.stack(
        [walk / roughness[0] ** 2, walk / roughness[0] ** 2, walk / roughness[1] ** 2], axis=-1
    )
    return Basis(np.eye(len(s)) if at is s else hats(s, at), np.ones((len(at), 3), bool), penalty)


def bends(s: Array) -> Array:
    """Penalty matrix (n, n) of an integrated random walk of unit roughness; pentadiagonal."""
    n = len(s)
    h = np.maximum(np.diff(s), 1e-9)
    D = np.zeros((max(n - 2, 0), n))
    for i in range(n - 2):
        D[i, i : i + 3] = 1.0 / h[i], -1.0 / h[i] - 1.0 / h[i + 1], 1.0 / h[i + 1]
    if n > 2:
        D /= np.sqrt(0.5 * (h[:-1] + h[1:]))[:, None]
    return np.asarray(D.T @ D)


def information(basis: Basis, blocks: Array) -> Array:
    """Sum over stations of X_i^T B_i X_i for blocks (n, 3, 3), shape (3 k, 3 k)."""
    k = basis.functions.shape[1]
    first, w = basis.local
    A = np.zeros((k, k, 3, 3))
    for p in range(w.shape[1]):
        for q in range(w.shape[1]):
            np.add.at(A, (first + p, first + q), blocks * (w[:, p] * w[:, q])[:, None, None])
    return A.transpose(0, 2, 1, 3).reshape(3 * k, 3 * k)


def solve(sites: Sites, basis: Basis, weight: Array) -> tuple[Array, Array]:
    """Coefficients (k, 3) and their covariance (free, free), of those that move."""
    k = basis.functions.shape[1]
    free = basis.moves.ravel()
    L = sites.precision * weight[:, None, None]
    A = information(basis, L)
    if basis.penalty is not None:
        P = A.reshape(k, 3, k, 3)
        for a in range(3):
            P[:, a, :, a] += basis.penalty[:, :, a]
    if not free.all():
        A = A[np.ix_(free, free)]
    A[np.diag_indices_from(A)] += 1e-3
    cov = np.linalg.inv(A)
    right = basis.functions.T @ np.einsum("iab,ib->ia", L, sites.value)
    beta = np.zeros(3 * k)
    beta[free] = cov @ right.ravel()[free]
    return beta.reshape(k, 3), np.asarray(cov)


def at_stations(M: Array, basis: Basis) -> Array:
    """X_i M X_i^T of every station, shape (n, 3, 3), for M (free, free)."""
    k = basis.functions.shape[1]
    free = basis.moves.ravel()
    if not free.all():
        full = np.zeros((3 * k, 3 * k))
        full[np.ix_(free, free)] = M
        M = full
    M = M.reshape(k, 3, k, 3)
    first, w = basis.local
    out = np.zeros((len(first), 3, 3))
    for p in range(w.shape[1]):
        for q in range(w.shape[1]):
            out += M[first + p, :, first + q, :] * (w[:, p] * w[:, q])[:, None, None]
    return out


def fit(sites: Sites, basis: Basis, *, rounds: int = 4) -> Trend:
    """Fit by least squares reweighted with Student weights on leave-one-out distances."""
    n = len(sites.s)
    weight = np.ones(n)
    for _ in range(rounds):
        beta, cov = solve(sites, basis, weight)
        distance, _ = _left_out(sites, weight, basis.functions @ beta, at_stations(cov, basis))
        new = np.minimum((_NU + 3.0) / (_NU + distance), 1.0)
        done = float(np.abs(new - weight).max()) < 0.01
        weight = new
        if done:
            break
    beta, cov = solve(sites, basis, weight)
    value, V = basis.functions @ beta, at_stations(cov, basis)
    e = sites.value - value
    q = np.einsum("ia,iab,ib->i", e, sites.precision, e)
    known = sites.known
    deviance = float(np.sum((_NU + 3.0) * np.log1p(q[known] / _NU)))
    freedom = float(np.einsum("iab,iba,i->", V, sites.precision, weight))
    distance, jump = _left_out(sites, weight, value, V)
    return Trend(value, V, weight, distance, jump, deviance, freedom, cov)


def left_out(sites: Sites, weight: Array, value: Array, V: Array) -> tuple[Array, Array]:
    """Every station less the fit to the others (n, 3), and the covariance of that (n, 3, 3)."""
    # regularised, for a station may say nothing about one direction
    C = np.linalg.inv(sites.precision + np.diag([400.0, 400.0, 4.0]))
    W = C / np.maximum(weight, 1e-3)[:, None, None]
    # the fit without a station: its residual grows, and the fit's own covariance does too
    gain = V @ np.linalg.inv(W - V + 1e-15 * np.eye(3))
    e = sites.value - value
    return e + np.einsum("iab,ib->ia", gain, e), C + V + gain @ V


def _left_out(sites: Sites, weight: Array, value: Array, V: Array) -> tuple[Array, Array]:
    """Squared Mahalanobis distance of every station from the fit to the others; how likely it has jumped.

    The latter is the posterior probability of a residual N(0, S + J) against N(0, S), J that of a jump.
    """
    e, spread = left_out(sites, weight, value, V)
    near = np.einsum("ia,ia->i", e, np.linalg.solve(spread, e[:, :, None])[:, :, 0])
    wide = spread + np.diag(_JUMP**2)
    far = np.einsum("ia,ia->i", e, np.linalg.solve(wide, e[:, :, None])[:, :, 0])
    odds = 0.5 * (near - far - np.linalg.slogdet(wide)[1] + np.linalg.slogdet(spread)[1])
    odds = np.clip(odds + np.log(_JUMPS / (1.0 - _JUMPS)), -50.0, 50.0)
    known = sites.known
    return np.where(known, np.maximum(near, 0.0), 0.0), np.where(known, 1.0 / (1.0 + np.exp(-odds)), 0.0)


class Evidence:
    """Log marginal likelihood of one component's stations under the smooth model, banded."""

    def __init__(self, sites: Sites) -> None:
        at = nodes(sites.s)
        self.n = n = len(at)
        basis = Basis(np.eye(n) if at is sites.s else hats(sites.s, at), np.ones((n, 3), bool))
        A = information(basis, sites.precision)
        walk = bends(at)
        self.ranges = np.zeros((9, 3 * n))
        self.walks = np.zeros((2, 9, 3 * n))
        for lag in range(min(6, 3 * n)):
            self.ranges[lag, : 3 * n - lag] = np.diagonal(A, -lag)
        for a in range(3):
            for lag in range(min(3, n)):
                self.walks[int(a == 2), 3 * lag, a : 3 * (n - lag) : 3] = np.diagonal(walk, -lag)
        self.ranges[0] += 1e-3
        self.right = (basis.functions.T @ np.einsum("iab,ib->ia", sites.precision, sites.value)).ravel()

    def __call__(self, roughness: tuple[float, float]) -> float:
        """At one pair of hyper-parameters, up to a constant."""
        from scipy.linalg import cho_solve_banded, cholesky_banded

        A = self.ranges + self.walks[0] / roughness[0] ** 2 + self.walks[1] / roughness[1] ** 2
        factor = cholesky_banded(A, lower=True, check_finite=False)
        beta = cho_solve_banded((factor, True), self.right, check_finite=False)
        prior = -2.0 * (self.n - 2) * np.log(roughness[0]) - (self.n - 2) * np.log(roughness[1])
        return float(0.5 * self.right @ beta - np.log(factor[0]).sum() + prior)
