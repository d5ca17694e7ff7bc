"""Rigid motions: SE(2) in a section plane, SE(3) as 4 x 4 matrices."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Pose2D:
    """A rigid motion of the section plane: turn about the frame's origin, then shift.

    Attributes
    ----------
    u, v : float
        Shift, m.
    theta : float
        Rotation, rad, counter-clockwise from u to v.
    """

    u: float = 0.0
    v: float = 0.0
    theta: float = 0.0

    @property
    def rotation(self) -> Array:
        """Rotation matrix, shape (2, 2)."""
        c, s = math.cos(self.theta), math.sin(self.theta)
        return np.array([[c, -s], [s, c]])

    @property
    def matrix(self) -> Array:
        """Homogeneous matrix, shape (3, 3)."""
        out = np.eye(3)
        out[:2, :2] = self.rotation
        out[:2, 2] = self.u, self.v
        return out

    def apply(self, points: ArrayLike) -> Array:
        """Move points of shape (..., 2)."""
        return np.asarray(np.asarray(points, float) @ self.rotation.T + (self.u, self.v))

    def point(self, u: float, v: float) -> tuple[float, float]:
        """Move one point given by its coordinates: :meth:`apply` without arrays."""
        c, s = math.cos(self.theta), math.sin(self.theta)
        return c * u - s * v + self.u, s * u + c * v + self.v

    def turn(self, vectors: ArrayLike) -> Array:
        """Rotate direction vectors of shape (..., 2)."""
        return np.asarray(np.asarray(vectors, float) @ self.rotation.T)

    def __matmul__(self, other: Pose2D) -> Pose2D:
        """Compose: ``(a @ b).apply(p) == a.apply(b.apply(p))``."""
        u, v = self.apply((other.u, other.v))
        return Pose2D(float(u), float(v), wrap_angle(self.theta + other.theta))

    def inverse(self) -> Pose2D:
        """The motion that undoes this one."""
        c, s = math.cos(self.theta), math.sin(self.theta)
        return Pose2D(-c * self.u - s * self.v, s * self.u - c * self.v, wrap_angle(-self.theta))

    def as_array(self) -> Array:
        """``[u, v, theta]``, shape (3,)."""
        return np.array([self.u, self.v, self.theta])

    @classmethod
    def from_array(cls, values: ArrayLike) -> Pose2D:
        """Make a pose from ``[u, v, theta]``."""
        u, v, theta = (float(x) for x in np.asarray(values, float))
        return cls(u, v, theta)

    @classmethod
    def about(cls, pivot: ArrayLike, u: float = 0.0, v: float = 0.0, theta: float = 0.0) -> Pose2D:
        """Turn by ``theta`` about ``pivot`` (2,), then shift by (u, v)."""
        p = np.asarray(pivot, float)
        shift = p - cls(theta=theta).apply(p) + (u, v)
        return cls(float(shift[0]), float(shift[1]), wrap_angle(theta))


def wrap_angle(angle: float) -> float:
    """Bring an angle into (-pi, pi]."""
    if -math.pi < angle <= math.pi:
        return angle
    return math.pi - (math.pi - angle) % (2.0 * math.pi)


def rigid_inverse(T: ArrayLike) -> Array:
    """Inverse of a rigid 4 x 4 matrix, exact up to rounding of the rotation's transpose."""
    m = np.asarray(T, float)
    out = np.eye(4)
    out[:3, :3] = m[:3, :3].T
    out[:3, 3] = -m[:3, :3].T @ m[:3, 3]
    return out


def transform_points(T: ArrayLike, points: ArrayLike) -> Array:
    """Apply a 4 x 4 matrix to points of shape (..., 3)."""
    m = np.asarray(T, float)
    return np.asarray(np.asarray(points, float) @ m[:3, :3].T + m[:3, 3])
