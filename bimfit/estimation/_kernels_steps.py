"""Steps of a posterior: the annealed pilot, and the profile along the weak direction."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bimfit._kernels import jit
from bimfit.estimation._kernels_beams import NEVER, RANGE
from bimfit.estimation._kernels_likelihood import front, hidden, log_likelihood, normal_equations
from bimfit.geometry.pose import Array

Ints = NDArray[np.int64]


@jit
def solve3(H: Array, g: Array, x: Array) -> None:
    """Solve the symmetric positive definite 3 x 3 system H x = g."""
    a, b, c = H[0, 0], H[0, 1], H[0, 2]
    e, f, i = H[1, 1], H[1, 2], H[2, 2]
    A, B, C = e * i - f * f, c * f - b * i, b * f - c * e
    det = a * A + b * B + c * C
    E, F, Z = a * i - c * c, b * c - a * f, a * e - b * b
    x[0] = (A * g[0] + B * g[1] + C * g[2]) / det
    x[1] = (B * g[0] + E * g[1] + F * g[2]) / det
    x[2] = (C * g[0] + F * g[1] + Z * g[2]) / det


@jit
def pose_at(q0: Array, axes: Array, s: float, w0: float, w1: float, rs: float, out: Array) -> None:
    """Point q0 + s u + w0 v1 + w1 v2 of the scaled coordinates, as (tx, ty, theta)."""
    for i in range(3):
        out[i] = q0[i] + s * axes[i, 0] + w0 * axes[i, 1] + w1 * axes[i, 2]
    out[2] /= rs


@jit
def log_prior(pose: Array, prior: Array) -> float:
    value: float = -0.5 * ((pose[0] / prior[0]) ** 2 + (pose[1] / prior[1]) ** 2 + (pose[2] / prior[2]) ** 2)
    return value


@jit
def conditional_step(
    args: tuple[Any, ...],
    q: Array,
    axes: Array,
    s: float,
    w: Array,
    P2: Array,
    lines: Array,
    runs: Ints,
    H: Array,
    g: Array,
    pose: Array,
    L: Array,
) -> None:
    """One Gauss-Newton step of w at fixed s; L becomes the Cholesky factor of its information."""
    edges, rs, B, start, eye, _, bearing, _, pinv = args
    pose_at(q, axes, s, w[0], w[1], rs, pose)
    normal_equations(edges, pose, rs, B, start, eye, 1.0, 2, bearing, lines, runs, H, g)
    pose[2] *= rs
    for i in range(3):
        g[i] -= pinv[i] * pose[i]
    h00 = h01 = h11 = b0 = b1 = 0.0
    for i in range(3):
        b0 += axes[i, 1] * g[i]
        b1 += axes[i, 2] * g[i]
        for j in range(3):
            h00 += axes[i, 1] * H[i, j] * axes[j, 1]
            h01 += axes[i, 1] * H[i, j] * axes[j, 2]
            h11 += axes[i, 2] * H[i, j] * axes[j, 2]
    h00 += P2[0, 0]
    h01 += P2[0, 1]
    h11 += P2[1, 1]
    det = h00 * h11 - h01 * h01
    w[0] += (h11 * b0 - h01 * b1) / det
    w[1] += (h00 * b1 - h01 * b0) / det
    L[0, 0] = math.sqrt(h00)
    L[1, 0] = h01 / L[0, 0]
    L[1, 1] = math.sqrt(h11 - L[1, 0] * L[1, 0])


@jit
def pilot(args: tuple[Any, ...], q: Array, lines: Array, runs: Ints, H: Array, g: Array, pose: Array) -> None:
    """Six annealed Gauss-Newton steps from q; q becomes the best place passed."""
    edges, rs, B, start, eye, margin, bearing, prior, pinv = args
    x, at = np.empty(3), q.copy()
    top = -np.inf
    for it in range(7):
        pose[0], pose[1], pose[2] = at[0], at[1], at[2] / rs
        value = log_likelihood(edges, pose, B, start, eye, margin, bearing, lines, runs) + log_prior(
            pose, prior
        )
        if value > top:
            top = value
            q[:] = at
        if it == 6:
            break
        m = 4.0 if it < 2 else (2.0 if it < 4 else 1.0)
        normal_equations(edges, pose, rs, B, start, eye, m, NEVER, bearing, lines, runs, H, g)
        for i in range(3):
            H[i, i] += 1.1 * pinv[i]
            g[i] -= pinv[i] * at[i]
        solve3(H, g, x)
        at += x


@jit
def profile(
    args: tuple[Any, ...], q: Array, axes: Array, step: float, P2: Array, lines: Array, runs: Ints,
    w: Array, best: Array,
) -> float:  # fmt: skip
    """Log marginal along the weak direction, from the middle node outwards; returns its maximum."""
    edges, rs, B, start, eye, margin, bearing, prior, _ = args
    H, g, pose, L = np.empty((3, 3)), np.empty(3), np.empty(3), np.empty((2, 2))
    nodes = best.shape[0]
    mid = nodes // 2
    w[mid] = 0.0
    for j in range(nodes):
        i = mid if j == 0 else (mid + (j + 1) // 2 if j % 2 == 1 else mid - j // 2)
        if i > mid:
            w[i] = w[i - 1]
        elif i < mid:
            w[i] = w[i + 1]
        for _ in range(2):
            conditional_step(args, q, axes, (i - mid) * step, w[i], P2, lines, runs, H, g, pose, L)
        pose_at(q, axes, (i - mid) * step, w[i, 0], w[i, 1], rs, pose)
        value = log_likelihood(edges, pose, B, start, eye, margin, bearing, lines, runs)
        best[i] = value + log_prior(pose, prior) - math.log(L[0, 0] * L[1, 1])
    return float(best.max())


@jit
def two_orientations(
    edges: Array, pose: Array, B: Array, start: Ints, eye: Array, lines: Array, runs: Ints
) -> bool:
    """Whether the returns lie on faces that differ by more than 20 degrees."""
    cos, sin = math.cos(pose[2]), math.sin(pose[2])
    ref = -1
    for g in range(eye.shape[0]):
        for i in range(front(edges, cos, sin, pose[0], pose[1], B, start, eye, g, lines, runs)):
            e, k, end = runs[i, 2], runs[i, 0], runs[i, 1]
            nx, ny, c = lines[e, 0], lines[e, 1], lines[e, 2]
            while k < end and (B[RANGE, k] < 0.0 or hidden(B, k, nx, ny, c)):
                k += 1
            if k == end:
                continue
            if ref < 0:
                ref = e
            elif edges[ref, 4] * edges[e, 4] + edges[ref, 5] * edges[e, 5] < 0.94:
                return True
    return False


@jit
def along(m: Array, axes: Array) -> float:
    """Quadratic form of the first axis."""
    total = 0.0
    for i in range(3):
        for j in range(3):
            total += axes[i, 0] * m[i, j] * axes[j, 0]
    return total
