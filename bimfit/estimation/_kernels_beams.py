"""Beams sorted for the kernels, the ranges that edges predict for them, and what covering each costs.

Beams come sorted by pseudo-angle within groups of one origin each, as arrays:

``p``      pseudo-angle of the direction in the group's own axes, ascending within a group
``d``      (2, n) unit directions;  ``r`` (n,) ranges, negative where nothing came back
``start``  (g + 1,) first beam of every group;  ``eye`` (g, 4) origin and look direction of every group

The likelihood takes them as one array ``B`` (9, n + PAD), whose rows are p, the two of d, and then r; OFF,
which is added to the log-likelihood whenever the beam is predicted to meet the component; DEEP, besides when
its return lies more than ``margin`` behind the component; LIMIT, the range at which something else is in the
way; INVERSE, 1 / sigma of its range; TOP, log A, the log-odds of a return on the spot against an outlier
there. The last PAD columns are 0, so that sums may go by whole vectors. No arithmetic that assumes that inf
does not exist: misses rely on it.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from bimfit._kernels import jit
from bimfit.geometry.pose import Array

Ints = NDArray[np.int64]
Mask = NDArray[np.bool_]

RANGE, OFF, DEEP, LIMIT, INVERSE, TOP = 3, 4, 5, 6, 7, 8
STEEP = 0.3
NEVER = 1 << 40
PAD = 8


@jit
def pseudo_angle(x: float, y: float) -> float:
    """Grows with atan2(y, x), from -2 to 2, without trigonometry."""
    size = abs(x) + abs(y)
    if size == 0.0:
        return 0.0
    q = y / size
    if x >= 0.0:
        return q
    return 2.0 - q if y >= 0.0 else -2.0 - q


@jit
def lower(rays: Array, lo: int, hi: int, value: float) -> int:
    """First index in [lo, hi) whose pseudo-angle, the first row of ``rays``, is at least value."""
    while lo < hi:
        mid = (lo + hi) >> 1
        if rays[0, mid] < value:
            lo = mid + 1
        else:
            hi = mid
    return lo


@jit
def _nearer(
    nx: float, ny: float, c: float, e: int, rays: Array, begin: int, end: int, rho: Array, face: Ints
) -> None:
    """Lower rho over a stretch of beams; no branches, so that it becomes vector code."""
    # unsigned: an index that could be negative would keep LLVM from vectorising
    for k in range(np.uint64(begin), np.uint64(end)):
        x = c / (nx * rays[1, k] + ny * rays[2, k])
        old = rho[k]
        nearer = (x < old) & (x > 0.0)
        rho[k] = x if nearer else old
        face[k] = e if nearer else face[k]


@jit
def predict(
    edges: Array,
    cos: float,
    sin: float,
    tx: float,
    ty: float,
    rays: Array,
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
    rays : (3 or more, n)
        Pseudo-angle and direction of every beam.
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
                i0, i1, j1 = lower(rays, s, t, low), lower(rays, s, t, high), s
            else:  # the edge lies across the cut behind the sensor
                i0, i1, j1 = lower(rays, s, t, low), t, lower(rays, s, t, high)
            _nearer(nx, ny, c, e, rays, i0, i1, rho, face)
            if j1 > s:
                _nearer(nx, ny, c, e, rays, s, j1, rho, face)


@jit
def whole_beams(o: Array, d: Array, near: float) -> tuple[Ints, bool]:
    """Beams whose origin and direction are numbers, and whether their origins all but coincide."""
    whole = np.empty(o.shape[0], np.int64)
    count, one = 0, True
    for k in range(o.shape[0]):
        if np.isfinite(o[k, 0]) and np.isfinite(o[k, 1]) and np.isfinite(d[k, 0]) and np.isfinite(d[k, 1]):
            whole[count] = k
            count += 1
            away = max(abs(o[k, 0] - o[whole[0], 0]), abs(o[k, 1] - o[whole[0], 1]))
            one = one and not away > near
    return whole[:count], one


@jit
def sort_beams(
    o: Array, d: Array, r: Array, whole: Ints, group: Ints, count: int, missing: float
) -> tuple[Array, Array, Ints, Array, Ints]:
    """Order beams by group and pseudo-angle about their group's mean direction.

    Parameters
    ----------
    whole, group : (n,)
        Which beams there are, and the group of each.
    missing : float
        Range that stands for one that is not finite.

    Returns
    -------
    rays, ranges, start, eye, order
        As in :class:`~bimfit.estimation.likelihood.BeamSet`.
    """
    n = whole.shape[0]
    eye, start, key = np.zeros((count, 4)), np.zeros(count + 1, np.int64), np.empty(n)
    for i in range(n):
        g, k = group[i], whole[i]
        start[g + 1] += 1
        eye[g, 0] += o[k, 0]
        eye[g, 1] += o[k, 1]
        eye[g, 2] += d[k, 0]
        eye[g, 3] += d[k, 1]
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
    for i in range(n):
        k, lx, ly = whole[i], eye[group[i], 2], eye[group[i], 3]
        key[i] = pseudo_angle(lx * d[k, 0] + ly * d[k, 1], lx * d[k, 1] - ly * d[k, 0])
    rank = np.argsort(key + 8.0 * group)
    rays, ranges, order = np.empty((3, n)), np.empty(n), np.empty(n, np.int64)
    for i in range(n):
        k = whole[rank[i]]
        order[i] = k
        rays[0, i], rays[1, i], rays[2, i] = key[rank[i]], d[k, 0], d[k, 1]
        ranges[i] = r[k] if np.isfinite(r[k]) else missing
    return rays, ranges, start, eye, order


@jit
def usual_step(step: Array) -> float:
    """The step that half of the whole length is made of: each counts by its length; 0 without any."""
    if step.shape[0] == 0:
        return 0.0
    ordered = np.sort(step)
    half = 0.5 * ordered.sum()
    total = 0.0
    for k in range(ordered.shape[0]):
        total += ordered[k]
        if total >= half:
            return float(ordered[k])
    return float(ordered[-1])


@jit
def beam_spacing(d: Array) -> float:
    """Usual angle between neighbouring beams that differ at all, rad; 0 for none."""
    n = d.shape[1]
    step = np.empty(max(n - 1, 1))
    count = 0
    for k in range(n - 1):
        x = abs(d[0, k + 1] * d[1, k] - d[1, k + 1] * d[0, k])
        if x > 1e-7:
            step[count] = x
            count += 1
    return float(usual_step(step[:count]))


@jit
def table(
    rays: Array, r: Array, scale: Array, inverse: float, top: float, miss: float, past: float, same: float
) -> Array:
    """Beams as the likelihood takes them when nothing is known of the other component.

    Covering a beam costs ``miss`` where it returned nothing, ``past`` where it went past: only a return that
    a neighbour bears out, within ``same``, may have come from behind.

    Parameters
    ----------
    scale : (n,) or (0,)
        How many times the sigma of ``inverse`` and ``top`` each beam has.
    """
    n = r.shape[0]
    B = np.zeros((TOP + 1, n + PAD))
    for k in range(n):
        B[0, k], B[1, k], B[2, k], B[RANGE, k] = rays[0, k], rays[1, k], rays[2, k], r[k]
        B[OFF, k] = miss if r[k] < 0.0 else 0.0
        if r[k] > 0.0:
            before = k > 0 and r[k - 1] > 0.0 and abs(r[k] - r[k - 1]) < same
            after = k + 1 < n and r[k + 1] > 0.0 and abs(r[k + 1] - r[k]) < same
            if before or after:
                B[DEEP, k] = past
        B[LIMIT, k] = np.inf
        B[INVERSE, k], B[TOP, k] = inverse, top
        if scale.shape[0] > 0:
            B[INVERSE, k] /= scale[k]
            B[TOP, k] -= math.log(scale[k])
    return B


@jit
def taken(B: Array, start: Ints, use: Mask) -> tuple[Array, Ints]:
    """The beams in ``use``, padded again; groups left empty stay."""
    n = 0
    for k in range(use.shape[0]):
        n += int(use[k])
    out, begin = np.zeros((B.shape[0], n + PAD)), np.empty(start.shape[0], np.int64)
    i = 0
    for g in range(start.shape[0] - 1):
        begin[g] = i
        for k in range(start[g], start[g + 1]):
            if use[k]:
                for j in range(B.shape[0]):
                    out[j, i] = B[j, k]
                i += 1
    begin[start.shape[0] - 1] = i
    return out, begin
