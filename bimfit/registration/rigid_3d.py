"""Rigid motions of space as six numbers, and what a set of point-to-plane pairs says of one.

A motion is ``(x, y, z, rotation vector)``: turn about the origin by the rotation vector, then shift.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from bimfit.geometry.pose import Array, rigid_inverse
from bimfit.registration.result import MatchResult
from bimfit.registration.surface_3d import Surface

WEAK_SHARE = 0.004
"""A direction fixed by less than this share of the inliers counts as weak."""
WEAK_POINTS = 4.0
"""A direction fixed by fewer points than this, each taken at full strength, counts as weak."""


def matrix_of(parameters: ArrayLike) -> Array:
    """4 x 4 matrix of ``(x, y, z, rotation vector)``."""
    p = np.asarray(parameters, float)
    out = np.eye(4)
    out[:3, :3] = Rotation.from_rotvec(p[3:6]).as_matrix()
    out[:3, 3] = p[:3]
    return out


def parameters_of(T: ArrayLike) -> Array:
    """``(x, y, z, rotation vector)`` of a rigid 4 x 4 matrix, shape (6,)."""
    m = np.asarray(T, float)
    return np.concatenate([m[:3, 3], Rotation.from_matrix(m[:3, :3]).as_rotvec()])


def T_scan_model(result: MatchResult) -> Array:
    """The motion of the model of a 3D match, shape (4, 4): as built = motion * designed.

    Raises
    ------
    ValueError
        When the result holds no pose: a failed match never turns into an identity matrix.
    """
    if not result.found or result.parameters.shape != (6,):
        raise ValueError(f"no 3D pose in this result: {result.status.name} ({result.status.reason})")
    return matrix_of(result.parameters)


def T_model_scan(result: MatchResult) -> Array:
    """What carries the scan into the designed model's frame, shape (4, 4); inverse of the motion.

    Raises
    ------
    ValueError
        When the result holds no pose.
    """
    return rigid_inverse(T_scan_model(result))


def about(pivot: ArrayLike, shift: ArrayLike, rotation_vector: ArrayLike) -> Array:
    """4 x 4 matrix that turns about ``pivot``, then shifts."""
    c = np.asarray(pivot, float)
    out = np.eye(4)
    out[:3, :3] = Rotation.from_rotvec(np.asarray(rotation_vector, float)).as_matrix()
    out[:3, 3] = c + np.asarray(shift, float) - out[:3, :3] @ c
    return out


@dataclass(frozen=True)
class Information:
    """How well point-to-plane pairs fix the six directions of a motion.

    Rotations are scaled by the points' rms lever about ``pivot``, so that every direction is in metres.

    Attributes
    ----------
    matrix : ndarray, shape (6, 6)
        Sum of squared sensitivities; an eigenvalue is the number of points that fix its direction.
    pivot : ndarray, shape (3,)
    lever : float
        Root mean square distance of the points from the pivot, m.
    count : float
        Sum of the pairs' weights.
    """

    matrix: Array
    pivot: Array
    lever: float
    count: float

    def weak(self) -> tuple[tuple[float, Array], ...]:
        """Flat directions as (eigenvalue, unit vector (6,) of shift and scaled turn), weakest first."""
        if not np.all(np.isfinite(self.matrix)):
            return ()
        values, vectors = np.linalg.eigh(self.matrix)
        limit = max(WEAK_POINTS, WEAK_SHARE * self.count)
        return tuple((float(v), vectors[:, i]) for i, v in enumerate(values) if v < limit)

    def names(self) -> tuple[str, ...]:
        """The flat directions in words, frame of the model."""
        return tuple(direction_name(vector) for _, vector in self.weak())


def direction_name(vector: ArrayLike) -> str:
    """Name a direction (6,) of motion by its larger part: a shift along, or a turn about, an axis."""
    v = np.asarray(vector, float)
    turning = np.linalg.norm(v[3:]) > np.linalg.norm(v[:3])
    axis = v[3:] if turning else v[:3]
    axis = axis / np.linalg.norm(axis)
    axis = axis * (1.0 if axis[np.argmax(np.abs(axis))] > 0 else -1.0)
    main = int(np.argmax(np.abs(axis)))
    where = (
        "xyz"[main]
        if abs(axis[main]) > 0.99
        else "({:.2f}, {:.2f}, {:.2f})".format(*(float(a) + 0.0 for a in axis))
    )
    return f"turn about {where}" if turning else f"shift along {where}"


def information_of(points: Array, normals: Array, weights: Array) -> Information:
    """Information of pairs whose points (n, 3) are held to planes with ``normals`` (n, 3)."""
    total = float(weights.sum())
    if total <= 0.0:
        return Information(np.zeros((6, 6)), points.mean(axis=0) if len(points) else np.zeros(3), 1.0, 0.0)
    pivot = np.asarray(weights @ points / total)
    arm = points - pivot
    lever = float(np.sqrt(weights @ np.einsum("ij,ij->i", arm, arm) / total)) or 1.0
    J = np.concatenate([normals, np.cross(arm, normals) / lever], axis=1)
    return Information(np.asarray((J * weights[:, None]).T @ J), pivot, lever, total)


@dataclass(frozen=True)
class Refined:
    """A motion refined by robust point-to-plane fitting.

    Attributes
    ----------
    T : ndarray, shape (4, 4)
        Carries the points into the surface's frame.
    sigma : float
        Robust standard deviation of the inliers' distances, m.
    inlier : ndarray of bool, shape (n,)
        Points within three sigma of the surface.
    rmse : float
        Root mean square distance of the inliers, m.
    information : Information
        In the surface's frame.
    """

    T: Array
    sigma: float
    inlier: np.ndarray[tuple[int], np.dtype[np.bool_]]
    rmse: float
    information: Information


@dataclass(frozen=True)
class PlanePairs:
    """Points paired with the planes of the nearest surface samples."""

    residual: Array
    normals: Array
    near: np.ndarray[tuple[int], np.dtype[np.bool_]]


class Refiner:
    """Robust point-to-plane refinement of points against one sampled surface.

    Iteratively reweighted Gauss-Newton with Tukey's weight, its width annealed from a wide gate to three
    times the residuals' own spread (METHOD, sections 8 and 9).

    Parameters
    ----------
    surface : Surface
        Samples with outward normals.
    """

    def __init__(self, surface: Surface) -> None:
        self.surface = surface
        self.tree = cKDTree(surface.points)

    def pair(self, moved: Array, normals: Array | None, gate: float) -> PlanePairs:
        """Pair points already in the surface's frame; ``normals`` (n, 3) or None gate the pairs."""
        distance, index = self.tree.query(moved, distance_upper_bound=gate + 2.0 * self.surface.spacing)
        near = np.isfinite(distance)
        index = np.where(near, index, 0)
        n = self.surface.normals[index]
        offset = moved - self.surface.points[index]
        residual = np.einsum("ij,ij->i", n, offset)
        sideways = np.sqrt(np.maximum(np.where(near, distance, 0.0) ** 2 - residual**2, 0.0))
        near &= (np.abs(residual) <= gate) & (sideways <= 0.75 * self.surface.spacing + 0.5 * gate)
        if normals is not None:
            agreement = np.einsum("ij,ij->i", n, normals)
            near &= (np.abs(agreement) if self.surface.unsigned else agreement) > 0.6
        return PlanePairs(residual, n, near)

    def refine(
        self,
        points: Array,
        T0: Array,
        *,
        gates: tuple[float, ...],
        floor: float,
        normals: Array | None = None,
        iterations: int = 8,
    ) -> Refined:
        """Refine ``T0``, which carries ``points`` into the surface's frame.

        Parameters
        ----------
        points : ndarray, shape (n, 3)
        T0 : ndarray, shape (4, 4)
        gates : tuple of float
            Tukey widths, wide to narrow, m; afterwards the spread of the residuals decides.
        floor : float
            The spread is never taken less than this, m.
        normals : ndarray, shape (n, 3), optional
            The points' own normals; pairs must agree within 53 degrees.
        iterations : int
            Gauss-Newton steps a gate.
        """
        T = np.array(T0, float)
        sigma = gates[-1] / 4.0
        for stage in range(len(gates) + 2):
            annealing = stage < len(gates)
            gate = gates[stage] if annealing else max(4.0 * sigma, 4.0 * floor)
            for _ in range(iterations):
                moved, turned = self._carry(T, points, normals)
                pairs = self.pair(moved, turned, gate)
                step = _gauss_newton(moved, pairs, gate)
                if step is None:
                    break
                T = step[0] @ T
                if step[1] < 1e-3 * floor:
                    break
            moved, turned = self._carry(T, points, normals)
            pairs = self.pair(moved, turned, gate)
            if pairs.near.sum() >= 6:
                spread = 1.4826 * float(np.median(np.abs(pairs.residual[pairs.near])))
                sigma = float(np.clip(spread, floor, gate / 2.5))
        return self.judge(points, T, sigma, normals)

    def judge(self, points: Array, T: Array, sigma: float, normals: Array | None = None) -> Refined:
        """What the motion ``T`` (4, 4) explains, at a given ``sigma``."""
        moved, turned = self._carry(T, points, normals)
        pairs = self.pair(moved, turned, 3.0 * sigma)
        inlier = pairs.near
        rmse = float(np.sqrt(np.mean(pairs.residual[inlier] ** 2))) if inlier.any() else float("nan")
        info = information_of(moved[inlier], pairs.normals[inlier], np.ones(int(inlier.sum())))
        return Refined(T, sigma, inlier, rmse, info)

    @staticmethod
    def _carry(T: Array, points: Array, normals: Array | None) -> tuple[Array, Array | None]:
        moved = points @ T[:3, :3].T + T[:3, 3]
        return moved, None if normals is None else normals @ T[:3, :3].T


def _gauss_newton(moved: Array, pairs: PlanePairs, gate: float) -> tuple[Array, float] | None:
    """One reweighted step: (4 x 4 increment, its largest motion in m); None with too few pairs."""
    k = pairs.near
    if int(k.sum()) < 6:
        return None
    r, n, p = pairs.residual[k], pairs.normals[k], moved[k]
    w = (1.0 - (r / (1.0001 * gate)) ** 2) ** 2
    info = information_of(p, n, w)
    arm = p - info.pivot
    J = np.concatenate([n, np.cross(arm, n) / info.lever], axis=1)
    # The ridge holds directions that nothing fixes where they are.
    A = info.matrix + (1e-4 * max(info.count, 1.0)) * np.eye(6)
    step = np.linalg.solve(A, -(J * w[:, None]).T @ r)
    if not np.all(np.isfinite(step)):
        return None
    return about(info.pivot, step[:3], step[3:] / info.lever), float(np.abs(step).max())
