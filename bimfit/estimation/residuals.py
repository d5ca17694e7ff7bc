"""How the returns of a component agree with where it is estimated to be (METHOD, section 5)."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from bimfit.estimation.likelihood import BeamSet
from bimfit.estimation.result import Residuals
from bimfit.geometry.pose import Array

Mask = NDArray[np.bool_]
_GRAZING = 0.3


def longest_run(flags: Mask) -> int:
    """Length of the longest unbroken run of True."""
    padded = np.concatenate([[0], flags.astype(np.int64), [0]])
    change = np.diff(padded)
    starts, ends = np.flatnonzero(change == 1), np.flatnonzero(change == -1)
    return int((ends - starts).max()) if len(starts) else 0


def excused(r: Array, rho: Array, sd: Array, cosine: Array, sigma: float) -> Mask:
    """Grazing returns that say nothing about the shape: the pose's own uncertainty explains their misfit.

    Parameters
    ----------
    sd, cosine : ndarray, shape (n,)
        From :func:`~bimfit.estimation.likelihood.range_sd`.
    """
    with np.errstate(invalid="ignore"):
        explained = np.abs(r - rho) < 4.0 * np.hypot(sd, sigma)
    return np.asarray((cosine > -_GRAZING) & (sd > sigma) & (r > 0.0) & explained)


def residuals_of(
    beams: BeamSet, rho: Array, face: NDArray[np.int64], used: Mask, sigma: float, silent: Mask | None = None
) -> Residuals:
    """Residual statistics of the beams in ``used`` against predicted ranges (METHOD section 5).

    Those that are ``silent`` (n,) count as beams that meet the component, and as nothing else.
    """
    whole = covered = used & (face >= 0)
    quiet = 0
    if silent is not None and silent.any():
        covered = whole & ~silent
        near = np.abs(beams.r[whole & silent] - rho[whole & silent]) < 4.0 * sigma
        quiet = int(near.sum())
    n = int(covered.sum())
    r = beams.r[covered]
    e = r - rho[covered]
    returned = r > 0.0
    inlier = returned & (np.abs(e) < 4.0 * sigma)
    z = e[inlier]
    k = len(z)
    lag = float(np.mean(z[1:] * z[:-1]) / max(float(np.mean(z * z)), 1e-30)) if k > 3 else 0.0
    walk = np.concatenate([[0.0], np.cumsum(z - z.mean())]) if k else np.zeros(1)
    return Residuals(
        n_beams=int(used.sum()),
        n_covered=n + quiet,
        n_inliers=k + quiet,
        rms=float(np.sqrt(np.mean(z * z))) if k else float("nan"),
        chi2=float(np.sum(z * z) / sigma**2 / max(k - 2.2, 1.0)) if k else float("nan"),
        outlier_share=float((returned & ~inlier).sum() / n) if n else 0.0,
        miss_share=float((~returned).sum() / n) if n else 0.0,
        outlier_run=longest_run(returned & ~inlier),
        miss_run=longest_run(~returned),
        cusum=float((walk.max() - walk.min()) / max(float(z.std()), sigma) / math.sqrt(k)) if k > 3 else 0.0,
        lag1=lag,
        unexplained=_continues(beams, rho, whole, used, sigma),
        edge=_edge_drop(z, face[covered][inlier], sigma),
        residuals=z,
        places=beams.points[covered][inlier],
    )


def _edge_drop(z: Array, face: NDArray[np.int64], sigma: float) -> float:
    """How far the last returns at either end of the main face lie behind it, in standard deviations."""
    if len(z) < 12:
        return 0.0
    names, counts = np.unique(face, return_counts=True)
    main = z[face == names[np.argmax(counts)]]
    worst = 0.0
    for end in (main, main[::-1]):
        total = np.cumsum(end[:6])
        worst = max(worst, float((total / np.sqrt(np.arange(1, len(total) + 1))).max()))
    return worst / max(sigma, float(main.std()) * 0.8)


def _continues(beams: BeamSet, rho: Array, covered: Mask, used: Mask, sigma: float) -> int:
    """Returns that carry a surface on past where it should end: the edge is not shaped as designed."""
    longest = 0
    for g in range(len(beams.eye)):
        s, t = int(beams.start[g]), int(beams.start[g + 1])
        at = np.flatnonzero(covered[s:t])
        if not len(at):
            continue
        for first, step in ((s + int(at[0]), -1), (s + int(at[-1]), 1)):
            level = float(rho[first])
            jump = max(4.0 * sigma, 3.0 * beams.spacing * level)
            count, k = 0, first + step
            while s <= k < t and used[k] and beams.r[k] > 0.0 and abs(beams.r[k] - level) < jump:
                level = float(beams.r[k])
                count, k = count + 1, k + step
            longest = max(longest, count)
    return longest
