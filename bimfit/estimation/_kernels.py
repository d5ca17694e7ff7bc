"""Every numba function of the estimation room: predicted ranges, beam likelihood, slide, quadrature.

Beams come sorted by pseudo-angle within groups of one origin each, as arrays:

``p``      pseudo-angle of the direction in the group's own axes, ascending within a group
``d``      (n, 2) unit directions;  ``r`` (n,) ranges, negative where nothing came back
``start``  (g + 1,) first beam of every group;  ``eye`` (g, 4) origin and look direction of every group

``off`` (n,) is added to the log-likelihood whenever the beam is predicted to meet the component, and
``lim`` (n,) is the range at which something else is in the way. No ``fastmath``: misses rely on inf.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from bimfit.geometry.pose import Array

Ints = NDArray[np.int64]

_JIT = {"cache": True, "nogil": True, "error_model": "numpy"}


@njit(**_JIT)
def pseudo_angle(x: float, y: float) -> float:
    """Grows with atan2(y, x), from -2 to 2, without trigonometry."""
    size = abs(x) + abs(y)
    if size == 0.0:
        return 0.0
    q = y / size
    if x >= 0.0:
        return q
    return 2.0 - q if y >= 0.0 else -2.0 - q


@njit(**_JIT)
def _lower(p: Array, lo: int, hi: int, value: float) -> int:
    """First index in [lo, hi) whose p is at least value."""
    while lo < hi:
        mid = (lo + hi) >> 1
        if p[mid] < value:
            lo = mid + 1
        else:
            hi = mid
    return lo


@njit(**_JIT)
def predict(
    edges: Array,
    cos: float,
    sin: float,
    tx: float,
    ty: float,
    p: Array,
    d: Array,
    start: Ints,
    eye: Array,
    rho: Array,
    face: Ints,
) -> None:
    """Lower ``rho`` to the first edge on every beam; ``face`` gets that edge's index.

    Parameters
    ----------
    edges : (m, 6)
        Ends a, b and outward unit normal; moved by the rotation (cos, sin) about 0, then by (tx, ty).
    rho, face : (n,)
        In and out: ranges and edge indices so far.
    """
    for e in range(edges.shape[0]):
        nx = cos * edges[e, 4] - sin * edges[e, 5]
        ny = sin * edges[e, 4] + cos * edges[e, 5]
        ax = cos * edges[e, 0] - sin * edges[e, 1] + tx
        ay = sin * edges[e, 0] + cos * edges[e, 1] + ty
        bx = cos * edges[e, 2] - sin * edges[e, 3] + tx
        by = sin * edges[e, 2] + cos * edges[e, 3] + ty
        for g in range(eye.shape[0]):
            ox, oy, lx, ly = eye[g, 0], eye[g, 1], eye[g, 2], eye[g, 3]
            dax, day, dbx, dby = ax - ox, ay - oy, bx - ox, by - oy
            c = nx * dax + ny * day
            if c >= 0.0:
                continue
            high = pseudo_angle(lx * dax + ly * day, lx * day - ly * dax)
            low = pseudo_angle(lx * dbx + ly * dby, lx * dby - ly * dbx)
            s, t = start[g], start[g + 1]
            if low <= high:
                i0, i1, j1 = _lower(p, s, t, low), _lower(p, s, t, high), s
            else:  # the edge lies across the cut behind the sensor
                i0, i1, j1 = _lower(p, s, t, low), t, _lower(p, s, t, high)
            for k in range(i0, i1):
                x = c / (nx * d[k, 0] + ny * d[k, 1])
                if 0.0 < x < rho[k]:
                    rho[k] = x
                    face[k] = e
            for k in range(s, j1):
                x = c / (nx * d[k, 0] + ny * d[k, 1])
                if 0.0 < x < rho[k]:
                    rho[k] = x
                    face[k] = e


@njit(**_JIT)
def sort_beams(
    o: Array, d: Array, group: Ints, count: int, eye: Array, p: Array, order: Ints, start: Ints
) -> None:
    """Order beams by group and pseudo-angle about their group's mean direction."""
    n = group.shape[0]
    eye[:] = 0.0
    for k in range(n):
        g = group[k]
        start[g + 1] += 1
        eye[g, 0] += o[k, 0]
        eye[g, 1] += o[k, 1]
        eye[g, 2] += d[k, 0]
        eye[g, 3] += d[k, 1]
    key = np.empty(n)
    for g in range(count):
        eye[g, 0] /= start[g + 1]
        eye[g, 1] /= start[g + 1]
        size = math.hypot(eye[g, 2], eye[g, 3])
        if size > 1e-6 * start[g + 1]:
            eye[g, 2] /= size
            eye[g, 3] /= size
        else:
            eye[g, 2], eye[g, 3] = 1.0, 0.0
        start[g + 1] += start[g]
    for k in range(n):
        lx, ly = eye[group[k], 2], eye[group[k], 3]
        key[k] = pseudo_angle(lx * d[k, 0] + ly * d[k, 1], lx * d[k, 1] - ly * d[k, 0])
    rank = np.argsort(key + 8.0 * group)
    for i in range(n):
        order[i] = rank[i]
        p[i] = key[rank[i]]


