"""Cut a scan into slices at the stations of a joint."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from bimfit.geometry.frame import SectionFrame
from bimfit.geometry.line_scan import LineScan
from bimfit.geometry.pose import Array
from bimfit.geometry.slice import Beams, Slice
from bimfit.scan.cloud import PointCloud
from bimfit.scan.coverage import covers, scan_stations
from bimfit.scan.grid import Ids, StationGrid, grouped, ray_enters, within
from bimfit.scan.sweeps import CHUNK, Anchors, Sweeps, anchor_beams, trace_sweeps

__all__ = ["covers", "cut_slices", "scan_stations"]

_LEAST_SCALE = 0.3
"""Beams that run along the joint more steeply than this (sine) say nothing in the section plane."""


def cut_slices(
    scan: LineScan | PointCloud,
    frames: Sequence[SectionFrame],
    stations: ArrayLike,
    *,
    thickness: float | None = None,
    reach: float = 0.3,
) -> tuple[Slice, ...]:
    """Cut a scan at every station of a joint, in one pass.

    Line scans: a sweep that lies across the joint (within 10 degrees) goes to the one station that it crosses
    nearest, as a whole; several sweeps at a station are combined. Sweeps that do not lie across the joint,
    such as those of a rotating scanner, are split beam by beam, each beam going where it crosses v = 0; a
    station that has whole sweeps takes none of these. Beams are projected into the section plane. Kept are
    those that pass within reach: returns there, beams that came back from behind (evidence of the gap), and
    beams that did not come back.

    Point clouds: slabs about each section plane.

    Parameters
    ----------
    scan : LineScan or PointCloud
    frames : sequence of SectionFrame
        In order along the joint.
    stations : array_like, shape (k,)
        Their distances along the joint, m.
    thickness : float, optional
        How much along the joint makes a slice, m. None: up to midway to the neighbours.
    reach : float
        Half side of the window about each frame's origin, in u and v, m.

    Returns
    -------
    tuple of Slice
        One a station; without points where the scan shows nothing.

    Raises
    ------
    ValueError
        When frames and stations differ in number.
    """
    grid = StationGrid.of(frames, stations)
    if not len(grid):
        return ()
    if isinstance(scan, PointCloud):
        return _cut_cloud(scan, grid, thickness, reach)
    return _cut_beams(scan, grid, thickness, reach)


# -- line scans ------------------------------------------------------------------------------------


def _cut_beams(scan: LineScan, grid: StationGrid, thickness: float | None, reach: float) -> tuple[Slice, ...]:
    anchors = anchor_beams(scan, grid, reach)
    sweeps = trace_sweeps(scan.scan[anchors.index], anchors)
    station = assign_stations(anchors, sweeps, grid, thickness)
    chosen = np.flatnonzero(station >= 0)
    index, k = anchors.index[chosen], station[chosen]

    origin = grid.local(scan.origins[index], k)[:, :2]
    direction = grid.turn(scan.directions[index], k)[:, :2]
    scale = np.hypot(direction[:, 0], direction[:, 1])
    steep = scale < _LEAST_SCALE
    scale = np.where(steep, 1.0, scale)
    direction = direction / scale[:, None]
    ranges = scan.ranges[index] * scale
    enters = ray_enters(origin, direction, (-reach, -reach), (reach, reach))
    keep = np.flatnonzero(~steep & np.isfinite(enters) & ~(ranges < enters))

    order, bounds = grouped(k[keep], len(grid))
    order = keep[order]
    numbers = scan.scan[index]
    slices = []
    for i, s in enumerate(grid.s.tolist()):
        rows = order[bounds[i] : bounds[i + 1]]
        beams = Beams(origin[rows], direction[rows], ranges[rows])
        eye = origin[rows].mean(axis=0) if len(rows) else None
        slices.append(Slice(s, beams.points, beams, eye, len(np.unique(numbers[rows]))))
    return tuple(slices)


def assign_stations(anchors: Anchors, sweeps: Sweeps, grid: StationGrid, thickness: float | None) -> Ids:
    """Station of every anchored beam, shape (m,); -1 where it belongs to none.

    Every transverse sweep goes to one station or to none, as a whole.
    """
    low, high = _cells(grid.s, thickness)
    nearest = nearest_station(sweeps.s, grid.s)
    with np.errstate(invalid="ignore"):
        inside = (sweeps.s >= low[nearest]) & (sweeps.s <= high[nearest])
    of_sweep = np.where(sweeps.transverse & inside, nearest, -1)
    station = of_sweep[sweeps.member]

    served = np.zeros(len(grid), bool)
    served[of_sweep[of_sweep >= 0]] = True
    single = ~sweeps.transverse[sweeps.member]
    k = anchors.station
    single &= (anchors.s >= low[k]) & (anchors.s <= high[k]) & ~served[k]
    return np.where(single, k, station)


def nearest_station(s: Array, stations: Array) -> Ids:
    """Index of the station nearest to each ``s`` (m,); of two as near, the earlier. ``stations`` ascend."""
    return np.searchsorted(0.5 * (stations[1:] + stations[:-1]), s).astype(np.int64)


def _cells(s: Array, thickness: float | None) -> tuple[Array, Array]:
    """From where to where along the joint each station takes what it gets, (k,) each."""
    if len(s) == 1:
        half = np.array([math.inf if thickness is None else 0.5 * thickness])
        return s - half, s + half
    steps = np.diff(s)
    before, after = np.r_[steps[0], steps] / 2, np.r_[steps, steps[-1]] / 2
    # a little more, so that rounding loses nothing at the outer ends; neighbours are told apart by nearness
    before, after = before * (1 + 1e-9) + 1e-9, after * (1 + 1e-9) + 1e-9
    if thickness is not None:
        before, after = np.minimum(before, 0.5 * thickness), np.minimum(after, 0.5 * thickness)
    return s - before, s + after


# -- point clouds ----------------------------------------------------------------------------------


def _cut_cloud(
    cloud: PointCloud, grid: StationGrid, thickness: float | None, reach: float
) -> tuple[Slice, ...]:
    thick = thickness if thickness is not None else (grid.spacing if len(grid) > 1 else 2.0 * reach)
    # slabs thicker than the spacing overlap: a point then belongs to several neighbours
    spread = (
        0 if len(grid) == 1 else math.ceil(max(0.0, thick / max(np.diff(grid.s).min(), 1e-9) - 1.0) / 2.0)
    )
    low, high = grid.box(math.sqrt(2.0) * reach + 0.5 * thick)
    owners, places = [], []
    for start in range(0, len(cloud), CHUNK):
        points = cloud.points[start : start + CHUNK]
        points = points[within(points, low, high)]
        if not len(points):
            continue
        nearest = grid.nearest(points)
        for offset in range(-spread, spread + 1):
            k = nearest + offset
            valid = (k >= 0) & (k < len(grid))
            chosen = points
            if not valid.all():
                k, chosen = k[valid], points[valid]
            local = grid.local(chosen, k)
            half = (reach, reach, 0.5 * thick)
            inside = within(local, np.negative(half), half)
            owners.append(k[inside])
            places.append(local[inside, :2])
    k = np.concatenate(owners) if owners else np.zeros(0, np.int64)
    uv = np.concatenate(places) if places else np.zeros((0, 2))
    order, bounds = grouped(k, len(grid))
    uv = uv[order]
    eyes = None
    if cloud.viewpoint is not None:
        everywhere = np.broadcast_to(cloud.viewpoint, (len(grid), 3))
        eyes = grid.local(everywhere, np.arange(len(grid)))[:, :2]
    return tuple(
        Slice(s, uv[bounds[i] : bounds[i + 1]].copy(), None, None if eyes is None else eyes[i])
        for i, s in enumerate(grid.s.tolist())
    )
