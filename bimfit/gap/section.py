"""The gap in one cross-section: what lies between the two components as built."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from bimfit.gap.clearance import TOUCH, Clearance, measure
from bimfit.gap.segments import Point
from bimfit.geometry.frame import SectionFrame
from bimfit.geometry.joint_section import GapOutline
from bimfit.geometry.pose import Array, Pose2D

Contact = Literal["clearance", "touch", "overlap"]

#: Standard deviation of an angle of which nothing is known but that it is a line's: uniform over pi.
_ANY_ANGLE = math.pi / math.sqrt(12.0)


@dataclass(frozen=True)
class GapSigma:
    """Standard deviations of a gap's figures, propagated from the two poses.

    Attributes
    ----------
    x, y : float
        Of the origin's u and v, m.
    angle : float
        Rad; at most that of a line of unknown direction, pi / sqrt(12).
    width : float
        Of the width at the mouth, m.
    area : float
        m^2.
    width_root, width_narrowest : float
        Of the other two widths, m.
    """

    x: float
    y: float
    angle: float
    width: float
    area: float
    width_root: float
    width_narrowest: float


@dataclass(frozen=True)
class GapSection:
    """The as-built gap at one station.

    Attributes
    ----------
    s : float
        Distance along the joint, m.
    frame : SectionFrame
    polygon : ndarray, shape (k, 2)
        Outline of the open gap in section coordinates, counter-clockwise: down A's side from mouth to root
        and up B's. Its largest part where the sides touch; no rows where the gap is closed.
    origin : ndarray, shape (2,)
        Midway between the two mouth corners, section coordinates.
    angle : float
        By how much the line through the mouth corners turned from its design, rad, in (-pi/2, pi/2].
    width_mouth, width_root : float
        Distance of the two mouth (root) corners, m; negative where B's corner has passed A's, across the
        joint (a step between the two counts into the distance, as it does into the angle).
    width_narrowest : float
        Least distance of the two sides, m; 0 where they touch; negative where they overlap: how deep.
    area : float
        Of the open gap, from mouth line to root line, m^2; never negative.
    overlap_area : float
        Where the two components as fitted would fill the same space, m^2.
    sigma : GapSigma or None
        None where a pose has no covariance.
    side_a, side_b : ndarray, shape (k, 2) and (m, 2)
        The two sides as built, mouth first, section coordinates.
    parts : tuple of ndarray
        All open parts, ``polygon`` first.
    """

    s: float
    frame: SectionFrame
    polygon: Array
    origin: Array
    angle: float
    width_mouth: float
    width_root: float
    width_narrowest: float
    area: float
    overlap_area: float
    sigma: GapSigma | None
    side_a: Array
    side_b: Array
    parts: tuple[Array, ...]

    @property
    def polygon_world(self) -> Array:
        """``polygon`` in world coordinates, shape (k, 3)."""
        return self.frame.to_world(self.polygon)

    @property
    def origin_world(self) -> Array:
        """``origin`` in world coordinates, shape (3,)."""
        return self.frame.to_world(self.origin)

    @property
    def closed(self) -> bool:
        """Whether nothing of the gap is open."""
        return not self.parts

    @property
    def contact(self) -> Contact:
        """Whether the components clear each other, touch (within a micrometre) or overlap."""
        if self.width_narrowest > TOUCH:
            return "clearance"
        return "touch" if self.width_narrowest >= -TOUCH else "overlap"


def gap_section(
    s: float,
    frame: SectionFrame,
    outline: GapOutline,
    pose_a: Pose2D,
    pose_b: Pose2D,
    cov_a: ArrayLike | None = None,
    cov_b: ArrayLike | None = None,
    *,
    cov_ab: ArrayLike | None = None,
) -> GapSection:
    """Measure the gap between two components as built (METHOD, section 6; paper, section 5).

    Parameters
    ----------
    s : float
        Distance along the joint, m.
    frame : SectionFrame
    outline : GapOutline
        The designed sides, in ``frame``.
    pose_a, pose_b : Pose2D
        As built = pose * designed, in ``frame``.
    cov_a, cov_b : array_like, shape (3, 3), optional
        Covariances of (u, v, theta).
    cov_ab : array_like, shape (3, 3), optional
        Their cross covariance; zero unless given.

    Returns
    -------
    GapSection

    Notes
    -----
    Origin, angle and the widths at the corners have closed Jacobians, and so have area and narrowest width
    while the gap is open. Where the sides touch or cross these two have kinks, and their deviation is the
    root mean square over the cubature points of the poses' distribution, about the figure given.
    """
    designed_a, designed_b = outline.side_a.tolist(), outline.side_b.tolist()
    a, b = _moved(designed_a, pose_a), _moved(designed_b, pose_b)
    clearance = measure(a, b)
    across = _across(a, b)
    turn = 0.5 * (pose_a.theta + pose_b.theta)
    mouth = _Line(a[0], b[0], across, _direction(designed_a[0], designed_b[0]), turn)
    root = _Line(a[-1], b[-1], across, _direction(designed_a[-1], designed_b[-1]), turn)
    sigma = None
    if cov_a is not None and cov_b is not None:
        cov = _joint(cov_a, cov_b, cov_ab)
        sigma = _propagate(outline, (pose_a, pose_b), (a, b), (mouth, root), clearance, cov)
    return GapSection(
        s=float(s),
        frame=frame,
        polygon=clearance.parts[0] if clearance.parts else np.zeros((0, 2)),
        origin=np.array([0.5 * (a[0][0] + b[0][0]), 0.5 * (a[0][1] + b[0][1])]),
        angle=mouth.angle,
        width_mouth=mouth.width,
        width_root=root.width,
        width_narrowest=clearance.narrowest,
        area=clearance.area,
        overlap_area=clearance.overlap_area,
        sigma=sigma,
        side_a=np.array(a),
        side_b=np.array(b),
        parts=clearance.parts,
    )


def _moved(side: list[list[float]], pose: Pose2D) -> list[Point]:
    c, s, du, dv = math.cos(pose.theta), math.sin(pose.theta), pose.u, pose.v
    return [(c * u - s * v + du, s * u + c * v + dv) for u, v in side]


def _direction(a: list[float], b: list[float]) -> float:
    """Angle of the designed line from A's corner to B's; along u where they coincide."""
    du, dv = b[0] - a[0], b[1] - a[1]
    return math.atan2(dv, du) if math.hypot(du, dv) > TOUCH else 0.0


def _across(a: list[Point], b: list[Point]) -> Point:
    """Unit direction from A's side to B's: to the left of both, walking from mouth to root."""
    du = a[-1][0] - a[0][0] + b[-1][0] - b[0][0]
    dv = a[-1][1] - a[0][1] + b[-1][1] - b[0][1]
    size = math.hypot(du, dv)
    return (-dv / size, du / size) if size > 0.0 else (1.0, 0.0)


class _Line:
    """The line from a corner of A to one of B, against its design."""

    def __init__(self, a: Point, b: Point, across: Point, designed: float, turn: float) -> None:
        du, dv = b[0] - a[0], b[1] - a[1]
        self.length = math.hypot(du, dv)
        sign = 1.0 if du * across[0] + dv * across[1] >= 0.0 else -1.0
        #: Negative where B's corner has passed A's.
        self.width = sign * self.length
        known = self.length > 1e-12
        #: From A's side to B's, whichever corner comes first now.
        self.along = (sign * du / self.length, sign * dv / self.length) if known else across
        angle = math.atan2(dv, du) - designed if known else turn
        # A line's angle is known but for half turns.
        self.angle = math.pi / 2.0 - (math.pi / 2.0 - angle) % math.pi


def _joint(cov_a: ArrayLike, cov_b: ArrayLike, cov_ab: ArrayLike | None) -> Array:
    """The covariance of both poses, shape (6, 6)."""
    out = np.zeros((6, 6))
    out[:3, :3], out[3:, 3:] = cov_a, cov_b
    if cov_ab is not None:
        out[:3, 3:] = cov_ab
        out[3:, :3] = out[:3, 3:].T
    return out


def _propagate(
    outline: GapOutline,
    poses: tuple[Pose2D, Pose2D],
    sides: tuple[list[Point], list[Point]],
    lines: tuple[_Line, _Line],
    clearance: Clearance,
    cov: Array,
) -> GapSigma | None:
    if not np.isfinite(cov).all():
        return None
    (a, b), (mouth, root), (pose_a, pose_b) = sides, lines, poses

    def pull(at_a: Point, at_b: Point, fu: float, fv: float, gu: float, gv: float) -> list[float]:
        # A point of a body moves by (du, dv) + dtheta * perp(point - shift): force times that, for both.
        lever_a = (at_a[0] - pose_a.u) * fv - (at_a[1] - pose_a.v) * fu
        lever_b = (at_b[0] - pose_b.u) * gv - (at_b[1] - pose_b.v) * gu
        return [fu, fv, lever_a, gu, gv, lever_b]

    def apart(at_a: Point, at_b: Point, along: Point) -> list[float]:
        return pull(at_a, at_b, -along[0], -along[1], along[0], along[1])

    across = (-mouth.along[1], mouth.along[0])
    rows = [
        pull(a[0], b[0], 0.5, 0.0, 0.5, 0.0),
        pull(a[0], b[0], 0.0, 0.5, 0.0, 0.5),
        apart(a[0], b[0], mouth.along),
        apart(a[0], b[0], across),
        apart(a[-1], b[-1], root.along),
    ]
    if clearance.simple:
        (au, av), (bu, bv) = clearance.nearest
        size = clearance.narrowest
        rows.append(_area_row(a, b, poses))
        rows.append(apart((au, av), (bu, bv), ((bu - au) / size, (bv - av) / size)))
    J = np.array(rows)
    variance = np.einsum("ij,ij->i", J @ cov, J).tolist()
    sd = [math.sqrt(max(x, 0.0)) for x in variance]
    if not clearance.simple:
        sd += _cubature(outline, poses, clearance, cov)
    x, y, width, sway, width_root, area, narrowest = sd
    angle = min(sway / mouth.length, _ANY_ANGLE) if mouth.length > 0.0 else _ANY_ANGLE
    return GapSigma(x, y, angle, width, area, width_root, narrowest)


def area_gradient(outline: GapOutline, pose_a: Pose2D, pose_b: Pose2D) -> Array:
    """Gradient of the area between the sides by (u, v, theta) of both poses, shape (6,), m^2 a m or rad.

    That of the shoelace area, which is the open one while the sides clear each other.
    """
    a, b = _moved(outline.side_a.tolist(), pose_a), _moved(outline.side_b.tolist(), pose_b)
    return np.array(_area_row(a, b, (pose_a, pose_b)))


def _area_row(a: list[Point], b: list[Point], poses: tuple[Pose2D, Pose2D]) -> list[float]:
    """Gradient of the shoelace area: each vertex weighs half its neighbours' chord, turned."""
    ring = [*a, *reversed(b)]
    n = len(ring)
    row: list[float] = []
    for pose, part in zip(poses, (range(len(a)), range(len(a), n)), strict=True):
        u = v = lever = 0.0
        for k in part:
            before, after = ring[k - 1], ring[(k + 1) % n]
            fu, fv = 0.5 * (after[1] - before[1]), 0.5 * (before[0] - after[0])
            u, v = u + fu, v + fv
            lever += (ring[k][0] - pose.u) * fv - (ring[k][1] - pose.v) * fu
        row += [u, v, lever]
    return row


def _cubature(
    outline: GapOutline, poses: tuple[Pose2D, Pose2D], clearance: Clearance, cov: Array
) -> list[float]:
    """Root mean square of area's and narrowest width's change over the 12 cubature points of 6 dimensions."""
    values, vectors = np.linalg.eigh(cov)
    steps = vectors * np.sqrt(6.0 * np.maximum(values, 0.0))
    at = np.concatenate([poses[0].as_array(), poses[1].as_array()])
    total = np.zeros(2)
    for step in np.concatenate([steps.T, -steps.T]):
        p = at + step
        moved = measure(
            _moved(outline.side_a.tolist(), Pose2D.from_array(p[:3])),
            _moved(outline.side_b.tolist(), Pose2D.from_array(p[3:])),
        )
        total += np.square([moved.area - clearance.area, moved.narrowest - clearance.narrowest])
    return [math.sqrt(t / 12.0) for t in total.tolist()]
