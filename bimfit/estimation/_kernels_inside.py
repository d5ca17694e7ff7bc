"""What lies inside a gap and beside it, and how surfaces end at its mouth; calls no other file's kernel."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from bimfit._kernels import jit
from bimfit.geometry.pose import Array

Ints = NDArray[np.int64]
Mask = NDArray[np.bool_]


@jit
def within(x: float, y: float, ring: Array) -> bool:
    """Whether a closed ring (k, 2) goes round a point, by the parity of crossings."""
    odd = False
    n = ring.shape[0]
    for i in range(n):
        j = i + 1 if i + 1 < n else 0
        if (ring[i, 1] > y) != (ring[j, 1] > y):
            part = (y - ring[i, 1]) / (ring[j, 1] - ring[i, 1])
            odd ^= x < ring[i, 0] + part * (ring[j, 0] - ring[i, 0])
    return odd


@jit
def distance(x: float, y: float, chain: Array) -> float:
    """Least distance of a point from an open chain (k, 2)."""
    least = np.inf
    for i in range(chain.shape[0] - 1):
        ax, ay = x - chain[i, 0], y - chain[i, 1]
        dx, dy = chain[i + 1, 0] - chain[i, 0], chain[i + 1, 1] - chain[i, 1]
        t = min(max((ax * dx + ay * dy) / max(dx * dx + dy * dy, 1e-300), 0.0), 1.0)
        least = min(least, math.hypot(ax - t * dx, ay - t * dy))
    return least


@jit
def returns_between(
    side_a: Array, side_b: Array, poses: Array, spread: Array, rays: Array, r: Array, start: Ints, eye: Array,
    spacing: float, sweeps: int, sure: float,
) -> tuple[Array, float]:  # fmt: skip
    """Beams that end between the sides of a gap and clear of them, (m, 4): origin and end; and their step, m.

    What lies on a side itself, deep in the gap where a beam grazes it, is the component: so many of its
    deviations, and a beam's step, a return must be away from it.

    Parameters
    ----------
    side_a, side_b : (k, 2)
        The components' sides of the gap as designed, from the mouth on.
    poses, spread : (2, 3) and (2,)
        Where the components are, and how well their places across the gap are known, m.
    spacing, sweeps : float, int
        Usual angle between neighbouring beams, rad, and how many sweeps share the slice.
    """
    a, b = _moved(side_a, poses[0]), _moved(side_b, poses[1])
    index, ends = returns_within(np.concatenate((a, b[::-1])), rays, r, start, eye)
    if index.shape[0] == 0:
        return ends, 0.0
    step = _beam_step(rays, start, eye, float(np.median(r[index])), spacing, sweeps)
    count = 0
    for k in range(ends.shape[0]):
        x, y = ends[k, 2], ends[k, 3]
        if distance(x, y, a) > sure * spread[0] + step and distance(x, y, b) > sure * spread[1] + step:
            ends[count] = ends[k]
            count += 1
    return ends[:count], step


@jit
def _moved(chain: Array, pose: Array) -> Array:
    """A chain (k, 2) at a pose."""
    cos, sin = math.cos(pose[2]), math.sin(pose[2])
    out = np.empty((chain.shape[0], 2))
    for i in range(chain.shape[0]):
        out[i, 0] = cos * chain[i, 0] - sin * chain[i, 1] + pose[0]
        out[i, 1] = sin * chain[i, 0] + cos * chain[i, 1] + pose[1]
    return out


@jit
def _beam_step(rays: Array, start: Ints, eye: Array, reach: float, spacing: float, sweeps: int) -> float:
    """How far apart the beams of one sweep are at a distance, m, however many sweeps interleave."""
    n = rays.shape[1]
    if sweeps <= 1:
        return spacing * reach
    mx, my = rays[1].mean(), rays[2].mean()
    low, high, size = np.inf, -np.inf, max(math.hypot(mx, my), 1e-9)
    for g in range(eye.shape[0]):
        for k in range(start[g], start[g + 1]):
            x, y = eye[g, 0] + reach * rays[1, k], eye[g, 1] + reach * rays[2, k]
            aside = (y * mx - x * my) / size
            low, high = min(low, aside), max(high, aside)
    return max(spacing * reach, float((high - low) / max(n / sweeps - 1.0, 1.0)))


@jit
def returns_within(ring: Array, rays: Array, r: Array, start: Ints, eye: Array) -> tuple[Ints, Array]:
    """Beams that end inside a ring: their indices, and where (m, 4): origin and end."""
    index, ends = np.empty(r.shape[0], np.int64), np.empty((r.shape[0], 4))
    low_x, high_x = ring[:, 0].min(), ring[:, 0].max()
    low_y, high_y = ring[:, 1].min(), ring[:, 1].max()
    count = 0
    for g in range(eye.shape[0]):
        for k in range(start[g], start[g + 1]):
            if not r[k] > 0.0:
                continue
            x, y = eye[g, 0] + rays[1, k] * r[k], eye[g, 1] + rays[2, k] * r[k]
            if low_x <= x <= high_x and low_y <= y <= high_y and within(x, y, ring):
                index[count] = k
                ends[count, 0], ends[count, 1], ends[count, 2], ends[count, 3] = eye[g, 0], eye[g, 1], x, y
                count += 1
    return index[:count], ends[:count]


@jit
def _meets(edges: Array, pose: Array, ox: float, oy: float, dx: float, dy: float) -> float:
    """Range of a beam to the first of the edges (m, 6), moved by ``pose``, that faces it; inf for none."""
    cos, sin = math.cos(pose[2]), math.sin(pose[2])
    # the beam in the component's own coordinates
    qx, qy = ox - pose[0], oy - pose[1]
    px, py = cos * qx + sin * qy, cos * qy - sin * qx
    ex, ey = cos * dx + sin * dy, cos * dy - sin * dx
    least = np.inf
    for e in range(edges.shape[0]):
        ax, ay = edges[e, 0] - px, edges[e, 1] - py
        bx, by = edges[e, 2] - px, edges[e, 3] - py
        level = edges[e, 4] * ax + edges[e, 5] * ay
        if level < 0.0 and (ex * ay - ey * ax) * (ex * by - ey * bx) <= 0.0:
            reach = level / (edges[e, 4] * ex + edges[e, 5] * ey)
            if 0.0 < reach < least:
                least = reach
    return least


@jit
def loose(ends: Array, edges_a: Array, edges_b: Array, poses: Array, beyond: float) -> int:
    """How many returns come from where neither component is.

    Parameters
    ----------
    ends : (n, 4)
        Origin and end of each beam.
    edges_a, edges_b : (m, 6)
        As designed.
    poses : (2, 2, 3)
        For each component the poses that it is tried at.
    beyond : float
        So much further than the return the components must lie, m.
    """
    count = 0
    for k in range(ends.shape[0]):
        ox, oy, x, y = ends[k]
        r = math.hypot(x - ox, y - oy)
        dx, dy = (x - ox) / r, (y - oy) / r
        least = np.inf
        for i in range(2):
            least = min(least, _meets(edges_a, poses[0, i], ox, oy, dx, dy))
            least = min(least, _meets(edges_b, poses[1, i], ox, oy, dx, dy))
        count += int(least > r + beyond)
    return count


@jit
def drop(
    edges: Array,
    side: Array,
    corner: Array,
    z: Array,
    places: Array,
    faces: Ints,
    few: int,
    last: int,
    on_side: float,
    sigma: float,
) -> float:
    """How far an outer surface falls off before the mouth, in standard deviations; 0 with too few returns.

    Parameters
    ----------
    edges : (m, 6)
        Of the designed component.
    side : (k, 2)
        Its side of the gap as designed; edges within ``on_side`` of it are not outer.
    corner : (2,)
        The mouth corner where it is.
    z, places, faces : (n,), (n, 2), (n,)
        Residuals, m, places and edges of the returns on it.
    few, last : int
        Returns that are needed, and how many before the corner are looked at.
    """
    outer = np.empty(edges.shape[0], np.bool_)
    for e in range(edges.shape[0]):
        x, y = 0.5 * (edges[e, 0] + edges[e, 2]), 0.5 * (edges[e, 1] + edges[e, 3])
        outer[e] = distance(x, y, side) > on_side
    near, far = np.full(last, np.inf), np.zeros(last)
    count, total, square = 0, 0.0, 0.0
    for k in range(z.shape[0]):
        if not outer[faces[k]]:
            continue
        count += 1
        total += z[k]
        square += z[k] * z[k]
        away = math.hypot(places[k, 0] - corner[0], places[k, 1] - corner[1])
        i = last
        while i > 0 and away < near[i - 1]:
            i -= 1
        for j in range(last - 1, i, -1):
            near[j], far[j] = near[j - 1], far[j - 1]
        if i < last:
            near[i], far[i] = away, z[k]
    if count < few:
        return 0.0
    best, run = -np.inf, 0.0
    for i in range(min(last, count)):
        run += far[i]
        best = max(best, run / math.sqrt(i + 1.0))
    spread = math.sqrt(max(square / count - (total / count) ** 2, 0.0))
    return best / max(sigma, 0.8 * spread)


@jit
def holes(
    pose: Array,
    rays: Array,
    r: Array,
    start: Ints,
    eye: Array,
    level: float,
    tilt: float,
    few: int,
    low: float,
    high: float,
    beside: float,
) -> Array:
    """Middles (m, 2) of the holes between returns near the mouth's line, in a joint's own coordinates.

    Parameters
    ----------
    pose : (3,)
        Where the joint is.
    level, tilt : float
        A return further than this from the line v = 0 is passed over, m and a metre along it.
    few : int
        More beams than this must lie between two returns.
    low, high : float
        Bounds of the hole's width, m.
    beside : float
        A hole nearer than this is the joint's own, m.
    """
    cos, sin = math.cos(pose[2]), math.sin(pose[2])
    out = np.empty((r.shape[0], 2))
    count = 0
    for g in range(eye.shape[0]):
        last, u0, v0 = -1, 0.0, 0.0
        for k in range(start[g], start[g + 1]):
            if not r[k] > 0.0:
                continue
            x, y = eye[g, 0] + rays[1, k] * r[k] - pose[0], eye[g, 1] + rays[2, k] * r[k] - pose[1]
            u, v = cos * x + sin * y, cos * y - sin * x
            if not abs(v) < level + tilt * abs(u):
                continue
            middle = 0.5 * (u0 + u)
            if last >= 0 and k - last > few and low < abs(u - u0) < high and abs(middle) > beside:
                out[count, 0], out[count, 1] = middle, 0.5 * (v0 + v)
                count += 1
            last, u0, v0 = k, u, v
    return out[:count]
