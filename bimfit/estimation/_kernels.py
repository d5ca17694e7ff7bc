"""Every numba function of the estimation room: predicted ranges, beam likelihood, slide, quadrature.

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
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bimfit._kernels import jit, jit_inner, jit_inner_sums, jit_sums
from bimfit.geometry.pose import Array

Ints = NDArray[np.int64]
Mask = NDArray[np.bool_]

RANGE, OFF, DEEP, LIMIT, INVERSE, TOP = 3, 4, 5, 6, 7, 8
STEEP = 0.3
NEGLIGIBLE = 12.0
"""What is so much less likely than the best is left out of the integral. The nodes of a profile are too rough
for a sharper cut: at 7, tails were lost on one side, and a groove sat 0.03 mm deep."""
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
def _lower(rays: Array, lo: int, hi: int, value: float) -> int:
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
                i0, i1, j1 = _lower(rays, s, t, low), _lower(rays, s, t, high), s
            else:  # the edge lies across the cut behind the sensor
                i0, i1, j1 = _lower(rays, s, t, low), t, _lower(rays, s, t, high)
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
        for k in range(_lower(B, s, t, low - step), _lower(B, s, t, high + step)):
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
    """Work space of the likelihood of one component under some beams: lines and runs, see :func:`_front`."""
    m, groups = edges.shape[0], eye.shape[0]
    return np.empty((m, 3)), np.zeros((4 * m + 1 + groups * m, 3), np.int64)


@jit_inner
def _from(B: Array, lo: int, hi: int, value: float, hint: int) -> int:
    """What :func:`_lower` finds, walking from a guess: the last pose's edge was seldom far off."""
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
def _front(
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
def _hidden(B: Array, k: int, nx: float, ny: float, c: float) -> bool:
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
        for i in range(_front(edges, cos, sin, pose[0], pose[1], B, start, eye, g, lines, runs)):
            first, end, e = runs[i, 0], runs[i, 1], runs[i, 2]
            nx, ny, c = lines[e, 0], lines[e, 1], lines[e, 2]
            while first < end and _hidden(B, first, nx, ny, c):
                first += 1
            if first == end:
                continue
            if bearing > 0.0 and nx * B[1, first] + ny * B[2, first] > -STEEP:
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
def normal_equations(
    edges: Array, pose: Array, rs: float, B: Array, start: Ints, eye: Array, soften: float, grazes: int,
    bearing: float, lines: Array, runs: Ints, H: Array, g: Array,
) -> None:  # fmt: skip
    """Gauss-Newton system of the ranges in (tx, ty, theta * rs), rotation about the origin of ``edges``.

    Weights a / (1 + a), a = A / m exp(-d^2 / (2 m^2)), m = ``soften`` times sigma. A face met nearly edge-on
    counts from ``grazes`` returns on: the Jacobian of a few claims more than they say. ``lines``, ``runs``:
    from :func:`scratch`.
    """
    cos, sin = math.cos(pose[2]), math.sin(pose[2])
    H[:] = 0.0
    g[:] = 0.0
    soft, drop, slope = 1.0 / soften, math.log(soften), 1.0 / rs
    for q in range(eye.shape[0]):
        ox, oy = eye[q, 0] - pose[0], eye[q, 1] - pose[1]
        for i in range(_front(edges, cos, sin, pose[0], pose[1], B, start, eye, q, lines, runs)):
            first, end, e = runs[i, 0], runs[i, 1], runs[i, 2]
            nx, ny, c = lines[e, 0], lines[e, 1], lines[e, 2]
            while first < end and _hidden(B, first, nx, ny, c):
                first += 1
            if first == end:
                continue
            steep = nx * B[1, first] + ny * B[2, first] > -STEEP
            if steep and end - first < grazes:
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


@jit
def _pose_at(q0: Array, axes: Array, s: float, w0: float, w1: float, rs: float, out: Array) -> None:
    """Point q0 + s u + w0 v1 + w1 v2 of the scaled coordinates, as (tx, ty, theta)."""
    for i in range(3):
        out[i] = q0[i] + s * axes[i, 0] + w0 * axes[i, 1] + w1 * axes[i, 2]
    out[2] /= rs


@jit
def _log_prior(pose: Array, prior: Array) -> float:
    value: float = -0.5 * ((pose[0] / prior[0]) ** 2 + (pose[1] / prior[1]) ** 2 + (pose[2] / prior[2]) ** 2)
    return value


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
    _pilot(args, q, lines, runs, H, g, pose)
    nodes = 25
    mid = nodes // 2
    w = np.zeros((nodes, 2))
    best = np.empty(nodes)
    raw, P2, axes = np.empty((3, 3)), np.empty((2, 2)), np.empty((3, 3))
    mixed, step, top = False, 0.0, 0.0
    for _ in range(4):
        pose[0], pose[1], pose[2] = q[0], q[1], q[2] / rs
        normal_equations(edges, pose, rs, B, start, eye, 1.0, NEVER, bearing, lines, runs, H, g)
        mixed = _two_orientations(edges, pose, B, start, eye, lines, runs)
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
        top = _profile(args, q, axes, step, P2, lines, runs, w, best)
        i = int(np.argmax(best))
        if 1 < i < nodes - 2 or abs(q[0]) + abs(q[1]) > 4.0 * window:
            break
        _pose_at(
            q, axes, (i - mid) * step, w[i, 0], w[i, 1], 1.0, pose
        )  # the best lies at an end: move there
        q[:] = pose
    if cells == 0:
        _glance(q, axes, rs, step, w, best, top, mean, cov, info)
        return
    first, final = nodes, -1
    for i in range(nodes):
        if best[i] > top - NEGLIGIBLE:
            first = min(first, i)
            final = max(final, i)
    lo = (max(first - 1, 0) - mid) * step
    hi = (min(final + 1, nodes - 1) - mid) * step
    _integrate(args, q, axes, lo, hi, cells, w, best, step, mid, top, P2, mixed, mean, cov, info)
    if info[10] < 8.0:
        for i in range(3):
            for j in range(3):
                H[i, j] = raw[i, j] + (pinv[i] if i == j else 0.0)
        _sample(args, q, H, axes, draws, mean, cov, info)
    info[1] = 1.0 / math.sqrt(max(_along(raw, axes), 1e-12))
    info[2], info[3], info[4] = axes[0, 0], axes[1, 0], axes[2, 0]
    info[5] = math.sqrt(max(_along(cov, axes), 0.0))
    pose[0], pose[1], pose[2] = mean[0], mean[1], mean[2] / rs
    info[8] = log_likelihood(edges, pose, B, start, eye, margin, bearing, lines, runs)


@jit
def _glance(
    q: Array, axes: Array, rs: float, step: float, w: Array, best: Array, top: float, mean: Array, cov: Array,
    info: Array,
) -> None:  # fmt: skip
    """The profile's best node in place of the mean, and its sum in place of the evidence."""
    i = int(np.argmax(best))
    _pose_at(q, axes, (i - best.shape[0] // 2) * step, w[i, 0], w[i, 1], 1.0, mean)
    cov[:] = 0.0
    total = 0.0
    for j in range(best.shape[0]):
        total += math.exp(best[j] - top)
    info[0] = top + math.log(2.0 * math.pi * step * total)


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
    n = start2[-1]
    rho, face = np.full(n, np.inf), np.full(n, -1, np.int64)
    cos, sin = math.cos(at[2]), math.sin(at[2])
    predict(rows, cos, sin, at[0], at[1], B, start2, eye, rho, face)
    count, px, py, slack = 0, 0.0, 0.0, 0.003
    points = np.empty((n, 2))
    for g in range(eye.shape[0]):
        for k in range(start2[g], start2[g + 1]):
            if face[k] >= 0 and B[RANGE, k] > 0.0 and abs(B[RANGE, k] - rho[k]) < near:
                points[count, 0] = eye[g, 0] + B[1, k] * B[RANGE, k]
                points[count, 1] = eye[g, 1] + B[2, k] * B[RANGE, k]
                px += points[count, 0]
                py += points[count, 1]
                slack = max(slack, 1.0 / B[INVERSE, k])
                count += 1
    if count < few:
        return False
    px /= count
    py /= count
    square = 0.0
    for k in range(count):
        square += (points[k, 0] - px) ** 2 + (points[k, 1] - py) ** 2
    rs = max(math.sqrt(square / count), 0.005)
    lx, ly = at[0] - px, at[1] - py
    moved = np.empty_like(rows)
    for e in range(rows.shape[0]):
        for j in range(3):
            x, y = rows[e, 2 * j], rows[e, 2 * j + 1]
            moved[e, 2 * j], moved[e, 2 * j + 1] = cos * x - sin * y, sin * x + cos * y
            if j < 2:
                moved[e, 2 * j] += lx
                moved[e, 2 * j + 1] += ly
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


@jit
def _along(m: Array, axes: Array) -> float:
    """Quadratic form of the first axis."""
    total = 0.0
    for i in range(3):
        for j in range(3):
            total += axes[i, 0] * m[i, j] * axes[j, 0]
    return total


@jit
def _pilot(
    args: tuple[Any, ...], q: Array, lines: Array, runs: Ints, H: Array, g: Array, pose: Array
) -> None:
    """Six annealed Gauss-Newton steps from q; q becomes the best place passed."""
    edges, rs, B, start, eye, margin, bearing, prior, pinv = args
    x, at = np.empty(3), q.copy()
    top = -np.inf
    for it in range(7):
        pose[0], pose[1], pose[2] = at[0], at[1], at[2] / rs
        value = log_likelihood(edges, pose, B, start, eye, margin, bearing, lines, runs) + _log_prior(
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
def _profile(
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
            _conditional_step(args, q, axes, (i - mid) * step, w[i], P2, lines, runs, H, g, pose, L)
        _pose_at(q, axes, (i - mid) * step, w[i, 0], w[i, 1], rs, pose)
        value = log_likelihood(edges, pose, B, start, eye, margin, bearing, lines, runs)
        best[i] = value + _log_prior(pose, prior) - math.log(L[0, 0] * L[1, 1])
    return float(best.max())


@jit
def _two_orientations(
    edges: Array, pose: Array, B: Array, start: Ints, eye: Array, lines: Array, runs: Ints
) -> bool:
    """Whether the returns lie on faces that differ by more than 20 degrees."""
    cos, sin = math.cos(pose[2]), math.sin(pose[2])
    ref = -1
    for g in range(eye.shape[0]):
        for i in range(_front(edges, cos, sin, pose[0], pose[1], B, start, eye, g, lines, runs)):
            e, k, end = runs[i, 2], runs[i, 0], runs[i, 1]
            nx, ny, c = lines[e, 0], lines[e, 1], lines[e, 2]
            while k < end and (B[RANGE, k] < 0.0 or _hidden(B, k, nx, ny, c)):
                k += 1
            if k == end:
                continue
            if ref < 0:
                ref = e
            elif edges[ref, 4] * edges[e, 4] + edges[ref, 5] * edges[e, 5] < 0.94:
                return True
    return False


@jit
def _conditional_step(
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
    _pose_at(q, axes, s, w[0], w[1], rs, pose)
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
    mixed: bool,
    mean: Array,
    cov: Array,
    info: Array,
) -> None:
    """Moments by midpoints along u and Gauss-Hermite across (METHOD, section 4, step 8)."""
    edges, rs, B, start, eye, margin, bearing, prior, _ = args
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
    lines, runs = scratch(edges, eye)
    H, g, pose = np.empty((3, 3)), np.empty(3), np.empty(3)
    wc, L = np.empty(2), np.empty((2, 2))
    m = xs.shape[0]
    values = np.empty(cells * m * m)
    points = np.empty((cells * m * m, 4))
    mass = np.empty(cells)
    count, h, mode = 0, 0.0, -np.inf
    for _ in range(4):
        h = (hi - lo) / cells
        count = 0
        mode = -np.inf
        for c in range(cells):
            s = lo + (c + 0.5) * h
            x = s / step + mid
            i = min(max(int(x), 0), w.shape[0] - 2)
            f = x - i
            if max(best[i], best[i + 1]) < top - NEGLIGIBLE:
                continue
            wc[0] = w[i, 0] + f * (w[i + 1, 0] - w[i, 0])
            wc[1] = w[i, 1] + f * (w[i + 1, 1] - w[i, 1])
            _conditional_step(args, q, axes, s, wc, P2, lines, runs, H, g, pose, L)
            base = math.log(2.0 * math.pi * h) - math.log(L[0, 0] * L[1, 1])
            for a in range(m):
                for b in range(m):
                    y1 = xs[b] / L[1, 1]
                    y0 = (xs[a] - L[1, 0] * y1) / L[0, 0]
                    _pose_at(q, axes, s, wc[0] + y0, wc[1] + y1, rs, pose)
                    value = log_likelihood(
                        edges, pose, B, start, eye, margin, bearing, lines, runs
                    ) + _log_prior(pose, prior)
                    mode = max(mode, value)
                    values[count] = value + 0.5 * (xs[a] * xs[a] + xs[b] * xs[b]) + lw[a] + lw[b] + base
                    points[count, 0], points[count, 1], points[count, 2] = pose[0], pose[1], pose[2] * rs
                    points[count, 3] = s
                    count += 1
        few, lo, hi = _narrowed(values, points, count, lo, h, mass)
        if not few:
            break
        lo, hi = max(lo, -mid * step), min(hi, mid * step)
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
    square = 0.0
    across = np.zeros(2)
    for k in range(count):
        square += values[k] * values[k]
        j = k % (m * m)
        across[0] += values[k] / total * xs[j // m] ** 2
        across[1] += values[k] / total * xs[j % m] ** 2
    info[10] = total * total / square
    if across.min() < 0.35:  # the conditional frame is far too wide: its nodes step over the posterior
        info[10] = 0.0
    _rival(values, points, count, total, h, info)


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
def _sample(
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
            before[i] = _log_prior(pose, prior)
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
