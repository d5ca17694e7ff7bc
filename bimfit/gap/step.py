"""The step of a joint: by how much one component stands out of the mouth beyond the other."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from bimfit.geometry.joint_section import GapOutline
from bimfit.geometry.pose import Array, Pose2D


@dataclass(frozen=True)
class Step:
    """How flush the two mouth corners are.

    Attributes
    ----------
    value, designed : float
        v of B's mouth corner less that of A's, as built and as designed, m: positive where B stands proud.
    sigma : float or None
        Standard deviation of ``value``, m; None where a pose has no covariance.
    """

    value: float
    designed: float
    sigma: float | None

    @property
    def deviation(self) -> float:
        """As built less designed, m."""
        return self.value - self.designed


def gap_step(
    outline: GapOutline,
    pose_a: Pose2D,
    pose_b: Pose2D,
    cov_a: ArrayLike | None = None,
    cov_b: ArrayLike | None = None,
) -> Step:
    """Measure the step at the mouth.

    Parameters
    ----------
    outline : GapOutline
        The designed sides.
    pose_a, pose_b : Pose2D
        As built = pose * designed.
    cov_a, cov_b : array_like, shape (3, 3), optional
        Covariances of (u, v, theta), independent of one another.

    Notes
    -----
    A corner (u, v) comes to sin(theta) u + cos(theta) v + dv, whose gradient by (du, dv, theta) is
    (0, 1, cos(theta) u - sin(theta) v).
    """
    value, variance = 0.0, 0.0
    known = cov_a is not None and cov_b is not None
    for sign, corner, pose, cov in (
        (-1.0, outline.mouth[0], pose_a, cov_a),
        (1.0, outline.mouth[1], pose_b, cov_b),
    ):
        c, s = math.cos(pose.theta), math.sin(pose.theta)
        u, v = (float(x) for x in corner)
        value += sign * (s * u + c * v + pose.v)
        if cov is not None:
            row: Array = np.array([0.0, 1.0, c * u - s * v])
            variance += float(row @ np.asarray(cov, float) @ row)
    sigma = math.sqrt(max(variance, 0.0)) if known and math.isfinite(variance) else None
    return Step(value, float(outline.mouth[1][1] - outline.mouth[0][1]), sigma)
