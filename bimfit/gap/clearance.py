"""What is open between two sides, and what overlaps."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from bimfit.gap.segments import Chain, Point, closing_lines_clear, nearest
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
    area = 0.5 * sum(p[0] * q[1] - p[1] * q[0] for p, q in zip(ring, [*ring[1:], ring[0]], strict=True))
    if (len(side_a) - 1) * (len(side_b) - 1) <= _FEW:
        distance, at_a, at_b = nearest(side_a, side_b)
        simple = distance > TOUCH and area > 0.0 and closing_lines_clear(side_a, side_b)
    else:
        distance, at_a, at_b, simple = _measure_long(side_a, side_b)
        simple = simple and distance > TOUCH and area > 0.0
    outline = np.array(ring)
    if simple:
        return Clearance(True, area, 0.0, distance, (at_a, at_b), (outline,))
    return _measure_crossing(outline, np.array(side_a), np.array(side_b), distance, (at_a, at_b))


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
