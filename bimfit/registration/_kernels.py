"""Every compiled function of the planar search.

The kernels take arrays and plain numbers only; ``table.py`` and ``grcsm.py`` validate and allocate.
Integers throughout: a bound is a bound of the very scores that it prunes, and sums do not depend on order.
Sums of quadratic bounds are the exception: single precision in any order, with a margin for rounding.
``fastmath``, which assumes that NaN does not exist, only there: cells and tables hold none.
Constants of ``_kernels_table.py`` are compiled in; a change to any kernel file of the room makes all anew.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bimfit._kernels import jit, jit_bare, jit_inner_bare, jit_inner_fast
from bimfit.registration._kernels_table import FULL, LANE, RIM

LANE_SUM = (1 << LANE) - 1
NOTHING = -(1 << 40)  # score of no pose at all
SHIFT_NODE = 20  # bits of one index in a node's code
PAD = 32  # points are filled up to a multiple of this with points of no weight: whole vectors
RUN = 512  # points whose sums are kept in single precision
ROUNDING = (
    2.0**-14
)  # such a sum's greatest error, as a share of its terms' magnitudes: RUN 2^-24, and to spare
PART = 257  # weight whose sum of table values fits 16 bits
HEAVY = 32  # weight from which on a block goes into the 32 bit sums at once

# slots of the state vector
HEAP, BEST, BEST_CODE, EVALUATIONS, PHASE, FOUND, BOUND, DIVED = 0, 1, 2, 3, 4, 5, 6, 7
EXPANDED = 8  # from here on, nodes expanded of each level; slot 8 counts rows of leaves scored
STATE_SIZE = 32
# what a call of ``search`` ends with
DONE, TOLERANCE, BUDGET, HEAP_FULL, FOUND_FULL = 0, 1, 2, 3, 4


class Model(NamedTuple):
    """What the search reads of a model and a lattice; see ``Tables`` and ``Lattice``."""

    cosine: NDArray[np.float64]
    sine: NDArray[np.float64]
    step: NDArray[np.float64]
    size: NDArray[np.int64]
    nodes: NDArray[np.int64]
    half_angle: NDArray[np.float64]
    lanes: NDArray[np.uint64]
    blocks: NDArray[np.uint8]
    place: NDArray[np.int64]
    quads: NDArray[np.uint64]
    quad_place: NDArray[np.int64]
    quad_scale: NDArray[np.float64]
    class_of: NDArray[np.uint8]
    slots: NDArray[np.int64]


class Scratch(NamedTuple):
    """What the search writes: the slice's points in cells, what is known of them, the queue, the state."""

    start: NDArray[np.float64]
    pu: NDArray[np.float64]
    pv: NDArray[np.float64]
    weight: NDArray[np.uint64]
    heft: NDArray[np.float32]
    classes: NDArray[np.uint8]
    cu: NDArray[np.int32]
    cv: NDArray[np.int32]
    have: NDArray[np.uint8]
    lists: NDArray[np.int32]
    list_counts: NDArray[np.int32]
    near: NDArray[np.uint8]
    near_have: NDArray[np.uint8]
    at: NDArray[np.int32]
    words: NDArray[np.uint64]
    halves: NDArray[np.int32]
    coef: NDArray[np.float32]
    sums: NDArray[np.float64]
    turns: NDArray[np.float64]
    tally: NDArray[np.int32]
    part: NDArray[np.uint16]
    box: NDArray[np.int64]
    root: NDArray[np.int32]
    crest: NDArray[np.int64]
    keys: NDArray[np.int64]
    codes: NDArray[np.int64]
    found_codes: NDArray[np.int64]
    found_scores: NDArray[np.int64]
    state: NDArray[np.int64]
    pivot: NDArray[np.float64]
    motion: NDArray[np.float64]


# ---------------------------------------------------------------- cells and leaves


@jit_inner_bare
def fill_cells(base, n, cosine, sine, pu, pv, start, cu, cv):
    """Cells of all points at one angle and translation 0, from ``base`` on.

    ``pu``, ``pv``: points about the pivot, in cells; ``start``: the pivot's cell coordinates and the ratio of
    the cells' sides.
    """
    a, b = sine * start[2], sine * start[3]
    for k in range(n):
        cu[np.uint64(base + k)] = np.int32(np.floor(cosine * pu[k] - a * pv[k] + start[0]))
        cv[np.uint64(base + k)] = np.int32(np.floor(b * pu[k] + cosine * pv[k] + start[1]))


@jit_inner_bare
def score_box(base, n, cu, cv, weight, chunk, lanes, v0, nv, u0, nu, at, out, to):
    """Scores of nv x nu neighbouring translations at one angle into ``out`` from ``to`` on.

    Cells of the ``n`` points lie at ``base`` and on. Three scores along u share each word of ``lanes``.
    """
    stride = np.int32(lanes.shape[1])
    right, low = np.int32(lanes.shape[1] - 1), np.int32(lanes.shape[0] - 1)
    table = lanes.reshape(lanes.size)
    for i in range(nv):
        shift_v = np.int32(v0 + i + 1)
        for left in range(0, nu, 3):
            shift_u = np.int32(u0 + left + 3)
            for p in range(n):
                x = min(max(np.int32(cu[np.uint64(base + p)] + shift_u), np.int32(0)), right)
                y = min(max(np.int32(cv[np.uint64(base + p)] + shift_v), np.int32(0)), low)
                at[p] = np.int32(np.int32(y * stride) + x)
            s0, s1, s2 = np.int64(0), np.int64(0), np.int64(0)
            k = 0
            while k < n:
                stop = min(n, k + chunk)
                word = np.uint64(0)
                for p in range(k, stop):
                    word += table[np.uint64(at[np.uint64(p)])] * weight[np.uint64(p)]
                s0 += np.int64(word & np.uint64(LANE_SUM))
                s1 += np.int64((word >> np.uint64(LANE)) & np.uint64(LANE_SUM))
                s2 += np.int64(word >> np.uint64(2 * LANE))
                k = stop
            out[to + i * nu + left] = s0
            if left + 1 < nu:
                out[to + i * nu + left + 1] = s1
            if left + 2 < nu:
                out[to + i * nu + left + 2] = s2


# ---------------------------------------------------------------- heap


@jit_inner_bare
def before(ka, ca, kb, cb):
    """Whether entry a leaves the queue before b: greater key, then lesser code."""
    return ka > kb or (ka == kb and ca < cb)


