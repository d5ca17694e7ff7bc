"""Log-likelihood of one component, its normal equations, and the slide of both (METHOD, section 4).

Beams as in :mod:`bimfit.estimation._kernels_beams`.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from bimfit._kernels import jit, jit_inner, jit_inner_sums, jit_sums
from bimfit.estimation._kernels_beams import (
    DEEP,
    INVERSE,
    LIMIT,
    OFF,
    PAD,
    RANGE,
    STEEP,
    TOP,
    predict,
    pseudo_angle,
)
from bimfit.geometry.pose import Array

Ints = NDArray[np.int64]


@jit_inner_sums
def _decay(x: float) -> float:
    """exp(-x) for x from 0 to 32 without branches, tables or divisions, to 2e-7."""
    y = -0.03125 * x
    e = 1.0 + y * (1.0 + y * (0.5 + y * (0.16666666666666666 + y * 0.041666666666666664)))
    e *= e  # to the 32nd power
    e *= e
    e *= e
    e *= e
    e *= e
    return e


@jit_inner_sums
def _gain(t: float) -> float:
    """log(1 + exp(t)) to 1e-5."""
    e = _decay(min(abs(t), 32.0))
    # Abramowitz and Stegun 4.1.43
    log = e * (0.99949556 + e * (-0.49190896 + e * (0.28947478 + e * (-0.13606275 + e * 0.03215845))))
    gain: float = max(t, 0.0) + log
    return gain


@jit_inner_sums
def _weight(t: float) -> float:
    """exp(t) / (1 + exp(t)), the derivative of the gain."""
    e = _decay(min(abs(t), 32.0))
    weight: float = (1.0 if t > 0.0 else e) / (1.0 + e)
    return weight


@jit_sums
def _total(B: Array, inverse: float, top: float, margin: float, rho: Array, face: Ints) -> float:
    """Sum over covered beams of the residual's term and the cost of covering, all with one sigma."""
    total = 0.0
    for k in range(np.uint64(face.shape[0])):
        z = B[RANGE, k] - rho[k]
        q = z * inverse
        value = _gain(top - 0.5 * q * q) + B[OFF, k] + (B[DEEP, k] if z > margin else 0.0)
        total += value if face[k] >= 0 else 0.0
    return total


@jit
def scratch(edges: Array, eye: Array) -> tuple[Array, Ints]:
    """Work space of the likelihood of one component under some beams: lines and runs, see :func:`front`."""
    m, groups = edges.shape[0], eye.shape[0]
    return np.empty((m, 3)), np.zeros((4 * m + 1 + groups * m, 3), np.int64)


@jit_inner
def _from(B: Array, lo: int, hi: int, value: float, hint: int) -> int:
    """What :func:`lower` finds, walking from a guess: the last pose's edge was seldom far off."""
    k = min(max(hint, lo), hi)
    while k < hi and B[0, k] < value:
        k += 1
    while k > lo and B[0, k - 1] >= value:
        k -= 1
    return k


@jit_inner
def _insert(B: Array, lines: Array, runs: Ints, count: int, lo: int, hi: int, e: int) -> int:
    """Add edge ``e``, met by the beams from ``lo`` to ``hi``, to stretches in order; how many there are then.

    Edges of a profile do not cross: which of two comes first on one beam does so on all that meet both.
    """
    i = 0
    while lo < hi:
        while i < count and runs[i, 1] <= lo:
            i += 1
        if i == count or runs[i, 0] > lo:  # free beams
            stop = hi if i == count else min(hi, runs[i, 0])
            count = _open(runs, count, i)
            runs[i, 0], runs[i, 1], runs[i, 2] = lo, stop, e
            lo = stop
            continue
        stop, k, f = min(hi, runs[i, 1]), (lo + min(hi, runs[i, 1])) >> 1, runs[i, 2]
        mine = lines[e, 2] / (lines[e, 0] * B[1, k] + lines[e, 1] * B[2, k])
        held = lines[f, 2] / (lines[f, 0] * B[1, k] + lines[f, 1] * B[2, k])
        if 0.0 < mine < held:
            if runs[i, 0] < lo:
                count = _open(runs, count, i)
                runs[i, 1] = lo
                i += 1
            if stop < runs[i, 1]:
                count = _open(runs, count, i)
                runs[i + 1, 0] = stop
            runs[i, 0], runs[i, 1], runs[i, 2] = lo, stop, e
        lo = stop
    return count


