"""The frame of a cross-section."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from bimfit.geometry.pose import Array, Pose2D


@dataclass(frozen=True)
class SectionFrame:
    """Where a cross-section lies in the world.

    u runs from component A to component B across the gap, v out of the joint's mouth, and n along the
    joint; right-handed, n = u x v. The origin is midway between the designed mouth corners.

    Attributes
    ----------
    origin, u, v, n : ndarray, shape (3,)
        World coordinates (m) and unit directions.
    """

    origin: Array
    u: Array
    v: Array
    n: Array

    @classmethod
    def from_axes(cls, origin: ArrayLike, u: ArrayLike, v: ArrayLike) -> SectionFrame:
        """Make an orthonormal frame from an origin, a u direction kept as it is and a rough v.

        Raises
        ------
        ValueError
            When u and v are parallel or zero.
        """
        a = np.asarray(u, float)
        b = np.asarray(v, float)
        n = np.cross(a, b)
        size = float(np.linalg.norm(n))
        if not size > 1e-12:
            raise ValueError("u and v do not span a plane")
        n = n / size
        a = a / np.linalg.norm(a)
        return cls(np.asarray(origin, float).copy(), a, np.cross(n, a), n)

    @property
    def rotation(self) -> Array:
        """Matrix whose columns are u, v, n; shape (3, 3)."""
        return np.column_stack([self.u, self.v, self.n])

    @property
    def T_world_section(self) -> Array:
        """Maps section coordinates (u, v, n) to world, shape (4, 4)."""
        out = np.eye(4)
        out[:3, :3] = self.rotation
        out[:3, 3] = self.origin
        return out

    def to_section(self, points: ArrayLike) -> Array:
        """World points (..., 3) to section coordinates (u, v, n), shape (..., 3)."""
        return np.asarray((np.asarray(points, float) - self.origin) @ self.rotation)

    def to_world(self, points: ArrayLike) -> Array:
        """Section coordinates of shape (..., 2) or (..., 3) to world points (..., 3)."""
        p = np.asarray(points, float)
        axes = self.rotation[:, : p.shape[-1]]
        return np.asarray(p @ axes.T + self.origin)

    def direction_to_section(self, vectors: ArrayLike) -> Array:
        """World directions (..., 3) to section components (u, v, n), shape (..., 3)."""
        return np.asarray(np.asarray(vectors, float) @ self.rotation)

    def direction_to_world(self, vectors: ArrayLike) -> Array:
        """Section directions of shape (..., 2) or (..., 3) to world directions (..., 3)."""
        p = np.asarray(vectors, float)
        return np.asarray(p @ self.rotation[:, : p.shape[-1]].T)

    def lift(self, pose: Pose2D) -> Array:
        """World motion (4, 4) that a motion in this section stands for: as built = lift * designed."""
        motion = np.eye(4)
        motion[:2, :2] = pose.rotation
        R = self.rotation @ motion[:3, :3] @ self.rotation.T
        out = np.eye(4)
        out[:3, :3] = R
        out[:3, 3] = self.origin + self.direction_to_world((pose.u, pose.v)) - R @ self.origin
        return out

    def drop(self, T_world: ArrayLike) -> Pose2D:
        """The in-plane part of a world motion (4, 4), as a motion in this section."""
        m = np.asarray(T_world, float)
        R = self.rotation.T @ m[:3, :3] @ self.rotation
        shift = self.to_section(m[:3, :3] @ self.origin + m[:3, 3])
        return Pose2D(
            float(shift[0]), float(shift[1]), float(np.arctan2(R[1, 0] - R[0, 1], R[0, 0] + R[1, 1]))
        )

    def moved(self, pose: Pose2D) -> SectionFrame:
        """The frame after a motion in its own plane."""
        R = pose.rotation
        u = self.direction_to_world(R[:, 0])
        v = self.direction_to_world(R[:, 1])
        return SectionFrame(self.to_world((pose.u, pose.v)), u, v, self.n)
