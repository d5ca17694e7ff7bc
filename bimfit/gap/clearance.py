"""What is open between two sides, and what overlaps."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from bimfit.geometry.pose import Array
from bimfit.geometry.profile import signed_area

if TYPE_CHECKING:
    from shapely import LineString, Polygon

#: Sides nearer than this touch, m.
TOUCH = 1e-6


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
    nearest : tuple of two ndarray, shape (2,)
        A point of A's side and one of B's at that distance.
    parts : tuple of ndarray, shape (k, 2)
        Open polygons, counter-clockwise, the largest first.
    """

    simple: bool
    area: float
    overlap_area: float
    narrowest: float
    nearest: tuple[Array, Array]
    parts: tuple[Array, ...]


def measure(side_a: Array, side_b: Array) -> Clearance:
    """Find what is open between two sides.

    Parameters
    ----------
    side_a, side_b : ndarray, shape (k, 2) and (m, 2)
        From mouth to root. A's material lies to the right of its chain and B's to the left.
    """
    import shapely

    ring = np.concatenate([side_a, side_b[::-1]])
    area = signed_area(ring)
    line_a, line_b = (cast("LineString", shapely.linestrings(side)) for side in (side_a, side_b))
    bridge = shapely.get_coordinates(shapely.shortest_line(line_a, line_b))
    du, dv = (bridge[1] - bridge[0]).tolist()
    distance = float(np.hypot(du, dv))
    if area > 0.0 and distance > TOUCH and shapely.is_valid(shapely.polygons(ring)):
        return Clearance(True, area, 0.0, distance, (bridge[0], bridge[1]), (ring,))
    return _measure_crossing(ring, line_a, line_b, distance, (bridge[0], bridge[1]))


def _measure_crossing(
    ring: Array, line_a: LineString, line_b: LineString, distance: float, nearest: tuple[Array, Array]
) -> Clearance:
    """Split the ring where it crosses itself: what it goes round counter-clockwise is open.

    What it goes round clockwise is overlap where both sides bound it; bounded by one side and the mouth or
    root line it is that component's own material beyond the line.
    """
    import shapely

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
                deepest, nearest = depth, pair
    merged: Any = shapely.get_parts(shapely.union_all(open_faces)) if open_faces else []
    solid = [p for p in merged if p.area > TOUCH * TOUCH]
    parts = sorted(
        (shapely.get_coordinates(shapely.orient_polygons(p).exterior)[:-1] for p in solid),
        key=signed_area,
        reverse=True,
    )
    narrowest = -deepest if deepest > TOUCH else distance
    return Clearance(
        False, float(sum(p.area for p in solid)), float(overlap), narrowest, nearest, tuple(parts)
    )


def _bounds(face: Polygon, side: LineString) -> bool:
    """Whether a side is part of a face's boundary (vertices made by noding lie off it by rounding)."""
    length: float = face.exterior.intersection(side.buffer(1e-9, cap_style="flat")).length
    return length > 1e-8


def _deepest(face: Polygon, line_a: LineString, line_b: LineString) -> tuple[float, tuple[Array, Array]]:
    """The vertex of an overlap that lies deepest in the other component."""
    import shapely

    corners: Any = shapely.points(shapely.get_coordinates(face.exterior)[:-1])
    best, pair = 0.0, (np.zeros(2), np.zeros(2))
    for own, other, swap in ((line_a, line_b, False), (line_b, line_a, True)):
        mine = corners[shapely.distance(corners, own) < 1e-9]
        if not len(mine):
            continue
        depths = shapely.distance(mine, other)
        k = int(np.argmax(depths))
        if depths[k] > best:
            best = float(depths[k])
            here, there = shapely.get_coordinates(shapely.shortest_line(mine[k], other))
            pair = (there, here) if swap else (here, there)
    return best, pair


def _winding(point: Array, ring: Array) -> int:
    """How often a ring goes round a point, counter-clockwise positive."""
    p = ring - point
    q = np.roll(p, -1, axis=0)
    left = p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0]
    up = (p[:, 1] <= 0.0) & (q[:, 1] > 0.0) & (left > 0.0)
    down = (p[:, 1] > 0.0) & (q[:, 1] <= 0.0) & (left < 0.0)
    return int(up.sum()) - int(down.sum())
