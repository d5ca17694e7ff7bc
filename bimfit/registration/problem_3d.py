"""The problem that the search in space solves: points, a lattice of poses, and what the data leave open."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from bimfit.errors import ConfigError, ScanError
from bimfit.geometry.pose import Array, rigid_inverse, transform_points
from bimfit.registration import _kernels_3d as kernels
from bimfit.registration.rigid_3d import WEAK_POINTS, about, direction_name, matrix_of, parameters_of
from bimfit.registration.table_3d import Target3D


@dataclass(frozen=True)
class Problem3D:
    """One search: points about their pivot and a lattice of poses. Lengths in lattice cells.

    Attributes
    ----------
    target : Target3D
    prior : ndarray, shape (4, 4)
        Motion of the model at the window's middle.
    points : ndarray, shape (n, 3)
        Data in the designed model's frame, about ``pivot``.
    weights : ndarray, shape (n,)
    pivot : ndarray, shape (3,)
        From the field's first node.
    x0 : ndarray, shape (6,)
        Pose (shift, rotation vector) at lattice coordinates 0.
    V : ndarray, shape (6, d)
        Directions that are searched; pose = x0 + V (steps * coordinates).
    steps, reach : ndarray, shape (d,)
        Length of a lattice step, and how many steps the window reaches each way.
    precision : ndarray, shape (6,)
        Of the prior on the pose, points' worth a squared cell or radian; 0 where it is free.
    """

    target: Target3D
    prior: Array
    points: Array
    weights: Array
    pivot: Array
    x0: Array
    V: Array
    steps: Array
    reach: Array
    precision: Array

    @property
    def rho(self) -> Array:
        """Distance of every point from the pivot, cells."""
        return np.asarray(np.linalg.norm(self.points, axis=1))

    @property
    def lever(self) -> float:
        """Root mean square distance of the points from the pivot, cells."""
        return float(max(np.sqrt(np.mean(self.rho**2)), 1e-9))

    @property
    def total(self) -> float:
        """No pose scores more than this."""
        return float(self.weights.sum())

    def worth(self, points: float) -> float:
        """Score of so many points of mean weight that lie on the surface."""
        return points * self.total / max(len(self.points), 1)

    @property
    def packed(self) -> tuple[Any, ...]:
        """The kernels' argument."""
        return (
            self.target.field,
            self.points,
            self.rho,
            self.weights,
            self.pivot,
            self.x0,
            self.V,
            self.steps,
            self.reach,
            self.precision,
        )

    def pose(self, at: ArrayLike) -> Array:
        """Shift (cells) and rotation vector at lattice coordinates ``at`` (d,), shape (6,)."""
        return np.asarray(self.x0 + self.V @ (self.steps * np.asarray(at, float)))

    def score(self, pose: Array) -> float:
        """Score of a pose (6,) as ``pose`` gives it."""
        J, R = np.empty((3, 3)), np.empty((3, 3))
        args = (self.target.field, self.points, self.weights, self.pivot, np.ascontiguousarray(pose), R, J)
        return float(kernels.score_at(*args)) + float(kernels.penalty(self.precision, args[4]))

    def bound(self, low: ArrayLike, high: ArrayLike) -> float:
        """Upper bound of the score over the lattice poses ``low`` .. ``high`` (d,)."""
        a, b = np.asarray(low, float), np.asarray(high, float)
        half = 0.5 * (b - a) * self.steps
        middle = self.pose(0.5 * (a + b))
        slope = np.empty(len(half))
        constant = kernels.bound_node(
            self.points,
            self.rho,
            self.weights,
            self.pivot,
            middle,
            half,
            self.V,
            self.target.tables.packed,
            np.empty((3, 3)),
            np.empty((3, 3)),
            slope,
        )
        slope -= self.V.T @ (self.precision * middle)
        constant += kernels.penalty(self.precision, middle)
        return float(min(constant + np.abs(slope) @ half, self.total))

    def nearest(self, motion: Array) -> Array:
        """The lattice coordinates (d,) of the window that lie nearest to a motion of the model (4, 4)."""
        pivot = self.target.origin + self.pivot * self.target.spacing
        T = rigid_inverse(motion) @ self.prior
        shift = (transform_points(T, pivot) - pivot) / self.target.spacing
        pose = np.concatenate([shift, parameters_of(T)[3:]]) - self.x0
        return np.asarray(np.clip(np.rint(self.V.T @ pose / self.steps), -self.reach, self.reach))

    def T_model_scan(self, pose: Array) -> Array:
        """What carries the scan to the designed model at a pose (6,), shape (4, 4)."""
        cell = self.target.spacing
        pivot = self.target.origin + self.pivot * cell
        return np.asarray(about(pivot, pose[:3] * cell, pose[3:]) @ rigid_inverse(self.prior))


