"""The cells between a sensor's beams, which stations of a joint share.

A station puts a corner in the middle of the cell between two beams: its error is a sawtooth of the corner's
bearing. With no drift it is one and the same at all stations; with drift they err in opposite ways as often
as in the same.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from bimfit.estimation.borrow import at_corners
from bimfit.estimation.likelihood import Ints
from bimfit.estimation.trend import Basis, Sites, Trend, at_stations
from bimfit.geometry.pose import Array, Pose2D

_LEAST = 0.75
"""Cells shared by stations never make a variance less than this share of what it is without."""
_HARMONICS = 8
_SOME = 0.05


@dataclass(frozen=True)
class SharedCells:
    """How the errors of one component's stations hang together where each station stands for itself.

    Attributes
    ----------
    covariance : ndarray, shape (n, n)
        Of the errors of the corner across the gap, m^2; 0 on the diagonal, which every station knows itself.
    corner : ndarray, shape (n, 2)
        The reference corner as designed.
    """

    covariance: Array
    corner: Array

    def between(self, gradients: Array, poses: Sequence[Pose2D | None]) -> Array:
        """Covariance (n, n) of one figure a station: see ``Coupling.between``."""
        across = at_corners(gradients, poses, self.corner)[:, 0]
        return np.asarray(self.covariance * across[:, None] * across[None, :])


def with_shared_cells(sites: Sites, basis: Basis, trend: Trend) -> Trend:
    """The trend with what stations have in common because they see a corner between beams.

    A station puts a corner in the middle of the cell between two beams: its error is a sawtooth of the
    corner's bearing. With no drift it is one and the same, and averaging does not help across the gap; with
    drift, stations err in opposite ways as often as in the same; V = V0 + K E K^T (METHOD, section 5).
    """
    k, s, rho = _errors(sites, basis, trend)
    if len(k) < 2:
        return trend
    pull = sites.precision[k, :, 0] * trend.weight[k, None]
    R = np.einsum("ik,ia->kai", basis.functions[k], pull).reshape(-1, len(k))
    G = trend.spread @ R[basis.moves.ravel()]
    # corners seen at different places between two beams err in opposite ways: the sum may well be less
    variances, root = np.linalg.eigh(trend.spread)
    kept = variances > 1e-13 * variances[-1]
    root = root[:, kept] * np.sqrt(variances[kept])
    back = root.T / variances[kept, None]
    half = back @ (G * s)
    values, axes = np.linalg.eigh(half @ rho @ half.T)
    wide = root @ axes
    shared = (wide * np.maximum(values, _LEAST - 1.0)) @ wide.T
    covariance = trend.covariance + at_stations(shared, basis)
    return replace(trend, covariance=covariance, spread=trend.spread + shared)


def shared_cells(sites: Sites, basis: Basis, trend: Trend, corner: Array) -> SharedCells:
    """What the stations of a component have in common where each stands for itself.

    Parameters
    ----------
    basis, trend
        A motion that fits them: it tells in which cells the corners are.
    corner : ndarray, shape (n, 2)
        As designed.
    """
    k, s, rho = _errors(sites, basis, trend)
    n = len(corner)
    covariance = np.zeros((n, n))
    if len(k) > 1:
        covariance[np.ix_(k, k)] = rho * s[:, None] * s[None, :]
    return SharedCells(covariance, corner)


def _errors(sites: Sites, basis: Basis, trend: Trend) -> tuple[Ints, Array, Array]:
    """Stations whose error across the gap is a cell's, its deviation, its correlations (0 with itself)."""
    k = np.flatnonzero(sites.known & np.isfinite(sites.step) & (sites.share > _SOME))
    if len(k) < 2:
        return k, np.zeros(len(k)), np.zeros((len(k), len(k)))
    s = np.sqrt(sites.share[k] / np.maximum(sites.precision[k, 0, 0], 1e-6))
    R = np.einsum("ik,a->kai", basis.functions[k], np.eye(3)[0]).reshape(-1, len(k))[basis.moves.ravel()]
    rho = cell_correlation(
        s / sites.share[k], sites.step[k], (trend.value - sites.value)[k, 0], R.T @ trend.spread @ R
    )
    np.fill_diagonal(rho, 0.0)
    return k, s, rho


def cell_correlation(sd: Array, step: Array, off: Array, spread: Array) -> Array:
    """Correlation (n, n) of the errors that the cells between beams make at n stations.

    For two corners d steps of the beams apart it is 1 - 6 f (1 - f), f the fraction of d. That is a sum of
    cosines, 6 / (pi k)^2 cos(2 pi k d), and each fades as exp(-2 (pi k)^2 var d) where d is uncertain: all
    terms are positive definite, and so is the sum.

    Parameters
    ----------
    sd : ndarray, shape (n,)
        Of each station across the gap: that of an even spread over its cell, m.
    step : ndarray, shape (n,)
        Bearing of each corner as its station puts it, in beam steps.
    off : ndarray, shape (n,)
        How far from there, across the gap, it really is, as far as is known, m.
    spread : ndarray, shape (n, n)
        Covariance of where the corners are, m^2.
    """
    pitch = np.sqrt(12.0) * np.median(sd)
    at = step + off / pitch
    d = at[:, None] - at[None, :]
    own = np.diag(spread)
    variance = (own[:, None] + own[None, :] - 2.0 * spread) / pitch**2
    out: Array = np.zeros_like(d)
    for k in range(1, _HARMONICS + 1):
        wave = np.pi * k
        out += 6.0 / wave**2 * np.cos(2.0 * wave * d) * np.exp(-2.0 * wave**2 * np.maximum(variance, 0.0))
    return out
