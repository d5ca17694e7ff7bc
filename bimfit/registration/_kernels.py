"""Every compiled function of the planar search, in one file so that the compiled cache cannot go stale.

The kernels take arrays and plain numbers only; ``table.py`` and ``grcsm.py`` validate and allocate.
Integers throughout: a bound is a bound of the very scores that it prunes, and sums do not depend on order.
No ``fastmath``: it assumes that NaN does not exist.
"""

from __future__ import annotations

import numpy as np

from bimfit._kernels import jit

FULL = 255  # leaf value on the model itself
LANE = 21  # bits of one of three sums that share a machine word
LANE_SUM = (1 << LANE) - 1
NOTHING = -(1 << 40)  # score of no pose at all
SHIFT_NODE = 20  # bits of one index in a node's code

# slots of the state vector
HEAP, BEST, BEST_CODE, EVALUATIONS, PHASE, FOUND, BOUND = 0, 1, 2, 3, 4, 5, 6
EXPANDED = 8  # from here on, nodes expanded of each level; slot 8 counts rows of leaves scored
STATE_SIZE = 32
# what a call of ``search`` ends with
DONE, TOLERANCE, BUDGET, HEAP_FULL, FOUND_FULL = 0, 1, 2, 3, 4


# ---------------------------------------------------------------- tables


@jit
def raster(edges, sigma, ou, ov, qu, qv, height, width):
    """Leaf table: round(255 exp(-d^2 / 2 sigma^2)), d from a cell's centre to the nearest edge."""
    out = np.zeros((height, width), np.uint8)
    reach = sigma * np.sqrt(2.0 * np.log(2.0 * FULL)) * 1.0001
    for e in range(edges.shape[0]):
        au, av = edges[e, 0, 0], edges[e, 0, 1]
        du, dv = edges[e, 1, 0] - au, edges[e, 1, 1] - av
        size = du * du + dv * dv
        i0 = max(0, int(np.floor((min(av, av + dv) - reach - ov) / qv)))
        i1 = min(height - 1, int(np.floor((max(av, av + dv) + reach - ov) / qv)))
        j0 = max(0, int(np.floor((min(au, au + du) - reach - ou) / qu)))
        j1 = min(width - 1, int(np.floor((max(au, au + du) + reach - ou) / qu)))
        for i in range(i0, i1 + 1):
            pv = ov + (i + 0.5) * qv - av
            for j in range(j0, j1 + 1):
                pu = ou + (j + 0.5) * qu - au
                t = 0.0
                if size > 0.0:
                    t = min(1.0, max(0.0, (pu * du + pv * dv) / size))
                xu, xv = pu - t * du, pv - t * dv
                value = np.uint8(np.floor(FULL * np.exp(-(xu * xu + xv * xv) / (2.0 * sigma * sigma)) + 0.5))
                if value > out[i, j]:
                    out[i, j] = value
    return out


@jit
def lane_table(leaf):
    """Three neighbours along u in one word, for cells -1 .. H in v and -3 .. W in u; zero at the rim."""
    height, width = leaf.shape
    out = np.zeros((height + 2, width + 4), np.uint64)
    for i in range(height):
        for j in range(-2, width):
            word = np.uint64(0)
            for m in range(3):
                if 0 <= j + m < width:
                    word |= np.uint64(leaf[i, j + m]) << np.uint64(LANE * m)
            out[i + 1, j + 3] = word
    return out


@jit
def block_table(leaf, bu, bv, slack, low_u, low_v, out):
    """Overlapped block maxima: out[b] = max of leaf over b B - slack .. (b + 2) B - 2 + slack an axis."""
    height, width = leaf.shape
    rows, columns = out.shape
    part = np.zeros((height, columns), np.uint8)
    for i in range(height):
        for b in range(columns):
            first = max(0, (b + low_u) * bu - slack)
            last = min(width - 1, (b + low_u + 2) * bu - 2 + slack)
            top = np.uint8(0)
            for j in range(first, last + 1):
                top = max(top, leaf[i, j])
            part[i, b] = top
    for b in range(rows):
        first = max(0, (b + low_v) * bv - slack)
        last = min(height - 1, (b + low_v + 2) * bv - 2 + slack)
        for j in range(columns):
            top = np.uint8(0)
            for i in range(first, last + 1):
                top = max(top, part[i, j])
            out[b, j] = top


