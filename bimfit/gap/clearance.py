"""What is open between two sides, and what overlaps."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from bimfit.gap.segments import Chain, Point, closing_lines_clear, crossings, nearest, ring_area, to_chain
from bimfit.geometry.pose import Array
from bimfit.geometry.profile import signed_area

if TYPE_CHECKING:
    from shapely import LineString, Polygon

#: Sides nearer than this touch, m.
TOUCH = 1e-6
#: Up to so many pairs of segments, plain floats are faster than Shapely.
_FEW = 12


@dataclass(frozen=True)
class Clearance:
    """The region between two chains that run from mouth to root, A's and B's.

    Attributes
    ----------
    simple : bool
        The sides clear each other, and the region is one simple polygon.
    area, overlap_area : float
        Open, and where both components would be, m^2.
    narrowest : float
        Least signed distance of the sides: negative is the depth of the deepest point that lies in the other.
    nearest : tuple of two (u, v)
        A point of A's side and one of B's at that distance.
    parts : tuple of ndarray, shape (k, 2)
        Open polygons, counter-clockwise, the largest first.
    """

    simple: bool
    area: float
    overlap_area: float
    narrowest: float
    nearest: tuple[Point, Point]
    parts: tuple[Array, ...]


def measure(side_a: Chain, side_b: Chain) -> Clearance:
    """Find what is open between two sides.

    Parameters
    ----------
    side_a, side_b : sequence of (u, v)
        From mouth to root. A's material lies to the right of its chain and B's to the left.
    """
    ring = [*side_a, *reversed(side_b)]
    area = ring_area(ring)
    if (len(side_a) - 1) * (len(side_b) - 1) <= _FEW:
        distance, at_a, at_b = nearest(side_a, side_b)
        clear = closing_lines_clear(side_a, side_b)
        simple = distance > TOUCH and area > 0.0 and clear
        if clear and not simple:
            found = _measure_once(side_a, side_b, distance)
            if found is not None:
                return found
    else:
        distance, at_a, at_b, simple = _measure_long(side_a, side_b)
        simple = simple and distance > TOUCH and area > 0.0
    outline = np.array(ring)
    if simple:
        return Clearance(True, area, 0.0, distance, (at_a, at_b), (outline,))
    return _measure_crossing(outline, np.array(side_a), np.array(side_b), distance, (at_a, at_b))


def _measure_once(side_a: Chain, side_b: Chain, distance: float) -> Clearance | None:
    """Sides that overlap all along, or cross once, in closed form; None where it is not as plain as that."""
    if distance > TOUCH:
        lobes = [([*side_a, *reversed(side_b)], side_a, side_b)]
    else:
        met = crossings(side_a, side_b)
        if len(met) != 1 or _near_an_end(met[0], side_a, side_b):
            return None
        i, j, x = met[0]
        upper_a, upper_b, lower_a, lower_b = (
            side_a[: i + 1],
            side_b[: j + 1],
            side_a[i + 1 :],
            side_b[j + 1 :],
        )
        lobes = [
            ([*upper_a, x, *reversed(upper_b)], upper_a, upper_b),
            ([x, *lower_a, *reversed(lower_b)], lower_a, lower_b),
        ]
    opened, overlap, deepest, closest = 0.0, 0.0, 0.0, ((0.0, 0.0), (0.0, 0.0))
    parts = []
    for ring, own_a, own_b in lobes:
        size = ring_area(ring)
        if size > TOUCH * TOUCH:
            opened += size
            parts.append((size, np.array(ring)))
        elif size < 0.0:
            overlap -= size
            for own, other, swap in ((own_a, side_b, False), (own_b, side_a, True)):
                for point in own:
                    depth, foot = to_chain(point, other)
                    if depth > deepest:
                        here = (point[0], point[1])
                        deepest, closest = depth, (foot, here) if swap else (here, foot)
    if deepest <= TOUCH:
        return None
    parts.sort(key=lambda part: -part[0])
    return Clearance(False, opened, overlap, -deepest, closest, tuple(ring for _, ring in parts))


def _near_an_end(crossing: tuple[int, int, Point], side_a: Chain, side_b: Chain) -> bool:
    """Whether sides cross so near to a vertex that rounding decides on which side of it."""
    i, j, x = crossing
    ends = (side_a[i], side_a[i + 1], side_b[j], side_b[j + 1])
    return any(math.hypot(x[0] - p[0], x[1] - p[1]) < TOUCH for p in ends)


def _measure_long(side_a: Chain, side_b: Chain) -> tuple[float, Point, Point, bool]:
    import shapely

    ring = shapely.polygons(np.array([*side_a, *reversed(side_b)]))
    bridge = shapely.shortest_line(
        shapely.linestrings(np.array(side_a)), shapely.linestrings(np.array(side_b))
    )
    (au, av), (bu, bv) = shapely.get_coordinates(bridge).tolist()
    return math.hypot(bu - au, bv - av), (au, av), (bu, bv), bool(shapely.is_valid(ring))


def _measure_crossing(
    ring: Array, side_a: Array, side_b: Array, distance: float, closest: tuple[Point, Point]
) -> Clearance:
    """Split the ring where it crosses itself: what it goes round counter-clockwise is open.

    What it goes round clockwise is overlap where both sides bound it; bounded by one side and the mouth or
    root line it is that component's own material beyond the line.
    """
    import shapely

    line_a, line_b = (cast("LineString", shapely.linestrings(side)) for side in (side_a, side_b))
    noded = shapely.node(shapely.linearrings(ring))
    faces = shapely.get_parts(shapely.polygonize([*shapely.get_parts(noded)]))
    open_faces: list[Polygon] = []
    deepest, overlap = 0.0, 0.0
    for face in faces:
        turns = _winding(shapely.get_coordinates(face.representative_point())[0], ring)
        if turns > 0:
            open_faces.append(face)
        elif turns < 0 and _bounds(face, line_a) and _bounds(face, line_b):
            overlap += face.area
            depth, pair = _deepest(face, line_a, line_b)
            if depth > deepest:
                deepest, closest = depth, pair
    merged: Any = shapely.get_parts(shapely.union_all(open_faces)) if open_faces else []
    solid = [p for p in merged if p.area > TOUCH * TOUCH]
    parts = sorted(
        (shapely.get_coordinates(shapely.orient_polygons(p).exterior)[:-1] for p in solid),
        key=signed_area,
        reverse=True,
    )
    narrowest = -deepest if deepest > TOUCH else distance
    return Clearance(
        False, float(sum(p.area for p in solid)), float(overlap), narrowest, closest, tuple(parts)
    )


def _bounds(face: Polygon, side: LineString) -> bool:
    """Whether a side is part of a face's boundary (vertices made by noding lie off it by rounding)."""
    length: float = face.exterior.intersection(side.buffer(1e-9, cap_style="flat")).length
    return length > 1e-8


