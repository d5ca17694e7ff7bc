"""What beams should see of both components, which may speak for which, and what passes between them."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from bimfit._kernels import jit
from bimfit.estimation._kernels_beams import LIMIT, OFF, RANGE, lower, predict, pseudo_angle
from bimfit.geometry.pose import Array

Ints = NDArray[np.int64]
Mask = NDArray[np.bool_]


@jit
def scene(
    edges_a: Array, edges_b: Array, pose_a: Array, pose_b: Array, rays: Array, start: Ints, eye: Array
) -> tuple[Array, Ints]:
    """Ranges (2, n) to A and to B at a pose each, inf where a beam does not meet it, and the edges met."""
    n = start[start.shape[0] - 1]
    rho, face = np.full((2, n), np.inf), np.full((2, n), -1, np.int64)
    cos, sin = math.cos(pose_a[2]), math.sin(pose_a[2])
    predict(edges_a, cos, sin, pose_a[0], pose_a[1], rays, start, eye, rho[0], face[0])
    cos, sin = math.cos(pose_b[2]), math.sin(pose_b[2])
    predict(edges_b, cos, sin, pose_b[0], pose_b[1], rays, start, eye, rho[1], face[1])
    return rho, face


@jit
def look(
    edges_a: Array, edges_b: Array, pose: Array, B: Array, start: Ints, eye: Array, steep: float, far: float
) -> tuple[Array, Ints, Ints, Mask]:
    """What the beams should see with both components at one pose, and which may speak for which.

    Parameters
    ----------
    steep, far : float
        A beam that meets a face at |n.d| less than the one, further than the other from the mouth's middle,
        m, may not speak.

    Returns
    -------
    rho, face : (2, n)
        As from :func:`scene`.
    side : (n,)
        See :func:`~bimfit.estimation.ownership.split_side`.
    use : (3, n)
        Beams that may speak at all, and those for A and for B while the other is known from here alone.
    """
    rho, face = scene(edges_a, edges_b, pose, pose, B, start, eye)
    n = rho.shape[1]
    side, use = np.empty(n, np.int64), np.ones((3, n), np.bool_)
    _split_side(rho, B, start, eye, pose[0], pose[1], side)
    cos, sin = math.cos(pose[2]), math.sin(pose[2])
    for which in range(2):
        edges = edges_a if which == 0 else edges_b
        for g in range(eye.shape[0]):
            for k in range(start[g], start[g + 1]):
                e, r = face[which, k], rho[which, k]
                hidden = rho[1 - which, k] < r
                use[1 + which, k] = side[k] == which and not (e >= 0 and hidden)
                if e < 0:
                    continue
                nx = cos * edges[e, 4] - sin * edges[e, 5]
                ny = sin * edges[e, 4] + cos * edges[e, 5]
                x, y = eye[g, 0] + B[1, k] * r - pose[0], eye[g, 1] + B[2, k] * r - pose[1]
                if abs(nx * B[1, k] + ny * B[2, k]) < steep and math.hypot(x, y) > far:
                    use[0, k] = False
    for k in range(n):
        use[1, k], use[2, k] = use[1, k] and use[0, k], use[2, k] and use[0, k]
    return rho, face, side, use


@jit
def _owner(a: float, b: float) -> int:
    """0 for A, 1 for B, -1 where a beam meets neither."""
    if a == np.inf and b == np.inf:
        return -1
    return 0 if a <= b else 1


@jit
def _split_side(rho: Array, B: Array, start: Ints, eye: Array, cx: float, cy: float, side: Ints) -> None:
    """Give every beam to the component on whose side of the gap's centre (cx, cy) it passes.

    Where that leaves many beams on the wrong side, the cut that separates the components best is taken. 0 is
    A's, 1 is B's, -1 where a group of beams meets neither.
    """
    p = B[0]
    for g in range(eye.shape[0]):
        s, t = start[g], start[g + 1]
        ox, oy, lx, ly = eye[g, 0], eye[g, 1], eye[g, 2], eye[g, 3]
        cut = pseudo_angle(lx * (cx - ox) + ly * (cy - oy), lx * (cy - oy) - ly * (cx - ox))
        a = b = above_a = below_b = 0
        for k in range(s, t):
            side[k] = -1
            own = _owner(rho[0, k], rho[1, k])
            if own == 0:
                a += 1
                above_a += int(p[k] >= cut)
            elif own == 1:
                b += 1
                below_b += int(p[k] < cut)
        if a + b == 0:
            continue
        straight, crossed = above_a + below_b, a - above_a + b - below_b
        swapped, least = crossed < straight, min(straight, crossed)
        if least > max(2.0, 0.02 * (a + b)) and a > 0 and b > 0:
            cut, swapped = _better_cut(rho, p, s, t, a, b, cut, swapped, least)
        for k in range(s, t):
            side[k] = 0 if (p[k] < cut) != swapped else 1


@jit
def _better_cut(
    rho: Array, p: Array, s: int, t: int, a: int, b: int, cut: float, swapped: bool, least: int
) -> tuple[float, bool]:
    """The cut between neighbours of different owners that has fewest beams on the wrong side."""
    best = float(least)
    found, found_swapped = cut, swapped
    before_a = before_b = 0
    last, last_p = -1, 0.0
    for k in range(s, t):
        own = _owner(rho[0, k], rho[1, k])
        if own < 0:
            continue
        if last >= 0 and own != last:
            here = 0.5 * (last_p + p[k])
            straight, crossed = a - before_a + before_b, before_a + b - before_b
            wrong = min(straight, crossed) + 1e-6 * abs(here - cut)
            if wrong < best and min(straight, crossed) < least:
                best, found, found_swapped = wrong, here, crossed < straight
        before_a += int(own == 0)
        before_b += int(own == 1)
        last, last_p = own, p[k]
    return found, found_swapped


@jit
def weigh(
    edges_a: Array, edges_b: Array, poses: Array, mouth: Array, B: Array, start: Ints, eye: Array,
    usable: Mask, depth: float, sigma: float, few: int,
) -> tuple[Array, Ints, int, bool]:  # fmt: skip
    """What the beams should see with a pose (2, 3) each, how many went in between, and whether it is close.

    Parameters
    ----------
    mouth : (2, 2)
        Mouth corners of A and B as designed.
    usable : (n,)
        Beams that may speak.
    depth : float
        A return that much farther than the corners went past them, m.
    sigma : float
        Standard deviation of a range, m.
    few : int
        Fewer open beams than that between A and B leave them close together.

    Returns
    -------
    rho, face : (2, n)
        As from :func:`scene`.
    passed : int
        Beams that went in between the mouth corners.
    close : bool
        Whether one hides part of the other, or hardly a beam passes between them, at the mouth or elsewhere
        as in a groove closed at its root.
    """
    rho, face = scene(edges_a, edges_b, poses[0], poses[1], B, start, eye)
    corners = np.empty((2, 2))
    for i in range(2):
        cos, sin = math.cos(poses[i, 2]), math.sin(poses[i, 2])
        corners[i, 0] = cos * mouth[i, 0] - sin * mouth[i, 1] + poses[i, 0]
        corners[i, 1] = sin * mouth[i, 0] + cos * mouth[i, 1] + poses[i, 1]
    passed = _through(corners, B, start, eye, rho, depth, sigma)
    close = passed < few
    last, at = -1, 0
    for k in range(rho.shape[1]):
        own = _owner(rho[0, k], rho[1, k])
        if own < 0:
            continue
        close = close or (face[0, k] >= 0 and face[1, k] >= 0 and usable[k])
        close = close or (last >= 0 and own != last and k - at - 1 < few)
        last, at = own, k
    return rho, face, passed, close


@jit
def _through(
    corners: Array, B: Array, start: Ints, eye: Array, rho: Array, depth: float, sigma: float
) -> int:
    """How many beams went in between two corners (2, 2): missing, or back from deeper than the mouth.

    A return from a groove's own face went in as well. 0 too where fewer than half of the beams between the
    corners did so: then something is there.
    """
    passed = between = 0
    for g in range(eye.shape[0]):
        s, t = start[g], start[g + 1]
        if t - s < 3:
            continue
        ox, oy, lx, ly = eye[g, 0], eye[g, 1], eye[g, 2], eye[g, 3]
        low, high, level = np.inf, -np.inf, 0.0
        for c in range(2):
            x, y = corners[c, 0] - ox, corners[c, 1] - oy
            bearing = pseudo_angle(lx * x + ly * y, lx * y - ly * x)
            low, high, level = min(low, bearing), max(high, bearing), max(level, math.hypot(x, y))
        step = 0.5 * float(np.median(B[0, s + 1 : t] - B[0, s : t - 1]))
        for k in range(lower(B, s, t, low - step), lower(B, s, t, high + step)):
            r = B[RANGE, k]
            own = abs(r - min(rho[0, k], rho[1, k])) < 4.0 * sigma and r > level + 2.0 * sigma
            passed += int(r < 0.0 or r > level + depth or own)
            between += 1
    return passed if 2 * passed >= between else 0


@jit
def claim(
    which: int, rho: Array, side: Ints, B: Array, eye: Array, start: Ints, usable: Mask, pose: Array,
    level: float, sigma: float, amplitude: float, past: float,
) -> tuple[Mask, Array]:  # fmt: skip
    """Beams that speak for one component, and what they cost, once the other has been estimated.

    Returns that the other explains count for it. Those on its side and above ``level`` may not be claimed
    even by a surface that would explain them equally well, for two bodies do not fill the same place.

    Parameters
    ----------
    which : int
        The component: 0 for A.
    pose : (3,)
        Of the joint: ``level`` is measured along its v, m; inf where the other has no such place.
    sigma, amplitude : float
        Of a return from the other, as in :func:`log_likelihood`.
    past : float
        Log-odds of a beam that went past a face in its way.
    """
    n = rho.shape[1]
    use, out = np.empty(n, np.bool_), B.copy()
    cos, sin = math.cos(pose[2]), math.sin(pose[2])
    v0 = sin * pose[0] - cos * pose[1]
    for g in range(eye.shape[0]):
        for k in range(start[g], start[g + 1]):
            r, other = B[RANGE, k], rho[1 - which, k]
            met, own = other < np.inf, side[k] == which
            q = (r - other) / sigma
            claimed = met and r > 0.0 and abs(r - other) < 4.0 * sigma
            use[k] = usable[k] and (own or claimed or (r < 0.0 and not met))
            out[LIMIT, k] = other + 3.0 * sigma
            if r < 0.0 and met:
                # a beam that the other should have returned speaks for neither when it did not
                out[OFF, k] = 0.0
            elif claimed:
                out[OFF, k] -= math.log1p(amplitude * math.exp(-0.5 * q * q))
                x, y = eye[g, 0] + B[1, k] * r, eye[g, 1] + B[2, k] * r
                if not own and cos * y - sin * x + v0 > level:
                    out[OFF, k] -= abs(past)
    return use, out
