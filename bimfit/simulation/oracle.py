"""The oracle: about the best that a single slice allows (METHOD, section 1).

It is told which beam hits which face. It is a yardstick for simulated scans, not a method: nothing that is
fitted in earnest knows so much.
"""

from __future__ import annotations

import math

import numpy as np

from bimfit.geometry.joint_section import JointSection
from bimfit.geometry.pose import Array, Pose2D
from bimfit.geometry.profile import Profile, signed_area
from bimfit.geometry.slice import Beams
from bimfit.simulation.accuracy import GapEstimate
from bimfit.simulation.rangefinder import cast

_STEPS = 8


def oracle_gap(
    section: JointSection, truth: tuple[Pose2D, Pose2D], beams: Beams, sigma: float
) -> GapEstimate | None:
    """Fit the face beside each mouth corner to the very beams that hit it.

    A line is fitted to each face by least squares on ranges, and the corner is taken on it midway in bearing
    between the last beam that hits the face and the first that misses it.

    Parameters
    ----------
    section : JointSection
    truth : tuple of 2 Pose2D
        Poses of A and B, used only to tell which beam hits which face.
    beams : Beams
        One sweep, in the order of its bearings.
    sigma : float
        Standard deviation of a range, m; returns more than 6 sigma from their face count as strays.

    Returns
    -------
    GapEstimate or None
        None where a face is hit by fewer than three beams, or to its end.
    """
    moved = [p.moved(pose) for p, pose in zip(section.components, truth, strict=True)]
    seen = cast(moved, beams.origins, beams.directions)
    poses = []
    for k in (0, 1):
        edge = _face(
            moved[k], truth[k].apply(section.gap.mouth[k]), np.where(seen.profile == k, seen.edge, -1)
        )
        if edge is None:
            return None
        on_face = (seen.profile == k) & (seen.edge == edge)
        found = _corner(
            on_face, moved[k].edges[edge], truth[k].apply(section.gap.mouth[k]), beams, seen.ranges, sigma
        )
        if found is None:
            return None
        designed = section.components[k].edges[edge]
        turn = found[1] - _direction(designed)
        poses.append(_carried(section.gap.mouth[k], found[0], turn))
    side_a, side_b = (
        pose.apply(side) for pose, side in zip(poses, (section.gap.side_a, section.gap.side_b), strict=True)
    )
    line, before = side_b[0] - side_a[0], section.gap.mouth[1] - section.gap.mouth[0]
    return GapEstimate(
        section.frame,
        section.frame.to_world(0.5 * (side_a[0] + side_b[0])),
        math.atan2(line[1], line[0]) - math.atan2(before[1], before[0]),
        abs(signed_area(np.concatenate([side_a, side_b[::-1]]))),
    )


def _carried(corner: Array, to: Array, turn: float) -> Pose2D:
    """The motion that turns about a corner (2,) and carries it to another place."""
    return Pose2D.about(corner, float(to[0] - corner[0]), float(to[1] - corner[1]), turn)


def _face(
    profile: Profile, corner: Array, hit: np.ndarray[tuple[int, ...], np.dtype[np.int64]]
) -> int | None:
    """Of the two edges that meet in the corner, the one that more beams hit."""
    ends = np.linalg.norm(profile.edges - corner, axis=2).min(axis=1)
    candidates = np.flatnonzero(ends < 1e-6)
    counts = [int(np.count_nonzero(hit == e)) for e in candidates]
    if not counts or max(counts) < 3:
        return None
    return int(candidates[int(np.argmax(counts))])


def _corner(
    on_face: np.ndarray[tuple[int, ...], np.dtype[np.bool_]],
    edge: Array,
    corner: Array,
    beams: Beams,
    true_ranges: Array,
    sigma: float,
) -> tuple[Array, float] | None:
    """Corner (2,) and direction (rad) of the line through the returns of one face."""
    use = on_face & np.isfinite(beams.ranges) & ~(np.abs(beams.ranges - true_ranges) > 6.0 * sigma + 1e-9)
    if np.count_nonzero(use) < 3:
        return None
    points = beams.origins[use] + beams.directions[use] * beams.ranges[use, None]
    middle, angle = points.mean(axis=0), _direction(edge)
    offset = 0.0
    for _ in range(_STEPS):  # Gauss-Newton on ranges: rho = (n.m + c - n.o) / (n.d)
        normal, along = (
            np.array([math.sin(angle), -math.cos(angle)]),
            np.array([math.cos(angle), math.sin(angle)]),
        )
        lean = beams.directions[use] @ normal
        rho = (normal @ middle + offset - beams.origins[use] @ normal) / lean
        lever = (beams.origins[use] + beams.directions[use] * rho[:, None] - middle) @ along
        step = np.linalg.lstsq(
            np.stack([1.0 / lean, -lever / lean], axis=1), beams.ranges[use] - rho, rcond=None
        )[0]
        offset, angle = offset + step[0], angle + step[1]
    edge_beams = np.flatnonzero(on_face)
    last = edge_beams[int(np.argmin(_away(beams, corner)[edge_beams]))]
    after = _next_miss(on_face, int(last), beams, corner)
    if after is None:
        return None
    ray = beams.directions[last] + beams.directions[after]
    normal = np.array([math.sin(angle), -math.cos(angle)])
    eye = beams.origins[last]
    reach = (normal @ middle + offset - normal @ eye) / (normal @ ray)
    return eye + ray * reach, angle


def _away(beams: Beams, point: Array) -> Array:
    """Angle between each beam and the way to a point, rad."""
    way = point - beams.origins
    cross = way[:, 0] * beams.directions[:, 1] - way[:, 1] * beams.directions[:, 0]
    return np.asarray(np.abs(np.arctan2(cross, np.einsum("ij,ij->i", way, beams.directions))))


def _next_miss(
    on_face: np.ndarray[tuple[int, ...], np.dtype[np.bool_]], last: int, beams: Beams, corner: Array
) -> int | None:
    """The neighbour of the last beam on the face that lies beyond the corner."""
    options = [i for i in (last - 1, last + 1) if 0 <= i < len(on_face) and not on_face[i]]
    away = _away(beams, corner)
    return min(options, key=lambda i: float(away[i])) if options else None


def _direction(edge: Array) -> float:
    d = edge[1] - edge[0]
    return math.atan2(d[1], d[0])
