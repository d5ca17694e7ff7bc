"""The beam model: what a range sensor should have measured, and how likely what it did measure is.

METHOD section 4, steps 3 and 4. A beam that is predicted to meet the component either returns nothing
(share ``e_m``) or returns at r with density (1 - e_o - e_m) N(r; rho, sigma) + e_o / r_max. A beam that is
not returns nothing or, with density e_o / r_max, an outlier. Only the difference of the two is summed.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import NDArray

from bimfit.config import SensorConfig
from bimfit.estimation import _kernels_beams as kernels
from bimfit.geometry.pose import Array, Pose2D
from bimfit.geometry.profile import Profile
from bimfit.geometry.slice import Beams

Ints = NDArray[np.int64]
_SHARE_FLOOR = 1e-3
_MISSING = -1e9
_SAME_ORIGIN = 1e-7


@dataclass(frozen=True)
class BeamModel:
    """Constants of the mixture.

    Attributes
    ----------
    sigma : float
        Standard deviation of a range, m.
    amplitude : float
        A of log(1 + A exp(-d^2 / 2)): the odds of a return on the spot against an outlier there.
    miss : float
        log(e_m / (1 - e_m - e_o)): what a beam that returned nothing says against a face in its way.
    past : float
        The same for a beam that went past and returned from behind; where strays come in runs, one of them
        counts no more than once.
    """

    sigma: float
    amplitude: float
    miss: float
    past: float

    @classmethod
    def of(
        cls, sensor: SensorConfig, *, sigma: float | None = None, outliers: float | None = None
    ) -> BeamModel:
        """Make the model of a sensor; shares of zero are floored, for nothing is impossible."""
        return _model(sensor, sigma, outliers)


@lru_cache(maxsize=64)
def _model(sensor: SensorConfig, sigma: float | None, outliers: float | None) -> BeamModel:
    s = sensor.sigma if sigma is None else sigma
    e_o = max(sensor.outlier_share if outliers is None else outliers, _SHARE_FLOOR)
    e_m = max(sensor.miss_share, _SHARE_FLOOR)
    amplitude = max(1.0 - e_o - e_m, 0.05) * sensor.max_range / (e_o * s * math.sqrt(2.0 * math.pi))
    there = max(1.0 - e_m - e_o, 0.05)
    miss = min(math.log(e_m / there), 0.0)
    past = miss
    if sensor.outlier_run > 1.0:
        past = max(miss, min(math.log(e_o / there), 0.0) / sensor.outlier_run)
    return BeamModel(s, amplitude, miss, past)


@dataclass(frozen=True)
class BeamSet:
    """Beams sorted for the kernels: by origin, then by pseudo-angle.

    Attributes
    ----------
    rays : ndarray, shape (3, n)
        Pseudo-angle and direction.
    r : ndarray, shape (n,)
        Range, negative where nothing came back.
    start, eye : ndarray, shape (g + 1,), (g, 4)
        First beam of every group of one origin; its origin and look direction.
    order : ndarray, shape (n,)
        Index of every beam in what it was made from.
    spread, scale : ndarray, shape (n,), or None
        How many times the sensor's sigma each range deviates, and as how many times it counts in the
        likelihood, see :mod:`bimfit.estimation.spread`; None where all deviate alike.
    """

    rays: Array
    r: Array
    start: Ints
    eye: Array
    order: Ints
    spread: Array | None = None
    scale: Array | None = None

    @classmethod
    def of(cls, beams: Beams) -> BeamSet:
        """Sort the beams of a slice; one whose origin or direction is not a number is left out."""
        o = np.ascontiguousarray(beams.origins, np.float64)
        d = np.ascontiguousarray(beams.directions, np.float64)
        r = np.ascontiguousarray(beams.ranges, np.float64)
        whole, one = kernels.whole_beams(o, d, _SAME_ORIGIN)
        group = np.zeros(len(whole), np.int64)
        if not one:
            near = np.round(o[whole] / _SAME_ORIGIN).astype(np.int64)
            group = np.unique(near, axis=0, return_inverse=True)[1].astype(np.int64).reshape(-1)
        count = int(group.max()) + 1 if len(group) else 0
        return cls(*kernels.sort_beams(o, d, r, whole, group, count, _MISSING))

    def __len__(self) -> int:
        return len(self.r)

    def take(self, keep: NDArray[np.bool_]) -> BeamSet:
        """The beams for which ``keep`` holds; groups left empty stay."""
        before = np.concatenate([[0], np.cumsum(keep)]).astype(np.int64)
        return BeamSet(
            np.ascontiguousarray(self.rays[:, keep]),
            self.r[keep],
            before[self.start],
            self.eye,
            self.order[keep],
            None if self.spread is None else self.spread[keep],
            None if self.scale is None else self.scale[keep],
        )

    def moved_origin(self, pivot: Array) -> BeamSet:
        """The same beams in coordinates whose origin is ``pivot``."""
        eye = self.eye.copy()
        eye[:, :2] -= pivot
        return replace(self, eye=eye)

    @property
    def p(self) -> Array:
        """Pseudo-angles, ascending within a group, shape (n,)."""
        return np.asarray(self.rays[0])

    @property
    def d(self) -> Array:
        """Unit directions, shape (2, n)."""
        return np.asarray(self.rays[1:])

    @cached_property
    def spacing(self) -> float:
        """Usual angle between neighbouring beams, rad; 0 for fewer than two.

        The median over the angle that they span, not over the beams: several rows or sweeps whose beams
        nearly coincide are as far apart as their clusters are.
        """
        return float(kernels.beam_spacing(self.d))

    @property
    def points(self) -> Array:
        """Where each beam ended (nonsense for misses), shape (n, 2)."""
        return np.asarray((self.origins + self.d * self.r).T)

    @property
    def origins(self) -> Array:
        """Where each beam starts from, shape (2, n)."""
        return np.repeat(self.eye[:, :2].T, np.diff(self.start), axis=1)


def usual_step(step: Array) -> float:
    """The step that half of the whole length is made of: each counts by its length; 0 without any."""
    return float(kernels.usual_step(np.ascontiguousarray(step, np.float64)))


def edge_rows(profile: Profile, pose: Pose2D | None = None) -> Array:
    """Edges of a profile as the kernels take them, shape (m, 6): ends and outward unit normal."""
    if pose is None:
        return profile.rows
    edges, normals = pose.apply(profile.edges), pose.turn(profile.normals)
    return np.ascontiguousarray(np.concatenate([edges.reshape(-1, 4), normals], axis=1))


def predict_ranges(rows: Array, beams: BeamSet) -> tuple[Array, Ints]:
    """Range of every beam to the first of the edges that faces it.

    Parameters
    ----------
    rows : ndarray, shape (m, 6)
        From :func:`edge_rows`.

    Returns
    -------
    rho : ndarray, shape (n,)
        inf where the beam meets nothing.
    face : ndarray, shape (n,)
        Row met, -1 for none.
    """
    rho = np.full(len(beams), np.inf)
    face = np.full(len(beams), -1, np.int64)
    kernels.predict(rows, 1.0, 0.0, 0.0, 0.0, beams.rays, beams.start, beams.eye, rho, face)
    return rho, face
