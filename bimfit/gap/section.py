"""The gap in one cross-section: what lies between the two components as built."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from bimfit.gap.clearance import TOUCH, Clearance, measure
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
        Distance of the two mouth (root) corners, m; negative where B's corner has passed A's.
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
    a, b = pose_a.apply(outline.side_a), pose_b.apply(outline.side_b)
    clearance = measure(a, b)
    (a0u, a0v), (b0u, b0v) = a[0].tolist(), b[0].tolist()
    across = _direction(outline.side_a[0], outline.side_b[0])
    turn = 0.5 * (pose_a.theta + pose_b.theta)
    sigma = None
    if cov_a is not None and cov_b is not None:
        sigma = _propagate(outline, (pose_a, pose_b), (a, b), clearance, _joint(cov_a, cov_b, cov_ab))
    return GapSection(
        s=float(s),
        frame=frame,
        polygon=clearance.parts[0] if clearance.parts else np.zeros((0, 2)),
        origin=np.array([0.5 * (a0u + b0u), 0.5 * (a0v + b0v)]),
        angle=_line_angle(b0u - a0u, b0v - a0v, across, turn),
        width_mouth=_signed(a[0], b[0], across, turn),
        width_root=_signed(a[-1], b[-1], _direction(outline.side_a[-1], outline.side_b[-1]), turn),
        width_narrowest=clearance.narrowest,
        area=clearance.area,
        overlap_area=clearance.overlap_area,
        sigma=sigma,
        side_a=a,
        side_b=b,
        parts=clearance.parts,
    )


def _direction(a: Array, b: Array) -> float:
    """Angle of the designed line from A's corner to B's; along u where they coincide."""
    (au, av), (bu, bv) = a.tolist(), b.tolist()
    return math.atan2(bv - av, bu - au) if math.hypot(bu - au, bv - av) > TOUCH else 0.0


def _line_angle(du: float, dv: float, designed: float, turn: float) -> float:
    """Angle of a line less its design's, modulo pi; the bodies' own turn where it has no length."""
    angle = math.atan2(dv, du) - designed if math.hypot(du, dv) > 1e-12 else turn
    return math.pi / 2.0 - (math.pi / 2.0 - angle) % math.pi


def _signed(a: Array, b: Array, designed: float, turn: float) -> float:
    (au, av), (bu, bv) = a.tolist(), b.tolist()
    along = (bu - au) * math.cos(designed + turn) + (bv - av) * math.sin(designed + turn)
    return math.copysign(math.hypot(bu - au, bv - av), along)


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
    sides: tuple[Array, Array],
    clearance: Clearance,
    cov: Array,
) -> GapSigma | None:
    if not np.isfinite(cov).all():
        return None
    a, b = sides
    shift_a, shift_b = np.array([poses[0].u, poses[0].v]), np.array([poses[1].u, poses[1].v])

    def pull(at_a: Array, at_b: Array, force_a: Array, force_b: Array) -> list[float]:
        # Virtual work: a point of a body moves by (du, dv) + dtheta * perp(point - shift).
        (fau, fav), (fbu, fbv) = force_a.tolist(), force_b.tolist()
        (pau, pav), (pbu, pbv) = (at_a - shift_a).tolist(), (at_b - shift_b).tolist()
        return [fau, fav, pau * fav - pav * fau, fbu, fbv, pbu * fbv - pbv * fbu]

    half_u, half_v = np.array([0.5, 0.0]), np.array([0.0, 0.5])
    rows = [pull(a[0], b[0], half_u, half_u), pull(a[0], b[0], half_v, half_v)]
    for corner in (0, -1):
        d = b[corner] - a[corner]
        size = max(math.hypot(*d.tolist()), 1e-12)
        along = d / size
        rows.append(pull(a[corner], b[corner], -along, along))
        if corner == 0:
            turn = np.array([-along[1], along[0]]) / size
            rows.append(pull(a[0], b[0], -turn, turn))
    if clearance.simple:
        rows.append(_area_row(a - shift_a, b - shift_b, a, b))
        pa, pb = clearance.nearest
        along = (pb - pa) / clearance.narrowest
        rows.append(pull(pa, pb, -along, along))
    J = np.array(rows)
    sd = np.sqrt(np.maximum(np.einsum("ij,jk,ik->i", J, cov, J), 0.0)).tolist()
    if not clearance.simple:
        sd += _cubature(outline, poses, clearance, cov)
    x, y, mouth, angle, root, area, narrowest = sd
    return GapSigma(x, y, min(angle, _ANY_ANGLE), mouth, area, root, narrowest)


def _area_row(lever_a: Array, lever_b: Array, a: Array, b: Array) -> list[float]:
    """Gradient of the shoelace area: each vertex weighs half its neighbours' chord, turned."""
    ring = np.concatenate([a, b[::-1]])
    chord = 0.5 * (np.roll(ring, -1, axis=0) - np.roll(ring, 1, axis=0))
    force = np.stack([chord[:, 1], -chord[:, 0]], axis=1)
    row: list[float] = []
    for lever, f in ((lever_a, force[: len(a)]), (lever_b[::-1], force[len(a) :])):
        row += f.sum(axis=0).tolist()
        row.append(float(lever[:, 0] @ f[:, 1] - lever[:, 1] @ f[:, 0]))
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
            Pose2D.from_array(p[:3]).apply(outline.side_a), Pose2D.from_array(p[3:]).apply(outline.side_b)
        )
        total += np.square([moved.area - clearance.area, moved.narrowest - clearance.narrowest])
    return [math.sqrt(t / 12.0) for t in total.tolist()]
