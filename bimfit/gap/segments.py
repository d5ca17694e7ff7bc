"""Two short chains against each other, in plain floats: array overhead would cost ten times more."""

from __future__ import annotations

import math
from collections.abc import Sequence

Point = tuple[float, float]
Chain = Sequence[Sequence[float]]


def nearest(side_a: Chain, side_b: Chain) -> tuple[float, Point, Point]:
    """Least distance of two chains, m, and the points of A and of B at that distance; 0 where they cross."""
    best, at_a, at_b = math.inf, (0.0, 0.0), (0.0, 0.0)
    for i in range(len(side_a) - 1):
        p, q = side_a[i], side_a[i + 1]
        for j in range(len(side_b) - 1):
            r, s = side_b[j], side_b[j + 1]
            if crosses(p, q, r, s):
                return 0.0, (p[0], p[1]), (p[0], p[1])
            for point, start, end, of_a in (
                (p, r, s, True),
                (q, r, s, True),
                (r, p, q, False),
                (s, p, q, False),
            ):
                foot = _foot(point, start, end)
                d = (point[0] - foot[0]) ** 2 + (point[1] - foot[1]) ** 2
                if d < best:
                    best = d
                    here = (point[0], point[1])
                    at_a, at_b = (here, foot) if of_a else (foot, here)
    return math.sqrt(best), at_a, at_b


def closing_lines_clear(side_a: Chain, side_b: Chain) -> bool:
    """Whether mouth and root line meet neither the sides, but at their ends, nor each other."""
    mouth, root = (side_a[0], side_b[0]), (side_a[-1], side_b[-1])
    if crosses(*mouth, *root):
        return False
    for side in (side_a, side_b):
        n = len(side) - 1
        for k in range(n):
            if k > 0 and crosses(*mouth, side[k], side[k + 1]):
                return False
            if k < n - 1 and crosses(*root, side[k], side[k + 1]):
                return False
    return True


def crosses(p: Sequence[float], q: Sequence[float], r: Sequence[float], s: Sequence[float]) -> bool:
    """Whether the segments pq and rs have a point in common."""
    du, dv, eu, ev = q[0] - p[0], q[1] - p[1], s[0] - r[0], s[1] - r[1]
    a = du * (r[1] - p[1]) - dv * (r[0] - p[0])
    b = du * (s[1] - p[1]) - dv * (s[0] - p[0])
    if a * b > 0.0:
        return False
    c = eu * (p[1] - r[1]) - ev * (p[0] - r[0])
    d = eu * (q[1] - r[1]) - ev * (q[0] - r[0])
    if c * d > 0.0:
        return False
    if a == b == 0.0:
        # On one line: they meet where their boxes do.
        return max(min(p[0], q[0]), min(r[0], s[0])) <= min(max(p[0], q[0]), max(r[0], s[0])) and max(
            min(p[1], q[1]), min(r[1], s[1])
        ) <= min(max(p[1], q[1]), max(r[1], s[1]))
    return True


def crossings(side_a: Chain, side_b: Chain) -> list[tuple[int, int, Point]]:
    """Where two chains cross: segment of A, segment of B, point."""
    out: list[tuple[int, int, Point]] = []
    for i in range(len(side_a) - 1):
        p, q = side_a[i], side_a[i + 1]
        for j in range(len(side_b) - 1):
            r, s = side_b[j], side_b[j + 1]
            if not crosses(p, q, r, s):
                continue
            du, dv, eu, ev = q[0] - p[0], q[1] - p[1], s[0] - r[0], s[1] - r[1]
            det = du * ev - dv * eu
            t = ((r[0] - p[0]) * ev - (r[1] - p[1]) * eu) / det if det != 0.0 else 0.0
            out.append((i, j, (p[0] + t * du, p[1] + t * dv)))
    return out


def to_chain(point: Sequence[float], side: Chain) -> tuple[float, Point]:
    """Distance of a point from a chain, and the chain's nearest point."""
    feet = [_foot(point, side[k], side[k + 1]) for k in range(len(side) - 1)]
    return min((math.hypot(point[0] - f[0], point[1] - f[1]), f) for f in feet)


def ring_area(ring: Chain) -> float:
    """Shoelace area of a closed ring, counter-clockwise positive."""
    u, v = ring[0]
    total = 0.0
    for k in range(1, len(ring) - 1):
        p, q = ring[k], ring[k + 1]
        total += (p[0] - u) * (q[1] - v) - (p[1] - v) * (q[0] - u)
    return 0.5 * total


def _foot(point: Sequence[float], start: Sequence[float], end: Sequence[float]) -> Point:
    eu, ev = end[0] - start[0], end[1] - start[1]
    size = eu * eu + ev * ev
    if size <= 0.0:
        return start[0], start[1]
    t = ((point[0] - start[0]) * eu + (point[1] - start[1]) * ev) / size
    t = 0.0 if t < 0.0 else 1.0 if t > 1.0 else t
    return start[0] + t * eu, start[1] + t * ev
