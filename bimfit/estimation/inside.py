"""Returns from inside the gap, where the design leaves it open: a bevel, a bead, a filler or no gap."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from bimfit.estimation.likelihood import BeamSet, edge_rows, predict_ranges
from bimfit.estimation.result import StationEstimate
from bimfit.geometry.joint_section import JointSection
from bimfit.geometry.pose import Array, Pose2D
from bimfit.geometry.status import Status

Mask = NDArray[np.bool_]
_SURE = 2.5
_SAME = 4.0
_FEW, _LAST = 12, 6
_ON_CHAIN = 1e-6
_DROP = (4.2, 1.0, 0.0, -math.inf)
"""Greatest drop at the mouth with no return inside the gap, with one, two and more."""


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
    a, b = (
        pose.apply(side) for pose, side in zip(poses, (section.gap.side_a, section.gap.side_b), strict=True)
    )
    ring = np.concatenate([a, b[::-1]])
    points = beams.points
    low, high = ring.min(axis=0), ring.max(axis=0)
    inside = (beams.r > 0.0) & (points >= low).all(axis=1) & (points <= high).all(axis=1)
    if not inside.any():
        return 0
    inside[inside] = within(points[inside], ring)
    if not inside.any():
        return 0
    chosen = beams.take(inside)
    across = b[0] - a[0]
    across = across / max(float(np.hypot(*across)), 1e-9)
    step = beam_step(beams, float(np.median(chosen.r)), sweeps)
    least = np.full(len(chosen), np.inf)
    for pose, sd, component, sign in zip(poses, spread, section.components, (1.0, -1.0), strict=True):
        closer = sign * (_SURE * sd + 0.5 * step) * across
        for shift in (np.zeros(2), closer):
            there = Pose2D(pose.u + float(shift[0]), pose.v + float(shift[1]), pose.theta)
            least = np.minimum(least, predict_ranges(edge_rows(component, there), chosen)[0])
    loose = least > chosen.r + _SAME * sigma
    for side, sd in zip((a, b), spread, strict=True):
        # what lies on a side itself, deep in the gap where a beam grazes it, is the component
        loose &= distance_to_chain(chosen.points, side) > _SURE * sd + step
    return int(loose.sum())


def beam_step(beams: BeamSet, reach: float, sweeps: int) -> float:
    """How far apart the beams of one sweep are at a distance ``reach``, m, however many sweeps interleave."""
    ends = np.repeat(beams.eye[:, :2], np.diff(beams.start), axis=0) + reach * beams.d.T
    middle = beams.d.mean(axis=1)
    aside = ends @ np.array([-middle[1], middle[0]]) / max(float(np.hypot(*middle)), 1e-9)
    alone = float(np.ptp(aside)) / max(len(beams) / max(sweeps, 1) - 1.0, 1.0)
    return max(beams.spacing * reach, alone) if sweeps > 1 else beams.spacing * reach


def within(points: Array, ring: Array) -> Mask:
    """Which points (n, 2) a closed ring (k, 2) goes round, by the parity of crossings."""
    p, q = ring, np.roll(ring, -1, axis=0)
    x, y = points[:, 0, None], points[:, 1, None]
    spans = (p[:, 1] > y) != (q[:, 1] > y)
    rise = q[:, 1] - p[:, 1]
    at = p[:, 0] + (y - p[:, 1]) * (q[:, 0] - p[:, 0]) / np.where(rise == 0.0, math.inf, rise)
    return np.asarray((spans & (x < at)).sum(axis=1) % 2 == 1)


def drop_at_mouth(section: JointSection, station: StationEstimate, sigma: float) -> float:
    """How far the outer surfaces fall off beside the mouth, in standard deviations, both sides added up.

    For each component, of the last one to six returns before the mouth corner the sum of residuals that is
    largest for its number; a chamfer, a fillet or a bevel where the design has an edge shows here.
    """
    total = 0.0
    for which, c in enumerate(station.components):
        if c.pose is None or len(c.residuals.places) < _FEW:
            continue
        chain = section.gap.side_a if which == 0 else section.gap.side_b
        middles = section.components[which].edges.mean(axis=1)
        outer = (distance_to_chain(middles, chain) > _ON_CHAIN)[c.residuals.faces]
        if int(outer.sum()) < _FEW:
            continue
        z = c.residuals.residuals[outer]
        away = c.residuals.places[outer] - c.pose.apply(chain[0])
        order = np.argsort(np.hypot(*away.T), kind="stable")
        last = z[order[:_LAST]]
        best = float((np.cumsum(last) / np.sqrt(np.arange(1, len(last) + 1))).max())
        total += best / max(sigma, 0.8 * float(z.std()))
    return total


def place_sd(section: JointSection, station: StationEstimate) -> tuple[float, float]:
    """Standard deviation of each component's mouth corner across the gap (u), m; 0 where unknown."""
    out = []
    for corner, c in zip(section.gap.mouth, station.components, strict=True):
        if c.pose is None or c.covariance is None:
            out.append(0.0)
            continue
        row = np.array([1.0, 0.0, -c.pose.turn(corner)[1]])
        out.append(math.sqrt(max(float(row @ c.covariance @ row), 0.0)))
    return out[0], out[1]


def distance_to_chain(points: Array, chain: Array) -> Array:
    """Least distance of each point (n, 2) from an open chain (k, 2)."""
    a, d = chain[:-1], np.diff(chain, axis=0)
    t = ((points[:, None] - a) * d).sum(axis=2) / np.maximum((d * d).sum(axis=1), 1e-300)
    near = a + np.clip(t, 0.0, 1.0)[:, :, None] * d
    return np.asarray(np.linalg.norm(points[:, None] - near, axis=2).min(axis=1))


def with_inside(
    station: StationEstimate, section: JointSection, beams: BeamSet, sigma: float, sweeps: int
) -> StationEstimate:
    """The station, ``rejected`` where something is inside the gap or its edges are not as designed."""
    a, b = (c.pose for c in station.components)
    if a is None or b is None or not station.status.measured:
        return station
    drop = drop_at_mouth(section, station, sigma)
    count = returns_inside(section, beams, (a, b), place_sd(section, station), sigma, sweeps)
    inside = math.ceil(count / max(sweeps, 1))
    most = _DROP[min(inside, len(_DROP) - 1)]
    if drop <= most:
        return station
    reason = (
        "the components' edges at the mouth are not shaped as designed: their surfaces drop off before them"
    )
    if inside:
        reason = f"{count} returns come from inside the gap, where the design has nothing"
    return replace(station, status=Status("rejected", reason))
