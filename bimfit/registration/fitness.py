"""How well points lie on a model at a pose, whichever matcher found it."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from bimfit.geometry.pose import Array, Pose2D
from bimfit.registration import _kernels
from bimfit.registration.table import Target

INLIER_SIGMAS = 3.0


def distances_to(target: Target, points: Array, pose: Pose2D) -> Array:
    """Distance of each point from the moved model's surface, m; inf where none of it is visible."""
    own = pose.inverse().apply(points)[:, None]
    a, along = target.edges[:, 0], target.edges[:, 1] - target.edges[:, 0]
    length = np.maximum(np.sum(along**2, axis=1), 1e-300)
    share = np.clip(np.sum((own - a) * along, axis=2) / length, 0.0, 1.0)
    off = np.linalg.norm(own - a - share[..., None] * along, axis=2)
    return np.asarray(np.min(off, axis=1, initial=np.inf))


def own_returns(targets: Sequence[Target], points: Array, pose: Pose2D) -> tuple[Array, ...]:
    """Which points are whose, as one mask a model: those nearest to it while all are moved by ``pose``."""
    nearest = np.argmin([distances_to(target, points, pose) for target in targets], axis=0)
    return tuple(nearest == k for k in range(len(targets)))


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
