"""Whether a station's numbers may be believed: a status with a reason in plain words."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from bimfit.config import FitConfig, SensorConfig
from bimfit.estimation.likelihood import BeamSet
from bimfit.estimation.posterior import Posterior, Window
from bimfit.estimation.result import ComponentEstimate, Residuals, Rival, StationEstimate
from bimfit.estimation.slide import SlideResult
from bimfit.geometry.joint_section import JointSection
from bimfit.geometry.pose import Array, Pose2D
from bimfit.geometry.status import OK, Status

Mask = NDArray[np.bool_]
_RIVAL_ODDS = -4.0


def longest_run(flags: Mask) -> int:
    """Length of the longest unbroken run of True."""
    padded = np.concatenate([[0], flags.astype(np.int64), [0]])
    change = np.diff(padded)
    starts, ends = np.flatnonzero(change == 1), np.flatnonzero(change == -1)
    return int((ends - starts).max()) if len(starts) else 0


def residuals_of(beams: BeamSet, rho: Array, face: NDArray[np.int64], used: Mask, sigma: float) -> Residuals:
    """Residual statistics of the beams in ``used`` against predicted ranges (METHOD section 5)."""
    covered = used & (face >= 0)
    n = int(covered.sum())
    r = beams.r[covered]
    e = r - rho[covered]
    returned = r > 0.0
    inlier = returned & (np.abs(e) < 4.0 * sigma)
    z = e[inlier]
    k = len(z)
    lag = float(np.mean(z[1:] * z[:-1]) / max(float(np.mean(z * z)), 1e-30)) if k > 3 else 0.0
    walk = np.concatenate([[0.0], np.cumsum(z - z.mean())]) if k else np.zeros(1)
    open_ = used & (face < 0) & (beams.r > 0.0)
    surface = rho[covered]
    unexplained = 0
    if n and open_.any():
        at = np.flatnonzero(covered)
        level = np.interp(np.flatnonzero(open_), at, surface)
        unexplained = int((np.abs(beams.r[open_] - level) < 4.0 * sigma).sum())
    return Residuals(
        n_beams=int(used.sum()),
        n_covered=n,
        n_inliers=k,
        rms=float(np.sqrt(np.mean(z * z))) if k else float("nan"),
        chi2=float(np.sum(z * z) / sigma**2 / max(k - 2.2, 1.0)) if k else float("nan"),
        outlier_share=float((returned & ~inlier).sum() / n) if n else 0.0,
        miss_share=float((~returned).sum() / n) if n else 0.0,
        outlier_run=longest_run(returned & ~inlier),
        miss_run=longest_run(~returned),
        cusum=float((walk.max() - walk.min()) / sigma / math.sqrt(max(k, 1))),
        lag1=lag,
        unexplained=unexplained,
        residuals=z,
        places=beams.points[covered][inlier],
    )


def judge_station(
    s: float,
    section: JointSection,
    slid: SlideResult,
    posteriors: tuple[Posterior | None, Posterior | None],
    residuals: tuple[Residuals, Residuals],
    steps: tuple[float, float],
    window: Window,
    sensor: SensorConfig,
    fit: FitConfig,
    passed: int,
    reason: str,
    virtual: bool,
) -> StationEstimate:
    """Put a station together and say what may be believed of it."""
    components = tuple(
        replace(_component(p, r, slid.pose, window, sensor, fit), corner_step=step)
        for p, r, step in zip(posteriors, residuals, steps, strict=True)
    )
    status = OK
    for name, c in zip("AB", components, strict=True):
        if (not c.status.measured and status.measured) or (c.status.name != "ok" and status.name == "ok"):
            status = Status(c.status.name, f"component {name}: {c.status.reason}")
    if status.name == "ok" and reason:
        status = Status("weak", reason)
    return StationEstimate(
        s,
        slid.pose,
        (components[0], components[1]),
        status,
        sensor,
        slid.shift,
        slid.rival_odds,
        passed,
        virtual,
    )


def with_rival(station: StationEstimate, odds: float) -> StationEstimate:
    """The station when another place of the whole joint has the log-odds ``odds`` against it."""
    status = station.status
    if odds > _RIVAL_ODDS and status.name in ("ok", "weak"):
        status = Status(
            "ambiguous", f"another place along u explains the slice as well (log-odds {odds:.1f})"
        )
    return replace(station, rival_odds=odds, status=status)


def _component(
    posterior: Posterior | None, residuals: Residuals, prior: Pose2D, window: Window, sensor: SensorConfig,
    fit: FitConfig,
) -> ComponentEstimate:  # fmt: skip
    if posterior is None:
        return ComponentEstimate(status=Status("no_data", "hardly any return lies on the component"))
    status, weak = OK, ""
    if residuals.n_inliers < fit.min_points:
        status = Status("rejected", f"only {residuals.n_inliers} returns lie on the component")
    elif posterior.weak_sd > 0.3 * window.shift:
        weak = _direction(posterior)
        status = Status(
            "weak", f"the data do not fix it {weak}: standard deviation {posterior.weak_sd * 1e3:.1f} mm"
        )
    elif posterior.rival_mass > 0.2:
        status = Status(
            "ambiguous",
            f"another place {posterior.rival_offset * 1e3:+.1f} mm away explains the data as well",
        )
    rivals: tuple[Rival, ...] = ()
    return ComponentEstimate(
        posterior.pose, posterior.covariance, status, rivals, residuals.n_inliers, residuals.rms, weak,
        posterior, residuals, prior, (window.shift, window.shift, window.angle),
    )  # fmt: skip


def _direction(posterior: Posterior) -> str:
    """Name of the weak direction in words."""
    a = np.abs(posterior.weak_axis)
    names = ("across the gap (u)", "out of the mouth (v)", "in rotation")
    return names[int(np.argmax(a))]
