"""How far each beam's range deviates: sigma that grows with range, and neighbours whose noise goes together.

Residuals are compared with what a single range deviates by. In the likelihood, neighbours that go together
count for what they are worth: noise with a lag-1 correlation rho is a first-order autoregression, and in the
best linear estimate of what k returns have in common (the row sums of the inverse of its covariance) each
weighs 1 / (1 + rho^g) + 1 / (1 + rho^h) - 1, g and h beams away from the returns beside it. That is
f = (1 - rho) / (1 + rho) in the middle of a run, but 1 / (1 + rho) at its end, where a corner lies.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from bimfit.config import SensorConfig
from bimfit.estimation.likelihood import BeamSet, Ints
from bimfit.geometry.pose import Array


def with_spread(beams: BeamSet, sensor: SensorConfig, distance: float, expected: Array | None) -> BeamSet:
    """Beams that know how far each of them deviates, relative to ``sensor.at(distance)``.

    Parameters
    ----------
    sensor : SensorConfig
        As it is, with its growth and its correlation.
    distance : float
        The typical range, m.
    expected : ndarray, shape (n,), or None
        Range that each beam should measure, m, inf where it meets nothing: what was measured will not do,
        for short ranges would seem better than long ones. None where sigma does not grow.
    """
    spread = None
    if expected is not None:
        ranges = np.where(np.isfinite(expected), expected, distance)
        spread = np.array([sensor.growth(r) for r in ranges.tolist()]) / sensor.growth(distance)
    scale = spread
    if sensor.correlation > 0.0:
        alone = np.sqrt(sensor.independent_share / run_weights(beams.r, beams.start, sensor.correlation))
        scale = alone if spread is None else alone * spread
    return beams if scale is None else replace(beams, spread=spread, scale=scale)


def run_weights(r: Array, start: Ints, rho: float) -> Array:
    """What each return is worth among its neighbours, shape (n,); 1 for beams that returned nothing.

    Parameters
    ----------
    r : ndarray, shape (n,)
        Ranges in the order of the beams, negative where nothing came back.
    start : ndarray, shape (g + 1,)
        First beam of every group; groups are independent.
    """
    weight = np.ones(len(r))
    hit = np.flatnonzero(r > 0.0)
    if not len(hit):
        return weight
    group = np.searchsorted(start, hit, side="right")
    apart = np.where(group[1:] == group[:-1], np.diff(hit).astype(float), np.inf)
    share = 1.0 / (1.0 + rho ** np.concatenate([[np.inf], apart, [np.inf]]))
    weight[hit] = share[1:] + share[:-1] - 1.0
    return weight