@njit(**_JIT)
def log_table(amplitude: float, scale: float, table: Array) -> None:
    """Fill ``table`` with log(1 + A exp(-q / 2)) at q = index * scale."""
    for i in range(table.shape[0]):
        table[i] = math.log(1.0 + amplitude * math.exp(-0.5 * i * scale))
    table[table.shape[0] - 1] = 0.0


@njit(**_JIT)
def log_likelihood(
    edges: Array,
    pose: Array,
    p: Array,
    d: Array,
    r: Array,
    start: Ints,
    eye: Array,
    off: Array,
    lim: Array,
    sigma: float,
    table: Array,
    scale: float,
    rho: Array,
    face: Ints,
) -> float:
    """Log-likelihood at a pose (tx, ty, theta), as a difference from 'every beam misses'."""
    n = p.shape[0]
    for k in range(n):
        rho[k] = lim[k]
        face[k] = -1
    cos, sin = math.cos(pose[2]), math.sin(pose[2])
    predict(edges, cos, sin, pose[0], pose[1], p, d, start, eye, rho, face)
    unit = 1.0 / (sigma * sigma * scale)
    last = table.shape[0] - 1
    total = 0.0
    for k in range(n):
        if face[k] < 0:
            continue
        total += off[k]
        if r[k] >= 0.0:
            x = (r[k] - rho[k]) * (r[k] - rho[k]) * unit
            if x < last:
                i = int(x)
                total += table[i] + (x - i) * (table[i + 1] - table[i])
    return total