def make_problem(
    target: Target3D,
    points: ArrayLike,
    prior: ArrayLike | None,
    window: Sequence[float],
    tolerance: Sequence[float],
    *,
    weights: ArrayLike | None = None,
    pivot: ArrayLike | None = None,
    prior_sigma: Sequence[float] | None = None,
    prior_weight: float = 1.0,
) -> Problem3D:
    """Check a search's input and bring it to lattice cells; arguments as those of :func:`match_3d`.

    Raises
    ------
    ScanError, ConfigError
    """
    half, step = np.asarray(window, float), np.asarray(tolerance, float)
    if half.shape != (6,) or step.shape != (6,):
        raise ConfigError("window and tolerance take six numbers: x, y, z (m) and rotation vector (rad)")
    if not (np.all(np.isfinite(half)) and np.all(half >= 0.0) and np.all(half[3:] <= np.pi)):
        raise ConfigError(f"window must be six numbers of at least 0, angles at most pi, got {half.tolist()}")
    if not (np.all(np.isfinite(step)) and np.all(step > 0.0)):
        raise ConfigError(f"tolerance must be six positive numbers, got {step.tolist()}")
    cloud = np.asarray(points, float)
    if cloud.ndim != 2 or cloud.shape[1] != 3 or not np.all(np.isfinite(cloud)):
        raise ScanError(f"points must be an (n, 3) array of finite numbers, got shape {cloud.shape}")
    w = np.ones(len(cloud)) if weights is None else np.asarray(weights, float)
    if w.shape != (len(cloud),) or not np.all(np.isfinite(w)) or np.any(w < 0.0):
        raise ConfigError("weights must be one number of at least 0 a point")
    spread = np.full(6, np.inf) if prior_sigma is None else np.asarray(prior_sigma, float)
    if spread.shape != (6,) or not np.all(spread > 0.0) or not 0.0 <= prior_weight < np.inf:
        raise ConfigError("prior_sigma takes six positive numbers, and prior_weight is at least 0")
    motion = motion_of(prior)
    back = rigid_inverse(motion)
    local = transform_points(back, cloud)
    centre = np.zeros(3) if not len(cloud) else 0.5 * (local.min(axis=0) + local.max(axis=0))
    if pivot is not None:
        centre = transform_points(back, np.asarray(pivot, float))
    cell = target.spacing
    # Neighbours in space are neighbours in memory: their look-ups share cache lines.
    tile = np.floor((local - target.origin) / (8.0 * cell)).astype(np.int64)
    order = np.lexsort((tile[:, 2], tile[:, 1], tile[:, 0]))
    searched = np.flatnonzero(half > 0.0)
    scale = np.array([cell] * 3 + [1.0] * 3)
    return Problem3D(
        target,
        motion,
        np.ascontiguousarray((local[order] - centre) / cell),
        np.ascontiguousarray(w[order]),
        np.ascontiguousarray((centre - target.origin) / cell),
        np.zeros(6),
        np.ascontiguousarray(np.eye(6)[:, searched]),
        (step / scale)[searched],
        np.ceil(half / step - 1e-9)[searched],
        prior_weight * (scale / spread) ** 2,
    )


