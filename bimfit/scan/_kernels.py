"""Every numba function of the scan room: which points lie in any of many boxes.

Cells of a regular grid list the boxes that reach into them: the boxes of cell c are
``members[starts[c]:starts[c + 1]]``.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bimfit._kernels import jit
from bimfit.geometry.pose import Array

Int32s = NDArray[np.int32]
Int64s = NDArray[np.int64]


@jit
def count_boxes(low: Int32s, high: Int32s, shape: Int64s, counts: Int64s) -> None:
    """Add to ``counts`` (cells + 1,), one place on, the boxes with cells ``low`` .. ``high`` (k, 3)."""
    for b in range(len(low)):
        for i in range(low[b, 0], high[b, 0] + 1):
            for j in range(low[b, 1], high[b, 1] + 1):
                row = (i * shape[1] + j) * shape[2]
                for k in range(low[b, 2], high[b, 2] + 1):
                    counts[row + k + 1] += 1


@jit
def list_boxes(low: Int32s, high: Int32s, shape: Int64s, fill: Int64s, members: Int32s) -> None:
    """Write every box's number into its cells' lists; ``fill`` (cells,) says where each goes on."""
    for b in range(len(low)):
        for i in range(low[b, 0], high[b, 0] + 1):
            for j in range(low[b, 1], high[b, 1] + 1):
                row = (i * shape[1] + j) * shape[2]
                for k in range(low[b, 2], high[b, 2] + 1):
                    members[fill[row + k]] = b
                    fill[row + k] += 1


@jit
def candidates(
    x: NDArray[np.generic],
    y: NDArray[np.generic],
    z: NDArray[np.generic],
    slope: Array,
    shift: Array,
    shape: Int64s,
    marks: NDArray[np.uint8],
    out: Int64s,
) -> int:
    """Which points lie in a marked cell: their numbers in ``out`` (n,), and how many there are.

    ``slope`` and ``shift`` (3,) take x, y, z to cells; ``marks`` has a bit a cell.
    """
    a0, a1, a2 = slope[0], slope[1], slope[2]
    b0, b1, b2 = shift[0], shift[1], shift[2]
    n0, n1, n2 = float(shape[0]), float(shape[1]), float(shape[2])
    rows, columns = shape[1], shape[2]
    count = 0
    for i in range(len(x)):
        a = x[i] * a0 + b0
        b = y[i] * a1 + b1
        c = z[i] * a2 + b2
        if (a >= 0.0) & (a < n0) & (b >= 0.0) & (b < n1) & (c >= 0.0) & (c < n2):
            cell = (int(a) * rows + int(b)) * columns + int(c)
            if marks[cell >> 3] & (1 << (cell & 7)):
                out[count] = i
                count += 1
    return count


@jit
def cells_inside(
    points: Array,
    origin: Array,
    per_cell: float,
    shape: Int64s,
    starts: Int64s,
    members: Int32s,
    low: Array,
    high: Array,
    out: Int64s,
) -> None:
    """For each point (n, 3) the cell it lies in, or -1 where it is in no box; (n,)."""
    for i in range(len(points)):
        out[i] = -1
        p, q, r = points[i, 0], points[i, 1], points[i, 2]
        a = int((p - origin[0]) * per_cell)
        b = int((q - origin[1]) * per_cell)
        c = int((r - origin[2]) * per_cell)
        if a < 0 or a >= shape[0] or b < 0 or b >= shape[1] or c < 0 or c >= shape[2]:
            continue
        cell = (a * shape[1] + b) * shape[2] + c
        for m in range(starts[cell], starts[cell + 1]):
            k = members[m]
            if (
                p >= low[k, 0]
                and p <= high[k, 0]
                and q >= low[k, 1]
                and q <= high[k, 1]
                and r >= low[k, 2]
                and r <= high[k, 2]
            ):
                out[i] = cell
                break
