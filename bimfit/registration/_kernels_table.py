"""Every compiled function that builds look-up tables; ``table.py`` validates and allocates."""

from __future__ import annotations

import numpy as np

from bimfit._kernels import jit, jit_fast, jit_inner_fast

FULL = 255  # leaf value on the model itself
LANE = 21  # bits of one of three sums that share a machine word
MANY_TRIES = 12  # half a window up to which flatter quadratics are tried, too
RIM = 16  # columns of zeros, or more, that end a row of a block table: rows are read in whole vectors
# bits of a quadratic's word: constant, two slopes, three curvatures
BITS_A, BITS_G, BITS_H = 16, 12, 8
MOST_A, MOST_G, MOST_H = (1 << BITS_A) - 1, (1 << (BITS_G - 1)) - 1, (1 << (BITS_H - 1)) - 1


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
def block_table(leaf, bu, bv, slack, low_u, low_v, rim, out):
    """Overlapped block maxima: out[b] = max of leaf over b B - slack .. (b + 2) B - 2 + slack an axis.

    ``rim`` zeros end a row.
    """
    height, width = leaf.shape
    rows, columns = out.shape[0], out.shape[1] - rim
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
def pack_quad(a, gu, gv, huu, huv, hvv):
    """One word of a quadratic: A, huu, hvv in the low half; gu, gv, huv in the high half; signs by offset."""
    low = np.uint64(a) | (np.uint64(huu + 128) << np.uint64(16)) | (np.uint64(hvv + 128) << np.uint64(24))
    high = (
        np.uint64(gu + 2048)
        | (np.uint64(gv + 2048) << np.uint64(12))
        | (np.uint64(huv + 128) << np.uint64(24))
    )
    return low | (high << np.uint64(32))


@jit_inner_fast
def residual(wide, y, x, ru, rv, gu, gv, huu, huv, hvv):
    """Greatest value over a window less gu du + gv dv + huu du^2 + huv du dv + hvv dv^2."""
    least = np.float32(-1e30)
    for a in range(2 * rv + 1):
        dv = np.float32(a - rv)
        line = np.uint64(y + a)
        steady = dv * (gv + hvv * dv)
        slope = gu + huv * dv
        for b in range(2 * ru + 1):
            du = np.float32(np.int32(b) - np.int32(ru))
            least = max(least, wide[line, np.uint64(x + b)] - du * (slope + huu * du) - steady)
    return least


@jit_fast
def row_sums(wide, ru, eu, columns, sums, tops):
    """Sums of value, value du and value du^2 (3, rows, columns), and tops, over each record's row windows."""
    for y in range(wide.shape[0]):
        line = np.uint64(y)
        for x in range(columns):
            s0, s1, s2, top = np.float32(0.0), np.float32(0.0), np.float32(0.0), np.float32(0.0)
            for b in range(2 * ru + 1):
                du = np.float32(np.int32(b) - np.int32(ru))
                value = wide[line, np.uint64((x << eu) + b)]
                s0 += value
                s1 += value * du
                s2 += value * du * du
                top = max(top, value)
            sums[0, y, x], sums[1, y, x], sums[2, y, x] = s0, s1, s2
            tops[y, x] = top


@jit_fast
def window_sums(sums, tops, y, rv, out):
    """Sums over the windows of one row of records, in ``out`` (7, columns).

    Of the value times 1, du, dv, du^2, du dv, dv^2; and the greatest value.
    """
    for k in range(7):
        for x in range(out.shape[1]):
            out[k, x] = np.float32(0.0)
    for a in range(2 * rv + 1):
        dv = np.float32(a - rv)
        for x in range(out.shape[1]):
            s0, s1 = sums[0, y + a, x], sums[1, y + a, x]
            out[0, x] += s0
            out[1, x] += s1
            out[2, x] += s0 * dv
            out[3, x] += sums[2, y + a, x]
            out[4, x] += s1 * dv
            out[5, x] += s0 * dv * dv
            out[6, x] = max(out[6, x], tops[y + a, x])


@jit
def whole(value, most):
    """The nearest integer within -most .. most."""
    return min(most, max(-most, int(np.rint(value))))


