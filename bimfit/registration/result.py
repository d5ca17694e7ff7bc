"""What every matcher returns."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from bimfit.geometry.pose import Array, Pose2D
from bimfit.geometry.status import OK, Status

Stop = Literal["proven", "tolerance", "budget", "converged", "unproven"]


@dataclass(frozen=True)
class Mode:
    """One of several poses that explain the data about as well."""

    parameters: Array
    score: float

    @property
    def pose(self) -> Pose2D:
        """The mode as a motion of the section plane."""
        return Pose2D.from_array(self.parameters)


@dataclass(frozen=True)
class MatchResult:
    """The outcome of fitting a model to a slice, whichever matcher made it.

    Attributes
    ----------
    method : str
        ``grcsm``, ``block``, ``mrcsm``, ``icp-point``, ...
    parameters : ndarray, shape (3,) or (6,)
        Motion of the *model*, as built = motion * designed: (u, v, theta) in the section frame, or
        (x, y, z, rotation vector) in 3D.
    score : float
        Weighted sum of look-up values at the pose, in [0, sum of weights]; NaN where the method has none.
    bound : float
        No pose of the window scores more; equals ``score`` when proven, NaN when nothing is known.
    evaluations : int
        Bounds and scores evaluated.
    stop : {"proven", "tolerance", "budget", "converged", "unproven"}
        Why it stopped; ``converged`` for iterative methods, ``unproven`` where bounds do not hold.
    status : Status
        ``ok`` or why there is no usable pose.
    levels : tuple of int
        Resolution levels an axis (the paper's L).
    fitness, inlier_rmse : float
        Share of points within three sigma of the model, and their root mean square distance, m.
    modes : tuple of Mode
        Rival poses within the asked delta that lie apart from ``parameters``, best first.
    seconds : float
        Wall time of the search alone.
    quantisation : float
        Rounding table values and weights to integers changes no score by more than this.
    flat : tuple of (str, ndarray)
        Directions that the data leave open, by name and as a unit vector of the motion, rotations scaled to
        lengths by the data's lever; the certificate holds for all others.
    """

    method: str
    parameters: Array
    score: float = float("nan")
    bound: float = float("nan")
    evaluations: int = 0
    stop: Stop = "converged"
    status: Status = OK
    levels: tuple[int, ...] = ()
    fitness: float = float("nan")
    inlier_rmse: float = float("nan")
    modes: tuple[Mode, ...] = field(default_factory=tuple)
    seconds: float = 0.0
    quantisation: float = 0.0
    flat: tuple[tuple[str, Array], ...] = ()

    @property
    def gap(self) -> float:
        """How much better a pose could still be: bound - score."""
        return self.bound - self.score

    @property
    def pose(self) -> Pose2D:
        """The motion of a planar match."""
        return Pose2D.from_array(self.parameters)

    @property
    def found(self) -> bool:
        """Whether ``parameters`` hold a pose at all."""
        return self.status.measured and bool(np.all(np.isfinite(self.parameters)))
