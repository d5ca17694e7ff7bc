"""What was read, in a line that a user can check."""

from __future__ import annotations

import numpy as np

from bimfit.geometry.line_scan import LineScan
from bimfit.geometry.pose import Array
from bimfit.scan.cloud import PointCloud
from bimfit.scan.formats.options import unit_name

_MOST_PLACES = 3
_MOST_MOVES = 10_000
"""A sensor that moved more often is not looked at for places that it came back to."""
_SAME_PLACE = 1e-6


def summary(scan: LineScan | PointCloud, form: str, unit: float) -> str:
    """Say what a scan holds.

    Parameters
    ----------
    scan : LineScan or PointCloud
        In metres.
    form : str
        The format's name.
    unit : float
        Metres a unit of length in the file.
    """
    if isinstance(scan, PointCloud):
        parts = [f"{len(scan):,} points"]
        parts.append(seen_from(scan.viewpoint))
    else:
        silent = int(np.count_nonzero(~scan.returned))
        parts = [f"{len(scan):,} beams in {len(scan.sweeps):,} sweeps", f"{silent:,} without return"]
        parts.append(seen_from(scan.origins))
    parts.append(f"stored in {unit_name(unit)}")
    low, high = scan.bounds
    if np.isfinite(low).all():
        parts.append(f"from {_at(low)} to {_at(high)} m")
    return f"{form}: {', '.join(parts)}"


def seen_from(origins: Array | None) -> str:
    """Where the sensor was: places of shape (3,) or (n, 3), a row a beam; None where that is not known."""
    if origins is None or not origins.size:
        return "sensor position unknown"
    rows = origins.reshape(-1, 3)
    move = np.flatnonzero((np.abs(np.diff(rows, axis=0)) > _SAME_PLACE).any(axis=1)) + 1
    count = len(move) + 1
    if count <= _MOST_MOVES:
        seen = np.unique(np.round(rows[np.r_[0, move]] / _SAME_PLACE), axis=0) * _SAME_PLACE
        count = len(seen)
        if count <= _MOST_PLACES:
            return "seen from " + " and ".join(map(_at, seen))
    return f"seen from {count:,} places between {_at(rows.min(axis=0))} and {_at(rows.max(axis=0))}"


def _at(point: Array) -> str:
    return "(" + ", ".join(f"{x:.10g}" for x in np.round(np.asarray(point, float), 4) + 0.0) + ")"