@jit
def quad_table(leaf, ru, rv, eu, ev, rim_u, rim_v, scale, unit_g, unit_h, out):
    """Quadratic majorants: scale leaf[c + d] <= A + g . d + d' h d for d within ru, rv of a record's cells.

    A record serves 2^eu x 2^ev cells; d counts from the middle one, (X - rim_u) 2^eu + 2^eu // 2 along u.
    The least-squares quadratic of the window, and flatter ones: kept is the one that lies least above
    the table on average. Slopes are stored in steps of ``unit_g``, curvatures of ``unit_h``.

    Returns the greatest sum of magnitudes of a record's terms anywhere in its window.
    """
    rows, columns = out.shape
    height, width = leaf.shape
    wu, wv = ru + (1 << eu) // 2, rv + (1 << ev) // 2
    wide = np.zeros((rows * (1 << ev) + 2 * wv, columns * (1 << eu) + 2 * wu), np.float32)
    y0, x0 = (rim_v << ev) - (1 << ev) // 2 + wv, (rim_u << eu) - (1 << eu) // 2 + wu
    for i in range(height):
        for j in range(width):
            wide[y0 + i, x0 + j] = scale * leaf[i, j]
    nu, nv = 2 * wu + 1, 2 * wv + 1
    mu, mv = wu * (wu + 1) / 3.0, wv * (wv + 1) / 3.0  # mean of du^2, dv^2
    ku, kv = nu * (nu * nu - 1.0) * (nu * nu - 4.0) / 180.0, nv * (nv * nv - 1.0) * (nv * nv - 4.0) / 180.0
    flat = pack_quad(0, 0, 0, 0, 0, 0)
    tries = 4 if max(wu, wv) <= MANY_TRIES else 1
    parts = np.empty((3, wide.shape[0], columns), np.float32)
    tops = np.empty((wide.shape[0], columns), np.float32)
    row_sums(wide, wu, eu, columns, parts, tops)
    sums = np.empty((7, columns), np.float32)
    most = 0.0
    for y in range(rows):
        window_sums(parts, tops, y << ev, wv, sums)
        for x in range(columns):
            top = float(sums[6, x])
            if top == 0.0:
                out[y, x] = flat
                continue
            best, word = top, pack_quad(min(MOST_A, int(np.ceil(top))), 0, 0, 0, 0, 0)
            peak = top
            slope_u, slope_v, bend_u, bend_v, twist = 0.0, 0.0, 0.0, 0.0, 0.0
            if wu > 0:
                slope_u = sums[1, x] / (nv * nu * mu)
                bend_u = (sums[3, x] - mu * sums[0, x]) / (nv * ku)
            if wv > 0:
                slope_v = sums[2, x] / (nu * nv * mv)
                bend_v = (sums[5, x] - mv * sums[0, x]) / (nu * kv)
            if wu > 0 and wv > 0:
                twist = sums[4, x] / (nu * mu * nv * mv)
            for f in range(tries):
                bend = 1.0 - f / 3.0
                gu, gv = whole(slope_u / unit_g, MOST_G), whole(slope_v / unit_g, MOST_G)
                huu, hvv = whole(bend * bend_u / unit_h, MOST_H), whole(bend * bend_v / unit_h, MOST_H)
                huv = whole(bend * twist / unit_h, MOST_H)
                slopes = unit_g * (abs(gu) * wu + abs(gv) * wv)
                bends = unit_h * (abs(huu) * wu * wu + abs(huv) * wu * wv + abs(hvv) * wv * wv)
                # single precision: terms of the sum's magnitude lose a few parts in ten million
                a = np.ceil(
                    0.05
                    + 1e-6 * (top + slopes + bends)
                    + residual(
                        wide, y << ev, x << eu, wu, wv, np.float32(gu * unit_g), np.float32(gv * unit_g),
                        np.float32(huu * unit_h), np.float32(huv * unit_h), np.float32(hvv * unit_h),
                    )
                )  # fmt: skip
                mean = a + unit_h * (huu * mu + hvv * mv)
                if 0.0 <= a <= MOST_A and mean < best:
                    best, word = mean, pack_quad(int(a), gu, gv, huu, huv, hvv)
                    peak = a + slopes + bends
            out[y, x] = word
            most = max(most, peak)
    return most


@jit
def flat_table(leaf, ru, rv, eu, ev, rim_u, rim_v, scale, out):
    """The same with constants alone: the plain maximum over the window."""
    rows, columns = out.shape
    height, width = leaf.shape
    part = np.zeros((height, columns), np.uint8)
    for i in range(height):
        for x in range(columns):
            first = max(0, ((x - rim_u) << eu) - ru)
            last = min(width - 1, ((x - rim_u + 1) << eu) - 1 + ru)
            top = np.uint8(0)
            for j in range(first, last + 1):
                top = max(top, leaf[i, j])
            part[i, x] = top
    for y in range(rows):
        first = max(0, ((y - rim_v) << ev) - rv)
        last = min(height - 1, ((y - rim_v + 1) << ev) - 1 + rv)
        for x in range(columns):
            top = np.uint8(0)
            for i in range(first, last + 1):
                top = max(top, part[i, x])
            out[y, x] = pack_quad(int(np.ceil(scale * top)), 0, 0, 0, 0, 0)
