"""Gaussian models of how a component moves along a joint (METHOD, section 5).

Every model is linear: at station i the motion of the reference corner is x_i = sum_k B_ik beta_k, with
x = (u, v, theta). Stations enter by what their ranges say alone: precision L_i and L_i x_i.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bimfit.geometry.pose import Array

Mask = NDArray[np.bool_]
_NU = 4.0
_JUMP = np.array([0.004, 0.004, 0.035])
"""What a station that jumps is off by, standard deviations in u, v (m) and theta (rad)."""
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
    """

    s: Array
    value: Array
    precision: Array
    step: Array

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
    """

    value: Array
    covariance: Array
    weight: Array
    distance: Array
    jump: Array
    deviance: float
    freedom: float


@dataclass(frozen=True)
class Basis:
    """Functions along the joint and the coordinates that each of them moves.

    Attributes
    ----------
    functions : ndarray, shape (n, k)
    moves : ndarray of bool, shape (k, 3)
    penalty : ndarray, shape (k, k, 3), or None
        Prior precision of the coefficients, one matrix a coordinate.
    """

    functions: Array
    moves: Mask
    penalty: Array | None = None


def hats(s: Array, knots: Array) -> Array:
    """Piecewise linear functions that are 1 at their own knot, shape (n, k)."""
    return np.stack([np.interp(s, knots, row) for row in np.eye(len(knots))], axis=1)


def polynomial(s: Array, *, turning: bool, moving: bool = True) -> Basis:
    """A constant, and a slope for u and v (``moving``) and for theta (``turning``)."""
    t = (s - s.mean()) / max(float(np.ptp(s)), 1e-9)
    moves = np.array([[True, True, True], [moving, moving, turning]])
    return Basis(np.stack([np.ones_like(t), t], axis=1), moves)


def smooth(s: Array, roughness: tuple[float, float]) -> Basis:
    """An integrated random walk: slopes change by N(0, roughness^2 h) over h, for u and v and for theta."""
    n = len(s)
    walk = bends(s)
    penalty = np.stack(
        [walk / roughness[0] ** 2, walk / roughness[0] ** 2, walk / roughness[1] ** 2], axis=-1
    )
    return Basis(np.eye(n), np.ones((n, 3), bool), penalty)


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


def solve(sites: Sites, basis: Basis, weight: Array) -> tuple[Array, Array, Array]:
    """Coefficients (free,), their covariance (free, free) and each station's design (n, 3, free)."""
    n, k = basis.functions.shape
    free = basis.moves.ravel()
    design = np.einsum("ik,ab->iakb", basis.functions, np.eye(3)).reshape(n, 3, 3 * k)[:, :, free]
    L = sites.precision * weight[:, None, None]
    flat = design.reshape(3 * n, -1)
    LX = np.matmul(L, design).reshape(3 * n, -1)
    A = flat.T @ LX
    if basis.penalty is not None:
        P = np.zeros((k, 3, k, 3))
        for a in range(3):
            P[:, a, :, a] = basis.penalty[:, :, a]
        A += P.reshape(3 * k, 3 * k)[np.ix_(free, free)]
    A[np.diag_indices_from(A)] += 1e-3
    cov = np.linalg.inv(A)
    return cov @ (LX.T @ sites.value.ravel()), cov, design


def _blocks(M: Array, design: Array) -> Array:
    """X_i M X_i^T of every station, shape (n, 3, 3)."""
    n = design.shape[0]
    if design.shape[2] == 3 * n:  # every station is its own node
        return np.ascontiguousarray(np.einsum("iaib->iab", M.reshape(n, 3, n, 3)))
    return np.asarray(np.matmul(np.matmul(design, M), design.transpose(0, 2, 1)))


def fit(sites: Sites, basis: Basis, *, rounds: int = 4) -> Trend:
    """Fit by least squares reweighted with Student weights on leave-one-out distances."""
    n = len(sites.s)
    weight = np.ones(n)
    for _ in range(rounds):
        beta, cov, design = solve(sites, basis, weight)
        distance, _ = _left_out(sites, weight, beta, cov, design)
        new = np.minimum((_NU + 3.0) / (_NU + distance), 1.0)
        done = float(np.abs(new - weight).max()) < 0.01
        weight = new
        if done:
            break
    beta, cov, design = solve(sites, basis, weight)
    value = design @ beta
    e = sites.value - value
    q = np.einsum("ia,iab,ib->i", e, sites.precision, e)
    known = sites.known
    deviance = float(np.sum((_NU + 3.0) * np.log1p(q[known] / _NU)))
    freedom = float(
        np.einsum(
            "fg,iaf,iab,ibg->", cov, design, sites.precision * weight[:, None, None], design, optimize=True
        )
    )
    V = np.einsum("iaf,fg,ibg->iab", design, cov, design, optimize=True)
    V = V + _shared_cells(sites, weight, cov, design)
    distance, jump = _left_out(sites, weight, beta, cov, design)
    return Trend(value, V, weight, distance, jump, deviance, freedom)


