"""Which station the beams of a line scan belong to."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from bimfit.geometry.line_scan import LineScan
from bimfit.geometry.pose import Array
from bimfit.scan.grid import Ids, Mask, StationGrid, ray_enters, within

CHUNK = 1 << 20
TRANSVERSE = math.tan(math.radians(10.0))
"""Sweeps whose trace on the joint runs at most this far along it for its width are whole sections."""
_LEVEL = 1e-3
_FLAT = 0.05
"""Beams less inclined to the joint's surface than this (sine) do not cross it anywhere definite."""


@dataclass(frozen=True)
class Anchors:
    """Where beams near a joint cross it.

    Attributes
    ----------
    index : ndarray, shape (m,)
        Which beams of the scan come near the joint.
    station : ndarray, shape (m,)
        The station that each crosses nearest.
    s, u : ndarray, shape (m,)
        Where it crosses the frames' v = 0, along and across the joint, m.
    crosses : ndarray, shape (m,), bool
        Whether it really does so within reach; else it is placed by its return, or by where it passes.
    """

    index: Ids
    station: Ids
    s: Array
    u: Array
    crosses: Mask


def anchor_beams(scan: LineScan, grid: StationGrid, reach: float) -> Anchors:
    """Find the beams that come within ``reach`` of a joint, and where they cross it.

    A beam crosses the joint where it meets v = 0, which beams that return nothing do as well.
    """
    low, high = grid.box(math.sqrt(2.0) * reach)
    parts = []
    for start in range(0, len(scan), CHUNK):
        chunk = slice(start, start + CHUNK)
        o, d, r = scan.origins[chunk], scan.directions[chunk], scan.ranges[chunk]
        near = np.flatnonzero(ray_enters(o, d, low, high) <= np.where(np.isnan(r), np.inf, r))
        if len(near):
            parts.append((near + start, *_anchor(o[near], d[near], r[near], grid, reach)))
    if not parts:
        nothing = np.zeros(0)
        return Anchors(nothing.astype(np.int64), nothing.astype(np.int64), nothing, nothing, nothing > 0)
    index, station, s, u, crosses = (np.concatenate(column) for column in zip(*parts, strict=True))
    return Anchors(index, station, s, u, crosses)


def _anchor(o: Array, d: Array, r: Array, grid: StationGrid, reach: float) -> tuple[Ids, Array, Array, Mask]:
    hit = np.isfinite(r)
    hits = o + d * np.where(hit, r, 0.0)[:, None]
    at_hit = grid.nearest(hits)
    k = at_hit.copy()
    p = hits.copy()
    crosses = np.zeros(len(o), bool)
    for _ in range(2 if grid.straight else 5):  # the frame decides the crossing, the crossing the frame
        lean = grid.turn(d, k)[:, 1]
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            t = -grid.local(o, k)[:, 1] / lean
        crosses = (np.abs(lean) > _FLAT) & (t > 0.0)
        p = np.where(crosses[:, None], o + d * np.where(crosses, t, 0.0)[:, None], hits)
        k = np.where(crosses, grid.nearest(p), k)
    local = grid.local(p, k)
    crosses &= np.abs(local[:, 0]) <= reach
    # An upstand's face is met before v = 0 is: there the return says where.
    seen = grid.local(hits, at_hit)
    by_hit = ~crosses & hit & within(seen[:, :2], (-reach, -reach), (reach, reach))
    k = np.where(by_hit, at_hit, k)
    local = np.where(by_hit[:, None], seen, local)
    passing = np.flatnonzero(~crosses & ~by_hit)
    if len(passing):
        t = np.maximum(np.einsum("ij,ij->i", grid.origins[k[passing]] - o[passing], d[passing]), 0.0)
        p = o[passing] + d[passing] * t[:, None]
        k[passing] = grid.nearest(p)
        local[passing] = grid.local(p, k[passing])
    return k, grid.s[k] + local[:, 2], local[:, 0], crosses


@dataclass(frozen=True)
class Sweeps:
    """The sweeps that come near a joint.

    Attributes
    ----------
    member : ndarray, shape (m,)
        For every anchored beam, its row in what follows.
    number : ndarray, shape (w,)
        The sweeps' numbers in the scan.
    s : ndarray, shape (w,)
        Where each crosses the joint's middle, m; NaN where it is not transverse.
    transverse : ndarray, shape (w,), bool
        Whether a sweep lies across the joint, so that it is one section.
    """

    member: Ids
    number: Ids
    s: Array
    transverse: Mask


def trace_sweeps(numbers: Ids, anchors: Anchors) -> Sweeps:
    """Fit a line s = a + b u to where each sweep crosses the joint, and tell which lie across it.

    Parameters
    ----------
    numbers : ndarray, shape (m,)
        The anchored beams' sweep numbers.
    anchors : Anchors
    """
    known, member = np.unique(numbers, return_inverse=True)
    member = member.reshape(-1).astype(np.int64)
    count = len(known)
    use = anchors.crosses
    rows, s, u = member[use], anchors.s[use], anchors.u[use]

    def total(values: Array) -> Array:
        return np.asarray(np.bincount(rows, values, count), np.float64)

    with np.errstate(divide="ignore", invalid="ignore"):
        number = total(np.ones(len(rows)))
        mean_s, mean_u = total(s) / number, total(u) / number
        ds, du = s - mean_s[rows], u - mean_u[rows]
        var_s, var_u, mixed = total(ds * ds) / number, total(du * du) / number, total(ds * du) / number
        slope = np.where(var_u > _LEVEL**2, mixed / var_u, 0.0)
        transverse = (number >= 3) & (var_s <= TRANSVERSE**2 * var_u + (0.5 * _LEVEL) ** 2)
    return Sweeps(member, known, np.where(transverse, mean_s - slope * mean_u, np.nan), transverse)