@jit_inner_bare
def heap_push(keys, codes, size, key, code):
    """Add an entry to a heap of ``size``."""
    i = size
    while i > 0:
        up = (i - 1) >> 1
        if not before(key, code, keys[up], codes[up]):
            break
        keys[i], codes[i] = keys[up], codes[up]
        i = up
    keys[i], codes[i] = key, code


@jit_inner_bare
def heap_pop(keys, codes, size):
    """Remove the first entry of a heap of ``size``; what is left has ``size - 1``."""
    last = size - 1
    key, code = keys[last], codes[last]
    i = 0
    while True:
        child = 2 * i + 1
        if child >= last:
            break
        if child + 1 < last and before(keys[child + 1], codes[child + 1], keys[child], codes[child]):
            child += 1
        if not before(keys[child], codes[child], key, code):
            break
        keys[i], codes[i] = keys[child], codes[child]
        i = child
    keys[i], codes[i] = key, code


# ---------------------------------------------------------------- search


@jit_inner_bare
def pack(t, v, u):
    """One code for three indices; codes compare lexicographically as (theta, v, u)."""
    return (np.int64(t) << (2 * SHIFT_NODE)) | (np.int64(v) << SHIFT_NODE) | np.int64(u)


@jit_inner_bare
def keeps(bound, code, cut, cut_code):
    """Whether a node may hold a leaf that beats the incumbent, ties in lexicographic order."""
    return bound > cut or (bound == cut and code < cut_code)


@jit_inner_bare
def ensure_cells(it, n, pu, pv, cosine, sine, start, cu, cv, have):
    """Compute the cells at angle ``it`` unless they are there."""
    if have[it] == 0:
        fill_cells(it * n, n, cosine[it], sine[it], pu, pv, start, cu, cv)
        have[it] = 1


@jit_inner_bare
def merge_blocks(base, n, cu, cv, weight, own, classes, bu, bv, at, lists, counts, slot):
    """Blocks that the points fall into at one (level, angle), neighbours merged; kept in ``lists``.

    Cells of the points lie at ``base`` and on, their classes at ``own`` and on. Rows of ``lists``: block in
    u, block in v, slack class, weight. Dividing by multiplication is exact here: a cell's middle is half a
    cell from any border, far above rounding.
    """
    first = slot * n
    inverse_u, inverse_v = 1.0 / bu, 1.0 / bv
    for k in range(n):
        at[k] = np.int32(np.floor((cu[np.uint64(base + k)] + 0.5) * inverse_u))
        at[np.uint64(n + k)] = np.int32(np.floor((cv[np.uint64(base + k)] + 0.5) * inverse_v))
    m = first - 1
    last_u, last_v, last_c = np.int32(0), np.int32(0), np.int32(-1)
    for k in range(n):
        if weight[k] == 0:
            continue
        x, y, c = at[k], at[np.uint64(n + k)], np.int32(classes[np.uint64(own + k)])
        if x == last_u and y == last_v and c == last_c:
            lists[3, np.uint64(m)] += np.int32(weight[k])
        else:
            m += 1
            i = np.uint64(m)
            lists[0, i], lists[1, i], lists[2, i], lists[3, i] = x, y, c, np.int32(weight[k])
            last_u, last_v, last_c = x, y, c
    counts[slot] = m - first + 1


