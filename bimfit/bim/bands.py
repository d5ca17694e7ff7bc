"""Middle lines of a strip that is not a rectangle: of an arc, an L, a frame; of the arms of an I."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from bimfit.geometry.pose import Array

_HEAL = 1e-4
_LATTICE = 1e-6
_SIMPLIFY = 2e-4
_END_TURN = np.radians(45.0)
_OFF_LINE = 0.1
_OPPOSITE = 0.9999
_ARM_LENGTH = 1.5
_ARMS_SHARE = 2.0 / 3.0


def middle_line(polygons: list[Array], *, max_depth: float) -> tuple[Array, bool] | None:
    """Middle line of a band made of convex polygons (k, 2).

    The band's two long sides are its rails. Every corner of a rail that is convex faces the nearest point
    of the other rail, and the line runs midway between the two.

    Returns
    -------
    tuple of (ndarray of shape (k, 2), bool) or None
        The line and whether it is closed (then its end repeats its start); None where the region is no band.
    """
    import shapely

    merged = _region(polygons)
    if merged is None:
        return None
    holes = [ring for ring in merged.interiors if shapely.Polygon(ring).area > 0.05 * merged.area]
    if len(holes) > 1:
        return None
    outer = _ring(merged.exterior, counter_clockwise=True)
    if holes:
        line = _between(outer, _ring(holes[0], counter_clockwise=False), closed=True)
    else:
        rails = _rails(outer)
        line = None if rails is None else _between(*rails, closed=False)
    if line is None or len(line) < 2:
        return None
    length = float(np.linalg.norm(np.diff(line, axis=0), axis=1).sum())
    depth = merged.area / length
    if depth > max_depth or length < 2.0 * depth or _branches(merged, line, depth):
        return None
    return line, bool(holes)


@dataclass(frozen=True)
class Arm:
    """A straight arm of a region: its middle line, shape (2, 2), and how deep it is across it, m."""

    line: Array
    depth: float

    @property
    def length(self) -> float:
        """Of the line, m."""
        return float(np.linalg.norm(self.line[1] - self.line[0]))


def straight_arms(polygons: list[Array]) -> list[Arm]:
    """The straight arms of a branched region of convex polygons (k, 2), such as flanges and web of an I.

    An arm lies between two edges that run opposite ways with the region between them, and is longer than
    deep by half or more. Arms that leave more than a third of the region out are not what it is made of:
    then there are none.
    """
    merged = _region(polygons)
    if merged is None or merged.interiors:
        return []
    ring = _ring(merged.exterior, counter_clockwise=True)
    edge = np.roll(ring, -1, axis=0) - ring
    size = np.linalg.norm(edge, axis=1)
    unit = edge / np.maximum(size, 1e-12)[:, None]
    arms: list[Arm] = []
    for i, j in np.argwhere(np.triu(unit @ unit.T < -_OPPOSITE, 1)):
        arm = _arm(ring[i], unit[i], size[i], ring[j], ring[(j + 1) % len(ring)])
        if arm is not None and merged.buffer(_SIMPLIFY).covers(_box_about(arm)):
            arms.append(arm)
    covered = sum(arm.length * arm.depth for arm in arms)
    return arms if covered >= _ARMS_SHARE * merged.area else []


def _arm(start: Array, unit: Array, size: float, far: Array, near: Array) -> Arm | None:
    """What lies between an edge and another one that runs the opposite way, on its left."""
    t = np.array([0.0, size, *sorted(((near - start) @ unit, (far - start) @ unit))])
    low, high = max(t[0], t[2]), min(t[1], t[3])
    normal = np.array([-unit[1], unit[0]])
    depth = float(0.5 * (near + far - 2.0 * start) @ normal)
    if depth <= 0.0 or high - low < _ARM_LENGTH * depth:
        return None
    return Arm(start + 0.5 * depth * normal + np.outer([low, high], unit), depth)


def _box_about(arm: Arm) -> Any:
    import shapely

    return shapely.LineString(arm.line).buffer(0.5 * arm.depth, cap_style="flat")


def _region(polygons: list[Array]) -> Any:
    """The polygons as one, the largest where they are several; None where nothing is left."""
    import shapely

    corners = np.round(np.concatenate(polygons) / _LATTICE) * _LATTICE
    which = np.repeat(np.arange(len(polygons)), [len(p) for p in polygons])
    merged = _union(shapely.polygons(shapely.linearrings(corners, indices=which))).simplify(_SIMPLIFY)
    if merged.geom_type == "MultiPolygon":
        merged = max(merged.geoms, key=lambda g: g.area)
    return merged if merged.geom_type == "Polygon" and not merged.is_empty else None


def _branches(region: Any, line: Array, depth: float) -> bool:
    """Whether a part of the region lies further off the line than the depth."""
    import shapely

    near = shapely.LineString(line).buffer(depth, cap_style="square", join_style="mitre")
    return bool(region.difference(near).area > _OFF_LINE * region.area)


def _union(pieces: Any) -> Any:
    """Union of polygons with corners on a lattice that leaves no slits between them."""
    import shapely

    # the first is much quicker, the second closes what runs off the lattice between two of its points
    for grid in (None, _LATTICE):
        try:
            merged = shapely.union_all(pieces, grid_size=grid)
        except shapely.errors.GEOSException:  # the lattice can tie a region into knots
            continue
        if merged.geom_type == "Polygon":
            return merged
    wide = shapely.union_all(shapely.buffer(pieces, _HEAL, join_style="mitre"))
    return wide.buffer(-_HEAL, join_style="mitre")


def _ring(ring: Any, *, counter_clockwise: bool) -> Array:
    points = np.asarray(ring.coords)[:-1]
    return points if bool(ring.is_ccw) == counter_clockwise else points[::-1]


def _turns(points: Array) -> Array:
    """Turn at each corner of a closed ring, rad, positive where the region on its left is convex."""
    before, after = points - np.roll(points, 1, axis=0), np.roll(points, -1, axis=0) - points
    cross = before[:, 0] * after[:, 1] - before[:, 1] * after[:, 0]
    return np.asarray(np.arctan2(cross, np.einsum("ij,ij->i", before, after)))


def _rails(outer: Array) -> tuple[Array, Array] | None:
    """The two long sides of an open band, both from its start to its end.

    The ends are the two shortest edges between sharp convex corners.
    """
    sharp = _turns(outer) > _END_TURN
    n = len(outer)
    edges = [i for i in range(n) if sharp[i] and sharp[(i + 1) % n]]
    edges.sort(key=lambda i: float(np.linalg.norm(outer[(i + 1) % n] - outer[i])))
    if len(edges) < 2:
        return None
    first, second = edges[0], edges[1]
    if second in ((first + 1) % n, (first - 1) % n):
        return None
    one = [(first + 1 + k) % n for k in range((second - first - 1) % n + 1)]
    other = [(second + 1 + k) % n for k in range((first - second - 1) % n + 1)]
    return outer[one], outer[other][::-1]


def _between(a: Array, b: Array, *, closed: bool) -> Array | None:
    """Midway line between rail a, the region on its left, and rail b.

    Both open rails run from start to end; the closed ones go round opposite ways.
    """
    import shapely

    loop_a = np.vstack([a, a[:1]]) if closed else a
    loop_b = np.vstack([b, b[:1]]) if closed else b
    line_a, line_b = shapely.LineString(loop_a), shapely.LineString(loop_b)
    stations: list[Array] = []
    middles: list[Array] = []
    for rail, other, forward in ((a, line_b, True), (b, line_a, False)):
        before, after = rail - np.roll(rail, 1, axis=0), np.roll(rail, -1, axis=0) - rail
        cross = before[:, 0] * after[:, 1] - before[:, 1] * after[:, 0]
        # rail b of an open band was turned round, so the region lies on its right
        convex = cross > 0.0 if (forward or closed) else cross < 0.0
        if not closed:
            convex[[0, -1]] = False
        here = rail[convex]
        place = shapely.points(here)
        foot = shapely.get_coordinates(
            shapely.line_interpolate_point(other, shapely.line_locate_point(other, place))
        )
        at = place if forward else shapely.points(foot)
        stations.append(np.asarray(shapely.line_locate_point(line_a, at)))
        middles.append(0.5 * (here + foot))
    order = np.argsort(np.concatenate(stations), kind="stable")
    points = list(np.concatenate(middles)[order])
    first, last = (points[:0], points[:1]) if closed else ([0.5 * (a[0] + b[0])], [0.5 * (a[-1] + b[-1])])
    points = [*first, *points, *last]
    line = np.array(points)
    apart = np.append(True, np.linalg.norm(np.diff(line, axis=0), axis=1) > 1e-3)
    if closed:
        apart[-1] = True
    line = line[apart]
    return line if len(line) >= (4 if closed else 2) else None
