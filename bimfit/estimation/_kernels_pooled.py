"""Numba functions of the likelihood of all beams along a joint under one motion of a component.

Everything is about the component's reference corner: edges as designed, less the corner, and beams from
their sensor's place, less the corner. Beams ``B`` (9, N) have the rows of :mod:`._kernels_beams`,
stations one after the other; ``at`` (2, N) is where each starts from. ``first`` (n + 1,) and ``row`` (n + 1,)
tell where a station's beams and edges begin.

Beams are of two kinds. Those that meet the same edge wherever the component may be add up to one quadratic;
the few near a corner, or on a face that is nearly edge-on, are summed one by one.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from bimfit._kernels import jit, jit_inner
from bimfit.estimation._kernels_beams import DEEP, INVERSE, LIMIT, OFF, RANGE, STEEP, TOP
from bimfit.geometry.pose import Array

Ints = NDArray[np.int64]
_SPREAD = 5.0
"""A corner may be that many standard deviations from where it is expected."""


@jit_inner
def _moved(edges: Array, begin: int, end: int, x: Array, out: Array) -> None:
    """Edges turned by x[2] about the corner, then shifted by x[:2]."""
    cos, sin = math.cos(x[2]), math.sin(x[2])
    for e in range(begin, end):
        k = e - begin
        for j in range(2):
            a, b = edges[e, 2 * j], edges[e, 2 * j + 1]
            out[k, 2 * j], out[k, 2 * j + 1] = cos * a - sin * b + x[0], sin * a + cos * b + x[1]
        out[k, 4], out[k, 5] = (
            cos * edges[e, 4] - sin * edges[e, 5],
            sin * edges[e, 4] + cos * edges[e, 5],
        )


@jit_inner
def _meet(edges: Array, count: int, ox: float, oy: float, dx: float, dy: float) -> tuple[float, int]:
    """Range to the first edge that faces a beam's start, and which; inf and -1 for none."""
    near, face = np.inf, -1
    for e in range(count):
        ax, ay = edges[e, 0] - ox, edges[e, 1] - oy
        c = edges[e, 4] * ax + edges[e, 5] * ay
        if c >= 0.0:
            continue
        if dx * ay - dy * ax <= 0.0 or dx * (edges[e, 3] - oy) - dy * (edges[e, 2] - ox) > 0.0:
            continue
        rho = c / (edges[e, 4] * dx + edges[e, 5] * dy)
        if 0.0 < rho < near:
            near, face = rho, e
    return near, face


@jit_inner
def _value(B: Array, k: int, near: float, slope: float, margin: float, bearing: float) -> float:
    """What one beam that meets a face at ``near`` adds to the log-likelihood (METHOD, section 4, step 4).

    ``slope`` is n.d there: on a face nearly edge-on the range depends on the bearing most of all.
    """
    z = B[RANGE, k] - near
    q = z * B[INVERSE, k]
    t = B[TOP, k] - 0.5 * q * q
    if bearing > 0.0 and slope > -STEEP:
        grow = 1.0 + (bearing * B[INVERSE, k] * near) ** 2 * (1.0 / (slope * slope) - 1.0)
        t = B[TOP, k] - 0.5 * (q * q / grow + math.log(grow))
    gain = t if t > 30.0 else (math.log1p(math.exp(t)) if t > -30.0 else 0.0)
    return float(gain + B[OFF, k] + (B[DEEP, k] if z > margin else 0.0))


