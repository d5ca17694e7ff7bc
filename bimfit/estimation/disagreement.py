"""Which stations disagree with the motion along their joint, once what is no error of theirs is allowed for.

Two things make a Gaussian distance wrong. A drop-out beside a component's edge moves the edge by whole beams,
always away from the gap: seldom, but far more often than a Gaussian has it. And a kinked motion that bends at
three stations in a row follows the middle one wherever it is, so that nothing but itself bears it out.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from bimfit.estimation.borrow import FLAG
from bimfit.estimation.result import StationEstimate
from bimfit.estimation.trend import Sites, Trend, left_out
from bimfit.geometry.joint_section import JointSection
from bimfit.geometry.pose import Array

_LOST = 3
"""So many lost beams in a row are looked at."""
_LEAST, _GREATEST = 1e-4, 0.4
"""Bounds of the share of lost beams."""
_ANOTHER = 0.010
"""A place that far away, or most of a gap, may be another gap, m."""


def disagreements(
    stations: Sequence[StationEstimate],
    sections: Sequence[JointSection],
    parts: tuple[Sites, Sites],
    fits: tuple[Trend, Trend],
    knots: Array,
) -> tuple[Trend, Trend]:
    """The trends, their distances corrected for lost beams beside an edge and for stations that stand alone.

    Parameters
    ----------
    knots : ndarray, shape (k,)
        Where along the joint a kinked motion bends, m; empty for other motions.
    """
    distances = [fit.distance.copy() for fit in fits]
    share = _lost_share(stations)
    for sites, fit, distance, sign in zip(parts, fits, distances, (-1.0, 1.0), strict=True):
        far = np.flatnonzero(distance > FLAG)
        if not len(far):
            continue
        e, spread = left_out(sites, fit.weight, fit.value, fit.covariance)
        for i in far.tolist():
            step = sign * _beam_width(stations[i], sections[i], parts, i)
            distance[i] = _with_lost_beams(e[i], spread[i], step, share)
    for i in _alone(parts[0].s, knots):
        width = float(np.hypot(*(sections[i].gap.mouth[1] - sections[i].gap.mouth[0])))
        jumps = [_off_neighbours(sites, fit, i) for sites, fit in zip(parts, fits, strict=True)]
        both = all(d > FLAG for _, d in jumps)
        near = all(size < max(_ANOTHER, 0.8 * width) for size, _ in jumps)
        if both and near:  # the joint has moved, or the sensor: the components say so independently
            continue
        for distance, (_, d) in zip(distances, jumps, strict=True):
            distance[i] = max(distance[i], d)
    a, b = (replace(fit, distance=d) for fit, d in zip(fits, distances, strict=True))
    return a, b


def _lost_share(stations: Sequence[StationEstimate]) -> float:
    """Share of beams that should meet a component and do not return from it, as the joint shows it.

    The sensor's own shares, which are never under 0.01 each, count as one beam's: at their price a jump by a
    beam's width could always be a lost beam.
    """
    lost, covered = max((e.sensor.miss_share + e.sensor.outlier_share for e in stations), default=0.0), 1.0
    for c in (c for station in stations for c in station.components if c.status.measured):
        r = c.residuals
        lost += (r.miss_share + r.outlier_share) * r.n_covered
        covered += r.n_covered
    return min(max(lost / covered, _LEAST), _GREATEST)


def _with_lost_beams(e: Array, spread: Array, step: float, share: float) -> float:
    """Least squared distance if up to three beams beside the edge were lost, each at its own price.

    Parameters
    ----------
    e, spread : ndarray, shape (3,) and (3, 3)
        Off by how much in (u, v, theta), and its covariance.
    step : float
        What a lost beam moves the edge by along u, m, signed.
    share : float
        Of beams that are lost: k of them in a row have a probability of share^k.
    """
    inverse = np.linalg.inv(spread)
    price = 2.0 * math.log((1.0 - share) / share)
    best = float(e @ inverse @ e)
    for k in range(1, _LOST + 1 if step != 0.0 else 1):
        rest = e - np.array([k * step, 0.0, 0.0])
        best = min(best, float(rest @ inverse @ rest) + k * price)
    return max(best, 0.0)


def _beam_width(station: StationEstimate, section: JointSection, parts: tuple[Sites, Sites], i: int) -> float:
    """How far apart two beams are across the gap, m: its width over how many of them it takes; 0 unknown."""
    beams = abs(station.components[1].corner_step - station.components[0].corner_step)
    if not math.isfinite(beams) or beams < 0.5:
        return 0.0
    a, b = (m + sites.value[i, :2] for m, sites in zip(section.gap.mouth, parts, strict=True))
    return float(np.hypot(*(b - a))) / beams


def _alone(s: Array, knots: Array) -> list[int]:
    """Stations that are bends, as both of their neighbours are."""
    at = np.searchsorted(s, knots)
    return [int(at[j]) for j in range(1, len(at) - 1) if at[j + 1] - at[j - 1] == 2]


def distance_off(sites: Sites, fit: Trend, i: int) -> float:
    """How far a station is off the trend, m, or off its neighbours where the trend bends to follow it."""
    off = float(np.hypot(*(sites.value[i] - fit.value[i])[:2]))
    return max(off, _off_neighbours(sites, fit, i)[0]) if 0 < i < len(sites.s) - 1 else off


def _off_neighbours(sites: Sites, fit: Trend, i: int) -> tuple[float, float]:
    """How far a station is off the line through its neighbours' values, m, and squared in deviations."""
    w = (sites.s[i] - sites.s[i - 1]) / (sites.s[i + 1] - sites.s[i - 1])
    e = sites.value[i] - (1.0 - w) * fit.value[i - 1] - w * fit.value[i + 1]
    own = np.linalg.inv(sites.precision[i] + np.diag([400.0, 400.0, 4.0]))
    spread = own + (1.0 - w) ** 2 * fit.covariance[i - 1] + w**2 * fit.covariance[i + 1]
    return float(np.hypot(*e[:2])), float(e @ np.linalg.solve(spread, e))
