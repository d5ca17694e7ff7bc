"""Every compiled function that builds look-up tables; ``table.py`` validates and allocates."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bimfit._kernels import jit, jit_fast, jit_inner_fast

FULL = 255  # leaf value on the model itself
LANE = 21  # bits of one of three sums that share a machine word
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


class Room(NamedTuple):
    """Scratch arrays for one row of records, all (..., columns).

    Sums over a window (6), terms of a row of cells (3), quadratics tried (fits + 1, 5; the last one flat),
    the greatest residual; and a class: the least mean so far, its constant, and whose it is.
    """

    sums: NDArray[np.float32]
    terms: NDArray[np.float32]
    coef: NDArray[np.float32]
    residual: NDArray[np.float32]
    best: NDArray[np.float32]
    constant: NDArray[np.float32]
    chosen: NDArray[np.int32]


@jit_fast
def row_sums(wide, first, ru, eu, sums):
    """Sums of value, value du and value du^2 (3, rows, columns) over each record's row windows.

    They begin at the record's cell ``first``.
    """
    sums[:] = np.float32(0.0)
    for y in range(wide.shape[1]):
        for b in range(2 * ru + 1):
            du = np.float32(b - ru)
            cells, shift = wide[(first + b) & ((1 << eu) - 1), y], (first + b) >> eu
            for x in range(sums.shape[2]):
                value = cells[np.uint64(x + shift)]
                sums[0, y, x] += value
                sums[1, y, x] += value * du
                sums[2, y, x] += value * du * du


@jit_fast
def fitted(row_sums, y, ru, rv, unit_g, unit_h, sums, out):
    """Least-squares slopes and curvatures (5, columns) of records of one row, in whole units.

    ``row_sums`` (3, rows, columns): see there; windows reach ``ru`` and ``rv`` from the row ``y``. ``sums``
    (6, columns): those of the value times 1, du, dv, du^2, du dv, dv^2 over a window.
    """
    columns = row_sums.shape[2]
    sums[:] = np.float32(0.0)
    for a in range(-rv, rv + 1):
        dv = np.float32(a)
        s0, s1, s2 = row_sums[0, y + a], row_sums[1, y + a], row_sums[2, y + a]
        for x in range(columns):
            sums[0, x] += s0[x]
            sums[1, x] += s1[x]
            sums[2, x] += s0[x] * dv
            sums[3, x] += s2[x]
            sums[4, x] += s1[x] * dv
            sums[5, x] += s0[x] * dv * dv
    nu, nv = 2.0 * ru + 1.0, 2.0 * rv + 1.0
    mu, mv = ru * (ru + 1) / 3.0, rv * (rv + 1) / 3.0  # mean of du^2, dv^2
    ku, kv = nu * (nu * nu - 1.0) * (nu * nu - 4.0) / 180.0, nv * (nv * nv - 1.0) * (nv * nv - 4.0) / 180.0
    fu, hu = (1.0 / (nv * nu * mu * unit_g), 1.0 / (nv * ku * unit_h)) if ru > 0 else (0.0, 0.0)
    fv, hv = (1.0 / (nu * nv * mv * unit_g), 1.0 / (nu * kv * unit_h)) if rv > 0 else (0.0, 0.0)
    twist = 1.0 / (nu * mu * nv * mv * unit_h) if ru > 0 and rv > 0 else 0.0
    for x in range(columns):
        out[0, x] = whole(fu * sums[1, x], MOST_G)
        out[1, x] = whole(fv * sums[2, x], MOST_G)
        out[2, x] = whole(hu * (sums[3, x] - mu * sums[0, x]), MOST_H)
        out[3, x] = whole(twist * sums[4, x], MOST_H)
        out[4, x] = whole(hv * (sums[5, x] - mv * sums[0, x]), MOST_H)


@jit_inner_fast
def whole(value, most):
    """The nearest integer within -most .. most."""
    return np.float32(min(float(most), max(-float(most), np.rint(value))))


@jit_fast
def residuals(
    wide, columns, y, eu, middle, inner_u, inner_v, ru, rv, unit_g, unit_h, coef, terms, least
):  # fmt: skip
    """Greatest value over each window of records of a row less their quadratics ``coef``, into ``least``.

    Windows reach ``ru`` and ``rv`` to each side of the row ``y`` and of a record's
    cell ``middle``; the part within ``inner``, -1 for none, has been gone through before. All records
    at a time, the cells on both sides of the middle together: vector code.
    """
    phase = (1 << eu) - 1
    gu, gv, huu, huv, hvv = coef[0], coef[1], coef[2], coef[3], coef[4]
    steady, slope, bend = terms[0], terms[1], terms[2]
    one, two = np.float32(unit_g), np.float32(unit_h)
    for x in range(columns):
        bend[x] = two * huu[x]
    for a in range(-rv, rv + 1):
        dv = np.float32(a)
        for x in range(columns):
            slope[x] = one * gu[x] + two * huv[x] * dv
            steady[x] = dv * (one * gv[x] + two * hvv[x] * dv)
        for b in range(inner_u + 1 if abs(a) <= inner_v else 0, ru + 1):
            du, square = np.float32(b), np.float32(b * b)
            left, low = wide[(middle - b) & phase, y + a], (middle - b) >> eu
            right, high = wide[(middle + b) & phase, y + a], (middle + b) >> eu
            for x in range(columns):
                even, odd = steady[x] + square * bend[x], du * slope[x]
                greater = max(left[np.uint64(x + low)] + odd, right[np.uint64(x + high)] - odd)
                least[x] = max(least[x], greater - even)


@jit_fast
def better(fit, columns, ru, rv, unit_g, unit_h, own, room):
    """Take quadratics of a row's records where they lie less above the table on average.

    ``fit`` names them in ``room``, ``own`` the class of windows that reach ``ru`` and ``rv``.
    """
    coef, least = room.coef[fit], room.residual
    best, constant, chosen = room.best[own], room.constant[own], room.chosen[own]
    one, two = np.float32(unit_g), np.float32(unit_h)
    wu, wv = np.float32(ru), np.float32(rv)
    mu, mv = np.float32(ru * (ru + 1) / 3.0), np.float32(rv * (rv + 1) / 3.0)
    for x in range(columns):
        slopes = one * (abs(coef[0, x]) * wu + abs(coef[1, x]) * wv)
        bends = two * (abs(coef[2, x]) * wu * wu + abs(coef[3, x]) * wu * wv + abs(coef[4, x]) * wv * wv)
        # single precision: terms of the sum's magnitude lose a few parts in ten million
        margin = np.float32(0.06) + np.float32(1e-6) * (abs(least[x]) + slopes + bends)
        a = np.ceil(least[x] + (margin if slopes + bends > np.float32(0.0) else np.float32(0.0)))
        mean = a + two * (coef[2, x] * mu + coef[4, x] * mv)
        good = np.float32(0.0) <= a <= np.float32(MOST_A) and mean < best[x]
        best[x] = mean if good else best[x]
        constant[x] = a if good else constant[x]
        chosen[x] = fit if good else chosen[x]


@jit
def pack_row(ru, rv, unit_g, unit_h, own, room, out):
    """Words of a row's records for one class of windows, which reach ``ru`` and ``rv``.

    Returns the greatest sum of magnitudes of a record's terms in its window.
    """
    most = 0.0
    for x in range(out.shape[0]):
        coef, a = room.coef[room.chosen[own, x]], room.constant[own, x]
        gu, gv, huu, huv, hvv = coef[0, x], coef[1, x], coef[2, x], coef[3, x], coef[4, x]
        out[x] = pack_quad(int(a), int(gu), int(gv), int(huu), int(huv), int(hvv))
        slopes = unit_g * (abs(gu) * ru + abs(gv) * rv)
        bends = unit_h * (abs(huu) * ru * ru + abs(huv) * ru * rv + abs(hvv) * rv * rv)
        most = max(most, a + slopes + bends)
    return most


@jit
def quad_tables(
    wide, middle_u, middle_v, eu, ev, halves, fits, unit_g, unit_h, peak, stretches, sums, room, out
):
    """Quadratic majorants: scale leaf[c + d] <= A + g . d + d' h d for d within a window of a record's cells.

    One table (classes, rows, columns) for windows that reach each of ``halves`` (classes, 2) cells to both
    sides; they grow. A record serves 2^eu x 2^ev cells; d counts from the middle one, which lies ``middle_u``
    and ``middle_v`` on from the record's first in ``wide`` (2^eu, rows, columns): cell X 2^eu + p of a row is
    (p, row, X), so that cells of neighbouring records lie side by side. Tried are the least-squares
    quadratics of the windows ``fits``: kept is what lies least above the table on average; the constant
    ``peak``, the greatest value, where none will do. Slopes are stored in steps of ``unit_g``, curvatures of
    ``unit_h``. ``sums`` (fits, 3, rows, columns) and ``room`` are scratch.

    ``stretches`` (n, 4): row, first record, end, end of those after it that are the same as the last one.

    Returns the greatest sum of magnitudes of a record's terms anywhere in its window.
    """
    for f in range(fits.shape[0]):
        half = halves[fits[f], 0]
        row_sums(wide, middle_u - half, half, eu, sums[f])
    most = 0.0
    for k in range(stretches.shape[0]):
        row, begin, end, until = stretches[k]
        y = (row << ev) + middle_v
        room.best[:] = np.float32(1e30)
        room.constant[:] = np.float32(peak)
        room.chosen[:] = np.int32(fits.shape[0])
        for f in range(fits.shape[0]):
            wu, wv = halves[fits[f]]
            fitted(sums[f, :, :, begin:end], y, wu, wv, unit_g, unit_h, room.sums, room.coef[f])
            room.residual[:] = np.float32(-1e30)
            inner_u, inner_v = np.int64(-1), np.int64(-1)
            for c in range(halves.shape[0]):
                wu, wv = halves[c]
                residuals(
                    wide[:, :, begin:], end - begin, y, eu, middle_u, inner_u, inner_v, wu, wv, unit_g,
                    unit_h, room.coef[f], room.terms, room.residual,
                )  # fmt: skip
                better(f, end - begin, wu, wv, unit_g, unit_h, c, room)
                inner_u, inner_v = wu, wv
        for c in range(halves.shape[0]):
            wu, wv = halves[c]
            most = max(most, pack_row(wu, wv, unit_g, unit_h, c, room, out[c, row, begin:end]))
            out[c, row, end:until] = out[c, row, end - 1]
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