@njit(**_JIT)
def normal_equations(
    edges: Array,
    pose: Array,
    rs: float,
    p: Array,
    d: Array,
    r: Array,
    start: Ints,
    eye: Array,
    lim: Array,
    sigma: float,
    amplitude: float,
    graze: float,
    rho: Array,
    face: Ints,
    H: Array,
    g: Array,
) -> None:
    """Gauss-Newton system of the ranges in (tx, ty, theta * rs), rotation about the origin of ``edges``.

    Weights a / (1 + a), a = A exp(-d^2 / 2). Returns that graze (|n.d| < graze) are left out: there a
    range says next to nothing about the pose, but its Jacobian would claim the opposite.
    """
    n = p.shape[0]
    for k in range(n):
        rho[k] = lim[k]
        face[k] = -1
    cos, sin = math.cos(pose[2]), math.sin(pose[2])
    predict(edges, cos, sin, pose[0], pose[1], p, d, start, eye, rho, face)
    h00 = h01 = h02 = h11 = h12 = h22 = g0 = g1 = g2 = 0.0
    inv = 1.0 / sigma
    for q in range(eye.shape[0]):
        ox, oy = eye[q, 0] - pose[0], eye[q, 1] - pose[1]
        for k in range(start[q], start[q + 1]):
            e = face[k]
            if e < 0 or r[k] < 0.0:
                continue
            z = (r[k] - rho[k]) * inv
            if z * z > 60.0:
                continue
            nx = cos * edges[e, 4] - sin * edges[e, 5]
            ny = sin * edges[e, 4] + cos * edges[e, 5]
            nd = nx * d[k, 0] + ny * d[k, 1]
            if nd > -graze:
                continue
            a = amplitude * math.exp(-0.5 * z * z)
            w = a / (1.0 + a)
            f = inv / nd
            px = ox + rho[k] * d[k, 0]
            py = oy + rho[k] * d[k, 1]
            j0, j1, j2 = nx * f, ny * f, (ny * px - nx * py) * f / rs
            h00 += w * j0 * j0
            h01 += w * j0 * j1
            h02 += w * j0 * j2
            h11 += w * j1 * j1
            h12 += w * j1 * j2
            h22 += w * j2 * j2
            g0 += w * z * j0
            g1 += w * z * j1
            g2 += w * z * j2
    H[0, 0] = h00
    H[0, 1] = H[1, 0] = h01
    H[0, 2] = H[2, 0] = h02
    H[1, 1] = h11
    H[1, 2] = H[2, 1] = h12
    H[2, 2] = h22
    g[0], g[1], g[2] = g0, g1, g2


@njit(**_JIT)
def solve3(H: Array, g: Array, x: float) -> None:
    """Solve the symmetric positive definite 3 x 3 system H x = g."""
    a, b, c = H[0, 0], H[0, 1], H[0, 2]
    e, f, i = H[1, 1], H[1, 2], H[2, 2]
    A, B, C = e * i - f * f, c * f - b * i, b * f - c * e
    det = a * A + b * B + c * C
    E, F, Z = a * i - c * c, b * c - a * f, a * e - b * b
    x[0] = (A * g[0] + B * g[1] + C * g[2]) / det
    x[1] = (B * g[0] + E * g[1] + F * g[2]) / det
    x[2] = (C * g[0] + F * g[1] + Z * g[2]) / det


@njit(**_JIT)
def slide(
    edges_a: Array,
    edges_b: Array,
    pose: Array,
    steps: Array,
    p: Array,
    d: Array,
    r: Array,
    start: Ints,
    eye: Array,
    off: Array,
    sigma: float,
    table: Array,
    scale: float,
    prior: float,
    scores: Array,
) -> None:
    """Score the union of both components at ``pose`` shifted by every (du, dv) row of ``steps``."""
    n = p.shape[0]
    rho = np.empty(n)
    face = np.empty(n, np.int64)
    cos, sin = math.cos(pose[2]), math.sin(pose[2])
    unit = 1.0 / (sigma * sigma * scale)
    last = table.shape[0] - 1
    for i in range(steps.shape[0]):
        rho[:] = np.inf
        face[:] = -1
        tx, ty = pose[0] + steps[i, 0], pose[1] + steps[i, 1]
        predict(edges_a, cos, sin, tx, ty, p, d, start, eye, rho, face)
        predict(edges_b, cos, sin, tx, ty, p, d, start, eye, rho, face)
        total = -0.5 * (steps[i, 0] ** 2 + steps[i, 1] ** 2) / (prior * prior)
        for k in range(n):
            if face[k] < 0:
                continue
            total += off[k]
            if r[k] >= 0.0:
                x = (r[k] - rho[k]) * (r[k] - rho[k]) * unit
                if x < last:
                    j = int(x)
                    total += table[j] + (x - j) * (table[j + 1] - table[j])
        scores[i] = total