@jit_inner
def _open(runs: Ints, count: int, i: int) -> int:
    """Make room for a row before row ``i``, which stays there as a copy."""
    for k in range(count, i, -1):
        for j in range(3):
            runs[k, j] = runs[k - 1, j]
    return count + 1


@jit_inner
def front(
    edges: Array, cos: float, sin: float, tx: float, ty: float, B: Array, start: Ints, eye: Array, g: int,
    lines: Array, runs: Ints,
) -> int:  # fmt: skip
    """Stretches of group ``g``'s beams that meet one edge first: rows (first, end, edge) of the runs.

    The lines become normal n and n.(a - o) of every edge that faces the sensor at o, moved as in
    :func:`predict`: a beam along d meets it at n.(a - o) / n.d. The last rows of the runs, one a group and
    edge, keep where the last pose's edges began and ended.
    """
    kept = runs.shape[0] - (g + 1) * edges.shape[0]
    ox, oy, lx, ly = eye[g, 0], eye[g, 1], eye[g, 2], eye[g, 3]
    s, t = start[g], start[g + 1]
    count = 0
    for e in range(edges.shape[0]):
        nx = cos * edges[e, 4] - sin * edges[e, 5]
        ny = sin * edges[e, 4] + cos * edges[e, 5]
        ax = cos * edges[e, 0] - sin * edges[e, 1] + tx - ox
        ay = sin * edges[e, 0] + cos * edges[e, 1] + ty - oy
        c = nx * ax + ny * ay
        if c >= 0.0:
            continue
        bx = cos * edges[e, 2] - sin * edges[e, 3] + tx - ox
        by = sin * edges[e, 2] + cos * edges[e, 3] + ty - oy
        lines[e, 0], lines[e, 1], lines[e, 2] = nx, ny, c
        high = pseudo_angle(lx * ax + ly * ay, lx * ay - ly * ax)
        low = pseudo_angle(lx * bx + ly * by, lx * by - ly * bx)
        i, j = _from(B, s, t, low, runs[kept + e, 0]), _from(B, s, t, high, runs[kept + e, 1])
        runs[kept + e, 0], runs[kept + e, 1] = i, j
        if low <= high:
            count = _insert(B, lines, runs, count, i, j, e)
        else:  # the edge lies across the cut behind the sensor
            count = _insert(B, lines, runs, count, i, t, e)
            count = _insert(B, lines, runs, count, s, j, e)
    return count


@jit_inner
def hidden(B: Array, k: int, nx: float, ny: float, c: float) -> bool:
    """Whether something else is in the way of beam ``k`` to a face."""
    return not c / (nx * B[1, k] + ny * B[2, k]) < B[LIMIT, k]


