"""One rigid motion for an element, from what its cross-sections say at all stations of all its joints."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from bimfit.geometry.frame import SectionFrame
from bimfit.geometry.pose import Array, Pose2D

_SLACK = (5e-4, 5e-4, 5e-3)
"""How far an element is from rigid, or a station from its neighbours' errors: added to every covariance."""
_UNKNOWN = (1e-3, 1e-3, 1e-2)
_SCALE = (0.05, 0.05)
"""What the stations know less well than this, m and rad, they do not determine."""


@dataclass(frozen=True)
class Seen:
    """A component's motion at one station.

    Attributes
    ----------
    frame : SectionFrame
    pose : Pose2D
        As built = pose * designed, in ``frame``.
    covariance : ndarray, shape (3, 3), or None
        Of (u, v, theta), m and rad.
    """

    frame: SectionFrame
    pose: Pose2D
    covariance: Array | None = None


@dataclass(frozen=True)
class ElementMotion:
    """A rigid motion in the world.

    Attributes
    ----------
    T_world : ndarray, shape (4, 4)
        As built = T_world * designed, m.
    stations : int
        How many stations it rests on.
    rms : float
        Root mean square distance, in the section planes, between where it puts the frames' origins and where
        the stations saw them, m: how far from rigid the element is.
    undetermined : int
        How many of the six directions of motion no station says anything about; there it stays as designed.
        Along a single straight joint that is one: sliding along it.
    """

    T_world: Array
    stations: int
    rms: float
    undetermined: int


def element_motion(seen: Sequence[Seen]) -> ElementMotion:
    """Fit a rigid motion to in-plane motions, weighted by their covariances.

    Parameters
    ----------
    seen : sequence of Seen
        At least one.

    Returns
    -------
    ElementMotion

    Notes
    -----
    Least squares over the turn (a rotation vector about the stations' centroid) and the shift, with the
    in-plane part of the motion in each section (:meth:`SectionFrame.drop`) as its prediction, in the
    subspace that the stations determine: that of the eigenvectors of their information.

    Raises
    ------
    ValueError
        Without a station.
    """
    from scipy.optimize import least_squares

    if not seen:
        raise ValueError("a motion takes at least one station")
    centre = np.mean([one.frame.origin for one in seen], axis=0)
    # everything about the centroid: nothing is lost at map coordinates
    frames = [SectionFrame(s.frame.origin - centre, s.frame.u, s.frame.v, s.frame.n) for s in seen]
    roots = [_root(one.covariance) for one in seen]
    poses = np.array([one.pose.as_array() for one in seen])
    scale = np.repeat(_SCALE, 3)
    values, vectors = np.linalg.eigh(_information(frames, roots) * np.outer(scale, scale))
    # the directions that the stations determine; along the others the element stays as designed
    basis = scale[:, None] * vectors[:, values > 1.0]

    def off(x: Array) -> Array:
        T = _matrix(basis @ x)
        return np.asarray(np.array([frame.drop(T).as_array() for frame in frames]) - poses)

    def residual(x: Array) -> Array:
        return np.asarray(np.hstack([np.linalg.solve(L, d) for L, d in zip(roots, off(x), strict=True)]))

    x = least_squares(residual, np.zeros(basis.shape[1])).x
    T = _matrix(basis @ x)
    world = T.copy()
    world[:3, 3] += centre - T[:3, :3] @ centre
    return ElementMotion(
        world,
        len(seen),
        float(np.sqrt(np.mean((off(x)[:, :2] ** 2).sum(axis=1)))),
        6 - basis.shape[1],
    )


def _matrix(x: Array) -> Array:
    """Shift (m) and rotation vector (rad), shape (6,), as a motion about the origin, shape (4, 4)."""
    from scipy.spatial.transform import Rotation

    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec(x[3:]).as_matrix()
    T[:3, 3] = x[:3]
    return T


def _root(covariance: Array | None) -> Array:
    """Lower triangular root of a station's covariance, slack included, shape (3, 3)."""
    known = np.diag(np.square(_UNKNOWN)) if covariance is None else np.asarray(covariance, float)
    return np.asarray(np.linalg.cholesky(known + np.diag(np.square(_SLACK))))


def _information(frames: Sequence[SectionFrame], roots: Sequence[Array]) -> Array:
    """What the stations say of shift and rotation at the design, shape (6, 6)."""
    total = np.zeros((6, 6))
    for frame, root in zip(frames, roots, strict=True):
        rows = np.zeros((3, 6))
        for k, axis in enumerate((frame.u, frame.v)):
            rows[k, :3], rows[k, 3:] = axis, np.cross(frame.origin, axis)
        rows[2, 3:] = frame.n
        weighed = np.linalg.solve(root, rows)
        total += weighed.T @ weighed
    return total
