"""Quadratic majorants of a look-up table: what bounds a node's children all at once (METHOD, section 3)."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from bimfit.geometry.pose import Array
from bimfit.registration import _kernels_table as _kernels
from bimfit.registration.lattice import Integers, Lattice

QUAD_WINDOW = 3.0  # half a window beyond which a quadratic gains nothing over a plain maximum, in sigma
GRAIN = 4.0  # half a block, in a record's cells; measured
FITS = 2  # windows that quadratics are fitted to; measured


def majorant_tables(
    leaf: NDArray[np.uint8],
    lattice: Lattice,
    slacks: list[Integers],
    levels: tuple[int, ...],
    shared: int,
    sigma: float,
) -> tuple[NDArray[np.uint64], Integers, Array]:
    """Quadratic majorants of some levels, where they lie, and their scales; see ``Tables``.

    Levels under the ``shared`` one use its tables. ``sigma``: the blur in cells of the finer axis.
    """
    place = np.full((lattice.top + 1, 8), -1, np.int64)
    scales = np.zeros((lattice.top + 1, 4))
    parts: list[NDArray[np.uint64]] = []
    offset, angles = 0, 0
    steps, unit_g, unit_h = _units(sigma)
    for level in levels[::-1]:
        if level < shared:
            place[level], scales[level] = place[shared], scales[shared]
        else:
            ru, rv = (int(size) // 2 for size in lattice.size[level, :2])
            made, where, most = _level(leaf, ru, rv, slacks[level], sigma)
            place[level, :7] = offset, *where
            scales[level] = unit_g, unit_h, 1.0 / steps, most / steps
            parts.append(made.ravel())
            offset += made.size
        place[level, 7] = angles
        angles += int(lattice.nodes[level, 2])
    return (np.concatenate(parts) if parts else np.zeros(1, np.uint64)), place, scales


def _level(
    leaf: NDArray[np.uint8], ru: int, rv: int, slacks: Integers, sigma: float
) -> tuple[NDArray[np.uint64], tuple[int, ...], float]:
    """Tables (classes, rows, columns) of one level, their place, and the greatest sum of a record's terms.

    Windows reach ``ru`` and ``rv`` cells and one of ``slacks`` to both sides.
    """
    height, width = leaf.shape
    steps, unit_g, unit_h = _units(sigma)
    most = int(slacks[-1])
    eu, ev = (_grain(r + most // 2) for r in (ru, rv))
    reach_u, reach_v = ru + most + (1 << eu), rv + most + (1 << ev)
    rim_u, rim_v = (reach_u >> eu) + 1, (reach_v >> ev) + 1
    columns, rows = rim_u + 1 - (-(width + reach_u) >> eu), rim_v + 1 - (-(height + reach_v) >> ev)
    out = np.full((len(slacks), rows, columns), _kernels.pack_quad(0, 0, 0, 0, 0, 0), np.uint64)
    fitted = int(np.sum(max(ru, rv) + slacks <= QUAD_WINDOW * sigma))
    peak = 0.0 if fitted == len(slacks) else _kernels.FULL * steps
    if fitted:
        halves = np.stack([r + (1 << e) // 2 + slacks[:fitted] for r, e in ((ru, eu), (rv, ev))], axis=1)
        rim = rim_u << eu, rim_v << ev
        peak = max(peak, fit_quads(leaf, halves, (eu, ev), rim, (steps, unit_g, unit_h), out[:fitted]))
    for slack, table in zip(slacks[fitted:].tolist(), out[fitted:], strict=True):
        _kernels.flat_table(leaf, ru + slack, rv + slack, eu, ev, rim_u, rim_v, steps, table)
    return out, (rows, columns, eu, ev, rim_u << eu, rim_v << ev), peak


def fit_quads(
    leaf: NDArray[np.uint8],
    halves: Integers,
    grain: tuple[int, int],
    rim: tuple[int, int],
    units: tuple[float, float, float],
    out: NDArray[np.uint64],
) -> float:
    """Quadratics over windows that reach ``halves`` (classes, 2) cells from a record's middle one.

    Parameters
    ----------
    grain, rim : tuple of 2 int
        Log2 of the cells that a record serves, and cells before the table's first one, in u and v.
    units : tuple of 3 float
        Steps of a leaf's unit, of slope and of curvature.
    out : ndarray of uint64, shape (classes, rows, columns)
        All words of quadratics that are nothing.

    Returns
    -------
    float
        The greatest sum of magnitudes of a record's terms anywhere in its window.
    """
    steps, unit_g, unit_h = units
    (eu, ev), classes, rows, columns = grain, *out.shape
    # where a record's middle cell lies behind the first one that its greatest window holds
    middle = halves[-1]
    size = (rows << ev) + 2 * int(middle[1]), (columns << eu) + (-(-2 * int(middle[0]) >> eu) << eu)
    wide = np.zeros(size, np.float32)
    x, y = rim[0] - (1 << eu) // 2 + int(middle[0]), rim[1] - (1 << ev) // 2 + int(middle[1])
    wide[y : y + leaf.shape[0], x : x + leaf.shape[1]] = np.float32(steps) * leaf
    wide = np.ascontiguousarray(wide.reshape(size[0], -1, 1 << eu).transpose(2, 0, 1))
    fits = (2 * np.arange(FITS) + 1) * classes // (2 * FITS)
    single = np.float32
    room = _kernels.Room(
        np.empty((6, columns), single), np.empty((3, columns), single),
        np.zeros((FITS + 1, 5, columns), single), np.empty(columns, single),
        np.empty((classes, columns), single), np.empty((classes, columns), single),
        np.empty((classes, columns), np.int32),
    )  # fmt: skip
    sums = np.empty((FITS, 3, size[0], columns), np.float32)
    fresh = _fresh(wide, (columns, rows), middle, grain)
    return float(
        _kernels.quad_tables(
            wide, int(middle[0]), int(middle[1]), eu, ev, halves, fits, unit_g, unit_h, _kernels.FULL * steps,
            _stretches(fresh), sums, room, out,
        )
    )  # fmt: skip


def _fresh(
    wide: NDArray[np.float32], count: tuple[int, int], middle: Integers, grain: tuple[int, int]
) -> NDArray[np.bool_]:
    """Records (rows, columns) whose windows do not hold what those of the record before them hold.

    Along a face that follows the u axis, and beside the model, windows repeat.
    """
    changed = np.zeros((wide.shape[1], wide.shape[2]), bool)
    changed[:, 1:] = (wide[:, :, 1:] != wide[:, :, :-1]).any(axis=0)
    across, tall = (2 * int(middle[0]) >> grain[0]) + 1, 2 * int(middle[1]) + 1
    rows, columns = np.arange(count[1]) << grain[1], np.arange(count[0])
    total = np.zeros((changed.shape[0] + 1, changed.shape[1] + 1), np.int32)
    total[1:, 1:] = changed.cumsum(axis=0, dtype=np.int32).cumsum(axis=1, dtype=np.int32)
    below = total[rows + tall] - total[rows]
    return np.asarray(below[:, columns + across] > below[:, columns])


def _stretches(fresh: NDArray[np.bool_]) -> Integers:
    """Row, begin and end of every run of a row, and where the next one begins; shape (n, 4)."""
    turn = np.diff(fresh.astype(np.int8), axis=1, prepend=0, append=0)
    row, begin = np.nonzero(turn == 1)
    end = np.nonzero(turn == -1)[1]
    until = np.full(len(row), fresh.shape[1])
    until[:-1] = np.where(row[1:] == row[:-1], begin[1:], until[:-1])
    return np.stack([row, begin, end, until], axis=1).astype(np.int64)


def _units(sigma: float) -> tuple[float, float, float]:
    """Steps of a leaf's unit that a constant is held in, and units of slope and curvature in those steps.

    Powers of two, so that what is stored is exact in floating point. Sized for a Gaussian of ``sigma``
    cells, whose steepest slope is 255 exp(-1/2) / sigma and whose greatest curvature 255 / (2 sigma^2).
    """
    steps = 2.0 ** min(7, max(0, math.floor(2.0 * math.log2(max(sigma, 1.0)))))
    peak = _kernels.FULL * steps
    slope = 1.1 * peak * math.exp(-0.5) / sigma / _kernels.MOST_G
    bend = 1.1 * peak / (2.0 * sigma * sigma) / _kernels.MOST_H
    return steps, 2.0 ** math.ceil(math.log2(slope)), 2.0 ** math.ceil(math.log2(bend))


def _grain(radius: int) -> int:
    """Log2 of the cells a record serves along an axis: about a quarter of the window that it must cover."""
    return max(0, int(math.log2(max(1.0, radius / GRAIN))))