def _deepest(face: Polygon, line_a: LineString, line_b: LineString) -> tuple[float, tuple[Point, Point]]:
    """The vertex of an overlap that lies deepest in the other component."""
    import shapely

    corners: Any = shapely.points(shapely.get_coordinates(face.exterior)[:-1])
    best, pair = 0.0, ((0.0, 0.0), (0.0, 0.0))
    for own, other, swap in ((line_a, line_b, False), (line_b, line_a, True)):
        mine = corners[shapely.distance(corners, own) < 1e-9]
        if not len(mine):
            continue
        depths = shapely.distance(mine, other)
        k = int(np.argmax(depths))
        if depths[k] > best:
            best = float(depths[k])
            (hu, hv), (tu, tv) = shapely.get_coordinates(shapely.shortest_line(mine[k], other)).tolist()
            pair = ((tu, tv), (hu, hv)) if swap else ((hu, hv), (tu, tv))
    return best, pair


def _winding(point: Array, ring: Array) -> int:
    """How often a ring goes round a point, counter-clockwise positive."""
    p = ring - point
    q = np.roll(p, -1, axis=0)
    left = p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0]
    up = (p[:, 1] <= 0.0) & (q[:, 1] > 0.0) & (left > 0.0)
    down = (p[:, 1] > 0.0) & (q[:, 1] <= 0.0) & (left < 0.0)
    return int(up.sum()) - int(down.sum())
