"""Posterior of one component's pose in its own window (METHOD, section 4, steps 5 to 8)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from bimfit.estimation import _kernels
from bimfit.estimation.likelihood import BeamModel, BeamSet
from bimfit.estimation.ownership import Cost
from bimfit.geometry.pose import Array, Pose2D

_CELLS = 24
_NU = 6
_BEARING = 0.05
"""A beam's bearing is blurred by this share of the spacing: footprints and encoders are never points."""


@dataclass(frozen=True)
class Window:
    """How far a component may be from the combined pose.

    Attributes
    ----------
    shift, angle : float
        Prior standard deviations, m and rad.
    reach, least : float
        Greatest and least half width that is integrated over along the weak direction, m.
    """

    shift: float = 0.008
    angle: float = math.radians(4.0)
    reach: float = 0.012
    least: float = 0.003


@dataclass(frozen=True)
class Posterior:
    """What one slice says about one component.

    Attributes
    ----------
    pose : Pose2D
        Posterior mean: motion of the designed component in the section frame.
    covariance : ndarray, shape (3, 3)
        Of (u, v, theta) of ``pose``.
    pivot : ndarray, shape (2,)
        Centroid of the returns used, where the three parameters are least correlated.
    pivot_covariance : ndarray, shape (3, 3)
        Of (u, v, theta) of a motion about the pivot.
    evidence : float
        log of the integral of likelihood times prior.
    weak_axis : ndarray, shape (3,)
        Direction in (u, v, theta * radius) that the ranges fix least.
    weak_sd_ranges, weak_sd : float
        Standard deviation along it from the ranges alone, and in the posterior, m.
    rival_mass, rival_offset : float
        Probability more than 3 mm from the mode along the weak axis, and where it lies, m.
    radius : float
        Root mean square distance of the returns from the pivot, m.
    ess : float
        Effective number of nodes or samples behind the moments.
    """

    pose: Pose2D
    covariance: Array
    pivot: Array
    pivot_covariance: Array
    evidence: float
    weak_axis: Array
    weak_sd_ranges: float
    weak_sd: float
    rival_mass: float
    rival_offset: float
    radius: float
    ess: float = float("nan")


@lru_cache(maxsize=1)
def _draws() -> Array:
    """Student deviates (nu = 6) in three dimensions and their log density, shape (512, 4)."""
    from scipy.special import gammaln
    from scipy.stats import chi2, norm, qmc

    uniform = qmc.Sobol(4, scramble=True, rng=np.random.default_rng(1)).random(512)
    z = norm.ppf(uniform[:, :3]) * np.sqrt(_NU / chi2.ppf(uniform[:, 3:], _NU))
    constant = gammaln((_NU + 3) / 2) - gammaln(_NU / 2) - 1.5 * math.log(_NU * math.pi)
    log_density = constant - 0.5 * (_NU + 3) * np.log1p((z**2).sum(axis=1) / _NU)
    return np.ascontiguousarray(np.column_stack([z, log_density]))


def component_posterior(
    rows: Array,
    start: Pose2D,
    beams: BeamSet,
    cost: Cost,
    centred_on: Array,
    model: BeamModel,
    window: Window,
    begin: Pose2D | None = None,
) -> Posterior:
    """Integrate the beam likelihood over the poses of one component.

    Parameters
    ----------
    rows : ndarray, shape (m, 6)
        Edges of the designed component, :func:`~bimfit.estimation.likelihood.edge_rows`.
    start : Pose2D
        The pose that the prior is centred on.
    cost : Cost
        What covering each beam adds to the log-likelihood.
    centred_on : ndarray, shape (k, 2)
        Returns on the component, whose centroid becomes the pivot.
    begin : Pose2D, optional
        Where the pilot starts; ``start`` unless told.
    """
    pivot = centred_on.mean(axis=0)
    radius = max(float(np.sqrt(np.mean(np.sum((centred_on - pivot) ** 2, axis=1)))), 0.005)
    local = Pose2D(start.u - pivot[0], start.v - pivot[1], start.theta)
    moved = np.empty_like(rows)
    moved[:, 0:2], moved[:, 2:4] = local.apply(rows[:, 0:2]), local.apply(rows[:, 2:4])
    moved[:, 4:6] = local.turn(rows[:, 4:6])
    set_ = beams.moved_origin(pivot)
    first = np.zeros(3)
    if begin is not None:
        theta = begin.theta - start.theta
        shift = np.array([begin.u, begin.v]) - pivot - Pose2D(theta=theta).apply((local.u, local.v))
        first[:] = shift[0], shift[1], theta
    spread = (_BEARING * beams.spacing / model.sigma) ** 2
    mean, cov, info = np.empty(3), np.empty((3, 3)), np.zeros(12)
    _kernels.posterior(
        moved, radius, set_.p, set_.d, set_.r, set_.start, set_.eye, cost.off, cost.deep,
        cost.margin, cost.limit, model.sigma, spread,
        model.table, model.scale, np.array([window.shift, window.shift, window.angle]), first,
        window.reach, window.least, _CELLS, _draws(), mean, cov, info,
    )  # fmt: skip
    phi = mean[2] / radius
    turned = Pose2D(theta=phi).apply((local.u, local.v))
    pose = Pose2D(
        float(turned[0] + mean[0] + pivot[0]), float(turned[1] + mean[1] + pivot[1]), start.theta + phi
    )
    scale = np.diag([1.0, 1.0, 1.0 / radius])
    about_pivot = scale @ cov @ scale
    jacobian = np.eye(3)
    jacobian[0, 2], jacobian[1, 2] = -turned[1], turned[0]
    return Posterior(
        pose=pose,
        covariance=jacobian @ about_pivot @ jacobian.T,
        pivot=pivot,
        pivot_covariance=about_pivot,
        evidence=float(info[0]),
        weak_axis=info[2:5].copy(),
        weak_sd_ranges=float(info[1]),
        weak_sd=float(info[5]),
        rival_mass=float(info[6]),
        rival_offset=float(info[7]),
        radius=radius,
        ess=float(info[10]),
    )
