"""Where a careful operator would hold the sensor over a joint."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from bimfit.geometry.joint_section import JointSection
from bimfit.geometry.pose import Array

_RAYS = 720
_STRAIGHT = math.radians(3.0)
"""Directions this near to straight out of the mouth are taken as that."""

Ranges = Callable[[Array, Array], Array]


def open_direction(section: JointSection, ranges: Ranges, reach: float) -> Array:
    """Unit direction (2,) from a joint's mouth to where the sensor is best held.

    It halves the open angle as designed: straight out of the mouth (v) of a butt joint or a groove, half way
    between the two faces of a corner, a T or a lap.

    Parameters
    ----------
    section : JointSection
    ranges : callable
        Distances (n,) at which rays, given as origins (n, 2) and directions (n, 2), meet the components.
    reach : float
        How far the view has to be free, m.
    """
    mouth = 0.5 * (section.gap.mouth[0] + section.gap.mouth[1])
    # from straight into the gap once round, so that the open side is one stretch
    angles = -0.5 * math.pi + (np.arange(_RAYS) + 0.5) * (2.0 * math.pi / _RAYS)
    rays = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    free = ranges(np.broadcast_to(mouth, rays.shape), rays) > reach
    middle = _middle_of_nearest_stretch(free)
    angle = 0.5 * math.pi if middle is None else float(np.interp(middle, np.arange(_RAYS), angles))
    if abs(angle - 0.5 * math.pi) < _STRAIGHT:
        return np.array([0.0, 1.0])
    return np.array([math.cos(angle), math.sin(angle)])


def _middle_of_nearest_stretch(free: np.ndarray[tuple[int, ...], np.dtype[np.bool_]]) -> float | None:
    """Middle index of the stretch of free rays that holds, or is nearest to, the middle ray."""
    steps = np.diff(np.concatenate([[0], free.astype(np.int8), [0]]))
    starts, ends = np.flatnonzero(steps == 1), np.flatnonzero(steps == -1) - 1
    if not len(starts):
        return None
    centre = 0.5 * (len(free) - 1)
    off = np.maximum(np.maximum(starts - centre, centre - ends), 0.0)
    nearest = int(np.argmin(off))
    return 0.5 * float(starts[nearest] + ends[nearest])
