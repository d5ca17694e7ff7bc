"""Posterior of one component's pose from the beams that speak for it (METHOD, section 4, steps 5 to 8)."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from bimfit._kernels import jit
from bimfit.estimation._kernels_beams import INVERSE, NEVER, RANGE, predict, taken
from bimfit.estimation._kernels_likelihood import log_likelihood, normal_equations, scratch
from bimfit.estimation._kernels_quadrature import NEGLIGIBLE, integrate, sample
from bimfit.estimation._kernels_steps import along, pilot, pose_at, profile, two_orientations
from bimfit.geometry.pose import Array

Ints = NDArray[np.int64]


@jit
def _pivot(
    rows: Array, at: Array, B: Array, start: Ints, eye: Array, near: float, few: int
) -> tuple[bool, float, float, float, float]:
    """Centroid of the returns near a component, their rms distance from it, and what a pose may be off there.

    The first of the five: whether there are ``few`` of them.
    """
    n = start[-1]
    rho, face = np.full(n, np.inf), np.full(n, -1, np.int64)
    predict(rows, math.cos(at[2]), math.sin(at[2]), at[0], at[1], B, start, eye, rho, face)
    count, px, py, slack = 0, 0.0, 0.0, 0.003
    points = np.empty((n, 2))
    for g in range(eye.shape[0]):
        for k in range(start[g], start[g + 1]):
            if face[k] >= 0 and B[RANGE, k] > 0.0 and abs(B[RANGE, k] - rho[k]) < near:
                points[count, 0] = eye[g, 0] + B[1, k] * B[RANGE, k]
                points[count, 1] = eye[g, 1] + B[2, k] * B[RANGE, k]
                px += points[count, 0]
                py += points[count, 1]
                slack = max(slack, 1.0 / B[INVERSE, k])
                count += 1
    if count < few:
        return False, px, py, 0.0, slack
    px /= count
    py /= count
    square = 0.0
    for k in range(count):
        square += (points[k, 0] - px) ** 2 + (points[k, 1] - py) ** 2
    return True, px, py, max(math.sqrt(square / count), 0.005), slack


@jit
def _turned(rows: Array, angle: float, x: float, y: float) -> Array:
    """Edges (m, 6) turned about the origin and then shifted."""
    cos, sin = math.cos(angle), math.sin(angle)
    moved = np.empty_like(rows)
    for e in range(rows.shape[0]):
        for j in range(3):
            a, b = rows[e, 2 * j], rows[e, 2 * j + 1]
            moved[e, 2 * j], moved[e, 2 * j + 1] = cos * a - sin * b, sin * a + cos * b
            if j < 2:
                moved[e, 2 * j] += x
                moved[e, 2 * j + 1] += y
    return moved


@jit
def component(
    rows: Array,
    at: Array,
    begin: Array,
    use: NDArray[np.bool_],
    every: Array,
    start: Ints,
    eye: Array,
    margin: float,
    near: float,
    few: int,
    bearing: float,
    prior: Array,
    window: float,
    least: float,
    cells: int,
    draws: Array,
    out: Array,
) -> bool:
    """Posterior of one component from the beams in ``use``; False where fewer than ``few`` meet it.

    Parameters
    ----------
    rows : (m, 6)
        Edges of the designed component.
    at : (3,)
        Pose that the prior is centred on; the returns within ``near`` of the component there set the pivot.
    begin : (3,)
        Another pose that the pilot may start from; NaN for none. The one with more evidence counts.
    out : (36,) out
        Pose (3), covariance (9), pivot (2), covariance about the pivot (9), info (12), radius.
    """
    B, start2 = taken(every, start, use)
    found, px, py, rs, slack = _pivot(rows, at, B, start2, eye, near, few)
    if not found:
        return False
    lx, ly = at[0] - px, at[1] - py
    moved = _turned(rows, at[2], lx, ly)
    seat = eye.copy()
    seat[:, 0] -= px
    seat[:, 1] -= py
    first, mean, cov, info = np.zeros(3), np.empty(3), np.empty((3, 3)), np.zeros(12)
    out[12], out[13], out[35] = px, py, rs
    posterior(
        moved, rs, B, start2, seat, margin, bearing, prior, first, window, least, cells, draws, mean, cov,
        info,
    )  # fmt: skip
    _put(at, mean, cov, info, out)
    if math.isnan(begin[0]) or not _apart(begin, out, slack):
        return True
    turn = begin[2] - at[2]
    first[0] = begin[0] - px - (math.cos(turn) * lx - math.sin(turn) * ly)
    first[1] = begin[1] - py - (math.sin(turn) * lx + math.cos(turn) * ly)
    first[2] = turn
    before = info[0]
    info[:] = 0.0
    posterior(
        moved, rs, B, start2, seat, margin, bearing, prior, first, window, least, cells, draws, mean, cov,
        info,
    )  # fmt: skip
    if info[0] > before + 1.0:
        _put(at, mean, cov, info, out)
    return True


@jit
def posterior(
    edges: Array,
    rs: float,
    B: Array,
    start: Ints,
    eye: Array,
    margin: float,
    bearing: float,
    prior: Array,
    begin: Array,
    window: float,
    least: float,
    cells: int,
    draws: Array,
    mean: Array,
    cov: Array,
    info: Array,
) -> None:
    """Posterior mean and covariance of a component's pose (METHOD, section 4, steps 5 to 8).

    Coordinates are (tx, ty, theta * rs) about the origin of ``edges``; the prior is centred on 0.

    Parameters
    ----------
    bearing : float
        See :func:`log_likelihood`.
    prior : (3,)
        Standard deviations of tx, ty (m) and theta (rad).
    begin : (3,)
        Pose (tx, ty, theta) that the pilot starts from.
    window, least : float
        Greatest and least half width of the integration along the weak direction, m.
    cells : int
        Cells of the quadrature along the weak direction; 0 for a glance: the mode and about the evidence.
    draws : (n, 4)
        Student deviates and their log density, for posteriors that the quadrature cannot resolve.
    mean : (3,) out, cov : (3, 3) out
        In (tx, ty, theta * rs).
    info : (12,) out
        log evidence, sd and direction (3) of the weak axis from ranges alone, sd of it in the posterior,
        rival mass, rival offset along the weak axis, log-likelihood at the mean, log-posterior at its mode,
        effective number of nodes, 1 where sampling replaced the quadrature.
    """
    lines, runs = scratch(edges, eye)
    H, g, pose = np.empty((3, 3)), np.empty(3), np.empty(3)
    pinv = np.array([1.0 / prior[0] ** 2, 1.0 / prior[1] ** 2, 1.0 / (prior[2] * rs) ** 2])
    args = (edges, rs, B, start, eye, margin, bearing, prior, pinv)
    q = np.array([begin[0], begin[1], begin[2] * rs])
    pilot(args, q, lines, runs, H, g, pose)
    nodes = 25
    mid = nodes // 2
    w = np.zeros((nodes, 2))
    best = np.empty(nodes)
    raw, P2, axes = np.empty((3, 3)), np.empty((2, 2)), np.empty((3, 3))
    mixed, step, top = False, 0.0, 0.0
    for _ in range(4):
        pose[0], pose[1], pose[2] = q[0], q[1], q[2] / rs
        normal_equations(edges, pose, rs, B, start, eye, 1.0, NEVER, bearing, lines, runs, H, g)
        mixed = two_orientations(edges, pose, B, start, eye, lines, runs)
        raw[:] = H
        for i in range(3):
            H[i, i] += pinv[i]
        values, axes = np.linalg.eigh(H)
        if axes[0, 0] < 0.0:
            axes[:, 0] *= -1.0
        step = max(least, min(window, 6.0 / math.sqrt(values[0]))) / mid
        for i in range(2):
            for j in range(2):
                P2[i, j] = 0.0
                for a in range(3):
                    P2[i, j] += axes[a, 1 + i] * axes[a, 1 + j] * pinv[a]
        top = profile(args, q, axes, step, P2, lines, runs, w, best)
        i = int(np.argmax(best))
        if 1 < i < nodes - 2 or abs(q[0]) + abs(q[1]) > 4.0 * window:
            break
        pose_at(q, axes, (i - mid) * step, w[i, 0], w[i, 1], 1.0, pose)  # the best lies at an end: move there
        q[:] = pose
    if cells == 0:
        _glance(q, axes, rs, step, w, best, top, mean, cov, info)
        return
    lo, hi = _range(best, top, step)
    integrate(args, q, axes, lo, hi, cells, w, best, step, mid, top, P2, mixed, mean, cov, info)
    if info[10] < 8.0:
        for i in range(3):
            for j in range(3):
                H[i, j] = raw[i, j] + (pinv[i] if i == j else 0.0)
        sample(args, q, H, axes, draws, mean, cov, info)
    info[1] = 1.0 / math.sqrt(max(along(raw, axes), 1e-12))
    info[2], info[3], info[4] = axes[0, 0], axes[1, 0], axes[2, 0]
    info[5] = math.sqrt(max(along(cov, axes), 0.0))
    pose[0], pose[1], pose[2] = mean[0], mean[1], mean[2] / rs
    info[8] = log_likelihood(edges, pose, B, start, eye, margin, bearing, lines, runs)


@jit
def _range(best: Array, top: float, step: float) -> tuple[float, float]:
    """From where to where along the weak direction the profile is not negligible, and a node more."""
    nodes = best.shape[0]
    first, final, mid = nodes, -1, nodes // 2
    for i in range(nodes):
        if best[i] > top - NEGLIGIBLE:
            first = min(first, i)
            final = max(final, i)
    return (max(first - 1, 0) - mid) * step, (min(final + 1, nodes - 1) - mid) * step


@jit
def _glance(
    q: Array, axes: Array, rs: float, step: float, w: Array, best: Array, top: float, mean: Array, cov: Array,
    info: Array,
) -> None:  # fmt: skip
    """The profile's best node in place of the mean, and its sum in place of the evidence."""
    i = int(np.argmax(best))
    pose_at(q, axes, (i - best.shape[0] // 2) * step, w[i, 0], w[i, 1], 1.0, mean)
    cov[:] = 0.0
    total = 0.0
    for j in range(best.shape[0]):
        total += math.exp(best[j] - top)
    info[0] = top + math.log(2.0 * math.pi * step * total)


@jit
def _put(at: Array, mean: Array, cov: Array, info: Array, out: Array) -> None:
    """Pose and covariances of a posterior about the pivot, out[12:14], for the section's frame."""
    px, py, rs = out[12], out[13], out[35]
    phi = mean[2] / rs
    c, s = math.cos(phi), math.sin(phi)
    x, y = c * (at[0] - px) - s * (at[1] - py), s * (at[0] - px) + c * (at[1] - py)
    out[0], out[1], out[2] = x + mean[0] + px, y + mean[1] + py, at[2] + phi
    for i in range(3):
        for j in range(3):
            out[14 + 3 * i + j] = cov[i, j] / ((rs if i == 2 else 1.0) * (rs if j == 2 else 1.0))
    # (u, v, theta) of a motion about the frame's origin: the shift gains theta x arm
    a = out[14:23].reshape((3, 3))
    arm = (-y, x)
    for i in range(3):
        for j in range(3):
            v = a[i, j]
            if i < 2:
                v += arm[i] * a[2, j]
            if j < 2:
                v += a[i, 2] * arm[j]
            if i < 2 and j < 2:
                v += arm[i] * arm[j] * a[2, 2]
            out[3 + 3 * i + j] = v
    out[23:35] = info


@jit
def _apart(begin: Array, out: Array, slack: float) -> bool:
    """Whether two poses differ by more than noise explains at the pivot."""
    turn = begin[2] - out[2]
    x, y = out[12] - out[0], out[13] - out[1]
    c, s = math.cos(turn), math.sin(turn)
    du, dv = c * x - s * y + begin[0] - out[12], s * x + c * y + begin[1] - out[13]
    return math.hypot(du, dv) > slack or abs(turn) > math.radians(2.0)
