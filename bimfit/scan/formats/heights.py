"""Heights on a grid, as pictures and profile tables hold them, made into beams.

Column k lies at x = k times the pitch, row k at y = k times the pitch, and heights are z. A row is a sweep.
The beams come from a point so far above the middle that they are parallel to within a quarter of a pixel over
the whole relief: such sensors triangulate, and where they stood is not in the file.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bimfit.geometry.line_scan import LineScan
from bimfit.geometry.pose import Array

Floats = NDArray[np.floating]

_LEAST_VIEW = 10.0
"""The eye is at least so many half diagonals away."""
_LEAN = 5.0
_ROWS = 8
"""So many rows tell a column that is not used from one that chanced upon nothing."""
_TAILS = (0.5, 99.5)


def beams_of_heights(
    heights: Floats,
    xs: Floats,
    ys: Floats,
    source: str = "",
    notes: tuple[str, ...] = (),
) -> LineScan:
    """Make beams of a grid of heights.

    Parameters
    ----------
    heights : ndarray, shape (h, w)
        m; NaN where nothing was measured. At least one is a number.
    xs, ys : ndarray, shape (w,) and (h,)
        Where the columns and the rows lie, m.

    Returns
    -------
    LineScan
        With a sweep a row, and a beam a place; those without height aim at a height between their
        neighbours' in the row. Columns at either end that are empty from the first row to the last are no
        beams: the sensor does not use them.
    """
    used = np.flatnonzero(np.isfinite(heights).any(axis=0))
    if len(heights) >= _ROWS and len(used) < heights.shape[1]:
        heights, xs = heights[:, used[0] : used[-1] + 1], xs[used[0] : used[-1] + 1]
    filled = _filled(heights)
    eye = _eye(heights, xs, ys)
    x, y = np.broadcast_arrays(xs[None, :], ys[:, None])
    way = np.stack([x, y, filled], axis=2).reshape(-1, 3) - eye
    distance = np.sqrt(np.einsum("ij,ij->i", way, way))
    way /= distance[:, None]
    distance[np.isnan(heights).reshape(-1)] = np.nan
    number: NDArray[np.int64] = np.repeat(np.arange(len(ys)), len(xs))
    return LineScan(number, np.tile(eye, (len(way), 1)), way, distance, source, notes)


def _eye(heights: Floats, xs: Floats, ys: Floats) -> Array:
    """Where the beams come from, shape (3,)."""
    half = 0.5 * float(np.hypot(np.ptp(xs), np.ptp(ys)))
    low, high = np.nanpercentile(heights, _TAILS)
    steps = [float(np.median(np.abs(np.diff(line)))) for line in (xs, ys) if len(line) > 1]
    pitch = min([step for step in steps if step > 0.0], default=half or 1e-3)
    away = half * max(_LEAST_VIEW, _LEAN * float(high - low) / pitch)
    middle = 0.5 * (xs.min() + xs.max()), 0.5 * (ys.min() + ys.max())
    return np.array([*middle, float(np.nanmax(heights)) + max(away, 1e-3)])


def _filled(heights: Floats) -> Array:
    """Heights with the holes of each row filled by straight lines, from its nearest ones at the ends."""
    out = heights.astype(np.float64)
    level = float(np.nanmedian(heights))
    places = np.arange(heights.shape[1], dtype=np.float64)
    known = np.isfinite(heights)
    for row in np.flatnonzero(~known.all(axis=1)).tolist():
        here = known[row]
        if here.any():
            out[row, ~here] = np.interp(places[~here], places[here], heights[row, here])
        else:
            out[row] = level
    return out
