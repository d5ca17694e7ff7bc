"""How well points lie on a model at a pose, whichever matcher found it."""

from __future__ import annotations

import math

import numpy as np

from bimfit.geometry.pose import Array, Pose2D
from bimfit.registration import _kernels
from bimfit.registration.table import Target

INLIER_SIGMAS = 3.0


def fitness_of(target: Target, points: Array, pose: Pose2D) -> tuple[float, float]:
    """Share of points within three blurs of the moved model, and their root mean square distance (m).

    The share is 0 and the distance NaN when there is none.
    """
    back = pose.inverse()
    motion = np.array([math.cos(back.theta), math.sin(back.theta), back.u, back.v])
    count, total = _kernels.fitness(
        np.ascontiguousarray(points), motion, target.edges, INLIER_SIGMAS * target.blur
    )
    if count == 0:
        return 0.0, float("nan")
    return count / len(points), math.sqrt(total / count)
