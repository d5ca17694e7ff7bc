"""Beams for a plain point cloud (METHOD section 4, 'Point cloud without beams')."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from bimfit.config import SensorConfig
from bimfit.geometry.joint_section import JointSection
from bimfit.geometry.pose import Array, Pose2D
from bimfit.geometry.slice import Beams, Slice

_ASSUMED_DISTANCE = 1.0
_HOLE = 1.8
_REGULAR = 0.2
_MOST = 400


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


def virtual_beams(
    slice_: Slice, section: JointSection, combined: Pose2D, sensor: SensorConfig
) -> VirtualBeams:
    """Look at the points from a virtual sensor and fill holes in bearing with missing beams.

    The sensor stands where the slice says; else where it makes the bearings most regular, if that is
    regular indeed; else straight above the joint. Order and duplicates of the points do not matter.
    """
    centre = combined.apply((0.0, 0.0))
    points = slice_.points
    if slice_.viewpoint is not None:
        eye = np.asarray(slice_.viewpoint, float)
    else:
        eye = _recovered(points, centre, combined)
    b, r = _bearings(points, eye, centre)
    step = np.diff(b)
    local = np.maximum(_local_median(step), 1e-9)
    regular = _irregularity(step) < _REGULAR
    if not regular:  # a hole is then judged by how many points were to be expected in it
        local = np.maximum(_local_mean(step), 1e-9)
    bearings, ranges = [b], [r]
    for i in np.flatnonzero(step > _HOLE * local):
        n = min(max(round(step[i] / local[i]) - 1, 1), _MOST)
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


def _irregularity(step: Array) -> float:
    """Mean of min(|step / median - 1|, 1/2): 0 for an even fan of beams, about 0.4 for points at random."""
    if len(step) < 8:
        return 0.5
    return float(np.mean(np.minimum(np.abs(step / max(float(np.median(step)), 1e-12) - 1.0), 0.5)))


def _recovered(points: Array, centre: Array, combined: Pose2D) -> Array:
    """The place above the joint from which the bearings are most regular; straight above when none is."""
    up = combined.turn((0.0, 1.0))

    def place(angle: float, distance: float) -> Array:
        return np.asarray(centre + distance * Pose2D(theta=angle).turn(up))

    def cost(angle: float, distance: float) -> float:
        return _irregularity(np.diff(_bearings(points, place(angle, distance), centre)[0]))

    angles, distances = np.radians(np.arange(-60.0, 61.0, 10.0)), np.geomspace(0.12, 6.0, 16)
    best = min(((cost(a, d), a, d) for a in angles for d in distances), key=lambda x: x[0])
    width, ratio = math.radians(5.0), 1.14
    for _ in range(5):
        _, a, d = best
        trials = [(a + i * width, d * ratio**j) for i in (-1, 0, 1) for j in (-1, 0, 1)]
        best = min([best, *((cost(*t), *t) for t in trials)], key=lambda x: x[0])
        width, ratio = 0.5 * width, ratio**0.5
    if best[0] < _REGULAR:
        return place(best[1], best[2])
    return place(0.0, _ASSUMED_DISTANCE)


def _windows(step: Array, half: int = 5) -> list[Array]:
    return [step[max(0, i - half) : i + half + 1] for i in range(len(step))]


def _local_median(step: Array) -> Array:
    """Median of the spacings about each."""
    return np.array([np.median(w) for w in _windows(step)]) if len(step) else step


def _local_mean(step: Array) -> Array:
    """Mean of the spacings about each, the widest left out: it is the hole that is being judged."""
    if len(step) < 3:
        return step
    return np.array([(w.sum() - w.max()) / (len(w) - 1) for w in _windows(step)])
