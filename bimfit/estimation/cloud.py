"""Beams for a plain point cloud (METHOD section 4, 'Point cloud without beams')."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from bimfit.config import SensorConfig
from bimfit.geometry.joint_section import JointSection
from bimfit.geometry.pose import Array, Pose2D
from bimfit.geometry.slice import Beams, Slice

_ASSUMED_DISTANCE = 1.0
_HOLE = 1.8


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
    """Look at the points from a virtual sensor and fill holes in bearing with missing beams."""
    eye = (
        np.asarray(slice_.viewpoint, float)
        if slice_.viewpoint is not None
        else combined.apply((0.0, _ASSUMED_DISTANCE))
    )
    d = slice_.points - eye
    r = np.linalg.norm(d, axis=1)
    middle = combined.apply((0.0, 0.0)) - eye
    b = np.arctan2(middle[0] * d[:, 1] - middle[1] * d[:, 0], d @ middle)
    order = np.argsort(b)
    b, r = b[order], r[order]
    step = np.diff(b)
    local = _local_median(step)
    bearings, ranges = [b], [r]
    for i in np.flatnonzero(step > _HOLE * local):
        n = max(round(step[i] / local[i]) - 1, 1)
        bearings.append(b[i] + step[i] * np.arange(1, n + 1) / (n + 1))
        ranges.append(np.full(n, np.nan))
    all_b, all_r = np.concatenate(bearings), np.concatenate(ranges)
    base = math.atan2(middle[1], middle[0])
    directions = np.stack([np.cos(base + all_b), np.sin(base + all_b)], axis=1)
    regular = float(np.median(np.minimum(np.abs(step / local - 1.0), 1.0))) < 0.35
    reason = (
        ""
        if regular
        else "the points' spacing is too irregular to tell a gap from a hole: not fixed across the gap (u)"
    )
    return VirtualBeams(
        Beams(np.broadcast_to(eye, directions.shape).copy(), directions, all_r), regular, reason
    )


def _local_median(step: Array, half: int = 5) -> Array:
    """Median of the spacings in a window about each."""
    n = len(step)
    return np.array([np.median(step[max(0, i - half) : i + half + 1]) for i in range(n)]) if n else step
