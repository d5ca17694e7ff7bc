"""Which part of a joint a scan shows, and where along it to cut sections."""

from __future__ import annotations

import math

import numpy as np

from bimfit.geometry.line_scan import LineScan
from bimfit.geometry.path import JointPath
from bimfit.geometry.pose import Array
from bimfit.scan.cloud import PointCloud
from bimfit.scan.grid import StationGrid, within
from bimfit.scan.sweeps import CHUNK, Anchors, anchor_beams, trace_sweeps

NEAREST_SWEEPS = 1e-3
"""Sweeps nearer to one another than this share a station, m."""
SLICE_POINTS = 40
"""How many points within reach a slice of a cloud should have."""
MOST_STATIONS = 1000
NEAREST_SLICES = 5e-3
"""Slices of a cloud are at least this far apart: in less, nothing that is built moves, m."""
THIN = 0.01
"""Stations farther apart get slices no thicker, if the scan allows: a joint moves along its way, m."""
_HOLE, _FEW_HOLES = 0.25, 0.1
_CELL = 0.005
_CELL_POINTS = 3
_MOST_BEAMS = 500_000
_SWEEP_BEAMS = 40
_SAMPLE = 200_000
"""Returns near a joint that are looked at closely; a greater number is thinned out to this."""


def covers(scan: LineScan | PointCloud, path: JointPath, reach: float = 0.3) -> float:
    """Share of a joint's length along which the scan has returns within ``reach`` of it, 0 to 1.

    Parameters
    ----------
    scan : LineScan or PointCloud
    path : JointPath
    reach : float
        m.
    """
    s, _ = _along(scan, path, reach)
    cells, count = np.unique(np.floor(s / _CELL).astype(np.int64), return_counts=True)
    places = cells[count >= _CELL_POINTS] * _CELL
    if not len(places):
        return 0.0
    steps = np.diff(places)
    # sweeps may be farther apart than cells; what lies between two of the usual distance is covered
    apart = steps[steps > 1.5 * _CELL]
    usual = 1.5 * float(np.median(apart)) if len(apart) > len(places) / 3 else 4.0 * _CELL
    return float(min(1.0, (np.minimum(steps, usual).sum() + _CELL) / path.length))


def scan_stations(
    scan: LineScan | PointCloud, path: JointPath, spacing: float | None = None, reach: float = 0.3
) -> Array:
    """Where along a joint to cut sections.

    With ``spacing``, on the multiples of it that the scan covers. Without it, at every sweep that lies across
    the joint (sweeps within 1 mm of one another share a station), or such that slices of a cloud have about
    40 points within reach, but at least 5 mm apart, and no more of them than the cloud has rows.

    Parameters
    ----------
    scan : LineScan or PointCloud
    path : JointPath
    spacing : float, optional
        m.
    reach : float
        What counts as near the joint, m.

    Returns
    -------
    ndarray, shape (k,)
        Ascending, within [0, length]; empty where the scan does not show the joint.
    """
    sweeps = np.zeros(0)
    if isinstance(scan, LineScan) and _near(scan, path, reach):
        sweeps = sweep_positions(scan, _path_grid(path), path, reach)
    if spacing is not None:
        s = sweeps if len(sweeps) else _along(scan, path, reach)[0]
        return _on_grid(s, spacing, path.length)
    if len(sweeps):
        return _merged(sweeps, max(NEAREST_SWEEPS, path.length / MOST_STATIONS))
    s, count = _along(scan, path, reach)
    if not len(s):
        return s
    return _cloud_stations(s, count)


def _cloud_stations(s: Array, count: float) -> Array:
    """Stations of a cloud of ``count`` points from where a sample of them lies along the joint, s (m,).

    Evenly spread; but a cloud whose rows lie across the joint, farther apart than that, gets one a row.
    """
    low, high = np.quantile(s, [0.002, 0.998])
    extent = max(float(high - low), 1e-9)
    most = int(np.clip(count / SLICE_POINTS, 1, min(MOST_STATIONS, max(1.0, extent / NEAREST_SLICES))))
    stations = most
    while stations > 1 and _holes(s, low, extent / stations) > _FEW_HOLES:
        stations = min(stations - 1, int(stations / 1.05))
    if stations == most:
        return np.asarray(low + extent * (np.arange(stations) + 0.5) / stations)
    inside = np.sort(s[(s >= low) & (s <= high)])
    rows = np.split(inside, np.flatnonzero(np.diff(inside) > 0.25 * extent / stations) + 1)
    if len(rows) >= 0.8 * stations:
        return np.array([row.mean() for row in rows])
    places = np.histogram(s, stations, (low, high), weights=s)[0]
    filled = np.histogram(s, stations, (low, high))[0]
    return np.asarray(places[filled > 0] / filled[filled > 0])


def _holes(s: Array, low: float, cell: float) -> float:
    """Share of the cells that are all but empty beside a full one: high where points lie in rows.

    The highest of four, for cells that begin a quarter of a cell apart, since rows may lie on borders.
    """
    most = 0.0
    for start in low - cell * np.array([0.0, 0.25, 0.5, 0.75]):
        filled = np.bincount(np.maximum(np.floor((s - start) / cell), 0.0).astype(np.int64))
        around = np.maximum(np.r_[0, filled[:-1]], np.r_[filled[1:], 0])
        poor = filled < _HOLE * around
        most = max(most, float(poor.mean()))
    return most