@jit_inner_bare
def bound_box(slot, n, lists, counts, blocks, place, level, v0, nv, u0, nu, tally):
    """Block bounds of nv x nu neighbouring nodes at one (level, angle) into rows of ``tally``.

    ``place`` (levels, classes, 6): offset into ``blocks``, rows, columns, lowest block in u and v, length of
    a row. Rows of ``tally`` are nu + RIM long, those of ``blocks`` end in RIM zeros or more: both are gone
    through in whole vectors.
    """
    stride = nu + RIM
    for k in range(nv * stride):
        tally[k] = np.int32(0)
    for m in range(slot * n, slot * n + counts[slot]):
        c = lists[2, m]
        weight = lists[3, m]
        rows, columns = place[level, c, 1], place[level, c, 2]
        x = np.int64(lists[0, m]) + u0 - place[level, c, 3]
        y = np.int64(lists[1, m]) + v0 - place[level, c, 4]
        j0, j1 = max(0, -x), min(nu, columns - x)
        for i in range(max(0, -y), min(nv, rows - y)):
            line, sums = place[level, c, 0] + (y + i) * place[level, c, 5] + x + j0, i * stride + j0
            for k in range((j1 - j0 + RIM - 1) // RIM * RIM):
                step = np.int32(weight * np.int32(blocks[np.uint64(line + k)]))
                tally[np.uint64(sums + k)] = np.int32(tally[np.uint64(sums + k)] + step)


@jit_inner_bare
def spill(part, stride, nv, nu, root, to):
    """Add the sums of 16 bits to those of 32, and begin anew."""
    for i in range(nv):
        for k in range(nu):
            root[np.uint64(to + i * nu + k)] += np.int32(part[np.uint64(i * stride + k)])
    for k in range(nv * stride):
        part[np.uint64(k)] = np.uint16(0)


@jit_inner_bare
def bound_root(slot, n, lists, counts, blocks, place, level, nv, nu, part, root, to):
    """Block bounds of all nodes at one angle of the first level, from ``to`` on in ``root``.

    Rows of that level's blocks all have one length and end in at least nu zeros, and rows of ``part`` are as
    long: a block's rows are gone through as one, in whole vectors of 16 bits; what lies beyond nu is waste.
    """
    stride = place[level, 0, 5]
    for k in range(to, to + nv * nu):
        root[np.uint64(k)] = np.int32(0)
    for k in range(nv * stride):
        part[np.uint64(k)] = np.uint16(0)
    held = 0
    for m in range(slot * n, slot * n + counts[slot]):
        c, weight = lists[2, m], np.int64(lists[3, m])
        rows, columns = place[level, c, 1], place[level, c, 2]
        x = np.int64(lists[0, m]) - place[level, c, 3]
        y = np.int64(lists[1, m]) - place[level, c, 4]
        i0, i1 = max(0, -y), min(nv, rows - y)
        if i0 >= i1 or x <= -nu or x >= columns:
            continue
        line = place[level, c, 0] + (y + i0) * stride + x
        if weight > HEAVY:
            for i in range(i1 - i0):
                sums, own = to + (i0 + i) * nu, line + i * stride
                for k in range(nu):
                    step = np.int32(weight * np.int32(blocks[np.uint64(own + k)]))
                    root[np.uint64(sums + k)] = np.int32(root[np.uint64(sums + k)] + step)
            continue
        if held + weight > PART:
            spill(part, stride, nv, nu, root, to)
            held = 0
        held += weight
        sums = i0 * stride
        for k in range(((i1 - i0 - 1) * stride + nu + 2 * RIM - 1) // (2 * RIM) * (2 * RIM)):
            step = np.uint16(weight * np.uint16(blocks[np.uint64(line + k)]))
            part[np.uint64(sums + k)] = np.uint16(part[np.uint64(sums + k)] + step)
    spill(part, stride, nv, nu, root, to)


@jit_bare
def point_classes(n, pu, pv, qu, qv, first, eta, class_of, out):
    """Slack class of every point on the levels from ``first`` on; ``eta`` (levels,) is half a node's angle.

    A point at radius rho moves by at most 2 rho sin(min(eta, pi) / 2), so its cell by at most that
    many cells, rounded up. ``class_of`` (levels, slacks) maps cells of slack to a class.
    """
    last = class_of.shape[1] - 1
    for level in range(first, eta.shape[0]):
        arm = 2.0 * np.sin(0.5 * min(eta[level], np.pi)) / min(qu, qv)
        for k in range(n):
            move = arm * np.sqrt(pu[k] * pu[k] * qu * qu + pv[k] * pv[k] * qv * qv)
            slack = 0
            if move > 0.0:
                slack = int(np.ceil(move + 1e-9))
            out[level * n + k] = class_of[level, min(slack, last)]


@jit_inner_bare
def turn_classes(first, middle, bt, n, cu, cv, class_of, level, at, own, out):
    """Slack class of every point at one (level, angle) from the cells at the interval's very angles.

    They go into ``out`` from ``own`` on.
    """
    for k in range(n):
        at[k] = np.int32(0)
    for i in range(first, first + bt):
        if i == middle:
            continue
        for k in range(n):
            a = np.int32(cu[np.uint64(i * n + k)] - cu[np.uint64(middle * n + k)])
            b = np.int32(cv[np.uint64(i * n + k)] - cv[np.uint64(middle * n + k)])
            at[k] = max(at[k], a, np.int32(-a), b, np.int32(-b))
    last = np.int32(class_of.shape[1] - 1)
    for k in range(n):
        out[np.uint64(own + k)] = class_of[level, np.uint64(min(at[k], last))]


@jit_inner_fast
def quad_pass(
    m, base, cu, cv, own, classes, k0, heft, du, dv, where, unit, level, quads, at, words, halves, coef,
    sums,
):  # fmt: skip
    """Sum of ``m`` points' quadratic majorants at one pose.

    Points ``k0`` and on, their cells at ``base`` and on, their slack classes at ``own`` and on.

    ``heft``: the points' weights; ``halves``: the low and high halves of ``words``. Each point's quadratic
    is moved to the cell that the point lies in. Slopes (u, v) and curvatures (uu, uv,
    vv) a point are kept, weighted, in five stretches of ``coef``; ``sums``: constant, slopes and curvatures
    are added to. Three loops, so that all but the look-ups becomes vector code.
    """
    offset, rows, columns = where[level, 0], where[level, 1], where[level, 2]
    right, low = np.int32((columns << where[level, 3]) - 1), np.int32((rows << where[level, 4]) - 1)
    stride, width = np.int32(rows * columns), np.int32(columns)
    shift_u, shift_v = np.int32(du + where[level, 5]), np.int32(dv + where[level, 6])
    # a record's cells along an axis are a power of two, so these products are exact
    many_u, many_v = np.float32(1 << where[level, 3]), np.float32(1 << where[level, 4])
    less_u, less_v = np.float32(1.0) / many_u, np.float32(1.0) / many_v
    mid_u, mid_v = np.float32((1 << where[level, 3]) >> 1), np.float32((1 << where[level, 4]) >> 1)
    unit_g, unit_h = np.float32(unit[level, 0]), np.float32(unit[level, 1])
    shifted = where[level, 3] + where[level, 4] > 0  # otherwise a record serves one cell, its own
    for k in range(0 if shifted else m):
        x = min(max(np.int32(cu[np.uint64(base + k)] + shift_u), np.int32(0)), right)
        y = min(max(np.int32(cv[np.uint64(base + k)] + shift_v), np.int32(0)), low)
        own_table = np.int32(np.int32(classes[np.uint64(own + k)]) * stride)
        at[k] = np.int32(np.int32(np.int32(y * width) + x) + own_table)
    for k in range(m if shifted else 0):
        x = min(max(np.int32(cu[np.uint64(base + k)] + shift_u), np.int32(0)), right)
        y = min(max(np.int32(cv[np.uint64(base + k)] + shift_v), np.int32(0)), low)
        line = np.int32(np.int32(np.float32(y) * less_v) * width)
        at[k] = np.int32(
            np.int32(line + np.int32(np.float32(x) * less_u))
            + np.int32(np.int32(classes[np.uint64(own + k)]) * stride)
        )
    for k in range(m):
        words[k] = quads[np.uint64(offset + at[k])]
    two, zero_g, zero_h = np.float32(2.0), np.float32(2048.0), np.float32(128.0)
    t0, t1, t2 = np.float32(0.0), np.float32(0.0), np.float32(0.0)
    t3, t4, t5 = np.float32(0.0), np.float32(0.0), np.float32(0.0)
    for k in range(0 if shifted else m):
        one, other = halves[2 * k], halves[2 * k + 1]
        w = heft[np.uint64(k0 + k)]
        wg, wh = w * unit_g, w * unit_h
        gu = wg * (np.float32(np.int32(other & np.int32(0xFFF))) - zero_g)
        gv = wg * (np.float32(np.int32(np.int32(other >> np.int32(12)) & np.int32(0xFFF))) - zero_g)
        bu = wh * (np.float32(np.int32(np.int32(one >> np.int32(16)) & np.int32(0xFF))) - zero_h)
        bv = wh * (np.float32(np.int32(np.int32(one >> np.int32(24)) & np.int32(0xFF))) - zero_h)
        twist = wh * (np.float32(np.int32(np.int32(other >> np.int32(24)) & np.int32(0xFF))) - zero_h)
        t0 += w * np.float32(np.int32(one & np.int32(0xFFFF)))
        t1 += gu
        t2 += gv
        t3 += bu
        t4 += twist
        t5 += bv
        coef[k] = gu
        coef[RUN + k] = gv
        coef[2 * RUN + k] = bu
        coef[3 * RUN + k] = twist
        coef[4 * RUN + k] = bv
    for k in range(m if shifted else 0):
        x = np.float32(min(max(np.int32(cu[np.uint64(base + k)] + shift_u), np.int32(0)), right))
        y = np.float32(min(max(np.int32(cv[np.uint64(base + k)] + shift_v), np.int32(0)), low))
        ou = x - many_u * np.float32(np.int32(x * less_u)) - mid_u
        ov = y - many_v * np.float32(np.int32(y * less_v)) - mid_v
        one, other = halves[2 * k], halves[2 * k + 1]
        w = heft[np.uint64(k0 + k)]
        wg, wh = w * unit_g, w * unit_h
        gu = wg * (np.float32(np.int32(other & np.int32(0xFFF))) - zero_g)
        gv = wg * (np.float32(np.int32(np.int32(other >> np.int32(12)) & np.int32(0xFFF))) - zero_g)
        bu = wh * (np.float32(np.int32(np.int32(one >> np.int32(16)) & np.int32(0xFF))) - zero_h)
        bv = wh * (np.float32(np.int32(np.int32(one >> np.int32(24)) & np.int32(0xFF))) - zero_h)
        twist = wh * (np.float32(np.int32(np.int32(other >> np.int32(24)) & np.int32(0xFF))) - zero_h)
        a, b, c = bu * ou, twist * ov, bv * ov
        t0 += w * np.float32(np.int32(one & np.int32(0xFFFF))) + ou * (gu + a + b) + ov * (gv + c)
        gu += two * a + b
        gv += two * c + twist * ou
        t1 += gu
        t2 += gv
        t3 += bu
        t4 += twist
        t5 += bv
        coef[k] = gu
        coef[RUN + k] = gv
        coef[2 * RUN + k] = bu
        coef[3 * RUN + k] = twist
        coef[4 * RUN + k] = bv
    sums[0] += t0
    sums[1] += t1
    sums[2] += t2
    sums[3] += t3
    sums[4] += t4
    sums[5] += t5


@jit_inner_fast
def turn_gain(m, base, other, cu, cv, coef, out, i):
    """What moving ``m`` points from cells at ``base`` to those at ``other`` adds to constant and slopes."""
    two = np.float32(2.0)
    t0, t1, t2 = np.float32(0.0), np.float32(0.0), np.float32(0.0)
    for k in range(m):
        u = np.float32(np.int32(cu[np.uint64(other + k)] - cu[np.uint64(base + k)]))
        v = np.float32(np.int32(cv[np.uint64(other + k)] - cv[np.uint64(base + k)]))
        b = coef[3 * RUN + k]
        a, c = coef[2 * RUN + k] * u, coef[4 * RUN + k] * v
        t0 += u * (coef[k] + a + b * v) + v * (coef[RUN + k] + c)
        t1 += two * a + b * v
        t2 += two * c + b * u
    out[3 * i] += t0
    out[3 * i + 1] += t1
    out[3 * i + 2] += t2


@jit_inner_bare
def arch(slope, bend, half):
    """Greatest slope x + bend x^2 for |x| <= half."""
    if bend < 0.0 and abs(slope) < -2.0 * bend * half:
        return -0.25 * slope * slope / bend
    return abs(slope) * half + bend * half * half


@jit_inner_bare
def quad_node(
    n, first, middle, bt, du, dv, cu, cv, own, classes, heft, where, unit, level, quads, at, words, halves,
    coef,
    sums, turns,
):  # fmt: skip
    """Quadratic of a node's bound: ``sums`` at its middle, ``turns`` (3 an angle) what each angle adds.

    Points go by in runs of ``RUN``, so that single precision loses no more than ``ROUNDING`` allows for.
    """
    for i in range(6):
        sums[i] = 0.0
    for i in range(3 * bt):
        turns[i] = 0.0
    for k in range(0, n, RUN):
        m, base = min(RUN, n - k), middle * n + k
        quad_pass(
            m, base, cu, cv, own + k, classes, k, heft, du, dv, where, unit, level, quads, at, words, halves,
            coef, sums,
        )  # fmt: skip
        for i in range(bt):
            if first + i != middle:
                turn_gain(m, base, (first + i) * n + k, cu, cv, coef, turns, i)


@jit_inner_bare
def quad_children(size, level, sums, turns, scale, margin, cut, out):
    """Bounds of all children (theta, v, u) of a node; NOTHING for those seen to lie under ``cut``.

    ``size`` (levels, 3): leaves an axis (u, v, theta) in a node of each level. A child's bound is the
    greatest of its angles', each the quadratic's greatest value over the child's box.
    """
    bu, bv, bt = size[level, 0], size[level, 1], size[level, 2]
    lu, lv, lt = size[level - 1, 0], size[level - 1, 1], size[level - 1, 2]
    fu, fv, ft = bu // lu, bv // lv, bt // lt
    huu, huv, hvv = sums[3], sums[4], sums[5]
    half_u, half_v = float(bu // 2), float(bv // 2)
    rest_u, rest_v = 0.5 * (lu - 1), 0.5 * (lv - 1)
    cross, cross_all = abs(huv) * rest_u * rest_v, abs(huv) * half_u * half_v
    for a in range(ft):
        for k in range(a * fv * fu, (a + 1) * fv * fu):
            out[k] = NOTHING
        for i in range(a * lt, (a + 1) * lt):
            steady = sums[0] + turns[3 * i]
            gu, gv = sums[1] + turns[3 * i + 1], sums[2] + turns[3 * i + 2]
            most = steady + arch(gu, huu, half_u) + arch(gv, hvv, half_v) + cross_all
            if most * scale + margin < cut:
                continue
            for b in range(fv):
                y = b * lv + rest_v - half_v
                line = steady + y * (gv + hvv * y) + cross
                slope_u, slope_v = gu + huv * y, gv + 2.0 * hvv * y
                for c in range(fu):
                    x = c * lu + rest_u - half_u
                    value = line + x * (slope_u + huu * x)
                    if rest_u > 0.0:
                        value += arch(slope_u + 2.0 * huu * x, huu, rest_u)
                    if rest_v > 0.0:
                        value += arch(slope_v + huv * x, hvv, rest_v)
                    at = (a * fv + b) * fu + c
                    out[at] = max(out[at], np.int64(np.floor(value * scale + margin)))


@jit_inner_bare
def log_prior(prior, prior_at, level, t, v, u):
    """Log-prior of one node of a level, or of one leaf (level 0)."""
    return prior[prior_at[level, 2] + t] + prior[prior_at[level, 1] + v] + prior[prior_at[level, 0] + u]


@jit_inner_bare
def list_blocks(
    level, t, n, pu, pv, weight, start, cosine, sine, size, classes, slots, cu, cv, have, lists, list_counts,
    at,
):  # fmt: skip
    """Make the blocks of one level and angle unless they are there; their slot."""
    middle = t * size[level, 2] + size[level, 2] // 2
    ensure_cells(middle, n, pu, pv, cosine, sine, start, cu, cv, have)
    slot = slots[level] + t
    if list_counts[slot] < 0:
        merge_blocks(
            middle * n, n, cu, cv, weight, level * n, classes, size[level, 0], size[level, 1], at, lists,
            list_counts,
            slot,
        )  # fmt: skip
    return slot


@jit_bare
def search(options, model, prior, prior_at, work):
    """Best-first branch and bound over (theta, v, u); resumable, see ``grcsm.py`` for the options."""
    (
        cosine, sine, _, size, count, _, lanes, blocks, place, quads, quad_place, quad_scale, class_of, slots,
    ) = model  # fmt: skip
    (
        start, pu, pv, weight, heft, classes, cu, cv, have, lists, list_counts, near, near_have, at, words,
        halves, coef, sums, turns, tally, part, box, root, crest, keys, codes, found_codes, found_scores,
        state, _, _,
    ) = work  # fmt: skip
    n, first = options[0], options[1]
    chunk, limit, slice_limit = options[3], options[4], options[5]
    collect, floor_score, has_prior, total = options[6], options[7], options[8], options[9]
    n_heap, cut, cut_code = state[HEAP], state[BEST], state[BEST_CODE]
    evaluations, n_found = state[EVALUATIONS], state[FOUND]
    started = evaluations
    if collect:
        cut, cut_code = floor_score - 1, np.int64(0)
    diving = False
    level, t, v, u, bound = np.int64(0), np.int64(0), np.int64(0), np.int64(0), np.int64(0)
    nt, nv, nu = count[first, 2], count[first, 1], count[first, 0]

    if state[PHASE] == 0:
        # every node of the first level, then a greedy dive from the best of them
        best_root, best_at = -(np.int64(1) << 60), np.int64(0)
        for it in range(nt):
            if first == 0:
                ensure_cells(it, n, pu, pv, cosine, sine, start, cu, cv, have)
                score_box(it * n, n, cu, cv, weight, chunk, lanes, 0, nv, 0, nu, at, box, 0)
                for k in range(nv * nu):
                    root[it * nv * nu + k] = np.int32(box[k])
            else:
                slot = list_blocks(
                    first, it, n, pu, pv, weight, start, cosine, sine, size, classes, slots, cu, cv, have,
                    lists, list_counts, at,
                )  # fmt: skip
                bound_root(
                    slot, n, lists, list_counts, blocks, place, first, nv, nu, part, root, it * nv * nu
                )
            for b in range(nv):
                line = (it * nv + b) * nu
                most = -(np.int64(1) << 60)
                if has_prior:
                    for c in range(nu):
                        value = root[line + c] + log_prior(prior, prior_at, first, it, b, c)
                        most = max(most, value)
                else:
                    greatest = np.int32(0)
                    for c in range(nu):
                        greatest = max(greatest, root[np.uint64(line + c)])
                    most = np.int64(greatest)
                crest[it * nv + b] = most
                if most > best_root:
                    best_root, best_at = most, line
        if best_root > cut or first == 0:
            # the first node of that bound
            it, b = best_at // (nv * nu), best_at // nu % nv
            for c in range(nu):
                value = np.int64(root[best_at + c])
                if has_prior:
                    value += log_prior(prior, prior_at, first, it, b, c)
                if value == best_root:
                    best_at += c
                    break
        evaluations += nt * nv * nu
        state[PHASE] = 1
        if first == 0:
            for i in range(nt * nv * nu):
                code, value = pack(i // (nv * nu), (i // nu) % nv, i % nu), np.int64(root[i])
                if has_prior:
                    value += log_prior(prior, prior_at, 0, i // (nv * nu), (i // nu) % nv, i % nu)
                if collect:
                    if value > cut:
                        if n_found < found_codes.shape[0]:
                            found_codes[n_found], found_scores[n_found] = code, value
                        n_found += 1
                elif keeps(value, code, cut, cut_code):
                    cut, cut_code = value, code
        elif best_root > cut:
            diving = True
            level, bound = first, best_root
            t, v, u = best_at // (nv * nu), (best_at // nu) % nv, best_at % nu
            state[DIVED] = best_at + 1

    stop = DONE
    while True:
        if not diving:
            if state[PHASE] == 1:
                # the incumbent is known: queue what can still beat it
                if first > 0:
                    if keys.shape[0] < n_heap + nt * nv * nu:
                        stop = HEAP_FULL
                        break
                    for row in range(nt * nv):
                        if crest[row] < cut:
                            continue
                        it, b = row // nv, row % nv
                        for c in range(nu):
                            value = np.int64(root[row * nu + c])
                            if has_prior:
                                value += log_prior(prior, prior_at, first, it, b, c)
                            if value < cut or row * nu + c + 1 == state[DIVED]:
                                continue
                            code = pack(it * size[first, 2], b * size[first, 1], c * size[first, 0])
                            if keeps(value, code, cut, cut_code):
                                heap_push(keys, codes, n_heap, (value << 6) | (63 - first), code)
                                n_heap += 1
                state[PHASE] = 2
            if n_heap == 0:
                break
            bound, code = keys[0] >> 6, codes[0]
            if bound < cut:
                n_heap = 0
                break
            if not keeps(bound, code, cut, cut_code):
                heap_pop(keys, codes, n_heap)
                n_heap -= 1
                continue
            if not collect and start[4] > 0.0 and bound - cut <= start[4] * cut:
                stop = TOLERANCE
                break
            if evaluations >= limit or evaluations - started >= slice_limit:
                stop = BUDGET
                break
            level = 63 - (keys[0] & 63)
            t = (code >> (2 * SHIFT_NODE)) // size[level, 2]
            v = ((code >> SHIFT_NODE) & ((1 << SHIFT_NODE) - 1)) // size[level, 1]
            u = (code & ((1 << SHIFT_NODE) - 1)) // size[level, 0]
            children = (
                (size[level, 2] // size[level - 1, 2])
                * (size[level, 1] // size[level - 1, 1])
                * (size[level, 0] // size[level - 1, 0])
            )
            if keys.shape[0] < n_heap + children:
                stop = HEAP_FULL
                break
            if collect and found_codes.shape[0] < n_found + children and level == 1:
                stop = FOUND_FULL
                break
            heap_pop(keys, codes, n_heap)
            n_heap -= 1
        bt, bv, bu = size[level, 2], size[level, 1], size[level, 0]
        lt, lv, lu = size[level - 1, 2], size[level - 1, 1], size[level - 1, 0]
        ft, fv, fu = bt // lt, bv // lv, bu // lu
        state[EXPANDED + level] += 1
        t0, v0, u0 = t * bt, v * bv, u * bu  # the node's first leaf
        majorant = quad_place[level, 0] >= 0
        if majorant:
            middle = t0 + bt // 2
            for i in range(t0, t0 + bt):
                if have[i] == 0:
                    ensure_cells(i, n, pu, pv, cosine, sine, start, cu, cv, have)
            flag = slots[level] + t
            own = quad_place[level, 7] * n + t * n
            if near_have[flag] == 0:
                turn_classes(t0, middle, bt, n, cu, cv, class_of, level, at, own, near)
                near_have[flag] = 1
            quad_node(
                n, t0, middle, bt, u0 + bu // 2, v0 + bv // 2, cu, cv, own, near, heft,
                quad_place, quad_scale, level, quads, at, words, halves, coef, sums, turns,
            )  # fmt: skip
            margin = 1e-6 + ROUNDING * quad_scale[level, 3] * total
            quad_children(size, level, sums, turns, quad_scale[level, 2], margin, cut, box)
            evaluations += ft * fv * fu
        best_child, best_key = np.int64(-1), -(np.int64(1) << 60)
        next_t, next_v, next_u = np.int64(0), np.int64(0), np.int64(0)
        for a in range(ft):
            ct = t0 // lt + a
            if level > 1 and not majorant:
                slot = list_blocks(
                    level - 1, ct, n, pu, pv, weight, start, cosine, sine, size, classes, slots, cu, cv, have,
                    lists, list_counts, at,
                )  # fmt: skip
                bound_box(
                    slot, n, lists, list_counts, blocks, place, level - 1, v0 // lv, fv, u0 // lu, fu, tally
                )
                evaluations += fv * fu
            elif level == 1 and not majorant:
                ensure_cells(ct, n, pu, pv, cosine, sine, start, cu, cv, have)
            for b in range(fv):
                line = (a * fv + b) * fu
                if level > 1 and not majorant:
                    for c in range(fu):
                        box[line + c] = tally[b * (fu + RIM) + c]
                if level == 1:
                    # score the rows that hold a leaf whose bound beats the incumbent
                    worth = not majorant
                    if majorant:
                        for c in range(fu):
                            value = box[line + c]
                            if value < cut:
                                continue
                            if has_prior:
                                value += log_prior(prior, prior_at, 0, ct, v0 + b, u0 + c)
                            worth = worth or keeps(min(value, bound), pack(ct, v0 + b, u0 + c), cut, cut_code)
                    if not worth:
                        continue
                    state[EXPANDED] += 1
                    evaluations += fu
                    score_box(ct * n, n, cu, cv, weight, chunk, lanes, v0 + b, 1, u0, fu, at, box, line)
                for c in range(fu):
                    value = box[line + c]
                    if value < cut:
                        continue  # a log-prior is never positive
                    if has_prior:
                        value += log_prior(prior, prior_at, level - 1, ct, v0 // lv + b, u0 // lu + c)
                    code = pack(ct * lt, v0 + b * lv, u0 + c * lu)
                    if level == 1:
                        if collect:
                            if value > cut:
                                found_codes[n_found], found_scores[n_found] = code, value
                                n_found += 1
                        elif keeps(value, code, cut, cut_code):
                            cut, cut_code = value, code
                        continue
                    value = min(value, bound)
                    if not keeps(value, code, cut, cut_code):
                        continue
                    if diving and value > best_key:
                        if best_child >= 0:
                            heap_push(keys, codes, n_heap, (best_key << 6) | (64 - level), best_child)
                            n_heap += 1
                        best_key, best_child = value, code
                        next_t, next_v, next_u = ct, v0 // lv + b, u0 // lu + c
                    else:
                        heap_push(keys, codes, n_heap, (value << 6) | (64 - level), code)
                        n_heap += 1
        if diving:
            diving = best_child >= 0
            level, t, v, u, bound = level - 1, next_t, next_v, next_u, best_key
    state[HEAP] = n_heap
    state[EVALUATIONS] = evaluations
    state[FOUND] = n_found
    state[BOUND] = max(cut, keys[0] >> 6) if n_heap > 0 else cut
    if not collect:
        state[BEST], state[BEST_CODE] = cut, cut_code
    return stop


# ---------------------------------------------------------------- whole slices

# columns of a slice's whole numbers and of its real ones
HOW, SCORE, OPEN, LEAF, WORK, KEPT = 0, 1, 2, 3, 4, 5
PIVOT_U, PIVOT_V, REACH, SHARE, RMSE = 0, 1, 2, 3, 4
FEW, FAR = 10, 11  # besides what ``search`` ends with: too few points left; farther out than the tables reach


@jit_bare
def leaf_score(code, n, chunk, model, prior, prior_at, has_prior, work):
    """Score of one leaf, its log-prior added."""
    mask = (1 << SHIFT_NODE) - 1
    t, v, u = code >> (2 * SHIFT_NODE), (code >> SHIFT_NODE) & mask, code & mask
    fill_cells(0, n, model.cosine[t], model.sine[t], work.pu, work.pv, work.start, work.cu, work.cv)
    score_box(
        0, n, work.cu, work.cv, work.weight, chunk, model.lanes, v, 1, u, 1, work.at, work.box, 0
    )  # fmt: skip
    score = work.box[0]
    if has_prior:
        score += log_prior(prior, prior_at, 0, t, v, u)
    return score


@jit_bare
def set_up(kept, options, frame, model, work):
    """Ready the scratch arrays and the options for a slice whose ``kept`` points are prepared."""
    n = (kept + PAD - 1) // PAD * PAD
    start, pivot, step = work.start, work.pivot, model.step
    start[0] = (pivot[0] + frame[8] - frame[10]) / step[0]
    start[1] = (pivot[1] + frame[9] - frame[11]) / step[1]
    start[2], start[3], start[4] = step[1] / step[0], step[0] / step[1], frame[12]
    total, most = np.int64(0), np.uint64(1)
    for k in range(kept):
        total += np.int64(work.weight[k])
        most = max(most, work.weight[k])
    options[0], options[3], options[9] = n, max(1, LANE_SUM // (FULL * np.int64(most))), total
    work.have[:] = 0
    work.near_have[:] = 0
    work.list_counts[:] = -1
    point_classes(
        n, work.pu, work.pv, step[0], step[1], options[10], model.half_angle, model.class_of, work.classes
    )
    work.state[:] = 0
    work.state[BEST] = NOTHING


@jit_bare
def leaf_motion(code, motion, frame, model, pivot, out):
    """The leaf's motion of the data, after ``motion``: a turn about the pivot, then a shift."""
    mask, step = (1 << SHIFT_NODE) - 1, model.step
    c, s = model.cosine[code >> (2 * SHIFT_NODE)], model.sine[code >> (2 * SHIFT_NODE)]
    du, dv = motion[2] - pivot[0], motion[3] - pivot[1]
    out[0] = c * motion[0] - s * motion[1]
    out[1] = s * motion[0] + c * motion[1]
    out[2] = c * du - s * dv + pivot[0] + frame[8] + step[0] * (code & mask)
    out[3] = s * du + c * dv + pivot[1] + frame[9] + step[1] * ((code >> SHIFT_NODE) & mask)


@jit_bare
def match_run(
    begin, points, ends, motions, given, hints, frame, edges, options, model, prior, prior_at, work, ints,
    reals,
):  # fmt: skip
    """Match slices one after the other from ``begin`` on; the first that was not done.

    ``points`` (n, 2): all slices', slice i's ending at ``ends[i]``; ``motions`` (m, 4): what carries each
    into the designed frame; ``given``: weights in steps, or empty; ``hints`` (m, 3): a leaf to begin with
    (its motion u, v, theta), or NaN. ``frame``: see ``batch.py``. A slice is left undone where the queue is
    full or the tables do not reach far enough: the caller makes room and comes again.
    """
    state, pivot = work.state, work.pivot
    for i in range(begin, ends.shape[0]):
        first = ends[i - 1] if i > 0 else 0
        own = points[first : ends[i]]
        limit = own.shape[0] + PAD
        prepare(
            own, motions[i], frame[0:4], frame[4], frame[5], 1.0 / model.step[0], 1.0 / model.step[1],
            given[first : ends[i]] if given.shape[0] > 0 else given[:0], work.pu[:limit], work.pv[:limit],
            work.weight[:limit], work.heft[:limit], pivot,
        )  # fmt: skip
        kept = int(pivot[3])
        reals[i, PIVOT_U], reals[i, PIVOT_V], reals[i, REACH] = pivot[0], pivot[1], pivot[2]
        ints[i, KEPT] = kept
        if kept < frame[6]:
            ints[i, HOW] = FEW
            continue
        if pivot[2] > frame[7]:
            ints[i, HOW] = FAR
            return i
        set_up(kept, options, frame, model, work)
        if not np.isnan(hints[i, 0]):
            code = nearest_leaf(hints[i], motions[i], pivot, frame, model.step, model.nodes)
            if code >= 0:
                state[BEST_CODE] = code
                state[BEST] = leaf_score(
                    code, options[0], options[3], model, prior, prior_at, options[8], work
                )
        ints[i, HOW] = search(options, model, prior, prior_at, work)
        if ints[i, HOW] == HEAP_FULL:
            return i
        ints[i, SCORE], ints[i, OPEN], ints[i, LEAF] = state[BEST], state[BOUND], state[BEST_CODE]
        ints[i, WORK] = state[EVALUATIONS]
        leaf_motion(state[BEST_CODE], motions[i], frame, model, pivot, work.motion)
        near_count, squares = fitness(own, work.motion, edges, frame[13])
        reals[i, SHARE] = near_count / own.shape[0]
        reals[i, RMSE] = np.sqrt(squares / near_count)
    return ends.shape[0]


@jit_bare
def nearest_leaf(pose, motion, pivot, frame, step, count):
    """Code of the leaf nearest to a motion of the model, or -1 outside the window.

    The data's motion after ``motion`` is (motion pose)^-1: ``pose`` (u, v, theta) in the same frame.
    """
    c, s = np.cos(pose[2]), np.sin(pose[2])
    u = motion[0] * pose[0] - motion[1] * pose[1] + motion[2]
    v = motion[1] * pose[0] + motion[0] * pose[1] + motion[3]
    cosine, sine = motion[0] * c - motion[1] * s, motion[1] * c + motion[0] * s
    # the inverse of (u, v, cosine, sine), taken at the pivot
    du, dv = pivot[0] - u, pivot[1] - v
    t = int(np.rint((np.arctan2(-sine, cosine) - frame[14]) / step[2]))
    a = int(np.rint((cosine * du + sine * dv - pivot[0] - frame[8]) / step[0]))
    b = int(np.rint((cosine * dv - sine * du - pivot[1] - frame[9]) / step[1]))
    if 0 <= t < count[0, 2] and 0 <= b < count[0, 1] and 0 <= a < count[0, 0]:
        return pack(t, b, a)
    return np.int64(-1)


# ---------------------------------------------------------------- other matchers


@jit
def brute(n, pu, pv, weight, chunk, start, cosine, sine, count, lanes, prior, prior_at, has_prior, state):
    """Score every pose of the window; the first of the best in (theta, v, u) order wins."""
    nt, nv, nu = count[0, 2], count[0, 1], count[0, 0]
    cu, cv, at = np.empty(n, np.int32), np.empty(n, np.int32), np.empty(n, np.int32)
    box = np.empty(nu, np.int64)
    best, best_code = np.int64(-(1 << 60)), np.int64(0)
    for t in range(nt):
        fill_cells(0, n, cosine[t], sine[t], pu, pv, start, cu, cv)
        for v in range(nv):
            score_box(0, n, cu, cv, weight, chunk, lanes, v, 1, 0, nu, at, box, 0)
            for u in range(nu):
                value = box[u]
                if has_prior:
                    value += prior[prior_at[0, 2] + t] + prior[prior_at[0, 1] + v] + prior[prior_at[0, 0] + u]
                if value > best:
                    best, best_code = value, pack(t, v, u)
    state[BEST], state[BEST_CODE], state[BOUND] = best, best_code, best
    state[EVALUATIONS] = nt * nv * nu


@jit
def printed(
    n, pu, pv, weight, start, angle_first, angle_step, size, count, tables, places, keys, codes, limit, state
):
    """The search as the paper prints it: block maxima, one look-up a point at a block's centre (Eq. 3-5).

    ``places`` (levels, 5): offset into ``tables``, rows, columns, lowest block in u and v. Not a bound:
    it may stop at a pose that is not the best.
    """
    top = count.shape[0] - 1
    level, t, v, u = top, np.int64(0), np.int64(0), np.int64(0)
    n_heap, evaluations = state[HEAP], state[EVALUATIONS]
    if evaluations > 0:
        level = -1
    while True:
        if level < 0:
            if n_heap == 0:
                return DONE
            if evaluations >= limit:
                state[HEAP], state[EVALUATIONS], state[BOUND] = n_heap, evaluations, keys[0] >> 6
                return BUDGET
            level = 63 - (keys[0] & 63)
            code = codes[0]
            if level > 0:
                worst = 1
                for axis in range(3):
                    worst *= size[level, axis] // size[level - 1, axis]
                if keys.shape[0] < n_heap + worst:
                    state[HEAP], state[EVALUATIONS] = n_heap, evaluations
                    return HEAP_FULL
            t = (code >> (2 * SHIFT_NODE)) // size[level, 2]
            v = ((code >> SHIFT_NODE) & ((1 << SHIFT_NODE) - 1)) // size[level, 1]
            u = (code & ((1 << SHIFT_NODE) - 1)) // size[level, 0]
            if level == 0:
                state[BEST], state[BEST_CODE], state[EVALUATIONS] = keys[0] >> 6, code, evaluations
                state[HEAP], state[BOUND] = n_heap, keys[0] >> 6
                return DONE
            heap_pop(keys, codes, n_heap)
            n_heap -= 1
        lt, lv, lu = size[level - 1, 2], size[level - 1, 1], size[level - 1, 0]
        ft, fv, fu = size[level, 2] // lt, size[level, 1] // lv, size[level, 0] // lu
        where = places[level - 1]
        rows, columns = where[1], where[2]
        for a in range(ft):
            ct = t * ft + a
            angle = angle_first + angle_step * (ct * lt + 0.5 * (lt - 1))
            c, s = np.cos(angle), np.sin(angle)
            for b in range(fv):
                for d in range(fu):
                    mv, mu = v * fv + b, u * fu + d
                    shift_u, shift_v = mu * lu + 0.5 * (lu - 1), mv * lv + 0.5 * (lv - 1)
                    total = np.int64(0)
                    for k in range(n):
                        x = (
                            int(np.floor((c * pu[k] - s * start[2] * pv[k] + start[0] + shift_u) / lu))
                            - where[3]
                        )
                        y = (
                            int(np.floor((s * start[3] * pu[k] + c * pv[k] + start[1] + shift_v) / lv))
                            - where[4]
                        )
                        if 0 <= x < columns and 0 <= y < rows:
                            total += np.int64(weight[k]) * np.int64(tables[where[0] + y * columns + x])
                    heap_push(
                        keys, codes, n_heap, (total << 6) | (64 - level), pack(ct * lt, mv * lv, mu * lu)
                    )
                    n_heap += 1
        evaluations += ft * fv * fu
        level = -1


@jit_bare
def prepare(points, motion, box, shift, swing, scale_u, scale_v, given, pu, pv, weight, heft, out):
    """Carry points by ``motion`` (cos, sin, u, v), choose the pivot, drop what can never meet the model.

    ``box`` (low u, low v, high u, high v) holds the model and its blur; ``shift`` and ``swing`` are the
    farthest that a window moves a point by translation, and by rotation a unit of radius. ``out``: pivot
    (2), largest radius, number of points kept. ``given`` may be empty: unit weights.
    """
    n = points.shape[0]
    cosine, sine = motion[0], motion[1]
    low_u, low_v, high_u, high_v = np.inf, np.inf, -np.inf, -np.inf
    for attempt in range(2):
        for k in range(n):
            u = cosine * points[k, 0] - sine * points[k, 1] + motion[2]
            v = sine * points[k, 0] + cosine * points[k, 1] + motion[3]
            pu[k], pv[k] = u, v
            off_u, off_v = max(box[0] - u, u - box[2], 0.0), max(box[1] - v, v - box[3], 0.0)
            if attempt == 1 or off_u * off_u + off_v * off_v <= shift * shift:
                low_u, high_u = min(low_u, u), max(high_u, u)
                low_v, high_v = min(low_v, v), max(high_v, v)
        if low_u <= high_u:
            break
    pivot_u, pivot_v = 0.5 * (low_u + high_u), 0.5 * (low_v + high_v)
    m, reach = 0, 0.0
    for k in range(n):
        u, v = pu[k], pv[k]
        off_u, off_v = max(box[0] - u, u - box[2], 0.0), max(box[1] - v, v - box[3], 0.0)
        radius = np.sqrt((u - pivot_u) ** 2 + (v - pivot_v) ** 2)
        if np.sqrt(off_u * off_u + off_v * off_v) <= shift + swing * radius + 1e-9:
            pu[m], pv[m] = (u - pivot_u) * scale_u, (v - pivot_v) * scale_v
            weight[m] = given[k] if given.shape[0] > 0 else np.uint64(1)
            heft[m] = np.float32(weight[m])
            reach = max(reach, radius)
            m += 1
    for k in range(m, pu.shape[0]):
        pu[k], pv[k], weight[k], heft[k] = 0.0, 0.0, np.uint64(0), np.float32(0.0)
    out[0], out[1], out[2], out[3] = pivot_u, pivot_v, reach, m


@jit_bare
def fitness(points, motion, edges, gate):
    """Number of points within ``gate`` of the edges after ``motion``, and their sum of squared distances."""
    count, total = 0, 0.0
    for k in range(points.shape[0]):
        x = motion[0] * points[k, 0] - motion[1] * points[k, 1] + motion[2]
        y = motion[1] * points[k, 0] + motion[0] * points[k, 1] + motion[3]
        least = np.inf
        for e in range(edges.shape[0]):
            du, dv = edges[e, 1, 0] - edges[e, 0, 0], edges[e, 1, 1] - edges[e, 0, 1]
            pu, pv = x - edges[e, 0, 0], y - edges[e, 0, 1]
            size = du * du + dv * dv
            f = min(1.0, max(0.0, (pu * du + pv * dv) / size)) if size > 0.0 else 0.0
            least = min(least, (pu - f * du) ** 2 + (pv - f * dv) ** 2)
        if least <= gate * gate:
            count += 1
            total += least
    return count, total
