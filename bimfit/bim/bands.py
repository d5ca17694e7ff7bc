"""The middle line of a strip that is not a rectangle: an arc, an L, a frame."""

from __future__ import annotations

from typing import Any

import numpy as np

from bimfit.geometry.pose import Array

_HEAL = 1e-4
_LATTICE = 1e-6
_SIMPLIFY = 2e-4
_END_TURN = np.radians(45.0)


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

    corners = np.round(np.concatenate(polygons) / _LATTICE) * _LATTICE
    which = np.repeat(np.arange(len(polygons)), [len(p) for p in polygons])
    merged = _union(shapely.polygons(shapely.linearrings(corners, indices=which))).simplify(_SIMPLIFY)
    if merged.geom_type == "MultiPolygon":
        merged = max(merged.geoms, key=lambda g: g.area)
    if merged.is_empty or merged.geom_type != "Polygon":
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
    if depth > max_depth or length < 2.0 * depth:
        return None
    return line, bool(holes)


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
