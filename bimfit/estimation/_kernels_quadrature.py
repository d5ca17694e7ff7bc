"""Moments of a posterior: quadrature along its profile, or samples where that cannot resolve it."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from bimfit._kernels import jit
from bimfit.estimation._kernels_likelihood import log_likelihood, scratch
from bimfit.estimation._kernels_steps import conditional_step, log_prior, pose_at
from bimfit.geometry.pose import Array

NEGLIGIBLE = 12.0
"""What is so much less likely than the best is left out of the integral. The nodes of a profile are too rough
for a sharper cut: at 7, tails were lost on one side, and a groove sat 0.03 mm deep."""


@jit
def integrate(
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
    mixed: bool,
    mean: Array,
    cov: Array,
    info: Array,
) -> None:
    """Moments by midpoints along u and Gauss-Hermite across (METHOD, section 4, step 8)."""
    xs, lw = _rule(mixed)
    if hi - lo > 0.008:
        cells *= 2
    nodes = xs.shape[0] ** 2
    values, points, mass = np.empty(cells * nodes), np.empty((cells * nodes, 4)), np.empty(cells)
    count, h, mode = 0, 0.0, -np.inf
    for _ in range(4):
        h = (hi - lo) / cells
        count, mode = _nodes(args, q, axes, lo, h, cells, w, best, step, mid, top, P2, xs, lw, values, points)
        few, lo, hi = _narrowed(values, points, count, lo, h, mass)
        if not few:
            break
        lo, hi = max(lo, -mid * step), min(hi, mid * step)
    info[9] = mode
    total = _gathered(values, points, count, xs, mean, cov, info)
    for i in range(3):
        for j in range(3):
            cov[i, j] += h * h / 12.0 * axes[i, 0] * axes[j, 0]
    _rival(values, points, count, total, h, info)


@jit
def _rule(mixed: bool) -> tuple[Array, Array]:
    """Gauss-Hermite nodes and log weights: five where faces of several orientations are seen, else three."""
    if mixed:
        xs = np.array([0.0, 1.3556261799742659, -1.3556261799742659, 2.8569700138728056, -2.8569700138728056])
        far, farther = 0.2220759220056126, 0.0112574113277207
        return xs, np.log(np.array([8.0 / 15.0, far, far, farther, farther]))
    return np.array([0.0, math.sqrt(3.0), -math.sqrt(3.0)]), np.log(
        np.array([2.0 / 3.0, 1.0 / 6.0, 1.0 / 6.0])
    )


@jit
def _nodes(
    args: tuple[Any, ...], q: Array, axes: Array, lo: float, h: float, cells: int, w: Array, best: Array,
    step: float, mid: int, top: float, P2: Array, xs: Array, lw: Array, values: Array, points: Array,
) -> tuple[int, float]:  # fmt: skip
    """Log masses and places (tx, ty, theta * rs, s) of all nodes that count; how many, and the mode."""
    edges, rs, B, start, eye, margin, bearing, prior, _ = args
    lines, runs = scratch(edges, eye)
    H, g, pose = np.empty((3, 3)), np.empty(3), np.empty(3)
    wc, L = np.empty(2), np.empty((2, 2))
    m = xs.shape[0]
    count, mode = 0, -np.inf
    for c in range(cells):
        s = lo + (c + 0.5) * h
        x = s / step + mid
        i = min(max(int(x), 0), w.shape[0] - 2)
        f = x - i
        if max(best[i], best[i + 1]) < top - NEGLIGIBLE:
            continue
        wc[0] = w[i, 0] + f * (w[i + 1, 0] - w[i, 0])
        wc[1] = w[i, 1] + f * (w[i + 1, 1] - w[i, 1])
        conditional_step(args, q, axes, s, wc, P2, lines, runs, H, g, pose, L)
        base = math.log(2.0 * math.pi * h) - math.log(L[0, 0] * L[1, 1])
        for a in range(m):
            for b in range(m):
                y1 = xs[b] / L[1, 1]
                y0 = (xs[a] - L[1, 0] * y1) / L[0, 0]
                pose_at(q, axes, s, wc[0] + y0, wc[1] + y1, rs, pose)
                value = log_likelihood(edges, pose, B, start, eye, margin, bearing, lines, runs)
                value += log_prior(pose, prior)
                mode = max(mode, value)
                values[count] = value + 0.5 * (xs[a] * xs[a] + xs[b] * xs[b]) + lw[a] + lw[b] + base
                points[count, 0], points[count, 1], points[count, 2] = pose[0], pose[1], pose[2] * rs
                points[count, 3] = s
                count += 1
    return count, mode


@jit
def _gathered(
    values: Array, points: Array, count: int, xs: Array, mean: Array, cov: Array, info: Array
) -> float:
    """Mean, covariance, evidence, effective nodes; log masses become masses, whose sum is given back."""
    peak = values[:count].max()
    total = square = x0 = x1 = x2 = 0.0
    for k in range(count):
        v = math.exp(values[k] - peak)
        values[k] = v
        total += v
        square += v * v
        x0 += v * points[k, 0]
        x1 += v * points[k, 1]
        x2 += v * points[k, 2]
    mean[0], mean[1], mean[2] = x0 / total, x1 / total, x2 / total
    c00 = c01 = c02 = c11 = c12 = c22 = across0 = across1 = 0.0
    m = xs.shape[0]
    for k in range(count):
        v = values[k] / total
        d0, d1, d2 = points[k, 0] - mean[0], points[k, 1] - mean[1], points[k, 2] - mean[2]
        c00 += v * d0 * d0
        c01 += v * d0 * d1
        c02 += v * d0 * d2
        c11 += v * d1 * d1
        c12 += v * d1 * d2
        c22 += v * d2 * d2
        j = k % (m * m)
        across0 += v * xs[j // m] ** 2
        across1 += v * xs[j % m] ** 2
    cov[0, 0], cov[0, 1], cov[0, 2] = c00, c01, c02
    cov[1, 0], cov[1, 1], cov[1, 2] = c01, c11, c12
    cov[2, 0], cov[2, 1], cov[2, 2] = c02, c12, c22
    info[0] = peak + math.log(total)
    # where the conditional frame is far too wide, its nodes step over the posterior
    info[10] = 0.0 if across0 < 0.35 or across1 < 0.35 else total * total / square
    return total


@jit
def _narrowed(
    values: Array, points: Array, count: int, lo: float, h: float, mass: Array
) -> tuple[bool, float, float]:
    """Whether the mass lies in so few cells that they must be made finer, and the range to look at then.

    A component whose two ends are both seen is pinned to a fraction of a beam's spacing, far less than
    the range that the profile's nodes leave open.
    """
    peak = values[:count].max()
    mass[:] = 0.0
    for k in range(count):
        i = min(int((points[k, 3] - lo) / h), mass.shape[0] - 1)
        mass[i] += math.exp(values[k] - peak)
    floor = 1e-3 * mass.max()
    first, final, filled = mass.shape[0], -1, 0
    for i in range(mass.shape[0]):
        if mass[i] > floor:
            first, final, filled = min(first, i), max(final, i), filled + 1
    narrow = (final - first) < mass.shape[0] // 4
    if not narrow:
        return False, lo, lo + h * mass.shape[0]
    return True, lo + (first - 1.0) * h, lo + (final + 2.0) * h


@jit
def _rival(values: Array, points: Array, count: int, total: float, h: float, info: Array) -> None:
    """Mass more than 3 mm from the mode along the weak axis and beyond a valley, and where most of it lies.

    What hangs together with the mode, as the whole cell between two beams that an edge may lie in, is
    width and no rival: the covariance tells it.
    """
    cells = int((points[count - 1, 3] - points[0, 3]) / h + 0.5) + 1
    lo = points[0, 3] - 0.5 * h
    mass = np.zeros(cells)
    for k in range(count):
        mass[min(int((points[k, 3] - lo) / h), cells - 1)] += values[k] / total
    top = int(np.argmax(mass))
    rival, centre = 0.0, 0.0
    for side in (-1, 1):
        valley, c = mass[top], top + side
        while 0 <= c < cells:
            valley = min(valley, mass[c])
            # a valley for those beyond it: a spike at the end of a plain makes no rival of the plain
            if valley < 0.1 * mass[c] and abs(c - top) * h > 0.003:
                rival += mass[c]
                centre += mass[c] * (c - top) * h
            c += side
    info[6] = rival
    info[7] = centre / rival if rival > 0.0 else 0.0


@jit
def sample(
    args: tuple[Any, ...], q: Array, H: Array, axes: Array, draws: Array, mean: Array, cov: Array, info: Array
) -> None:
    """Tempered importance sampling, for posteriors much narrower than the ranges' information says.

    Returns that graze a deep face, or two visible ends, can pin a component to a sliver that lies askew
    to the weak direction. The likelihood is raised to a power that grows to 1 as the proposal adapts.
    """
    edges, rs, B, start, eye, margin, bearing, prior, _ = args
    n = draws.shape[0]
    lines, runs = scratch(edges, eye)
    pose = np.empty(3)
    centre = q.copy()
    shape = 2.0 * np.linalg.inv(H)
    x, target, before, w = np.empty((n, 3)), np.empty(n), np.empty(n), np.empty(n)
    power, calm = 0.0, 0
    for _ in range(30):
        L = np.linalg.cholesky(shape)
        log_det = math.log(L[0, 0] * L[1, 1] * L[2, 2])
        for i in range(n):
            for a in range(3):
                x[i, a] = centre[a]
                for b in range(a + 1):
                    x[i, a] += L[a, b] * draws[i, b]
            pose[0], pose[1], pose[2] = x[i, 0], x[i, 1], x[i, 2] / rs
            target[i] = log_likelihood(edges, pose, B, start, eye, margin, bearing, lines, runs)
            before[i] = log_prior(pose, prior)
        low, power = power, 1.0
        for _ in range(12):
            if _weights(target, before, draws, power, w) >= 0.12 * n:
                break
            power = low + 0.5 * (power - low)
        effective = _weights(target, before, draws, power, w)
        _moments(x, w, mean, cov)
        centre[:] = mean
        shape = 1.5 * cov + 0.01 * shape  # never degenerate, however few samples count
        if power == 1.0:
            calm += 1
            if calm == 2:
                break
    peak = -np.inf
    for i in range(n):
        target[i] += before[i]
        peak = max(peak, target[i])
    total = 0.0
    for i in range(n):
        total += math.exp(target[i] - draws[i, 3] - peak)
    info[0] = peak + math.log(total / n) + log_det
    info[9] = peak
    info[10] = effective
    info[11] = 1.0
    info[6] = 0.0
    best, at = 0, -np.inf
    for i in range(n):
        if target[i] > at:
            best, at = i, target[i]
    for i in range(n):
        away = 0.0
        for a in range(3):
            away += (x[i, a] - x[best, a]) * axes[a, 0]
        if abs(away) > 0.003:
            info[6] += w[i]
            info[7] = away


@jit
def _weights(target: Array, before: Array, draws: Array, power: float, w: Array) -> float:
    """Normalised importance weights at a power of the target, and their effective number."""
    top = -np.inf
    for i in range(w.shape[0]):
        w[i] = power * target[i] + before[i] - draws[i, 3]
        top = max(top, w[i])
    total = square = 0.0
    for i in range(w.shape[0]):
        w[i] = math.exp(w[i] - top)
        total += w[i]
        square += w[i] * w[i]
    for i in range(w.shape[0]):
        w[i] /= total
    return total * total / square


@jit
def _moments(x: Array, w: Array, mean: Array, cov: Array) -> None:
    mean[:] = 0.0
    cov[:] = 0.0
    for i in range(w.shape[0]):
        for a in range(3):
            mean[a] += w[i] * x[i, a]
    for i in range(w.shape[0]):
        for a in range(3):
            for b in range(3):
                cov[a, b] += w[i] * (x[i, a] - mean[a]) * (x[i, b] - mean[b])
