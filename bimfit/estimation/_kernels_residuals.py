"""Residual figures of one component in one pass (METHOD, section 5); calls no kernel of another file."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from bimfit._kernels import jit
from bimfit.geometry.pose import Array

Ints = NDArray[np.int64]
Mask = NDArray[np.bool_]

GRAZING = 0.3
ENDS = 6
FIGURES = 22
DOZEN = 12
"""A face with more returns than that holds, whatever else is lost on it."""
LEAST = 4
_RARE = 7.6
"""-log of a chance of 1 in 2,000."""
_FALSE = 0.4


@jit
def longest_run(flags: Mask) -> int:
    """Length of the longest unbroken run of True."""
    best = run = 0
    for k in range(flags.shape[0]):
        run = run + 1 if flags[k] else 0
        best = max(best, run)
    return best


@jit
def excused(r: float, rho: float, sd: float, cosine: float, sigma: float) -> bool:
    """Whether a grazing return says nothing about the shape: the pose's uncertainty explains its misfit.

    ``sd`` is how far that uncertainty moves the predicted range, ``cosine`` n.d.
    """
    explained = abs(r - rho) < 4.0 * math.hypot(sd, sigma)
    return cosine > -GRAZING and sd > sigma and r > 0.0 and explained


@jit
def range_sd(
    nx: float, ny: float, dx: float, dy: float, ax: float, ay: float, cov: Array
) -> tuple[float, float]:
    """How far a pose's uncertainty moves a predicted range, to first order, and n.d.

    sqrt(g C g^T) with g = [n, n x (p - pivot)] / (n.d) (METHOD, section 4, step 5); (ax, ay) = p - pivot.
    """
    c = min(nx * dx + ny * dy, -1e-6)
    g0, g1, g2 = nx / c, ny / c, (ny * ax - nx * ay) / c
    v = g0 * (cov[0, 0] * g0 + 2.0 * cov[0, 1] * g1 + 2.0 * cov[0, 2] * g2)
    v += g1 * (cov[1, 1] * g1 + 2.0 * cov[1, 2] * g2) + g2 * cov[2, 2] * g2
    return math.sqrt(max(v, 0.0)), c


@jit
def residuals(
    which: int, edges: Array, pose: Array, pivot: Array, cov: Array, ranges: Array, edges_met: Ints,
    side: Ints, usable: Mask, B: Array, start: Ints, eye: Array, spacing: float, sigma: float, spread: Array,
    sensor: Array,
) -> tuple[Array, Array, Array, Array, Array, Ints]:  # fmt: skip
    """Residuals of the returns on a component, and what they say of it.

    Parameters
    ----------
    which : int
        0 for A, 1 for B.
    edges, pose : (m, 6) and (3,)
        Of the designed component, and where it is.
    pivot, cov : (2,) and (3, 3)
        Its covariance about the pivot, for grazing returns.
    ranges, edges_met : (2, n)
        Range to each component and the edge met; the one may hide the other.
    side, usable : (n,)
        Whose each beam is, and whether it may speak.
    B : (4 or more, n or more)
        Beams: pseudo-angle, direction, range.
    spread : (n,) or (0,)
        How many times ``sigma`` each range deviates; residuals are brought to ``sigma``.
    sensor : (3,)
        Share of beams that return nothing or from elsewhere, how many neighbours do so together, and the
        greatest standard deviation, m, that a direction of the pose may have and still be fixed.

    Returns
    -------
    figures : (FIGURES,)
        Beams, covered, inliers, rms, chi2, outlier share, miss share, their longest runs, cumulated
        range, lag 1, unexplained, edge; in the order of :class:`~bimfit.estimation.result.Residuals`; then
        excused returns, and of a face that the pose depends on without support: the edge (-1: none), its
        beams and inliers, and the direction that depends on it, in (u, v, theta * radius).
    z, places, feet, lean, faces : (k,), (k, 2), (k, 2), (k,), (k,)
        Of the inliers; see :class:`~bimfit.estimation.result.Residuals`.
    """
    n = side.shape[0]
    out, z, lean = np.empty(FIGURES), np.empty(n), np.empty(n)
    places, feet, faces = np.empty((n, 2)), np.empty((n, 2)), np.empty(n, np.int64)
    rho, other, face, r = ranges[which], ranges[1 - which], edges_met[which], B[3]
    cos, sin = math.cos(pose[2]), math.sin(pose[2])
    used, stray, missed = np.empty(n, np.bool_), np.empty(n, np.bool_), np.empty(n, np.bool_)
    held = np.zeros((edges.shape[0], 3), np.int64)
    beams = covered = quiet_all = quiet = count = strays = misses = 0
    for q in range(eye.shape[0]):
        for k in range(start[q], start[q + 1]):
            used[k] = side[k] == which and usable[k] and not other[k] < rho[k]
            if not used[k]:
                continue
            beams += 1
            e = face[k]
            if e < 0:
                continue
            dx, dy = B[1, k], B[2, k]
            x, y = eye[q, 0] + dx * rho[k], eye[q, 1] + dy * rho[k]
            nx = cos * edges[e, 4] - sin * edges[e, 5]
            ny = sin * edges[e, 4] + cos * edges[e, 5]
            own = sigma * spread[k] if spread.shape[0] > 0 else sigma
            sd, c = range_sd(nx, ny, dx, dy, x - pivot[0], y - pivot[1], cov)
            misfit = r[k] - rho[k]
            if excused(r[k], rho[k], sd, c, own):
                quiet_all += 1
                quiet += int(abs(misfit) < 4.0 * own)
                continue
            inlier = r[k] > 0.0 and abs(misfit) < 4.0 * own
            stray[covered], missed[covered] = r[k] > 0.0 and not inlier, not r[k] > 0.0
            strays += int(stray[covered])
            misses += int(missed[covered])
            covered += 1
            if c < -GRAZING:
                held[e, 0] += 1
                held[e, 1] += int(inlier)
                held[e, 2] += int(r[k] > 0.0 and not inlier)
            if inlier:
                z[count], lean[count], faces[count] = misfit * (sigma / own), c * (own / sigma), e
                feet[count, 0], feet[count, 1] = x, y
                places[count, 0] = eye[q, 0] + dx * r[k]
                places[count, 1] = eye[q, 1] + dy * r[k]
                count += 1
    square, mean = 0.0, 0.0
    for i in range(count):
        square += z[i] * z[i]
        mean += z[i] / count
    out[0], out[1], out[2] = beams, covered + quiet, count + quiet
    out[3] = math.sqrt(square / count) if count else np.nan
    out[4] = square / (sigma * sigma) / max(count - 2.2, 1.0) if count else np.nan
    out[5] = strays / covered if covered else 0.0
    out[6] = misses / covered if covered else 0.0
    out[7], out[8] = longest_run(stray[:covered]), longest_run(missed[:covered])
    out[9] = _cumulated(z[:count], mean, sigma)
    out[10] = 0.0
    if count > 3:
        lag = 0.0
        for i in range(count - 1):
            lag += z[i + 1] * z[i]
        out[10] = lag / (count - 1) / max(square / count, 1e-30)
    out[11] = _continues(edges, cos, sin, rho, face, used, B, start, spacing, sigma)
    out[12] = _edge_drop(z[:count], faces[:count], edges.shape[0], sigma)
    out[13] = quiet_all
    out[14] = -1.0
    doubted = _least_supported(held, sensor[0], sensor[1])
    if doubted >= 0 and _depends(
        edges, cos, sin, pivot, rho, face, used, B, start, eye, sigma, spread, doubted, sensor[2], out[17:]
    ):
        out[14], out[15], out[16] = doubted, held[doubted, 0], held[doubted, 1]
    return out, z[:count], places[:count], feet[:count], lean[:count], faces[:count]


@jit
def _least_supported(held: Ints, lost: float, together: float) -> int:
    """The face whose lost returns are least likely to be chance, -1 where all are likely enough.

    Few returns on a face say that it is there as long as what is missing or false among them is what the
    sensor loses anyway. The chance of x lost of n is at most exp(-n KL(x / n | share)) (Chernoff); what is
    lost in runs counts once a run. ``held`` (m, 3): beams, inliers and strays a face.
    """
    worst, found = _RARE, -1
    for e in range(held.shape[0]):
        n, good, strays = held[e, 0], held[e, 1], held[e, 2]
        if n < LEAST or good > DOZEN:
            continue
        x = (n - good) / n
        if x > lost:
            gain = x * math.log(x / lost)
            if x < 1.0:
                gain += (1.0 - x) * math.log((1.0 - x) / (1.0 - lost))
            surprise = n * gain / together
            if together > 1.0 and good < _FALSE * (good + strays):
                surprise += _RARE
            if surprise > worst:
                worst, found = surprise, e
    return found


@jit
def _depends(
    edges: Array, cos: float, sin: float, pivot: Array, rho: Array, face: Ints, used: Mask, B: Array,
    start: Ints, eye: Array, sigma: float, spread: Array, doubted: int, most: float, axis: Array,
) -> bool:  # fmt: skip
    """Whether the returns on all other faces leave a direction open that the face ``doubted`` would fix.

    By Fisher information of ranges (METHOD, section 5): of the others' returns, and of all the beams that
    should meet the face. ``axis`` (3 or more,) gets the direction.
    """
    rest, own = np.zeros((3, 3)), np.zeros((3, 3))
    g = np.empty(3)
    square, count = 0.0, 0
    for both in range(2):
        radius = math.sqrt(square / max(count, 1)) if both else 1.0
        for q in range(eye.shape[0]):
            for k in range(start[q], start[q + 1]):
                e = face[k]
                if not used[k] or e < 0:
                    continue
                nx = cos * edges[e, 4] - sin * edges[e, 5]
                ny = sin * edges[e, 4] + cos * edges[e, 5]
                c = nx * B[1, k] + ny * B[2, k]
                if c > -GRAZING:
                    continue
                x, y = eye[q, 0] + B[1, k] * rho[k] - pivot[0], eye[q, 1] + B[2, k] * rho[k] - pivot[1]
                if not both:
                    square, count = square + x * x + y * y, count + 1
                    continue
                g[0], g[1], g[2] = nx / c, ny / c, (ny * x - nx * y) / (c * radius)
                own_sigma = sigma * spread[k] if spread.shape[0] > 0 else sigma
                for i in range(3):
                    for j in range(3):
                        add = g[i] * g[j] / (own_sigma * own_sigma)
                        if e == doubted:
                            own[i, j] += add
                        elif B[3, k] > 0.0 and abs(B[3, k] - rho[k]) < 4.0 * own_sigma:
                            rest[i, j] += add
    if count == 0:
        return False
    values, axes = np.linalg.eigh(rest)
    least = 1.0 / (most * most)
    axis[0], axis[1], axis[2] = axes[0, 0], axes[1, 0], axes[2, 0]
    would = 0.0
    for i in range(3):
        for j in range(3):
            would += axis[i] * own[i, j] * axis[j]
    return values[0] < least and would > least


@jit
def _cumulated(z: Array, mean: float, sigma: float) -> float:
    """Range of the cumulated standardised residuals over sqrt(n): bends and wrong shapes show here."""
    n = z.shape[0]
    if n <= 3:
        return 0.0
    low = high = walk = square = 0.0
    for i in range(n):
        walk += z[i] - mean
        low, high = min(low, walk), max(high, walk)
        square += (z[i] - mean) ** 2
    return (high - low) / max(math.sqrt(square / n), sigma) / math.sqrt(n)


@jit
def _edge_drop(z: Array, faces: Ints, names: int, sigma: float) -> float:
    """How far the last returns at either end of the main face lie behind it, in standard deviations."""
    n = z.shape[0]
    if n < 12:
        return 0.0
    counts = np.zeros(names, np.int64)
    for i in range(n):
        counts[faces[i]] += 1
    name = np.argmax(counts)
    main = z[faces == name]
    m = main.shape[0]
    worst = -np.inf
    for end in range(2):
        total = 0.0
        for i in range(min(ENDS, m)):
            total += main[i] if end == 0 else main[m - 1 - i]
            worst = max(worst, total / math.sqrt(i + 1.0))
    return max(worst, 0.0) / max(sigma, float(main.std()) * 0.8)


@jit
def _continues(
    edges: Array, cos: float, sin: float, rho: Array, face: Ints, used: Mask, B: Array, start: Ints,
    spacing: float, sigma: float,
) -> int:  # fmt: skip
    """Returns that carry a face on past where it should end: the edge is not shaped as designed.

    From the last beam on a face that is not seen grazing, beams count that return from within four deviations
    of the face's own line, the first that does not ends it. What lies behind the component is none of it, and
    beams that should meet another face of it do not count.
    """
    longest = 0
    for g in range(start.shape[0] - 1):
        s, t = start[g], start[g + 1]
        low, high = t, s - 1
        for k in range(s, t):
            e = face[k]
            if not used[k] or e < 0:
                continue
            nx, ny = cos * edges[e, 4] - sin * edges[e, 5], sin * edges[e, 4] + cos * edges[e, 5]
            if nx * B[1, k] + ny * B[2, k] < -GRAZING:
                low, high = min(low, k), k
        if high < s:
            continue
        for end in range(2):
            first, step = (low, -1) if end == 0 else (high, 1)
            e = face[first]
            nx, ny = cos * edges[e, 4] - sin * edges[e, 5], sin * edges[e, 4] + cos * edges[e, 5]
            level = rho[first] * (nx * B[1, first] + ny * B[2, first])
            near = max(4.0 * sigma, spacing * rho[first])
            count, k = 0, first + step
            while s <= k < t and used[k] and B[3, k] > 0.0:
                if abs(B[3, k] * (nx * B[1, k] + ny * B[2, k]) - level) > near:
                    break
                count += int(face[k] < 0)
                k += step
            longest = max(longest, count)
    return longest
