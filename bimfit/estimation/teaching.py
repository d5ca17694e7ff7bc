"""A joint's profile taught from slices: the surface that a sensor sees, averaged over stations.

Each slice is carried back by its components' poses, so that it shows the components where they were designed
to be. Returns are then averaged in narrow bearings as seen from the mean sensor position, and straight pieces
are fitted to them. What is not seen (the back, and the sides of a deep gap) is taken from the design.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from bimfit.errors import ScanError
from bimfit.estimation.result import StationEstimate
from bimfit.geometry.joint_section import GapOutline, JointSection
from bimfit.geometry.pose import Array
from bimfit.geometry.profile import Profile
from bimfit.geometry.slice import Slice

_BELOW = 0.010
"""A return that far under the root is something behind the joint, m."""
_NEAR_MOUTH = 0.015
_LEAST = 3
_PIECE = 4
"""Cells, of half a beam each, that a straight piece needs."""
_BEND = 30.0
"""What a corner must explain: it costs three parameters, one of which looks for the best of many places."""
_TURN = math.radians(8.0)


def taught_section(
    section: JointSection, slices: Sequence[Slice], estimates: Sequence[StationEstimate], sigma: float
) -> JointSection:
    """The joint's section with both components shaped as the slices show them.

    Parameters
    ----------
    section : JointSection
        The design, or a first guess; its frame and what cannot be seen are kept.
    slices, estimates : sequence
        With beams; stations without both poses do not count.
    sigma : float
        Of a range, m: what straight pieces may leave unexplained.

    Raises
    ------
    ScanError
        Where too little of a component is seen.
    """
    profiles, sides = [], []
    for which in (0, 1):
        profile, side = _component(section, slices, estimates, which, sigma)
        profiles.append(profile)
        sides.append(side)
    return replace(section, components=(profiles[0], profiles[1]), gap=GapOutline(sides[0], sides[1]))


def _component(
    section: JointSection,
    slices: Sequence[Slice],
    estimates: Sequence[StationEstimate],
    which: int,
    sigma: float,
) -> tuple[Profile, Array]:
    eye, bearings, ranges, step = _gathered(section, slices, estimates, which)
    designed = (section.gap.side_a, section.gap.side_b)[which]
    name = "AB"[which]
    line, open_end = surface_line(bearings, ranges, step, sigma)
    if len(line) < 2:
        raise ScanError(f"too few returns to teach component {name} from", remedy="give more slices")
    points = eye + line[:, 1:2] * np.column_stack([np.cos(line[:, 0]), np.sin(line[:, 0])])
    # from the gap outwards
    if np.hypot(*(points[0] - designed[0])) > np.hypot(*(points[-1] - designed[0])):
        points, open_end = points[::-1], open_end[::-1]
    return closed_profile(points, designed, closed_outside=open_end[1])


def _gathered(
    section: JointSection, slices: Sequence[Slice], estimates: Sequence[StationEstimate], which: int
) -> tuple[Array, Array, Array, float]:
    """Mean sensor place on the component, and bearing and range (NaN: past it) of all beams on its side."""
    a, b = section.gap.mouth
    root = min(float(section.gap.side_a[:, 1].min()), float(section.gap.side_b[:, 1].min()))
    origins, ways, distances, mine, steps = [], [], [], [], []
    for slice_, estimate in zip(slices, estimates, strict=True):
        pose, other = (estimate.components[k].pose for k in (which, 1 - which))
        if pose is None or other is None or slice_.beams is None:
            continue
        back = pose.inverse()
        o, d = back.apply(slice_.beams.origins), back.turn(slice_.beams.directions)
        # half way between the mouth corners as they stand, seen from the component
        ends = (a, b)[which], back.apply(other.apply((b, a)[which]))
        middle = 0.5 * (ends[0] + ends[1])
        t = (middle - o)[:, 1] / np.minimum(d[:, 1], -1e-6)
        side = (o + t[:, None] * d - middle) @ (ends[0] - middle)
        origins.append(o)
        ways.append(d)
        distances.append(slice_.beams.ranges)
        mine.append((side > 0.0) & (d[:, 1] < 0.0))
        angle = np.sort(np.arctan2(d[:, 1], d[:, 0]))
        steps.append(float(np.median(np.diff(angle))) if len(angle) > 2 else math.nan)
    if not origins:
        raise ScanError("no slice gives both components a place", remedy="give other slices")
    o, d, r = np.concatenate(origins), np.concatenate(ways), np.concatenate(distances)
    keep = np.concatenate(mine)
    eye = o.mean(axis=0)
    o, d, r = o[keep], d[keep], r[keep]
    typical = float(np.nanmedian(r))
    points = o + d * np.where(np.isfinite(r), r, typical)[:, None]
    r = np.where(points[:, 1] < root - _BELOW, np.nan, r)
    beyond = np.isfinite(np.where(np.isfinite(r), r, np.nan))
    points = o + d * np.where(beyond, r, typical)[:, None]
    way = points - eye
    bearings = np.arctan2(way[:, 1], way[:, 0])
    return eye, bearings, np.where(beyond, np.hypot(*way.T), np.nan), float(np.nanmedian(steps))


def surface_line(
    bearings: Array, ranges: Array, step: float, sigma: float, *, least: int = _LEAST
) -> tuple[Array, list[bool]]:
    """Straight pieces through the surface seen at these bearings.

    Parameters
    ----------
    bearings, ranges : ndarray, shape (n,)
        Rad and m; NaN where the beam went past the surface.
    step : float
        Between neighbouring beams of one sweep, rad.
    sigma : float
        Of a range, m.
    least : int
        Returns that each cell of half a beam needs; 1 for a single slice.

    Returns
    -------
    line : ndarray, shape (k, 2)
        Bearing and range of the vertices, ascending in bearing.
    open_end : list of 2 bool
        Whether the surface really ends at its first and at its last vertex (beams go past it there).
    """
    order = np.argsort(bearings, kind="stable")
    b, r = bearings[order], ranges[order]
    low, high = _extent(b, np.isfinite(r), step)
    inside = (b >= low) & (b <= high) & np.isfinite(r)
    b_in, r_in = b[inside], r[inside]
    if len(b_in) < max(2 * least, 2 * _PIECE):
        return np.zeros((0, 2)), [False, False]
    width = 0.5 * step
    cell = np.floor((b_in - low) / width).astype(np.int64)
    _, start, count = np.unique(cell, return_index=True, return_counts=True)
    parts = [slice(s, s + c) for s, c in zip(start.tolist(), count.tolist(), strict=True) if c >= least]
    if len(parts) < 2:
        return np.zeros((0, 2)), [False, False]
    middles = np.array([b_in[p].mean() for p in parts])
    levels = np.array([np.median(r_in[p]) for p in parts])
    size = np.array([p.stop - p.start for p in parts])
    # a median of many deviates 1.25 times as much as their mean
    noise = np.where(size > 1, 1.25, 1.0) * sigma / np.sqrt(size)
    xy = levels[:, None] * np.column_stack([np.cos(middles), np.sin(middles)])
    first, last = _grazed(xy, noise), len(xy) - _grazed(xy[::-1], noise[::-1])
    if first:
        low = 0.5 * float(middles[first - 1] + middles[first])
    if last < len(xy):
        high = 0.5 * float(middles[last - 1] + middles[last])
    xy, noise = xy[first:last], noise[first:last]
    corners = _corners(xy, noise)
    vertices = _fitted(xy, noise, corners)
    out = np.column_stack([np.arctan2(vertices[:, 1], vertices[:, 0]), np.hypot(*vertices.T)])
    # the ends lie where beams begin to go past, on the outermost straight pieces
    for at, bearing in ((0, low), (-1, high)):
        p, q = vertices[at], vertices[1 if at == 0 else -2]
        ray = np.array([math.cos(bearing), math.sin(bearing)])
        way = q - p
        cross = float(ray[0] * way[1] - ray[1] * way[0])
        if abs(cross) > 1e-9:
            distance = float(p[0] * way[1] - p[1] * way[0]) / cross
            if abs(distance - out[at, 1]) < 0.02:
                out[at] = bearing, distance
    return out, [bool((b < low).any()), bool((b > high).any())]


def _extent(b: Array, hit: NDArray[np.bool_], step: float) -> tuple[float, float]:
    """The stretch of bearings that best parts hits from beams that went past."""
    gain = np.where(hit, 1.0, -1.0)
    total = np.concatenate([[0.0], np.cumsum(gain)])
    least = np.minimum.accumulate(total)
    end = int(np.argmax(total[1:] - least[:-1])) + 1
    begin = int(np.argmin(total[:end]))
    low = b[0] - 0.5 * step if begin == 0 else 0.5 * (b[begin - 1] + b[begin])
    high = b[-1] + 0.5 * step if end == len(b) else 0.5 * (b[end - 1] + b[end])
    return float(low), float(high)


def _corners(xy: Array, noise: Array) -> list[int]:
    """Where straight pieces meet: a piece is split while two explain it better than noise can."""
    out = [0, len(xy) - 1]
    stack = [(0, len(xy) - 1)]
    while stack:
        i, j = stack.pop()
        if j - i < 2 * _PIECE:
            continue
        piece = slice(i, j + 1)
        at, cost = _split(xy[piece], noise[piece])
        if _misfit(xy[piece], noise[piece]) - cost < _BEND:
            continue
        k = i + at
        out.append(k)
        stack += [(i, k), (k, j)]
    return sorted(set(out))


def _misfit(xy: Array, noise: Array) -> float:
    """Sum of squares, in deviations, that a straight piece leaves."""
    centre, normal = _line(xy, noise)
    return float(np.sum((((xy - centre) @ normal) / noise) ** 2))


def _split(xy: Array, noise: Array) -> tuple[int, float]:
    """The place where two lines, each with its own fit, leave the least unexplained, and how much."""
    best, at = math.inf, len(xy) // 2
    for k in range(_PIECE, len(xy) - _PIECE):
        cost = _misfit(xy[: k + 1], noise[: k + 1]) + _misfit(xy[k:], noise[k:])
        if cost < best:
            best, at = cost, k
    return at, best


def _line(xy: Array, noise: Array, rounds: int = 1) -> tuple[Array, Array]:
    """Centre and unit normal of a line by total least squares; robust (Cauchy) from two rounds on."""
    w = 1.0 / noise**2
    for _ in range(rounds):
        centre = (w[:, None] * xy).sum(axis=0) / w.sum()
        d = xy - centre
        _, axes = np.linalg.eigh((w[:, None] * d).T @ d)
        w = 1.0 / (noise**2 * (1.0 + (d @ axes[:, 0] / (2.0 * noise)) ** 2))
    return centre, axes[:, 0]


def _grazed(xy: Array, noise: Array) -> int:
    """How many cells at the start, at most three, belong to a face that beams only graze."""
    for count in (3, 2, 1):
        rest = slice(count, count + 8)
        if len(xy) < count + 8:
            continue
        centre, normal = _line(xy[rest], noise[rest], 3)
        z = np.abs((xy - centre) @ normal) / noise
        if z[:count].min() > 5.0 and z[count] < 3.0:
            return count
    return 0


def _fitted(xy: Array, noise: Array, corners: list[int]) -> Array:
    """Vertices where neighbouring fitted lines meet; the ends on their own lines."""
    lines = [_line(xy[i : j + 1], noise[i : j + 1], 4) for i, j in pairwise(corners)]
    out = [_foot(xy[0], lines[0])]
    for k, (one, two) in zip(corners[1:-1], pairwise(lines), strict=True):
        cross = float(one[1][0] * two[1][1] - one[1][1] * two[1][0])
        meeting = None
        if abs(cross) > math.sin(_TURN):
            meeting = np.linalg.solve(
                np.array([one[1], two[1]]), np.array([one[1] @ one[0], two[1] @ two[0]])
            )
        near = meeting is not None and float(np.hypot(*(meeting - xy[k]))) < 0.01
        out.append(meeting if near and meeting is not None else _foot(xy[k], one))
    out.append(_foot(xy[-1], lines[-1]))
    return np.array(out)


def _foot(point: Array, line: tuple[Array, Array]) -> Array:
    centre, normal = line
    return np.asarray(point - ((point - centre) @ normal) * normal)


def closed_profile(points: Array, designed: Array, *, closed_outside: bool) -> tuple[Profile, Array]:
    """A profile and its side of the gap from a surface line that runs from the gap outwards.

    Parameters
    ----------
    points : ndarray, shape (k, 2)
        What is seen, from the gap outwards.
    designed : ndarray, shape (m, 2)
        The side of the gap from about its mouth corner on; what is not seen is taken from it.
    closed_outside : bool
        Whether the component really ends where the line does.
    """
    away = np.hypot(*(points - designed[0]).T)
    near = np.flatnonzero(away < _NEAR_MOUTH)
    mouth = int(near[np.argmax(_turns(points)[near])]) if len(near) else int(np.argmin(away))
    if mouth == len(points) - 1:
        mouth = 0
    side = points[mouth::-1]
    rest = designed - designed[0]
    floor = float(designed[:, 1].min())
    below = rest[1:] + side[0]
    hidden = below[below[:, 1] < side[-1, 1] - 0.002] if len(side) == 1 else np.zeros((0, 2))
    if len(side) > 1 and side[-1, 1] > floor + 0.002:
        hidden = np.array([[side[-1, 0], floor]])
    chain = np.concatenate([side, hidden])
    if len(chain) < 2:
        chain = np.concatenate([chain, [chain[-1] - np.array([0.0, 0.002])]])
    bottom = min(float(chain[-1, 1]), float(points[:, 1].min()) - 0.002)
    outer = points[-1]
    ring = np.concatenate([chain[::-1], points[mouth + 1 :], [[outer[0], bottom]]])
    if chain[-1, 1] > bottom + 1e-6:
        ring = np.concatenate([ring, [[chain[-1, 0], bottom]]])
    flags = np.zeros(len(ring), bool)
    at = len(chain) + len(points) - mouth - 2  # the edge down from the outer end of what is seen
    flags[at] = not closed_outside
    profile = Profile.polygon(ring)
    if not np.array_equal(profile.loops[0], ring):
        # reversed: edge k of the ring is edge n - 2 - k of the loop
        flags = np.roll(flags[::-1], -1)
    return replace(profile, artificial=(flags,) if flags.any() else ()), chain


def _turns(points: Array) -> Array:
    """How sharply the line turns at each vertex, rad; an end counts as a right angle."""
    out = np.full(len(points), math.pi / 2.0)
    d = np.diff(points, axis=0)
    cross = d[:-1, 0] * d[1:, 1] - d[:-1, 1] * d[1:, 0]
    out[1:-1] = np.abs(np.arctan2(cross, (d[:-1] * d[1:]).sum(axis=1)))
    return out