@jit
def affine_table(leaf, ru, rv, pad, shift, out):
    """Affine majorants: leaf[c + d] 2^shift <= A + gu du + gv dv for |du| <= ru, |dv| <= rv.

    The slope is the window's least-squares slope times the one of a few factors that gives the least A.
    ``out`` (H + 2 pad, W + 2 pad) packs A (16 bits), gu + 128 and gv + 128 (8 bits each).
    """
    rows, columns = out.shape
    height, width = leaf.shape
    nu, nv = 2 * ru + 1, 2 * rv + 1
    one = np.int32(1 << shift)
    wide = np.zeros((rows + 2 * rv, columns + 2 * ru), np.int32)
    wide[rv + pad : rv + pad + height, ru + pad : ru + pad + width] = leaf
    scale_u = one * 3.0 / (max(1, ru * (ru + 1)) * nu * nv)
    scale_v = one * 3.0 / (max(1, rv * (rv + 1)) * nu * nv)
    empty = (np.uint32(128) << np.uint32(16)) | (np.uint32(128) << np.uint32(24))
    for y in range(rows):
        for x in range(columns):
            sum_u, sum_v, top = np.int32(0), np.int32(0), np.int32(0)
            for a in range(nv):
                row = wide[y + a, x : x + nu]
                line = np.int32(0)
                for b in range(nu):
                    line = np.int32(line + row[b])
                    sum_u = np.int32(sum_u + np.int32(row[b] * np.int32(b - ru)))
                    top = max(top, row[b])
                sum_v = np.int32(sum_v + np.int32(line * np.int32(a - rv)))
            if top == 0:
                out[y, x] = empty
                continue
            best_a, best_u, best_v = np.int32(top * one), np.int32(0), np.int32(0)
            for f in range(2, 6):
                gu = np.int32(min(127, max(-127, int(np.rint(0.25 * f * scale_u * sum_u)))))
                gv = np.int32(min(127, max(-127, int(np.rint(0.25 * f * scale_v * sum_v)))))
                if gu == 0 and gv == 0:
                    continue
                least = np.int32(-(1 << 30))
                for a in range(nv):
                    row = wide[y + a, x : x + nu]
                    rest = np.int32(gv * np.int32(a - rv))
                    for b in range(nu):
                        value = np.int32(np.int32(row[b] * one) - np.int32(gu * np.int32(b - ru)))
                        least = max(least, np.int32(value - rest))
                if least < best_a:
                    best_a, best_u, best_v = least, gu, gv
            word = np.uint32(best_a) | (np.uint32(best_u + 128) << np.uint32(16))
            out[y, x] = word | (np.uint32(best_v + 128) << np.uint32(24))


# ---------------------------------------------------------------- cells and leaves


@jit
def fill_cells(cosine, sine, pu, pv, start, cu, cv):
    """Cells of all points at one angle and translation 0; ``pu``, ``pv`` in cells about the pivot.

    ``start`` holds the pivot's cell coordinates and the ratio of the cells' sides.
    """
    a, b = sine * start[2], sine * start[3]
    for k in range(pu.shape[0]):
        cu[k] = np.int32(np.floor(cosine * pu[k] - a * pv[k] + start[0]))
        cv[k] = np.int32(np.floor(b * pu[k] + cosine * pv[k] + start[1]))


