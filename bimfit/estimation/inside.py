"""Returns from inside the gap, where the design leaves it open: a bevel, a bead, a filler or no gap."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from bimfit.estimation import _kernels_inside as kernels
from bimfit.estimation.cut_edges import Reshape, odds_of_cut_edges
from bimfit.estimation.likelihood import BeamSet
from bimfit.estimation.result import StationEstimate
from bimfit.geometry.joint_section import JointSection
from bimfit.geometry.pose import Array, Pose2D
from bimfit.geometry.status import Status

_SURE = 2.5
_SAME = 4.0
_CERTAIN = 2.5
_FEW, _LAST = 12, 6
_ON_CHAIN = 1e-6
_SUSPICIOUS = 2.2
"""A drop at the mouth that large, of both sides together, is worth the test of cut edges."""
_ODDS = (4.0, 1.0, 0.0, -math.inf)
"""Greatest log-odds of cut edges with no return inside the gap, with one, two and more."""

_DOUBT = 3.0
"""So much the log-odds at a glance may be off."""


def returns_inside(
    section: JointSection,
    beams: BeamSet,
    poses: tuple[Pose2D, Pose2D],
    spread: tuple[float, float],
    sigma: float,
    sweeps: int = 1,
) -> int:
    """How many returns come from between the two sides of the gap on beams that nothing should stop there.

    Parameters
    ----------
    spread : tuple of 2 float
        Standard deviation of each component's place across the gap, m: a beam counts only if it stays open
        when both components are moved towards each other by 2.5 of these and half a beam.
    sigma : float
        Of a range, m.
    sweeps : int
        How many sweeps share the slice.
    """
    sides = _chain(section.gap.side_a), _chain(section.gap.side_b)
    at = np.array([(pose.u, pose.v, pose.theta) for pose in poses])
    ends, step = kernels.returns_between(
        *sides,
        at,
        np.array(spread),
        beams.rays,
        beams.r,
        beams.start,
        beams.eye,
        beams.spacing,
        sweeps,
        _SURE,
    )
    if not len(ends):
        return 0
    a, b = (pose.apply(side) for pose, side in zip(poses, sides, strict=True))
    if _from_behind(a, b, beams, ends, sigma):
        return 0
    across = b[0] - a[0]
    across = across / max(math.hypot(across[0], across[1]), 1e-9)
    closer = _SURE * np.array(spread) + 0.5 * step
    tried = np.repeat(at[:, None], 2, axis=1)
    tried[0, 1, :2] += closer[0] * across
    tried[1, 1, :2] -= closer[1] * across
    rows = (section.components[0].rows, section.components[1].rows)
    return int(kernels.loose(ends, *rows, tried, _SAME * sigma))


def _from_behind(a: Array, b: Array, beams: BeamSet, ends: Array, sigma: float) -> bool:
    """Whether returns from inside are the noise of a surface at or behind the root, by all near it together.

    What stops beams less than four deviations on either side of the root's line is taken for one surface: it
    is inside the gap where its mean is, by 2.5 of the mean's deviations.
    """
    root = b[-1] - a[-1]
    depth = np.array([-root[1], root[0]]) / max(math.hypot(*root), 1e-9)
    depth = depth if float(depth @ (a[0] + b[0] - a[-1] - b[-1])) < 0.0 else -depth
    band = _SAME * sigma
    deeper = np.concatenate([a[-1:], a[-1:] + band * depth, b[-1:] + band * depth, b[-1:]])
    _, beyond = kernels.returns_within(deeper, beams.rays, beams.r, beams.start, beams.eye)
    below = (np.concatenate([ends, beyond])[:, 2:] - a[-1]) @ depth
    if below.min() < -band:
        return False
    return float(below.mean()) > -_CERTAIN * sigma / math.sqrt(len(below))


def _chain(side: Array) -> Array:
    """A gap's side as the kernels take it."""
    return np.ascontiguousarray(side, np.float64)


def drop_at_mouth(section: JointSection, station: StationEstimate, sigma: float) -> float:
    """How far the outer surfaces fall off beside the mouth, in standard deviations, both sides added up.

    For each component, of the last one to six returns before the mouth corner the sum of residuals that is
    largest for its number; a chamfer, a fillet or a bevel where the design has an edge shows here.
    """
    total = 0.0
    for which, c in enumerate(station.components):
        if c.pose is None or len(c.residuals.places) < _FEW:
            continue
        chain, r = (section.gap.side_a, section.gap.side_b)[which], c.residuals
        corner = np.array(c.pose.point(*section.gap.corners[which].tolist()))
        total += kernels.drop(
            section.components[which].rows, _chain(chain), corner, r.residuals, r.places, r.faces, _FEW,
            _LAST, _ON_CHAIN, sigma,
        )  # fmt: skip
    return total


def place_sd(section: JointSection, station: StationEstimate) -> tuple[float, float]:
    """Standard deviation of each component's mouth corner across the gap (u), m; 0 where unknown."""
    out = []
    for (u, v), c in zip(section.gap.corners.tolist(), station.components, strict=True):
        if c.pose is None or c.covariance is None:
            out.append(0.0)
            continue
        lever = math.sin(c.pose.theta) * u + math.cos(c.pose.theta) * v
        (uu, _, turned), _, (_, _, turn) = c.covariance.tolist()
        out.append(math.sqrt(max(uu + lever * (lever * turn - 2.0 * turned), 0.0)))
    return out[0], out[1]


def with_inside(
    station: StationEstimate,
    section: JointSection,
    beams: BeamSet,
    sigma: float,
    sweeps: int,
    glance: Reshape,
    reshape: Reshape,
) -> StationEstimate:
    """The station, ``rejected`` where something is inside the gap or its edges are not as designed.

    Parameters
    ----------
    glance, reshape : callable
        Try other shapes of a component on the slice, in brief and in full: the one only where its edges look
        suspicious, the other only where that leaves them so.
    """
    a, b = (c.pose for c in station.components)
    if a is None or b is None or not station.status.measured:
        return station
    count = returns_inside(section, beams, (a, b), place_sd(section, station), sigma, sweeps)
    inside = math.ceil(count / max(sweeps, 1))
    most = _ODDS[min(inside, len(_ODDS) - 1)]
    if not inside and drop_at_mouth(section, station, sigma) < _SUSPICIOUS:
        return station
    if math.isfinite(most) and (
        odds_of_cut_edges(section, glance) <= most - _DOUBT or odds_of_cut_edges(section, reshape) <= most
    ):
        return station
    reason = (
        "the edges at the mouth are not shaped as designed: a bevel or a chamfer explains the returns better"
    )
    if inside:
        returns = "return comes" if count == 1 else "returns come"
        reason = f"{count} {returns} from inside the gap, where the design has nothing"
    return replace(station, status=Status("rejected", reason))