@jit
def expand(
    edges: Array, row: Ints, B: Array, at: Array, first: Ints, bearing: Array, place: Array, spread: Array,
    H: Array, g: Array, near_edge: NDArray[np.bool_],
) -> None:  # fmt: skip
    """Split the beams into the two kinds and expand those of the first kind.

    Parameters
    ----------
    place : (n, 3)
        Motion of the corner at every station to expand about.
    spread : (n, 3, 3)
        How far from there it may be, a covariance.
    H, g : (n, 3, 3) and (n, 3) out
        The log-likelihood of beams of the first kind is g.x - x.H x / 2 for a further motion x.
    near_edge : (N,) out
        Beams of the second kind.
    """
    most = 0
    for i in range(first.shape[0] - 1):
        most = max(most, row[i + 1] - row[i])
    moved, J = np.empty((most, 6)), np.empty(3)
    H[:] = 0.0
    g[:] = 0.0
    near_edge[:] = False
    for i in range(first.shape[0] - 1):
        count, x = row[i + 1] - row[i], place[i]
        _moved(edges, row[i], row[i + 1], x, moved)
        for k in range(first[i], first[i + 1]):
            ox, oy, dx, dy = at[0, k], at[1, k], B[1, k], B[2, k]
            near_edge[k] = _near_corner(moved, count, x, spread[i], bearing[i], ox, oy, dx, dy)
            if near_edge[k]:
                continue
            near, e = _meet(moved, count, ox, oy, dx, dy)
            if e < 0 or not near < B[LIMIT, k]:
                continue
            slope = moved[e, 4] * dx + moved[e, 5] * dy
            if slope > -STEEP:
                near_edge[k] = True
                continue
            z = B[RANGE, k] - near
            q = z * B[INVERSE, k]
            odds = math.exp(min(B[TOP, k] - 0.5 * q * q, 50.0))
            w = odds / (1.0 + odds) * B[INVERSE, k] ** 2
            px, py = ox + near * dx - x[0], oy + near * dy - x[1]
            J[0], J[1] = moved[e, 4] / slope, moved[e, 5] / slope
            J[2] = J[1] * px - J[0] * py
            for a in range(3):
                g[i, a] += w * z * J[a]
                for b in range(3):
                    H[i, a, b] += w * J[a] * J[b]


@jit_inner
def _near_corner(
    moved: Array, count: int, x: Array, spread: Array, bearing: float, ox: float, oy: float, dx: float,
    dy: float,
) -> bool:  # fmt: skip
    """Whether a corner of the component may lie on either side of a beam."""
    for e in range(count):
        for j in range(2):
            vx, vy = moved[e, 2 * j], moved[e, 2 * j + 1]
            lx, ly = vx - ox, vy - oy
            size = lx * lx + ly * ly
            off = dx * ly - dy * lx
            if dx * lx + dy * ly <= 0.0 or off * off > 0.25 * size:
                continue
            # how the bearing changes with (u, v, theta)
            a, b = -ly / size, lx / size
            c = -a * (vy - x[1]) + b * (vx - x[0])
            variance = a * a * spread[0, 0] + b * b * spread[1, 1] + c * c * spread[2, 2]
            variance += 2.0 * (a * b * spread[0, 1] + a * c * spread[0, 2] + b * c * spread[1, 2])
            reach = _SPREAD * math.sqrt(max(variance, 0.0)) + bearing
            if off * off < reach * reach * size:
                return True
    return False


@jit
def log_likelihoods(
    edges: Array, row: Ints, B: Array, at: Array, first: Ints, margin: Array, bearing: Array, place: Array,
    functions: Array, draws: Array, out: Array,
) -> None:  # fmt: skip
    """Log-likelihood of the beams given, one by one, for many motions of the component.

    Parameters
    ----------
    place : (n, 3)
        See :func:`expand`.
    functions : (n, K)
        What a further motion along the joint is made of.
    draws : (m, K, 3)
        Their coefficients in u, v and theta, one set after the other.
    out : (m,) out
    """
    most = 0
    for i in range(first.shape[0] - 1):
        most = max(most, row[i + 1] - row[i])
    moved, x = np.empty((most, 6)), np.empty(3)
    out[:] = 0.0
    for i in range(first.shape[0] - 1):
        if first[i] == first[i + 1]:
            continue
        count = row[i + 1] - row[i]
        for s in range(draws.shape[0]):
            for a in range(3):
                x[a] = place[i, a]
                for j in range(functions.shape[1]):
                    x[a] += functions[i, j] * draws[s, j, a]
            _moved(edges, row[i], row[i + 1], x, moved)
            for k in range(first[i], first[i + 1]):
                near, e = _meet(moved, count, at[0, k], at[1, k], B[1, k], B[2, k])
                if e >= 0 and near < B[LIMIT, k]:
                    slope = moved[e, 4] * B[1, k] + moved[e, 5] * B[2, k]
                    out[s] += _value(B, k, near, slope, margin[i], bearing[i])