@jit
def score_box(base, n, cu, cv, weight, chunk, lanes, v0, nv, u0, nu, at, out):
    """Scores of nv x nu neighbouring translations at one angle, three along u in each word."""
    height, width = lanes.shape
    table = lanes.reshape(height * width)
    own_u, own_v, cells = cu[base : base + n], cv[base : base + n], at[:n]
    right, low, stride = np.int32(width - 1), np.int32(height - 1), np.int32(width)
    words = (nu + 2) // 3
    for i in range(nv):
        shift_v = np.int32(v0 + i + 1)
        for m in range(words):
            left = 3 * m
            shift_u = np.int32(u0 + left + 3)
            for p in range(n):
                x = min(max(np.int32(own_u[p] + shift_u), np.int32(0)), right)
                y = min(max(np.int32(own_v[p] + shift_v), np.int32(0)), low)
                cells[p] = np.int32(np.int32(y * stride) + x)
            s0, s1, s2 = np.int64(0), np.int64(0), np.int64(0)
            k = 0
            while k < n:
                stop = min(n, k + chunk)
                word = np.uint64(0)
                for p in range(k, stop):
                    word += table[np.uint64(cells[p])] * weight[p]
                s0 += np.int64(word & np.uint64(LANE_SUM))
                s1 += np.int64((word >> np.uint64(LANE)) & np.uint64(LANE_SUM))
                s2 += np.int64(word >> np.uint64(2 * LANE))
                k = stop
            out[i * nu + left] = s0
            if left + 1 < nu:
                out[i * nu + left + 1] = s1
            if left + 2 < nu:
                out[i * nu + left + 2] = s2


# ---------------------------------------------------------------- heap


@jit
def before(ka, ca, kb, cb):
    """Whether entry a leaves the queue before b: greater key, then lesser code."""
    return ka > kb or (ka == kb and ca < cb)


@jit
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


@jit
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


@jit
def pack(t, v, u):
    """One code for three indices; codes compare lexicographically as (theta, v, u)."""
    return (np.int64(t) << (2 * SHIFT_NODE)) | (np.int64(v) << SHIFT_NODE) | np.int64(u)


@jit
def keeps(bound, code, cut, cut_code):
    """Whether a node may hold a leaf that beats the incumbent, ties in lexicographic order."""
    return bound > cut or (bound == cut and code < cut_code)


@jit
def ensure_cells(it, n, pu, pv, cosine, sine, start, cu, cv, have):
    """Compute the cells at angle ``it`` unless they are there."""
    if have[it] == 0:
        own = slice(it * n, it * n + n)
        fill_cells(cosine[it], sine[it], pu, pv, start, cu[own], cv[own])
        have[it] = 1


@jit
def merge_blocks(cu, cv, weight, classes, bu, bv, at, lists, counts, slot):
    """Blocks that the points fall into at one (level, angle), neighbours merged; kept in ``lists``.

    Rows of ``lists``: block in u, block in v, slack class, weight. Dividing by multiplication is exact
    here: a cell's middle is half a cell from any border, far above rounding.
    """
    n = cu.shape[0]
    first = slot * n
    inverse_u, inverse_v = 1.0 / bu, 1.0 / bv
    for k in range(n):
        at[k] = np.int32(np.floor((cu[k] + 0.5) * inverse_u))
        at[n + k] = np.int32(np.floor((cv[k] + 0.5) * inverse_v))
    m = first - 1
    last_u, last_v, last_c = np.int32(0), np.int32(0), np.int32(-1)
    for k in range(n):
        x, y, c = at[np.uint64(k)], at[np.uint64(n + k)], np.int32(classes[k])
        if x == last_u and y == last_v and c == last_c:
            lists[3, m] += np.int32(weight[k])
        else:
            m += 1
            lists[0, m], lists[1, m], lists[2, m], lists[3, m] = x, y, c, np.int32(weight[k])
            last_u, last_v, last_c = x, y, c
    counts[slot] = m - first + 1