@njit(**_JIT)
def _pose_at(q0: Array, axes: Array, s: float, w0: float, w1: float, rs: float, out: Array) -> None:
    """Point q0 + s u + w0 v1 + w1 v2 of the scaled coordinates, as (tx, ty, theta)."""
    for i in range(3):
        out[i] = q0[i] + s * axes[i, 0] + w0 * axes[i, 1] + w1 * axes[i, 2]
    out[2] /= rs


@njit(**_JIT)
def _log_prior(pose: Array, prior: Array) -> float:
    return -0.5 * ((pose[0] / prior[0]) ** 2 + (pose[1] / prior[1]) ** 2 + (pose[2] / prior[2]) ** 2)


@njit(**_JIT)
def posterior(
    edges: Array,
    rs: float,
    p: Array,
    d: Array,
    r: Array,
    start: Ints,
    eye: Array,
    off: Array,
    lim: Array,
    sigma: float,
    amplitude: float,
    table: Array,
    scale: float,
    prior: Array,
    begin: Array,
    window: float,
    least: float,
    cells: int,
    mean: Array,
    cov: Array,
    info: Array,
) -> None:
    """Posterior mean and covariance of a component's pose (METHOD, section 4, steps 5 to 8).

    Coordinates are (tx, ty, theta * rs) about the origin of ``edges``; the prior is centred on 0.

    Parameters
    ----------
    prior : (3,)
        Standard deviations of tx, ty (m) and theta (rad).
    begin : (3,)
        Pose (tx, ty, theta) that the pilot starts from.
    window, least : float
        Greatest and least half width of the integration along the weak direction, m.
    cells : int
        Cells of the quadrature along the weak direction.
    mean : (3,) out, cov : (3, 3) out
        In (tx, ty, theta * rs).
    info : (12,) out
        log evidence, sd and direction (3) of the weak axis from ranges alone, sd of it in the posterior,
        rival mass, rival offset along the weak axis, log-likelihood at the mean, log-likelihood at its mode.
    """
    n = p.shape[0]
    rho = np.empty(n)
    face = np.empty(n, np.int64)
    H, g, x, pose = np.empty((3, 3)), np.empty(3), np.empty(3), np.empty(3)
    pinv = np.array([1.0 / prior[0] ** 2, 1.0 / prior[1] ** 2, 1.0 / (prior[2] * rs) ** 2])
    graze = 0.3
    q = np.array([begin[0], begin[1], begin[2] * rs])
    for it in range(6):
        m = 4.0 if it < 2 else (2.0 if it < 4 else 1.0)
        pose[0], pose[1], pose[2] = q[0], q[1], q[2] / rs
        normal_equations(
            edges, pose, rs, p, d, r, start, eye, lim, m * sigma, amplitude / m, graze, rho, face, H, g
        )
        for i in range(3):
            H[i, i] += 1.1 * pinv[i]
            g[i] -= pinv[i] * q[i]
        solve3(H, g, x)
        q += x
    pose[0], pose[1], pose[2] = q[0], q[1], q[2] / rs
    normal_equations(edges, pose, rs, p, d, r, start, eye, lim, sigma, amplitude, graze, rho, face, H, g)
    mixed = _two_orientations(edges, face, r)
    raw = H.copy()
    for i in range(3):
        H[i, i] += pinv[i]
    values, axes = np.linalg.eigh(H)
    if axes[0, 0] < 0.0:
        axes[:, 0] *= -1.0
    sd = 1.0 / math.sqrt(values[0])
    half = max(least, min(window, 6.0 * sd))
    P2 = np.empty((2, 2))
    for i in range(2):
        for j in range(2):
            P2[i, j] = (
                axes[0, 1 + i] * axes[0, 1 + j] * pinv[0]
                + axes[1, 1 + i] * axes[1, 1 + j] * pinv[1]
                + axes[2, 1 + i] * axes[2, 1 + j] * pinv[2]
            )
    args = (edges, rs, p, d, r, start, eye, off, lim, sigma, amplitude, table, scale, prior, pinv)

    # profile along the weak direction, from the middle outwards
    nodes = 25
    mid = nodes // 2
    w = np.zeros((nodes, 2))
    best = np.full(nodes, -np.inf)
    L = np.empty((2, 2))
    step = half / mid
    for j in range(nodes):
        i = mid if j == 0 else (mid + (j + 1) // 2 if j % 2 == 1 else mid - j // 2)
        if i > mid:
            w[i] = w[i - 1]
        elif i < mid:
            w[i] = w[i + 1]
        for _ in range(2):
            _conditional_step(args, q, axes, (i - mid) * step, w[i], P2, graze, rho, face, H, g, pose, L)
        _pose_at(q, axes, (i - mid) * step, w[i, 0], w[i, 1], rs, pose)
        value = log_likelihood(edges, pose, p, d, r, start, eye, off, lim, sigma, table, scale, rho, face)
        best[i] = value + _log_prior(pose, prior) - math.log(L[0, 0] * L[1, 1])
    top = best.max()
    first, final = nodes, -1
    for i in range(nodes):
        if best[i] > top - 7.0:
            first = min(first, i)
            final = max(final, i)
    lo = (max(first - 1, 0) - mid) * step
    hi = (min(final + 1, nodes - 1) - mid) * step
    _integrate(args, q, axes, lo, hi, cells, w, best, step, mid, top, P2, graze, mixed, mean, cov, info)
    info[1] = 1.0 / math.sqrt(max(axes[:, 0] @ raw @ axes[:, 0], 1e-12))
    info[2], info[3], info[4] = axes[0, 0], axes[1, 0], axes[2, 0]
    info[5] = math.sqrt(max(axes[:, 0] @ cov @ axes[:, 0], 0.0))
    pose[0], pose[1], pose[2] = mean[0], mean[1], mean[2] / rs
    info[8] = log_likelihood(edges, pose, p, d, r, start, eye, off, lim, sigma, table, scale, rho, face)


@njit(**_JIT)
def _two_orientations(edges: Array, face: Ints, r: Array) -> bool:
    """Whether the returns lie on faces that differ by more than 20 degrees."""
    ref = -1
    for k in range(face.shape[0]):
        if face[k] < 0 or r[k] < 0.0:
            continue
        if ref < 0:
            ref = face[k]
        elif edges[ref, 4] * edges[face[k], 4] + edges[ref, 5] * edges[face[k], 5] < 0.94:
            return True
    return False


@njit(**_JIT)
def _conditional_step(
    args: tuple[Any, ...],
    q: Array,
    axes: Array,
    s: float,
    w: Array,
    P2: Array,
    graze: float,
    rho: Array,
    face: Ints,
    H: Array,
    g: Array,
    pose: Array,
    L: Array,
) -> None:
    """One Gauss-Newton step of w at fixed s; L becomes the Cholesky factor of its information."""
    edges, rs, p, d, r, start, eye, _, lim, sigma, amplitude, _, _, _, pinv = args
    _pose_at(q, axes, s, w[0], w[1], rs, pose)
    normal_equations(edges, pose, rs, p, d, r, start, eye, lim, sigma, amplitude, graze, rho, face, H, g)
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


@njit(**_JIT)
def _integrate(
    args: tuple[Any, ...],
    q: Array,
    axes: Array,
    lo: float,
    hi: float,
    cells: int,
    w: Array,
    best: Array,
    step: float,
    mid: int,
    top: float,
    P2: Array,
    graze: float,
    mixed: bool,
    mean: Array,
    cov: Array,
    info: Array,
) -> None:
    """Moments by midpoints along u and Gauss-Hermite across (METHOD, section 4, step 8)."""
    edges, rs, p, d, r, start, eye, off, lim, sigma, _, table, scale, prior, _ = args
    if mixed:
        xs = np.array([0.0, 1.3556261799742659, -1.3556261799742659, 2.8569700138728056, -2.8569700138728056])
        lw = np.log(
            np.array(
                [8.0 / 15.0, 0.2220759220056126, 0.2220759220056126, 0.0112574113277207, 0.0112574113277207]
            )
        )
    else:
        xs = np.array([0.0, math.sqrt(3.0), -math.sqrt(3.0)])
        lw = np.log(np.array([2.0 / 3.0, 1.0 / 6.0, 1.0 / 6.0]))
    if hi - lo > 0.008:
        cells *= 2
    n = p.shape[0]
    rho = np.empty(n)
    face = np.empty(n, np.int64)
    H, g, pose = np.empty((3, 3)), np.empty(3), np.empty(3)
    wc, L = np.empty(2), np.empty((2, 2))
    m = xs.shape[0]
    h = (hi - lo) / cells
    values = np.empty(cells * m * m)
    points = np.empty((cells * m * m, 4))
    count = 0
    mode = -np.inf
    for c in range(cells):
        s = lo + (c + 0.5) * h
        x = s / step + mid
        i = min(max(int(x), 0), w.shape[0] - 2)
        f = x - i
        if max(best[i], best[i + 1]) < top - 12.0:
            continue
        wc[0] = w[i, 0] + f * (w[i + 1, 0] - w[i, 0])
        wc[1] = w[i, 1] + f * (w[i + 1, 1] - w[i, 1])
        _conditional_step(args, q, axes, s, wc, P2, graze, rho, face, H, g, pose, L)
        base = math.log(2.0 * math.pi * h) - math.log(L[0, 0] * L[1, 1])
        for a in range(m):
            for b in range(m):
                y1 = xs[b] / L[1, 1]
                y0 = (xs[a] - L[1, 0] * y1) / L[0, 0]
                _pose_at(q, axes, s, wc[0] + y0, wc[1] + y1, rs, pose)
                value = log_likelihood(
                    edges, pose, p, d, r, start, eye, off, lim, sigma, table, scale, rho, face
                ) + _log_prior(pose, prior)
                mode = max(mode, value)
                values[count] = value + 0.5 * (xs[a] * xs[a] + xs[b] * xs[b]) + lw[a] + lw[b] + base
                points[count, 0], points[count, 1], points[count, 2] = pose[0], pose[1], pose[2] * rs
                points[count, 3] = s
                count += 1
    peak = values[:count].max()
    total = 0.0
    mean[:] = 0.0
    cov[:] = 0.0
    for k in range(count):
        values[k] = math.exp(values[k] - peak)
        total += values[k]
        for i in range(3):
            mean[i] += values[k] * points[k, i]
    mean /= total
    for k in range(count):
        for i in range(3):
            for j in range(3):
                cov[i, j] += values[k] / total * (points[k, i] - mean[i]) * (points[k, j] - mean[j])
    for i in range(3):
        for j in range(3):
            cov[i, j] += h * h / 12.0 * axes[i, 0] * axes[j, 0]
    info[0] = peak + math.log(total)
    info[9] = mode
    _rival(values, points, count, total, lo, h, cells, info)


@njit(**_JIT)
def _rival(
    values: Array, points: Array, count: int, total: float, lo: float, h: float, cells: int, info: Array
) -> None:
    """Mass more than 3 mm from the mode along the weak axis, and where most of it lies."""
    mass = np.zeros(cells)
    for k in range(count):
        mass[min(int((points[k, 3] - lo) / h), cells - 1)] += values[k] / total
    top = int(np.argmax(mass))
    rival, centre = 0.0, 0.0
    for c in range(cells):
        if abs(c - top) * h > 0.003:
            rival += mass[c]
            centre += mass[c] * (c - top) * h
    info[6] = rival
    info[7] = centre / rival if rival > 0.0 else 0.0