def slice_thickness(
    scan: LineScan | PointCloud, path: JointPath, spacing: float | None, reach: float = 0.3
) -> float | None:
    """How thick slices are best made where stations have a given spacing, m; None leaves nothing out.

    Components may move within a wide spacing. A slice is then no thicker than 10 mm, or than the stations
    that the scan itself suggests are apart.
    """
    if spacing is None or spacing <= THIN:
        return None
    own = np.diff(scan_stations(scan, path, reach=reach))
    usual = float(np.quantile(own, 0.9)) if len(own) else spacing
    return min(spacing, max(THIN, usual * (1.0 + 1e-6)))


def sweep_positions(scan: LineScan, grid: StationGrid, path: JointPath, reach: float) -> Array:
    """Where the sweeps that lie across a joint cross it, ascending; those beyond its ends left out.

    A sweep that is no farther beyond an end than half the usual distance between sweeps counts as at the end.
    """
    scan = _thinned(scan)
    anchors = anchor_beams(scan, grid, reach)
    if not _any_return(scan, anchors):
        return np.zeros(0)
    sweeps = trace_sweeps(scan.scan[anchors.index], anchors)
    s = np.sort(sweeps.s[sweeps.transverse])
    steps = np.diff(s)
    steps = steps[steps > NEAREST_SWEEPS]
    slack = 0.5 * float(np.median(steps)) if len(steps) else NEAREST_SWEEPS
    s = s[(s >= -slack) & (s <= path.length + slack)]
    return np.asarray(np.clip(s, 0.0, path.length))


def _thinned(scan: LineScan) -> LineScan:
    """A large scan with fewer beams a sweep: enough to tell where each sweep lies."""
    numbers = int(np.count_nonzero(np.diff(scan.scan))) + 1
    stride = min(len(scan) // _MOST_BEAMS, len(scan) // numbers // _SWEEP_BEAMS)
    if stride < 2:
        return scan
    part = slice(None, None, stride)
    return LineScan(scan.scan[part], scan.origins[part], scan.directions[part], scan.ranges[part])


def _any_return(scan: LineScan, anchors: Anchors) -> bool:
    return bool(np.isfinite(scan.ranges[anchors.index]).any())


def _path_grid(path: JointPath) -> StationGrid:
    """Frames dense enough that a crossing found with one of them is right to a fraction of a millimetre."""
    count = int(np.clip(math.ceil(path.length / 0.01), 2, 2000)) if path.curved or len(path.u) > 1 else 2
    s = np.linspace(0.0, path.length, count + 1)
    return StationGrid.of([path.rough_frame(float(x)) for x in s], s)


def _near(scan: LineScan | PointCloud, path: JointPath, reach: float) -> bool:
    """Whether the boxes around scan and path meet: with many joints, most are settled by this."""
    low, high = path.points.min(axis=0) - reach, path.points.max(axis=0) + reach
    with np.errstate(invalid="ignore"):
        return bool(np.all(scan.bounds[0] <= high) and np.all(scan.bounds[1] >= low))


def _along(scan: LineScan | PointCloud, path: JointPath, reach: float) -> tuple[Array, float]:
    """Where along a path its neighbouring returns are, and about how many there are.

    Returns
    -------
    s : ndarray, shape (m,)
        Of an even sample of them, m; beyond the path's ends there are none.
    count : float
    """
    if not _near(scan, path, reach):
        return np.zeros(0), 0.0
    low, high = path.points.min(axis=0) - reach, path.points.max(axis=0) + reach
    found = []
    for start in range(0, len(scan), CHUNK):
        chunk = slice(start, start + CHUNK)
        if isinstance(scan, PointCloud):
            p = scan.points[chunk]
        else:
            p = scan.origins[chunk] + scan.directions[chunk] * scan.ranges[chunk, None]
        found.append(p[within(p, low, high)])
    p = np.concatenate(found) if found else np.zeros((0, 3))
    stride = max(1, len(p) // _SAMPLE)
    # drawn at random: files are ordered, and a fixed stride may walk along that order
    if stride > 1:
        p = p[np.sort(np.random.default_rng(0).integers(0, len(p), len(p) // stride))]
    s, distance = path.project(p)
    near = distance <= reach
    if not path.closed:
        ends = [path.rough_frame(0.0), path.rough_frame(path.length)]
        near &= ~((s <= 0.0) & ((p - ends[0].origin) @ ends[0].n < 0.0))
        near &= ~((s >= path.length) & ((p - ends[1].origin) @ ends[1].n > 0.0))
    return s[near], float(np.count_nonzero(near)) * stride


def _on_grid(s: Array, spacing: float, length: float) -> Array:
    if not len(s):
        return s
    stations = np.arange(math.floor(length / spacing * (1 + 1e-12) + 1e-9) + 1) * spacing
    low, high = s.min() - 0.5 * spacing, s.max() + 0.5 * spacing
    return np.asarray(np.minimum(stations[(stations >= low) & (stations <= high)], length))


def _merged(s: Array, least: float) -> Array:
    """Means of runs of ascending ``s`` that are each no longer than ``least``."""
    groups: list[list[float]] = []
    for value in s.tolist():
        if groups and value - groups[-1][0] < least:
            groups[-1].append(value)
        else:
            groups.append([value])
    return np.array([sum(group) / len(group) for group in groups])