@jit
def bound_box(slot, n, lists, counts, blocks, place, v0, nv, u0, nu, tally, out):
    """Block bounds of nv x nu neighbouring nodes at one (level, angle); ``tally`` is scratch.

    ``place`` (classes, 5): offset into ``blocks``, rows, columns, lowest block in u and v.
    """
    tally[: nv * nu] = 0
    for m in range(slot * n, slot * n + counts[slot]):
        where = place[lists[2, m]]
        weight = lists[3, m]
        x = np.int64(lists[0, m]) + u0 - where[3]
        y = np.int64(lists[1, m]) + v0 - where[4]
        i0, i1 = max(0, -y), min(nv, where[1] - y)
        j0, j1 = max(0, -x), min(nu, where[2] - x)
        if j0 >= j1:
            continue
        for i in range(i0, i1):
            line = where[0] + (y + i) * where[2] + x
            row, sums = blocks[line + j0 : line + j1], tally[i * nu + j0 : i * nu + j1]
            for j in range(row.shape[0]):
                sums[j] = np.int32(sums[j] + np.int32(weight * np.int32(row[j])))
    for i in range(nv * nu):
        out[i] = tally[i]


@jit
def point_classes(n, pu, pv, qu, qv, eta, class_of, out):
    """Slack class of every point on every level; ``eta`` (levels,) is half a node's angle.

    A point at radius rho moves by at most 2 rho sin(min(eta, pi) / 2), so its cell by at most that
    many cells, rounded up. ``class_of`` (levels, slacks) maps cells of slack to a class.
    """
    last = class_of.shape[1] - 1
    for level in range(eta.shape[0]):
        arm = 2.0 * np.sin(0.5 * min(eta[level], np.pi)) / min(qu, qv)
        for k in range(n):
            move = arm * np.sqrt(pu[k] * pu[k] * qu * qu + pv[k] * pv[k] * qv * qv)
            slack = 0
            if move > 0.0:
                slack = int(np.ceil(move + 1e-9))
            out[level * n + k] = class_of[level, min(slack, last)]


@jit
def affine_classes(first, middle, bt, n, cu, cv, class_of, at, out):
    """Slack class of every point at one (level, angle) from the cells at the interval's very angles."""
    last = class_of.shape[0] - 1
    mu, mv = cu[middle * n : middle * n + n], cv[middle * n : middle * n + n]
    most = at[:n]
    most[:] = 0
    for i in range(first, first + bt):
        ou, ov = cu[i * n : i * n + n], cv[i * n : i * n + n]
        for k in range(n):
            a, b = np.int32(ou[k] - mu[k]), np.int32(ov[k] - mv[k])
            most[k] = max(most[k], a, np.int32(-a), b, np.int32(-b))
    for k in range(n):
        out[k] = class_of[np.uint64(min(most[k], last))]


@jit
def affine_pass(cu, cv, classes, weight, du, dv, where, tables, at, gu, gv, sums):
    """Sum of majorants at one pose: constants and slopes into ``sums``, weighted slopes a point kept.

    All arrays run over the points; ``where``: offset into ``tables``, rows, columns, rim. Three
    loops, so that all but the look-ups become vector code.
    """
    offset, rows, columns, pad = where[0], where[1], where[2], where[3]
    right, low, stride = np.int32(columns - 1), np.int32(rows - 1), np.int32(rows * columns)
    shift_u, shift_v, width = np.int32(du + pad), np.int32(dv + pad), np.int32(columns)
    for k in range(cu.shape[0]):
        x = min(max(np.int32(cu[k] + shift_u), np.int32(0)), right)
        y = min(max(np.int32(cv[k] + shift_v), np.int32(0)), low)
        at[k] = np.int32(np.int32(np.int32(y * width) + x) + np.int32(np.int32(classes[k]) * stride))
    for k in range(cu.shape[0]):
        at[k] = np.int32(tables[np.uint64(offset + at[k])])
    total, total_u, total_v = np.int64(0), np.int32(0), np.int32(0)
    for k in range(cu.shape[0]):
        word, w = at[k], np.int32(weight[k])
        a = np.int32(w * np.int32(np.int32(np.int32(word >> np.int32(16)) & np.int32(255)) - np.int32(128)))
        b = np.int32(w * np.int32(np.int32(np.int32(word >> np.int32(24)) & np.int32(255)) - np.int32(128)))
        total += np.int64(np.int32(w * np.int32(word & np.int32(65535))))
        total_u = np.int32(total_u + a)
        total_v = np.int32(total_v + b)
        gu[k] = a
        gv[k] = b
    sums[0], sums[1], sums[2] = total, total_u, total_v