def motion_of(prior: ArrayLike | None, name: str = "prior") -> Array:
    """A rigid 4 x 4 matrix of itself or of six numbers; the identity of None.

    Raises
    ------
    ConfigError
        When it is neither, or not rigid.
    """
    if prior is None:
        return np.eye(4)
    given = np.asarray(prior, float)
    if given.shape not in ((6,), (4, 4)) or not np.all(np.isfinite(given)):
        raise ConfigError(f"{name} must be a 4 x 4 matrix or six numbers: x, y, z and rotation vector")
    motion = matrix_of(given) if given.shape == (6,) else given
    if not np.allclose(motion[:3, :3] @ motion[:3, :3].T, np.eye(3), atol=1e-6):
        raise ConfigError(f"{name} must be a rigid motion")
    return motion


def flat_directions(problem: Problem3D, pose: Array) -> tuple[Array, tuple[tuple[str, Array], ...]]:
    """The searched directions that the score hardly depends on at a pose (6,).

    The score's curvature over half a blur is an effective number of points that fix a direction. A
    direction is flat where they are too few to fix it within the tolerance (the noise taken as half the
    blur), but never for lack of more than one in a hundred, and always under ``WEAK_POINTS``.

    Returns
    -------
    flat : ndarray, shape (d, k)
        Orthonormal, in the searched axes with rotations scaled by the lever.
    named : tuple of (str, ndarray, shape (6,))
        Their names, and themselves in all six axes, of unit length.
    """
    d = len(problem.steps)
    scale = scales(problem)
    blur = problem.target.blur / problem.target.spacing
    h = 0.5 * blur
    directions = problem.V / scale

    def score(z: Array) -> float:
        return problem.score(pose + directions @ z)

    H = np.zeros((d, d))
    unit = h * np.eye(d)
    middle = problem.score(pose)
    for i in range(d):
        H[i, i] = (2.0 * middle - score(unit[i]) - score(-unit[i])) / h**2
        for j in range(i):
            H[i, j] = H[j, i] = (
                score(unit[i] - unit[j])
                + score(unit[j] - unit[i])
                - score(unit[i] + unit[j])
                - score(-unit[i] - unit[j])
            ) / (4.0 * h**2)
    values, vectors = np.linalg.eigh(H) if d else (np.zeros(0), np.zeros((0, 0)))
    # Fixed to within a tolerance: so many points of half a blur's spread does it take.
    needed = (0.5 * blur / float(np.median(problem.steps * scale))) ** 2 if d else 0.0
    limit = problem.worth(max(WEAK_POINTS, min(needed, 0.01 * len(problem.points))))
    # Far from a summit the score curves upwards too, but there it changes.
    still = [max(abs(score(h * v) - middle), abs(score(-h * v) - middle)) < 0.5 * limit for v in vectors.T]
    flat = vectors[:, (values * blur**2 < limit) & np.array(still, bool)]
    each = [problem.V @ column for column in flat.T]
    return flat, tuple((direction_name(v), v / np.linalg.norm(v)) for v in each)


def scales(problem: Problem3D) -> Array:
    """Motion of the data, cells, a unit of each searched direction, shape (d,)."""
    shift = np.linalg.norm(problem.V[:3], axis=0)
    turn = np.linalg.norm(problem.V[3:], axis=0)
    return np.asarray(shift + problem.lever * turn)


def without(problem: Problem3D, at: Array, flat: Array) -> Problem3D:
    """The search with flat directions held at lattice coordinates ``at`` (d,)."""
    scale = scales(problem)
    basis = np.linalg.svd(flat, full_matrices=True)[0][:, flat.shape[1] :] if flat.size else np.eye(len(at))
    V = problem.V / scale @ basis
    step = problem.steps * scale
    steps = np.sqrt((basis**2).T @ step**2)
    # The new axes' box must hold the old one, wherever in it the climb ended.
    half = np.abs(basis).T @ (step * (problem.reach + np.abs(at)))
    return replace(
        problem,
        x0=problem.pose(at),
        V=np.ascontiguousarray(V),
        steps=np.ascontiguousarray(steps),
        reach=np.ceil(half / steps - 1e-9) if len(steps) else np.zeros(0),
    )