def _left_out(sites: Sites, weight: Array, beta: Array, cov: Array, design: Array) -> tuple[Array, Array]:
    """Squared Mahalanobis distance of every station from the fit to the others; how likely it has jumped.

    The latter is the posterior probability of a residual N(0, S + J) against N(0, S), J that of a jump.
    """
    V = _blocks(cov, design)
    # regularised, for a station may say nothing about one direction
    C = np.linalg.inv(sites.precision + np.diag([400.0, 400.0, 4.0]))
    W = C / np.maximum(weight, 1e-3)[:, None, None]
    # the fit without a station: its residual grows, and the fit's own covariance does too
    gain = V @ np.linalg.inv(W - V + 1e-15 * np.eye(3))
    e = sites.value - design @ beta
    e = e + np.einsum("iab,ib->ia", gain, e)
    spread = C + V + gain @ V
    near = np.einsum("ia,ia->i", e, np.linalg.solve(spread, e[:, :, None])[:, :, 0])
    wide = spread + np.diag(_JUMP**2)
    far = np.einsum("ia,ia->i", e, np.linalg.solve(wide, e[:, :, None])[:, :, 0])
    odds = 0.5 * (near - far - np.linalg.slogdet(wide)[1] + np.linalg.slogdet(spread)[1])
    odds = np.clip(odds + np.log(_JUMPS / (1.0 - _JUMPS)), -50.0, 50.0)
    known = sites.known
    return np.where(known, np.maximum(near, 0.0), 0.0), np.where(known, 1.0 / (1.0 + np.exp(-odds)), 0.0)


def _shared_cells(sites: Sites, weight: Array, cov: Array, design: Array) -> Array:
    """What neighbouring stations have in common because they see a corner through the same beams.

    With no drift every slice sees the corner between the same two beams, so that averaging does not help
    across the gap; V = V0 + K E K^T (METHOD, section 5).
    """
    known = sites.known & np.isfinite(sites.step)
    n = len(sites.s)
    if known.sum() < 2:
        return np.zeros((n, 3, 3))
    k = np.flatnonzero(known)
    d = sites.step[k, None] - sites.step[None, k]
    f = d - np.floor(d)
    rho = (1.0 - 6.0 * f * (1.0 - f)) * np.exp(-((d / 2.5) ** 2))
    values, axes = np.linalg.eigh(rho)
    rho = (axes * np.maximum(values, 0.0)) @ axes.T
    np.fill_diagonal(rho, np.maximum(np.diag(rho) - 1.0, 0.0))
    s = 1.0 / np.sqrt(np.maximum(sites.precision[k, 0, 0], 1e-6))
    G = cov @ np.einsum("iaf,ia->fi", design[k], sites.precision[k, :, 0] * weight[k, None])
    extra = _blocks(G @ (rho * s[:, None] * s[None, :]) @ G.T, design)
    values, axes = np.linalg.eigh(extra)
    return np.asarray(np.einsum("iab,ib,icb->iac", axes, np.maximum(values, 0.0), axes))


class Evidence:
    """Log marginal likelihood of one component's stations under the smooth model, banded."""

    def __init__(self, sites: Sites) -> None:
        n = len(sites.s)
        self.n = n
        walk = bends(sites.s)
        self.ranges = np.zeros((9, 3 * n))
        self.walks = np.zeros((2, 9, 3 * n))
        for a in range(3):
            for b in range(a + 1):
                self.ranges[a - b, b::3] = sites.precision[:, a, b]
            for lag in range(min(3, n)):
                self.walks[int(a == 2), 3 * lag, a : 3 * (n - lag) : 3] = np.diagonal(walk, -lag)
        self.ranges[0] += 1e-3
        self.right = np.einsum("iab,ib->ia", sites.precision, sites.value).ravel()

    def __call__(self, roughness: tuple[float, float]) -> float:
        """At one pair of hyper-parameters, up to a constant."""
        from scipy.linalg import cho_solve_banded, cholesky_banded

        A = self.ranges + self.walks[0] / roughness[0] ** 2 + self.walks[1] / roughness[1] ** 2
        factor = cholesky_banded(A, lower=True, check_finite=False)
        beta = cho_solve_banded((factor, True), self.right, check_finite=False)
        prior = -2.0 * (self.n - 2) * np.log(roughness[0]) - (self.n - 2) * np.log(roughness[1])
        return float(0.5 * self.right @ beta - np.log(factor[0]).sum() + prior)