@jit
def turn_gain(cu, cv, other_u, other_v, gu, gv):
    """Sum of slope times cells moved between two angles."""
    total = np.int32(0)
    for k in range(cu.shape[0]):
        a = np.int32(gu[k] * np.int32(other_u[k] - cu[k]))
        b = np.int32(gv[k] * np.int32(other_v[k] - cv[k]))
        total = np.int32(total + np.int32(a + b))
    return np.int64(total)


@jit
def search(
    options, pu, pv, weight, start, cosine, sine, size, count, lanes, blocks, place, affine, affine_place,
    class_of, classes, slots, prior, prior_at, cu, cv, have, lists, list_counts, near, near_have, at, gu, gv,
    tally, box, root, keys, codes, found_codes, found_scores, state,
):  # fmt: skip
    """Best-first branch and bound over (theta, v, u); resumable, see ``grcsm.py`` for the arguments."""
    n, first, top = options[0], options[1], options[2]
    chunk, limit, slice_limit = options[3], options[4], options[5]
    collect, floor_score, has_prior = options[6], options[7], options[8]
    sums = np.empty(3, np.int64)
    turns = np.empty(max(1, size[top, 2]), np.int64) if affine.shape[0] > 1 else np.empty(1, np.int64)
    n_heap, cut, cut_code = state[HEAP], state[BEST], state[BEST_CODE]
    evaluations, n_found = state[EVALUATIONS], state[FOUND]
    started = evaluations
    if collect:
        cut, cut_code = floor_score - 1, np.int64(0)
    diving = False
    level, t, v, u, bound = np.int64(0), np.int64(0), np.int64(0), np.int64(0), np.int64(0)

    if state[PHASE] == 0:
        # every node of the first level, then a greedy dive from the best of them
        nt, nv, nu = count[first, 2], count[first, 1], count[first, 0]
        best_root, best_at = -(np.int64(1) << 60), np.int64(0)
        for it in range(nt):
            if first == 0:
                ensure_cells(it, n, pu, pv, cosine, sine, start, cu, cv, have)
                score_box(it * n, n, cu, cv, weight, chunk, lanes, 0, nv, 0, nu, at, box)
            else:
                middle = it * size[first, 2] + size[first, 2] // 2
                ensure_cells(middle, n, pu, pv, cosine, sine, start, cu, cv, have)
                slot = slots[first] + it
                if list_counts[slot] < 0:
                    own = slice(middle * n, middle * n + n)
                    merge_blocks(
                        cu[own], cv[own], weight, classes[first * n : first * n + n], size[first, 0],
                        size[first, 1], at, lists, list_counts, slot,
                    )  # fmt: skip
                bound_box(slot, n, lists, list_counts, blocks, place[first], 0, nv, 0, nu, tally, box)
            for i in range(nv * nu):
                value = box[i]
                if has_prior:
                    value += (
                        prior[prior_at[first, 2] + it]
                        + prior[prior_at[first, 1] + i // nu]
                        + prior[prior_at[first, 0] + i % nu]
                    )
                root[it * nv * nu + i] = value
                if value > best_root:
                    best_root, best_at = value, it * nv * nu + i
        evaluations += nt * nv * nu
        state[PHASE] = 1
        if first == 0:
            for i in range(nt * nv * nu):
                code = pack(i // (nv * nu), (i // nu) % nv, i % nu)
                if collect:
                    if root[i] > cut:
                        if n_found < found_codes.shape[0]:
                            found_codes[n_found], found_scores[n_found] = code, root[i]
                        n_found += 1
                elif keeps(root[i], code, cut, cut_code):
                    cut, cut_code = root[i], code
        elif best_root > cut:
            diving = True
            level, bound = first, best_root
            t, v, u = best_at // (nv * nu), (best_at // nu) % nv, best_at % nu
            root[best_at] = -(np.int64(1) << 60)

    stop = DONE
    while True:
        if not diving:
            if state[PHASE] == 1:
                # the incumbent is known: queue what can still beat it
                if first > 0:
                    nt, nv, nu = count[first, 2], count[first, 1], count[first, 0]
                    if keys.shape[0] < n_heap + nt * nv * nu:
                        stop = HEAP_FULL
                        break
                    bu, bv, bt = size[first, 0], size[first, 1], size[first, 2]
                    for it in range(nt):
                        for i in range(nv * nu):
                            value = root[it * nv * nu + i]
                            if value < cut:
                                continue
                            code = pack(it * bt, (i // nu) * bv, (i % nu) * bu)
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
            if evaluations >= limit:
                stop = BUDGET
                break
            if evaluations - started >= slice_limit:
                stop = BUDGET
                break
            level = 63 - (keys[0] & 63)
            t = (code >> (2 * SHIFT_NODE)) // size[level, 2]
            v = ((code >> SHIFT_NODE) & ((1 << SHIFT_NODE) - 1)) // size[level, 1]
            u = (code & ((1 << SHIFT_NODE) - 1)) // size[level, 0]
            bt, bv, bu = size[level, 2], size[level, 1], size[level, 0]
            lt, lv, lu = size[level - 1, 2], size[level - 1, 1], size[level - 1, 0]
            children = (bt // lt) * (bv // lv) * (bu // lu)
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
        shift = affine_place[level, 4]
        majorant = shift >= 0
        steady, slope_u, slope_v, most_u, most_v = (
            np.int64(0),
            np.int64(0),
            np.int64(0),
            np.int64(0),
            np.int64(0),
        )
        if majorant:
            middle = t0 + bt // 2
            for i in range(t0, t0 + bt):
                if have[i] == 0:
                    ensure_cells(i, n, pu, pv, cosine, sine, start, cu, cv, have)
            flag = slots[level] + t
            class_base = affine_place[level, 5] * n
            if near_have[flag] == 0:
                near_at = class_base + t * n
                affine_classes(t0, middle, bt, n, cu, cv, class_of[level], at, near[near_at : near_at + n])
                near_have[flag] = 1
            here = slice(middle * n, middle * n + n)
            mu, mv = cu[here], cv[here]
            affine_pass(
                mu, mv, near[(class_base + t * n) : (class_base + t * n + n)], weight, u0 + bu // 2,
                v0 + bv // 2, affine_place[level], affine, at[:n], gu[:n], gv[:n], sums,
            )  # fmt: skip
            for i in range(bt):
                if t0 + i == middle:
                    turns[i] = 0
                else:
                    there = slice((t0 + i) * n, (t0 + i) * n + n)
                    turns[i] = turn_gain(mu, mv, cu[there], cv[there], gu[:n], gv[:n])
            steady, slope_u, slope_v = sums[0], sums[1], sums[2]
            # the most that the slopes add within the node, whichever child
            most_u = max(-slope_u * (bu // 2), slope_u * (bu - 1 - bu // 2))
            most_v = max(-slope_v * (bv // 2), slope_v * (bv - 1 - bv // 2))
        best_child, best_key = np.int64(-1), -(np.int64(1) << 60)
        next_t, next_v, next_u = np.int64(0), np.int64(0), np.int64(0)
        for a in range(ft):
            ct = t0 // lt + a
            turn = np.int64(0)
            if majorant:
                turn = turns[a * lt]
                for i in range(1, lt):
                    turn = max(turn, turns[a * lt + i])
                evaluations += fv * fu
                if (steady + turn + most_u + most_v) >> shift < cut:
                    continue  # a log-prior is never positive, so it cannot save the angle
                if level == 1:
                    # score the rows that hold a leaf whose bound beats the incumbent
                    for b in range(fv):
                        line = box[b * fu : (b + 1) * fu]
                        worth = False
                        high = steady + turn + slope_v * (b - bv // 2)
                        if (high + most_u) >> shift < cut:
                            line[:] = NOTHING
                            continue
                        for c in range(fu):
                            value = (high + slope_u * (c - bu // 2)) >> shift
                            if has_prior:
                                value += (
                                    prior[prior_at[0, 2] + ct]
                                    + prior[prior_at[0, 1] + v0 + b]
                                    + prior[prior_at[0, 0] + u0 + c]
                                )
                            worth = worth or keeps(min(value, bound), pack(ct, v0 + b, u0 + c), cut, cut_code)
                        if worth:
                            state[EXPANDED] += 1
                            evaluations += fu
                            score_box(ct * n, n, cu, cv, weight, chunk, lanes, v0 + b, 1, u0, fu, at, line)
                        else:
                            line[:] = NOTHING
            elif level > 1:
                middle = ct * lt + lt // 2
                ensure_cells(middle, n, pu, pv, cosine, sine, start, cu, cv, have)
                slot = slots[level - 1] + ct
                if list_counts[slot] < 0:
                    own = slice(middle * n, middle * n + n)
                    merge_blocks(
                        cu[own], cv[own], weight, classes[(level - 1) * n : level * n], lu, lv, at, lists,
                        list_counts, slot,
                    )  # fmt: skip
                bound_box(
                    slot,
                    n,
                    lists,
                    list_counts,
                    blocks,
                    place[level - 1],
                    v0 // lv,
                    fv,
                    u0 // lu,
                    fu,
                    tally,
                    box,
                )
                evaluations += fv * fu
            if level == 1 and not majorant:
                ensure_cells(ct, n, pu, pv, cosine, sine, start, cu, cv, have)
                score_box(ct * n, n, cu, cv, weight, chunk, lanes, v0, fv, u0, fu, at, box)
                evaluations += fv * fu
            for b in range(fv):
                for c in range(fu):
                    if majorant and level > 1:
                        lo, hi = b * lv - bv // 2, (b + 1) * lv - 1 - bv // 2
                        value = steady + turn + max(slope_v * lo, slope_v * hi)
                        lo, hi = c * lu - bu // 2, (c + 1) * lu - 1 - bu // 2
                        value = (value + max(slope_u * lo, slope_u * hi)) >> shift
                    else:
                        value = box[b * fu + c]
                    if has_prior:
                        value += (
                            prior[prior_at[level - 1, 2] + ct]
                            + prior[prior_at[level - 1, 1] + v0 // lv + b]
                            + prior[prior_at[level - 1, 0] + u0 // lu + c]
                        )
                    code = pack(ct * lt, v0 + b * lv, u0 + c * lu)
                    if level == 1:
                        if collect:
                            if value > cut and value > NOTHING // 2:
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


# ---------------------------------------------------------------- other matchers


@jit
def brute(n, pu, pv, weight, chunk, start, cosine, sine, count, lanes, prior, prior_at, has_prior, state):
    """Score every pose of the window; the first of the best in (theta, v, u) order wins."""
    nt, nv, nu = count[0, 2], count[0, 1], count[0, 0]
    cu, cv, at = np.empty(n, np.int32), np.empty(n, np.int32), np.empty(n, np.int32)
    box = np.empty(nu, np.int64)
    best, best_code = np.int64(-(1 << 60)), np.int64(0)
    for t in range(nt):
        fill_cells(cosine[t], sine[t], pu, pv, start, cu, cv)
        for v in range(nv):
            score_box(0, n, cu, cv, weight, chunk, lanes, v, 1, 0, nu, at, box)
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


@jit
def prepare(points, motion, box, shift, swing, scale_u, scale_v, given, pu, pv, weight, out):
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
            reach = max(reach, radius)
            m += 1
    out[0], out[1], out[2], out[3] = pivot_u, pivot_v, reach, m


@jit
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
