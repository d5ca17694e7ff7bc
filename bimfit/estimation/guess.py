"""A first guess of a joint's section from one slice, where there is no design: near enough to be fitted."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from bimfit.errors import ScanError
from bimfit.estimation.teaching import closed_profile, surface_line
from bimfit.geometry.frame import SectionFrame
from bimfit.geometry.joint_section import GapOutline, JointSection
from bimfit.geometry.pose import Array
from bimfit.geometry.profile import Profile
from bimfit.geometry.slice import Beams

Mask = NDArray[np.bool_]
_SEARCHED = 0.030
"""The gap's middle is looked for this near to the line that was given, m."""
_OPEN = 3
_JUMP = 0.010
_CORNER = math.radians(20.0)
_SHALLOW = 0.005


def guessed_section(s: float, frame: SectionFrame, beams: Beams, sigma: float, depth: float) -> JointSection:
    """Both components as one slice shows them, each cut where its returns end or jump away.

    Parameters
    ----------
    s : float
        Distance along the joint, m.
    frame : SectionFrame
        Its origin near the gap's mouth, v towards the sensor.
    sigma : float
        Of a range, m.
    depth : float
        How far below the mouth a side of the gap goes that the slice does not show, m.

    Raises
    ------
    ScanError
        Where a component shows too few returns.
    """
    bearing, ranges, across, eye = _seen(beams)
    middle = _middle(eye, bearing, ranges, across)
    steps = np.diff(np.sort(bearing))
    step = float(np.median(steps[steps > 1e-7]))
    profiles: list[Profile] = []
    sides: list[Array] = []
    for name, sign in (("A", -1.0), ("B", 1.0)):
        mine = np.flatnonzero(sign * (across - middle) > 0.0)
        # from outside inwards
        mine = mine[np.argsort(-np.abs(across[mine] - middle), kind="stable")]
        own = _to_the_edge(eye, bearing[mine], ranges[mine], sigma)
        line, open_end = np.zeros((0, 2)), [False, False]
        if np.isfinite(own).any():
            line, open_end = surface_line(bearing[mine], own, step, sigma, least=1)
        if len(line) < 2:
            raise ScanError(
                f"too few returns to guess component {name} from",
                remedy="see that --line runs along the gap, or give more --slices",
            )
        points = eye + line[:, 1:2] * np.column_stack([np.cos(line[:, 0]), np.sin(line[:, 0])])
        if sign * (points[0] - points[-1])[0] > 0.0:
            points, open_end = points[::-1], open_end[::-1]
        corner = _mouth(points)
        seen = float(corner[1] - points[0, 1])
        floor = corner - np.array([0.0, seen if seen > _SHALLOW else depth])
        profile, side = closed_profile(points, np.array([corner, floor]), closed_outside=open_end[1])
        profiles.append(profile)
        sides.append(side)
    return JointSection(s, frame, (profiles[0], profiles[1]), GapOutline(sides[0], sides[1]))


def _seen(beams: Beams) -> tuple[Array, Array, Array, Array]:
    """Bearing and range (NaN: none) from the mean sensor place, where beams cross v = 0, and that place."""
    eye = beams.origins.mean(axis=0)
    down = beams.directions[:, 1] < -0.1
    o, d, r = beams.origins[down], beams.directions[down], beams.ranges[down]
    if len(o) < 3:
        raise ScanError("no beams look into the joint", remedy="turn --out towards the sensor")
    across = o[:, 0] - o[:, 1] * d[:, 0] / d[:, 1]
    level = -o[:, 1] / d[:, 1]
    hit = np.isfinite(r)
    way = o + d * np.where(hit, r, level)[:, None] - eye
    return np.arctan2(way[:, 1], way[:, 0]), np.where(hit, np.hypot(*way.T), np.nan), across, eye


def _middle(eye: Array, bearing: Array, ranges: Array, across: Array) -> float:
    """The middle of the gap: of the longest run of beams that met nothing, else where it is deepest."""
    near = np.flatnonzero(np.abs(across) < _SEARCHED)
    if len(near) < 3:
        raise ScanError("the line does not lie where the scan looks", remedy="check --line and its unit")
    near = near[np.argsort(across[near], kind="stable")]
    v = eye[1] + ranges[near] * np.sin(bearing[near])
    holes = _runs(np.isnan(v))
    if holes and max(holes)[0] >= _OPEN:
        _, begin, end = max(holes)
        return float(0.5 * (across[near[begin]] + across[near[end - 1]]))
    smooth = np.array([np.nanmedian(v[max(0, k - 2) : k + 3]) for k in range(len(v))])
    return float(across[near[int(np.nanargmin(smooth))]])


def _runs(flags: Mask) -> list[tuple[int, int, int]]:
    """Length, begin and end of every unbroken run of True."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]]).astype(int)))
    return [
        (int(end - begin), int(begin), int(end)) for begin, end in zip(edges[::2], edges[1::2], strict=True)
    ]


def _to_the_edge(eye: Array, bearing: Array, ranges: Array, sigma: float) -> Array:
    """Ranges on the way to the gap, NaN from where two returns in a row have jumped away from the surface."""
    out = ranges.copy()
    hit = np.flatnonzero(np.isfinite(ranges))
    points = eye + ranges[hit, None] * np.column_stack([np.cos(bearing[hit]), np.sin(bearing[hit])])
    last: Array | None = None
    away = 0
    for k, point in zip(hit.tolist(), points, strict=True):
        far = last is not None and abs(float(point[1] - last[1])) > max(_JUMP, 6.0 * sigma)
        if not far:
            last, away = point, 0
            continue
        out[k] = np.nan
        away += 1
        if away >= 2:
            out[k:] = np.nan
            break
    return out


def _mouth(points: Array) -> Array:
    """Where the outer face ends, of a line from the gap outwards: the outermost sharp turn."""
    for k in range(len(points) - 2, 0, -1):
        a, b = points[k] - points[k - 1], points[k + 1] - points[k]
        if abs(math.atan2(a[0] * b[1] - a[1] * b[0], float(a @ b))) > _CORNER:
            return np.asarray(points[k])
    return np.asarray(points[0])