@jit_inner_sums
def _sum(B: Array, first: int, end: int, nx: float, ny: float, c: float, margin: float) -> float:
    """Sum over a stretch of beams on one face of the residual's term and the cost of covering."""
    total = 0.0
    # unsigned: an index that could be negative would keep LLVM from vectorising; whole vectors: no rest
    for i in range(np.uint64((end - first + PAD - 1) // PAD * PAD)):
        k = np.uint64(first + i)
        near = c / (nx * B[1, k] + ny * B[2, k])
        z = B[RANGE, k] - near
        q = z * B[INVERSE, k]
        value = _gain(B[TOP, k] - 0.5 * q * q) + B[OFF, k] + (B[DEEP, k] if z > margin else 0.0)
        total += value if (near < B[LIMIT, k]) & (near > 0.0) & (i < np.uint64(end - first)) else 0.0
    return total


@jit
def _steep_sum(
    B: Array, first: int, end: int, nx: float, ny: float, c: float, margin: float, bearing: float
) -> float:
    """The same on a face met nearly edge-on."""
    total = 0.0
    for k in range(first, end):
        near = c / (nx * B[1, k] + ny * B[2, k])
        if not 0.0 < near < B[LIMIT, k]:
            continue
        z = B[RANGE, k] - near
        q, lean = z * B[INVERSE, k], near / c
        grow = 1.0 + (bearing * B[INVERSE, k] * near) ** 2 * (lean * lean - 1.0)
        total += _gain(B[TOP, k] - 0.5 * (q * q / grow + math.log(grow))) + B[OFF, k]
        total += B[DEEP, k] if z > margin else 0.0
    return total


@jit_inner
def log_likelihood(
    edges: Array, pose: Array, B: Array, start: Ints, eye: Array, margin: float, bearing: float,
    lines: Array, runs: Ints,
) -> float:  # fmt: skip
    """Log-likelihood at a pose (tx, ty, theta), as a difference from 'every beam misses'.

    A return at r adds log(1 + A exp(-d^2 / 2)), d = (r - rho) / sigma (METHOD, section 4, step 4). Where a
    face is nearly edge-on (|n.d| < STEEP) a range depends on the bearing more than on anything: sigma^2
    grows there by (bearing's sd * rho tan i)^2. ``lines``, ``runs``:
    from :func:`scratch`.
    """
    cos, sin = math.cos(pose[2]), math.sin(pose[2])
    total = 0.0
    for g in range(eye.shape[0]):
        for i in range(front(edges, cos, sin, pose[0], pose[1], B, start, eye, g, lines, runs)):
            first, end, e = runs[i, 0], runs[i, 1], runs[i, 2]
            nx, ny, c = lines[e, 0], lines[e, 1], lines[e, 2]
            while first < end and hidden(B, first, nx, ny, c):
                first += 1
            if first == end:
                continue
            least = max(nx * B[1, first] + ny * B[2, first], nx * B[1, end - 1] + ny * B[2, end - 1])
            if bearing > 0.0 and least > -STEEP:
                total += _steep_sum(B, first, end, nx, ny, c, margin, bearing)
            else:
                total += _sum(B, first, end, nx, ny, c, margin)
    return total


@jit_inner_sums
def _stretch(
    B: Array, first: int, end: int, nx: float, ny: float, c: float, lever: float, slope: float, soft: float,
    drop: float, bearing: float,
) -> tuple[float, float, float, float, float]:  # fmt: skip
    """Sums of w f^2, w f^2 arm, w f^2 arm^2, w f z and w f z arm over a stretch of beams on one face."""
    s0 = s1 = s2 = t0 = t1 = 0.0
    over = 1.0 / c
    for j in range(np.uint64((end - first + PAD - 1) // PAD * PAD)):
        k = np.uint64(first + j)
        near = c / (nx * B[1, k] + ny * B[2, k])
        seen = (near < B[LIMIT, k]) & (near > 0.0) & (j < np.uint64(end - first))
        near = near if seen else 0.0
        i = B[INVERSE, k] * soft if seen else 0.0
        z = (B[RANGE, k] - near) * i
        top = B[TOP, k] - drop
        if bearing > 0.0:  # the same for the whole stretch
            lean = near * over
            grow = 1.0 + (bearing * B[INVERSE, k] * near) ** 2 * (lean * lean - 1.0)
            w = _weight(top - 0.5 * (z * z / grow + math.log(grow))) / grow
        else:
            w = _weight(top - 0.5 * z * z)
        # rho / c = 1 / (n.d)
        f = near * i * over
        arm = lever + slope * near * (ny * B[1, k] - nx * B[2, k])
        wf, wz = w * f * f, w * z * f
        s0 += wf
        s1 += wf * arm
        s2 += wf * arm * arm
        t0 += wz
        t1 += wz * arm
    return s0, s1, s2, t0, t1


@jit_inner
def _square_on(B: Array, first: int, end: int, nx: float, ny: float) -> tuple[int, int]:
    """A stretch of beams on one face without those at its ends that graze it; |n.d| has one maximum."""
    while first < end and nx * B[1, first] + ny * B[2, first] > -STEEP:
        first += 1
    while first < end and nx * B[1, end - 1] + ny * B[2, end - 1] > -STEEP:
        end -= 1
    return first, end


@jit_inner
def normal_equations(
    edges: Array, pose: Array, rs: float, B: Array, start: Ints, eye: Array, soften: float, grazes: int,
    bearing: float, lines: Array, runs: Ints, H: Array, g: Array,
) -> None:  # fmt: skip
    """Gauss-Newton system of the ranges in (tx, ty, theta * rs), rotation about the origin of ``edges``.

    Weights a / (1 + a), a = A / m exp(-d^2 / (2 m^2)), m = ``soften`` times sigma. Beams that meet a face
    nearly edge-on count where ``grazes`` or more are on it: the Jacobian of a few claims more than they say.
    ``lines``, ``runs``: from :func:`scratch`.
    """
    cos, sin = math.cos(pose[2]), math.sin(pose[2])
    H[:] = 0.0
    g[:] = 0.0
    soft, drop, slope = 1.0 / soften, math.log(soften), 1.0 / rs
    for q in range(eye.shape[0]):
        ox, oy = eye[q, 0] - pose[0], eye[q, 1] - pose[1]
        for i in range(front(edges, cos, sin, pose[0], pose[1], B, start, eye, q, lines, runs)):
            first, end, e = runs[i, 0], runs[i, 1], runs[i, 2]
            nx, ny, c = lines[e, 0], lines[e, 1], lines[e, 2]
            while first < end and hidden(B, first, nx, ny, c):
                first += 1
            if first == end:
                continue
            square, last = _square_on(B, first, end, nx, ny)
            steep = square > first or last < end
            if steep and end - first < grazes:
                first, end, steep = square, last, False
                if first == end:
                    continue
            # n.(a - o) is common to a stretch on one face, and so is the Jacobian's direction
            s0, s1, s2, t0, t1 = _stretch(
                B, first, end, nx, ny, c, (ny * ox - nx * oy) / rs, slope, soft, drop,
                bearing if steep else 0.0,
            )  # fmt: skip
            H[0, 0] += nx * nx * s0
            H[0, 1] += nx * ny * s0
            H[1, 1] += ny * ny * s0
            H[0, 2] += nx * s1
            H[1, 2] += ny * s1
            H[2, 2] += s2
            g[0] += nx * t0
            g[1] += ny * t0
            g[2] += t1
    H[1, 0], H[2, 0], H[2, 1] = H[0, 1], H[0, 2], H[1, 2]


@jit
def slide(
    edges_a: Array, edges_b: Array, pose: Array, shifts: Array, B: Array, start: Ints, eye: Array,
    inverse: float, top: float, margin: float, prior: float, apart: float,
) -> tuple[Array, int, int]:  # fmt: skip
    """Score the union of both components at ``pose`` shifted along its u.

    Parameters
    ----------
    inverse, top : float
        1 / sigma and log A of every beam here.
    prior : float
        Standard deviation of a shift, m.

    Returns
    -------
    scores : (k,)
        Of the shifts.
    best, other : int
        The best, and the best of those more than ``apart`` from it; -1 for none.
    """
    n = start[start.shape[0] - 1]
    rho, face, scores = np.empty(n), np.empty(n, np.int64), np.empty(shifts.shape[0])
    cos, sin = math.cos(pose[2]), math.sin(pose[2])
    best = 0
    for i in range(shifts.shape[0]):
        rho[:] = np.inf
        face[:] = -1
        du, dv = shifts[i] * cos, shifts[i] * sin
        tx, ty = pose[0] + du, pose[1] + dv
        predict(edges_a, cos, sin, tx, ty, B, start, eye, rho, face)
        predict(edges_b, cos, sin, tx, ty, B, start, eye, rho, face)
        scores[i] = _total(B, inverse, top, margin, rho, face)
        scores[i] -= 0.5 * (du * du + dv * dv) / (prior * prior)
        if scores[i] > scores[best]:
            best = i
    other = -1
    for i in range(shifts.shape[0]):
        if abs(shifts[i] - shifts[best]) > apart and (other < 0 or scores[i] > scores[other]):
            other = i
    return scores, best, other
