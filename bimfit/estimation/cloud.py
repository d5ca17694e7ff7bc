"""Beams for a plain point cloud (METHOD section 4, 'Point cloud without beams')."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from bimfit.config import SensorConfig
from bimfit.geometry.pose import Array, Pose2D
from bimfit.geometry.slice import Beams, Slice

_ASSUMED_DISTANCE = 1.0
_HOLE = 1.8
_REGULAR = 0.2
_FAN = 0.12
"""So regular are the bearings from where a sensor stood; a few points at random may come to 0.2."""
_MOST = 400
_OWN_HOLES = 2
_WINDOW = 6.0
_CLIP = 3.0
_LOOKS = 12


@dataclass(frozen=True)
class VirtualBeams:
    """Beams made up from points.

    Attributes
    ----------
    beams : Beams
        A beam a point, and missing beams where the points leave a hole.
    spacing_known : bool
        Whether the points are regular enough for a hole to be evidence.
    reason : str
        Why not, in plain words; empty where it is.
    """

    beams: Beams
    spacing_known: bool
    reason: str


def virtual_beams(slice_: Slice, combined: Pose2D) -> VirtualBeams:
    """Look at the points from a virtual sensor and fill holes in bearing with missing beams.

    The sensor stands where the slice says; else where it makes the bearings most regular, if that is
    regular indeed; else straight above the joint. Order and duplicates of the points do not matter.
    """
    centre = combined.apply((0.0, 0.0))
    points = slice_.points
    if slice_.viewpoint is not None:
        eye = np.asarray(slice_.viewpoint, float)
    else:
        found = recovered_viewpoint([points], combined)
        eye = centre + combined.turn((0.0, _ASSUMED_DISTANCE)) if found is None else found
    b, r = _bearings(points, eye, centre)
    step = np.diff(b)
    local, rows = (np.maximum(x, 1e-9) for x in _local_steps(b, step))
    regular = _irregularity(step) < _REGULAR
    # among points at random, half of the length lies in steps of at least 1.7 of their mean
    fill = local if regular else 0.5 * local
    bearings, ranges = [b], [r]
    for i in np.flatnonzero(step > _HOLE * rows):
        n = min(max(round(step[i] / fill[i]) - 1, 1), _MOST)
        bearings.append(b[i] + step[i] * np.arange(1, n + 1) / (n + 1))
        ranges.append(np.full(n, np.nan))
    all_b, all_r = np.concatenate(bearings), np.concatenate(ranges)
    middle = centre - eye
    base = math.atan2(middle[1], middle[0])
    directions = np.stack([np.cos(base + all_b), np.sin(base + all_b)], axis=1)
    reason = (
        "" if regular else "the points are too irregular to tell the edge of a gap from a hole between points"
    )
    return VirtualBeams(
        Beams(np.broadcast_to(eye, directions.shape).copy(), directions, all_r), regular, reason
    )


def irregular_sensor(sensor: SensorConfig) -> SensorConfig:
    """The sensor when points lie at random: an expected point that is absent counts one nat (Poisson)."""
    return replace(sensor, miss_share=(1.0 - sensor.outlier_share) * math.exp(-1.0) / (1.0 + math.exp(-1.0)))


def _bearings(points: Array, eye: Array, centre: Array) -> tuple[Array, Array]:
    """Sorted bearings about the line to the joint, and ranges."""
    d = points - eye
    middle = centre - eye
    b = np.arctan2(middle[0] * d[:, 1] - middle[1] * d[:, 0], d @ middle)
    order = np.argsort(b, kind="stable")
    return b[order], np.linalg.norm(d, axis=1)[order]


def _row_step(step: Array) -> float:
    """The step from row to row: three quarters of the length, a gap's holes apart, lie in no greater ones.

    Several rows that all but coincide leave small steps between them, however many, and those are no rows.
    """
    ordered = np.sort(step)[: max(len(step) - _OWN_HOLES, min(len(step), 1))]
    length = np.cumsum(ordered)
    return float(ordered[np.searchsorted(length, 0.75 * length[-1])]) if len(ordered) else 0.0


def _irregularity(step: Array) -> float:
    """Mean over the length of min(|step / usual - 1|, 1/2): 0 for an even fan, about 0.4 at random.

    Steps count by their length, so that several rows whose points nearly coincide are as regular as one.
    """
    usual = _row_step(step)
    if len(step) < 8 or usual <= 0.0:
        return 0.5
    return float(np.minimum(np.abs(step / usual - 1.0), 0.5) @ step / step.sum())


def recovered_viewpoint(slices: Sequence[Array], combined: Pose2D) -> Array | None:
    """The place above the joint from which the points' bearings are most regular.

    Parameters
    ----------
    slices : sequence of ndarray, shape (n, 2)
        Points of stations that one sensor saw from the same place in the section plane.
    combined : Pose2D
        About where the joint is.

    Returns
    -------
    ndarray, shape (2,), or None
        None where the points are irregular from everywhere.
    """
    if not slices:
        return None
    centre, up = combined.apply((0.0, 0.0)), combined.turn((0.0, 1.0))
    picked = [slices[int(k)] for k in np.unique(np.linspace(0, len(slices) - 1, _LOOKS).round())]

    def place(angle: float, distance: float) -> Array:
        return np.asarray(centre + distance * Pose2D(theta=angle).turn(up))

    def cost(angle: float, distance: float) -> float:
        eye = place(angle, distance)
        return float(np.mean([_irregularity(np.diff(_bearings(p, eye, centre)[0])) for p in picked]))

    angles, distances = np.radians(np.arange(-60.0, 61.0, 10.0)), np.geomspace(0.12, 6.0, 16)
    best = min(((cost(a, d), a, d) for a in angles for d in distances), key=lambda x: x[0])
    width, ratio = math.radians(5.0), 1.14
    for _ in range(5):
        _, a, d = best
        trials = [(a + i * width, d * ratio**j) for i in (-1, 0, 1) for j in (-1, 0, 1)]
        best = min([best, *((cost(*t), *t) for t in trials)], key=lambda x: x[0])
        width, ratio = 0.5 * width, ratio**0.5
    return place(best[1], best[2]) if best[0] < _FAN else None


def _local_steps(b: Array, step: Array) -> tuple[Array, Array]:
    """The usual step about each and the usual step from row to row, each without itself: it may be a hole.

    Means of the steps, weighted by the length that they take and by its square. Over an even fan both are its
    step; where several rows all but coincide, the second is hardly less than the way to the next such group.
    """
    usual = _row_step(step)
    if len(step) < 3 or usual <= 0.0:
        return step, step
    kept = np.minimum(step, _CLIP * usual)
    low = np.searchsorted(b, b[:-1] - _WINDOW * usual)
    high = np.searchsorted(b, b[1:] + _WINDOW * usual, side="right") - 1

    def around(values: Array) -> Array:
        sums = np.concatenate([[0.0], np.cumsum(values)])
        return np.asarray(sums[high] - sums[low] - values)

    length, squares, cubes = around(kept), around(kept**2), around(kept**3)
    enough = length > usual
    return (
        np.where(enough, squares / np.maximum(length, 1e-12), usual),
        np.where(enough, cubes / np.maximum(squares, 1e-24), usual),
    )
