"""Where a joint's motion bends: piecewise linear models by messages along a chain of knots.

With knots at stations, the weighted sum of squares of a piecewise linear motion is a quadratic function of
the motion at the knots, in which only neighbours meet. Sums over any stretch of stations are differences of
prefix sums, and what lies left and right of a stretch is summed up by one quadratic function each (a
message), so that a knot is added, moved or dropped in constant time. Calls no kernel of another file.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bimfit._kernels import jit
from bimfit.geometry.pose import Array

Ints = NDArray[np.int64]

COLUMNS = 34
RIDGE = 1e-3


@jit
def prefix_sums(s: Array, value: Array, precision: Array, sums: Array) -> None:
    """Prefix sums (n + 1, COLUMNS) of L, s L, s^2 L (9 each), L x, s L x (3 each) and x L x."""
    n = s.shape[0]
    sums[0] = 0.0
    for i in range(n):
        sums[i + 1] = sums[i]
        square = 0.0
        for a in range(3):
            right = 0.0
            for b in range(3):
                w = precision[i, a, b]
                sums[i + 1, 3 * a + b] += w
                sums[i + 1, 9 + 3 * a + b] += s[i] * w
                sums[i + 1, 18 + 3 * a + b] += s[i] * s[i] * w
                right += w * value[i, b]
            sums[i + 1, 27 + a] += right
            sums[i + 1, 30 + a] += s[i] * right
            square += right * value[i, a]
        sums[i + 1, 33] += square


@jit
def _invert(J: Array, out: Array) -> None:
    """Inverse of a symmetric positive definite 3 x 3 matrix."""
    a, b, c, e, f, i = J[0, 0], J[0, 1], J[0, 2], J[1, 1], J[1, 2], J[2, 2]
    A, B, C = e * i - f * f, c * f - b * i, b * f - c * e
    E, F, Z = a * i - c * c, b * c - a * f, a * e - b * b
    det = max(a * A + b * B + c * C, 1e-300)
    out[0, 0], out[0, 1], out[0, 2] = A / det, B / det, C / det
    out[1, 0], out[1, 1], out[1, 2] = B / det, E / det, F / det
    out[2, 0], out[2, 1], out[2, 2] = C / det, F / det, Z / det


@jit
def _pass(
    s: Array, sums: Array, at: int, to: int, last: bool, message: Array, work: Array, out: Array
) -> None:
    """Carry a message (13: J, h, c) from knot ``at`` to knot ``to`` over the stations between them.

    The knot further right owns its station only where it is the ``last``.
    """
    lo, hi = min(at, to), max(at, to) + (1 if last else 0)
    sa, h = s[at], s[to] - s[at]
    J, R, S, inverse = work[0], work[1], work[2], work[3]
    for a in range(3):
        for b in range(3):
            k = 3 * a + b
            m0 = sums[hi, k] - sums[lo, k]
            m1 = sums[hi, 9 + k] - sums[lo, 9 + k] - sa * m0
            m2 = sums[hi, 18 + k] - sums[lo, 18 + k] - sa * (m1 + m1 + sa * m0)
            S[a, b] = m2 / (h * h)
            R[a, b] = m1 / h - S[a, b]
            J[a, b] = message[k] + m0 - 2.0 * m1 / h + S[a, b]
    _invert(J, inverse)
    va, vb = work[4, 0], work[4, 1]
    for a in range(3):
        v0 = sums[hi, 27 + a] - sums[lo, 27 + a]
        v1 = (sums[hi, 30 + a] - sums[lo, 30 + a] - sa * v0) / h
        va[a] = message[9 + a] + v0 - v1
        vb[a] = v1
    out[12] = message[12] + sums[hi, 33] - sums[lo, 33]
    T = work[5]
    for a in range(3):
        for b in range(3):
            T[a, b] = inverse[a, 0] * R[0, b] + inverse[a, 1] * R[1, b] + inverse[a, 2] * R[2, b]
    for a in range(3):
        x = inverse[a, 0] * va[0] + inverse[a, 1] * va[1] + inverse[a, 2] * va[2]
        out[12] -= va[a] * x
        out[9 + a] = vb[a] - (T[0, a] * va[0] + T[1, a] * va[1] + T[2, a] * va[2])
        for b in range(3):
            out[3 * a + b] = S[a, b] - (R[0, a] * T[0, b] + R[1, a] * T[1, b] + R[2, a] * T[2, b])
        out[4 * a] += RIDGE


@jit
def _meet(left: Array, right: Array, work: Array) -> float:
    """Least sum of what two messages to the same knot say; its ridge is in both of them."""
    J, inverse = work[0], work[3]
    for a in range(3):
        for b in range(3):
            J[a, b] = left[3 * a + b] + right[3 * a + b]
        J[a, a] -= RIDGE
    _invert(J, inverse)
    total = left[12] + right[12]
    for a in range(3):
        for b in range(3):
            total -= (left[9 + a] + right[9 + a]) * inverse[a, b] * (left[9 + b] + right[9 + b])
    return float(total)


@jit
def _messages(
    s: Array, sums: Array, knots: Ints, count: int, left: Array, right: Array, work: Array
) -> float:
    """Messages (2, k, 13) to every knot from its left and from its right; returns the cost."""
    total = 0.0
    for c in range(2):
        left[c, 0] = 0.0
        right[c, count - 1] = 0.0
        for a in range(3):
            left[c, 0, 4 * a] = RIDGE
            right[c, count - 1, 4 * a] = RIDGE
        for j in range(1, count):
            _pass(s, sums[c], knots[j - 1], knots[j], j == count - 1, left[c, j - 1], work, left[c, j])
        for j in range(count - 2, -1, -1):
            _pass(s, sums[c], knots[j + 1], knots[j], j == count - 2, right[c, j + 1], work, right[c, j])
        total += _meet(left[c, count - 1], right[c, count - 1], work)
    return total


@jit
def _between(
    s: Array, sums: Array, knots: Ints, count: int, j: int, middle: int, after: int, left: Array,
    right: Array, work: Array, ends: Array,
) -> float:  # fmt: skip
    """Cost with one knot at ``middle`` (-1: none) between the knots number j and ``after``."""
    total = 0.0
    last = after == count - 1
    for c in range(2):
        if middle < 0:
            _pass(s, sums[c], knots[j], knots[after], last, left[c, j], work, ends[1])
        else:
            _pass(s, sums[c], knots[j], middle, False, left[c, j], work, ends[0])
            _pass(s, sums[c], middle, knots[after], last, ends[0], work, ends[1])
        total += _meet(ends[1], right[c, after], work)
    return total


@jit
def cost_of(s: Array, sums: Array, knots: Ints) -> float:
    """Weighted sum of squares of both components, sums (2, n + 1, COLUMNS), with these knots."""
    n = knots.shape[0]
    return float(
        _messages(s, sums, knots, n, np.empty((2, n, 13)), np.empty((2, n, 13)), np.empty((6, 3, 3)))
    )


@jit
def find_knots(
    s: Array, sums: Array, allowed: NDArray[np.bool_], keep: float, reach: int, knots: Ints
) -> int:
    """Add the knots that pay, move them, drop those that do not; returns how many there are.

    Parameters
    ----------
    s : (n,)
    sums : (2, n + 1, COLUMNS)
        Of both components, which share their knots.
    allowed : (n,)
        Where a knot may be added; changed.
    keep : float
        What a knot must lower the cost by.
    reach : int
        By how many stations a knot may be moved.
    knots : (m,) in and out
        The first and the last station to begin with; its length bounds how many there can be.
    """
    most = knots.shape[0]
    left, right = np.empty((2, most, 13)), np.empty((2, most, 13))
    work, ends = np.empty((6, 3, 3)), np.empty((2, 13))
    count = 2
    cost = _messages(s, sums, knots, count, left, right, work)
    while count < most:
        best, pick, where = np.inf, -1, 0
        for j in range(count - 1):
            for i in range(knots[j] + 1, knots[j + 1]):
                if allowed[i]:
                    new = _between(s, sums, knots, count, j, i, j + 1, left, right, work, ends)
                    if new < best:
                        best, pick, where = new, i, j + 1
        if pick < 0 or not cost - best >= keep:
            break
        for j in range(count, where, -1):
            knots[j] = knots[j - 1]
        knots[where] = pick
        count += 1
        allowed[pick] = False
        cost = _messages(s, sums, knots, count, left, right, work)
    for _ in range(2):
        for j in range(1, count - 1):
            here = knots[j]
            best, pick = cost, here
            for i in range(max(here - reach, knots[j - 1] + 1), min(here + reach + 1, knots[j + 1])):
                new = _between(s, sums, knots, count, j - 1, i, j + 1, left, right, work, ends)
                if new < best:
                    best, pick = new, i
            if pick != here:
                knots[j] = pick
                cost = _messages(s, sums, knots, count, left, right, work)
        while count > 2:
            best, pick = np.inf, -1
            for j in range(1, count - 1):
                new = _between(s, sums, knots, count, j - 1, -1, j + 1, left, right, work, ends)
                if new < best:
                    best, pick = new, j
            if pick < 0 or not best - cost <= keep:
                break
            for j in range(pick, count - 1):
                knots[j] = knots[j + 1]
            count -= 1
            cost = _messages(s, sums, knots, count, left, right, work)
    return count
