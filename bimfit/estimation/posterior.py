"""Posterior of one component's pose in its own window (METHOD, section 4, steps 5 to 8)."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bimfit.estimation import _kernels_posterior as kernels
from bimfit.estimation.ownership import BeamTable
from bimfit.geometry.pose import Array, Pose2D

_CELLS = 24
_NU = 6
_NEAR = 0.03
"""Returns that far from the component at the prior's centre are on it, m."""
_MIN_HITS = 3
_NOWHERE = np.full(3, np.nan)
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

    @cached_property
    def deviations(self) -> Array:
        """Prior standard deviations in u, v (m) and theta (rad), shape (3,)."""
        return np.array([self.shift, self.shift, self.angle])


@dataclass(frozen=True)
class Heard:
    """The beams that spoke for a component, and what each of them says, so that others may hear them too.

    Attributes
    ----------
    rows : ndarray, shape (m, 6)
        Edges of the designed component.
    table : BeamTable
        All beams of the slice.
    use : ndarray of bool, shape (n,)
        Those that spoke.
    """

    rows: Array
    table: BeamTable
    use: NDArray[np.bool_]

    @property
    def beams(self) -> Array:
        """Those that spoke, shape (9, k), see :class:`~bimfit.estimation.ownership.BeamTable`."""
        return np.asarray(self.table.rows[:, : len(self.table)][:, self.use])

    @property
    def origin(self) -> Array:
        """Where each starts from, shape (2, k)."""
        return np.asarray(self.table.origins[:, self.use])

    @property
    def margin(self) -> float:
        """How far behind a surface a return went past it, m."""
        return self.table.margin

    @property
    def bearing(self) -> float:
        """Standard deviation of a bearing, rad."""
        return _BEARING * self.table.spacing


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
    heard : Heard or None
        The beams behind it.
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
    heard: Heard | None = field(default=None, repr=False)


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
    table: BeamTable,
    window: Window,
    *,
    use: NDArray[np.bool_] | None = None,
    begin: Pose2D | None = None,
) -> Posterior | None:
    """Integrate the beam likelihood over the poses of one component.

    Parameters
    ----------
    rows : ndarray, shape (m, 6)
        Edges of the designed component, :func:`~bimfit.estimation.likelihood.edge_rows`.
    start : Pose2D
        The pose that the prior is centred on. The centroid of the returns near the component there becomes
        the pivot.
    table : BeamTable
        The beams, and what covering each adds to the log-likelihood.
    use : ndarray of bool, shape (n,), optional
        Beams that speak for the component; all unless told.
    begin : Pose2D, optional
        Another place to start from; it counts where it leads elsewhere and explains more.

    Returns
    -------
    Posterior or None
        None where hardly any return lies on the component.
    """
    speak = np.ones(len(table), bool) if use is None else use
    out = _integrated(rows, start, table, window, speak, begin, _CELLS)
    if out is None:
        return None
    u, v, theta = out[:3].tolist()
    evidence, ranges, _, _, _, sd, mass, offset, _, _, ess, _, radius = out[23:36].tolist()
    return Posterior(
        pose=Pose2D(u, v, theta),
        covariance=out[3:12].reshape(3, 3),
        pivot=out[12:14],
        pivot_covariance=out[14:23].reshape(3, 3),
        evidence=evidence,
        weak_axis=out[25:28],
        weak_sd_ranges=ranges,
        weak_sd=sd,
        rival_mass=mass,
        rival_offset=offset,
        radius=radius,
        ess=ess,
        heard=Heard(rows, table, speak),
    )


class Glance(NamedTuple):
    """Where a component is most likely, and about the log evidence: a posterior at a fraction of its cost."""

    pose: Pose2D
    evidence: float


def component_glance(
    rows: Array, start: Pose2D, table: BeamTable, window: Window, use: NDArray[np.bool_], begin: Pose2D | None
) -> Glance | None:
    """What :func:`component_posterior` would find, from the profile along the weak direction alone."""
    out = _integrated(rows, start, table, window, use, begin, 0)
    return None if out is None else Glance(Pose2D(*out[:3].tolist()), float(out[23]))


def _integrated(
    rows: Array,
    start: Pose2D,
    table: BeamTable,
    window: Window,
    use: NDArray[np.bool_],
    begin: Pose2D | None,
    cells: int,
) -> Array | None:
    """Figures of a posterior as the kernel gives them, shape (36,)."""
    other = _NOWHERE if begin is None else begin.as_array()
    out = np.empty(36)
    found = kernels.component(
        rows, start.as_array(), other, use, table.rows, table.start, table.eye, table.margin, _NEAR,
        _MIN_HITS, _BEARING * table.spacing, window.deviations, window.reach, window.least, cells, _draws(),
        out,
    )  # fmt: skip
    return out if found else None
