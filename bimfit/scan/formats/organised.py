"""Clouds that keep the sensor's grid: rows are sweeps, and empty places beams that saw nothing."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from bimfit.geometry.line_scan import LineScan
from bimfit.geometry.pose import Array
from bimfit.scan.formats.packed import precision_note

PLANAR = math.radians(0.3)
"""Beams of a sweep lie in a plane to within this (rms)."""
_WIDEST_HOLE = math.radians(40.0)
"""Empty places between returns farther apart than this get no direction."""
_SAMPLE = 40


def beams_of(grid: Array, viewpoint: Array, source: str, dtype: np.dtype[np.generic]) -> LineScan | None:
    """Beams of an organised cloud.

    Rows or columns are the sweeps, whichever lie in planes through the viewpoint (columns of a spinning
    scanner, rows of a line scanner, both of a camera). The direction of a beam that did not come back is
    interpolated between its neighbours in the sweep; beyond a sweep's outermost returns it is unknown, and
    such beams are left out.

    Parameters
    ----------
    grid : ndarray, shape (height, width, 3)
        Points, NaN where nothing came back, m.
    viewpoint : ndarray, shape (3,)
    source : str
    dtype : dtype
        Of the numbers in the file.

    Returns
    -------
    LineScan or None
        None where neither rows nor columns are sweeps, so that the viewpoint cannot be right.
    """
    rows, columns = planarity(grid, viewpoint), planarity(grid.transpose(1, 0, 2), viewpoint)
    if not min(rows, columns) <= PLANAR:
        return None
    # both are planes for a camera: rows, as they are stored
    sweeps = grid if rows <= PLANAR else grid.transpose(1, 0, 2)
    scan, unknown = swept(sweeps, viewpoint, source)
    if not len(scan):
        return None
    missing = int((~scan.returned).sum())
    which = "rows" if rows <= PLANAR else "columns"
    notes = (
        f"organised cloud: its {which} are sweeps seen from its viewpoint, {missing} beams without return",
        *((f"{unknown} empty places at the ends of sweeps left out",) if unknown else ()),
        *precision_note(scan.hits, dtype),
    )
    return replace(scan, notes=notes)


def swept(sweeps: Array, viewpoint: Array, source: str, first: int = 0) -> tuple[LineScan, int]:
    """Beams of sweeps as seen from one place.

    Parameters
    ----------
    sweeps : ndarray, shape (sweeps, places, 3)
        Points, NaN where nothing came back, m.
    viewpoint : ndarray, shape (3,)
    first : int
        Number of the first sweep.

    Returns
    -------
    scan : LineScan
    unknown : int
        How many empty places beyond a sweep's outermost returns were left out.
    """
    numbers, ways, ranges = [np.zeros(0, np.int64)], [np.zeros((0, 3))], [np.zeros(0)]
    unknown = 0
    for number, sweep in enumerate(sweeps, start=first):
        way, distance = _filled(sweep - viewpoint)
        known = np.isfinite(way).all(axis=1)
        unknown += int((~known).sum())
        numbers.append(np.full(int(known.sum()), number))
        ways.append(way[known])
        ranges.append(distance[known])
    directions = np.concatenate(ways)
    origins = np.broadcast_to(viewpoint, directions.shape)
    return LineScan.of(np.concatenate(numbers), origins, directions, np.concatenate(ranges), source), unknown


def planarity(sweeps: Array, viewpoint: Array) -> float:
    """Typical rms angle of beams out of their sweep's plane, rad; inf where nothing can be said."""
    out = []
    for k in np.unique(np.linspace(0, len(sweeps) - 1, _SAMPLE).astype(int)):
        way = sweeps[k] - viewpoint
        way = way[np.isfinite(way).all(axis=1)]
        size = np.linalg.norm(way, axis=1)
        if np.count_nonzero(size > 0.0) < 8:
            continue
        unit = way[size > 0.0] / size[size > 0.0, None]
        values = np.linalg.svd(unit, compute_uv=False) / math.sqrt(len(unit))
        # a bundle of nearly parallel beams lies in any plane
        if values[1] > 5.0 * math.radians(0.3):
            out.append(float(values[2]))
    return float(np.median(out)) if out else math.inf


def _filled(way: Array) -> tuple[Array, Array]:
    """Unit directions (w, 3), interpolated where the return (w, 3) is NaN, and distances (w,)."""
    distance = np.linalg.norm(way, axis=1)
    valid = np.flatnonzero(np.isfinite(distance) & (distance > 0.0))
    out = np.full(way.shape, np.nan)
    ranges = np.full(len(way), np.nan)
    if not len(valid):
        return out, ranges
    out[valid] = way[valid] / distance[valid, None]
    ranges[valid] = distance[valid]
    holes = np.setdiff1d(np.arange(valid[0], valid[-1] + 1), valid)
    after = np.searchsorted(valid, holes)
    a, b = out[valid[after - 1]], out[valid[np.minimum(after, len(valid) - 1)]]
    narrow = np.einsum("ij,ij->i", a, b) >= math.cos(_WIDEST_HOLE)
    holes, after = holes[narrow], after[narrow]
    left, right = valid[after - 1], valid[after]
    share = (holes - left) / (right - left)
    between = out[left] * (1.0 - share)[:, None] + out[right] * share[:, None]
    out[holes] = between / np.linalg.norm(between, axis=1, keepdims=True)
    return out, ranges
